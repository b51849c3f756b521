"""What joining, leaving and dying costs the loop: `uv run python -m tests.benchmarks.joins_and_leaves`, as root.

Plant, controller and third party are on hosts of their own (network namespaces), at 500 Hz with the default settings;
`--realtime strict` demands SCHED_FIFO of both ends. `third_parties.py` starts programs, whose start-up alone costs
ticks on two cores. Here every guest is a process that was started, has imported all and has had a Zenoh session before;
it then joins, leaves, ends or is killed while nothing else begins.

An observer subscribes to what `op top` shows; a recorder to all that is recorded, with the history that the ends'
caches hold. Each event is measured in turns with a window of the same length in which nothing happens. Windows run from
one status of both ends to another, 4 s and at most a second more. Printed are the ticks skipped by both ends in each
window, their medians, the ratio of the sums and the sessions lost.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.history import RecoveringSubscriber
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from tests.support.namespaces import Hosts

WINDOW_S: Final = 4.0
LEAD_S: Final = 0.5
"""From the start of a window to its event [s]."""
SETTLE_S: Final = 2.0
PATIENCE_S: Final = 60.0
TAKE_S: Final = 0.1
TRIALS: Final = 10

EVENTS: Final = (
    "observer joins",
    "observer leaves",
    "observer ends by os._exit",
    "observer is killed",
    "recorder joins",
    "recorder is killed",
)


# ── the guest, a process on the third host ──


def be_a_guest(rendezvous: list[str]) -> None:
    """Follow lines of stdin: observe, record, leave, exit. Prints a line when each is done."""
    join(NetworkSettings(rendezvous=[]), listen=False).close()  # Zenoh's threads are there from now on
    settings = NetworkSettings(rendezvous=rendezvous, insecure=True)
    session: zenoh.Session | None = None
    recorded: list[RecoveringSubscriber] = []
    say("ready")
    while True:
        if not select.select([sys.stdin], [], [], TAKE_S if recorded else None)[0]:
            for subscriber in recorded:
                subscriber.take()
            continue
        word = os.read(0, 100).decode().strip()
        if word in ("observe", "record"):
            session = join(settings)
            if word == "record":
                recorded = [RecoveringSubscriber(session, topics.key(name, "*")) for name in topics.RECORDED]
            else:
                for topic in ("status", "event", "telemetry", "truth"):
                    session.declare_subscriber(topics.key(topic, "*"), lambda _: None)
        elif word == "leave" and session is not None:
            session.close()
        else:  # `exit`, or the end of stdin
            os._exit(0)
        say(word)


def say(word: str) -> None:
    """Print a line at once."""
    sys.stdout.write(word + "\n")
    sys.stdout.flush()


# ── the measurement ──


class Guest:
    """A guest that is ready and has not joined."""

    def __init__(self, hosts: Hosts, said: Path) -> None:
        self._said = said
        words = ["-m", "tests.benchmarks.joins_and_leaves", "--guest", json.dumps(hosts.rendezvous)]
        self._process = hosts.python("third", *words, stdin=subprocess.PIPE, stdout=said)

    def await_said(self, word: str) -> None:
        """Wait until it has printed a line."""
        until(f"a guest's {word!r}", lambda: word in self._said.read_text().split())

    def order(self, word: str) -> None:
        """Send it a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{word}\n".encode())
        self._process.stdin.flush()

    def kill(self) -> None:
        """End it by SIGKILL."""
        self._process.kill()
        self._process.wait()


class Totals(NamedTuple):
    """Ticks skipped by both ends and sessions lost, since the start."""

    skipped: int
    lost: int


class Watch:
    """Statuses and events in the file that a watcher on the plant's host writes."""

    def __init__(self, path: Path) -> None:
        self._file = path.open()
        self._rest = ""
        self._skipped: dict[str, int] = {}
        self._lost = 0
        self._new: set[str] = set()
        self.state: dict[str, str] = {}
        self.notes: dict[str, list[str]] = {}

    def read(self) -> None:
        """Read what is new."""
        *lines, self._rest = (self._rest + self._file.read()).split("\n")
        for line in map(json.loads, lines):
            if "skipped" in line:
                role = line["role"]
                self._skipped[role], self.state[role], self.notes[role] = line["skipped"], line["state"], line["notes"]
                self._new.add(role)
            else:
                self._lost += line.get("kind") == "tripped"

    def totals(self) -> Totals:
        """Those of the next status of each end."""
        self.read()
        self._new.clear()
        until("a status of both ends", self._both)
        return Totals(sum(self._skipped.values()), self._lost)

    def driven(self) -> bool:
        """Whether the plant is driven."""
        self.read()
        return self.state.get("plant") == "driven" and self._both()

    def _both(self) -> bool:
        self.read()
        return self._new >= {"plant", "controller"}


def until(what: str, condition: Callable[[], bool]) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"{what} did not come within {PATIENCE_S:g} s")
        time.sleep(0.02)


def window(watch: Watch, happens: Callable[[], object]) -> Totals:
    """Ticks skipped and sessions lost in a window with an event."""
    before = watch.totals()
    begun = time.monotonic()
    time.sleep(LEAD_S)
    happens()
    time.sleep(max(0.0, begun + WINDOW_S - time.monotonic()))
    after = watch.totals()
    return Totals(after.skipped - before.skipped, after.lost - before.lost)


def main(trials: int, realtime: str) -> None:
    """Run all events in turns, and print a line for each."""
    quiet: dict[str, list[Totals]] = {title: [] for title in EVENTS}
    found: dict[str, list[Totals]] = {title: [] for title in EVENTS}
    with tempfile.TemporaryDirectory() as name, Hosts(["plant", "controller", "third"], Path(name)) as hosts:
        folder = Path(name)
        overrides = [f"loop.realtime={realtime}"]
        hosts.aeroloop("plant", "emulator", overrides=overrides)
        hosts.aeroloop("controller", "controller", "--auto-arm", overrides=overrides)
        hosts.watch("plant", folder / "seen")
        watch = Watch(folder / "seen")
        until("a driven plant", watch.driven)
        refused = {role: notes for role, notes in watch.notes.items() if notes}
        print(f"loop.realtime = {realtime}; refused by this host: {refused or 'nothing'}", flush=True)

        def measure(title: str, happens: Callable[[], object]) -> None:
            quiet[title].append(window(watch, lambda: None))
            found[title].append(window(watch, happens))

        for trial in range(trials):
            guests = [Guest(hosts, folder / f"guest-{trial}-{i}") for i in range(4)]
            for guest in guests:
                guest.await_said("ready")
            passing, ending, killed, recording = guests
            time.sleep(SETTLE_S)
            measure("observer joins", lambda guest=passing: guest.order("observe"))  # type: ignore[misc]
            measure("observer leaves", lambda guest=passing: guest.order("leave"))  # type: ignore[misc]
            for guest in (ending, killed):
                guest.order("observe")
                guest.await_said("observe")
            time.sleep(SETTLE_S)
            measure("observer ends by os._exit", lambda guest=ending: guest.order("exit"))  # type: ignore[misc]
            measure("observer is killed", killed.kill)
            measure("recorder joins", lambda guest=recording: guest.order("record"))  # type: ignore[misc]
            measure("recorder is killed", recording.kill)
            passing.kill()
            until("a driven plant", watch.driven)
    for title in EVENTS:
        print(_line(title, quiet[title], found[title]))


def _line(title: str, quiet: list[Totals], found: list[Totals]) -> str:
    calm, disturbed = [one.skipped for one in quiet], [one.skipped for one in found]
    ratio = f"{sum(disturbed) / sum(calm):.2f}" if sum(calm) else "–"
    medians = f"median {median(disturbed):g}, with nothing {median(calm):g}; ratio of the sums {ratio}"
    lost = f"sessions lost {sum(one.lost for one in found)}, with nothing {sum(one.lost for one in quiet)}"
    return f"{title:26} {medians}; {lost}\n    ticks skipped {disturbed}\n    with nothing  {calm}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trials", nargs="?", type=int, default=TRIALS)
    parser.add_argument("--realtime", choices=["off", "try", "strict"], default="try")
    parser.add_argument("--guest", type=json.loads, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.guest:
        be_a_guest(given.guest)
    else:
        main(given.trials, given.realtime)
