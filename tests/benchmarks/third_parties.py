"""What a third party's troubles cost the loop: `uv run python -m tests.benchmarks.third_parties [TRIALS]`, as root.

Plant, controller and third party are on hosts of their own (network namespaces), at 500 Hz with the default settings.
Each trouble is repeated; printed are the sessions lost and the ticks skipped by both ends, trial by trial, beside those
of as many undisturbed stretches of the same length.
"""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from subprocess import Popen
from typing import Any

from tests.support.namespaces import Hosts

AWAY_S = 2.0
LONG_S = 25.0
"""Longer than the lease of links between hosts, 10 s: these are closed meanwhile [s]."""
THIRDS = ("third", "third2", "third3", "third4")
SETTLE_S = 2.0
TRIALS = 10

Parties = dict[str, Popen[bytes]]


def totals(seen: list[dict[str, Any]]) -> tuple[int, int]:
    """Sessions lost, and ticks skipped by both ends so far, by statuses and events."""
    skipped = {line["role"]: line["skipped"] for line in seen if "skipped" in line}
    return sum(line.get("kind") == "tripped" for line in seen), skipped["plant"] + skipped["controller"]


def main(trials: int) -> None:
    """Run all troubles and print a line for each."""
    with tempfile.TemporaryDirectory() as name, Hosts(["plant", "controller", *THIRDS], Path(name)) as hosts:
        folder = Path(name)
        hosts.aeroloop("plant", "plant")
        hosts.aeroloop("controller", "controller", "--auto-arm")
        seen, logs = hosts.watch("plant"), count()

        def recorder(host: str = "third") -> Popen[bytes]:
            return hosts.aeroloop(host, "recorder", "--log", str(folder / f"{next(logs)}.mcap"))

        def operator() -> Popen[bytes]:
            return hosts.aeroloop("third", "op", "top")

        def cable_out(_: Parties) -> None:
            hosts.pull("third")
            time.sleep(AWAY_S)
            hosts.plug("third")

        def four_cables_out(_: Parties) -> None:
            for host in THIRDS:
                hosts.pull(host)
            time.sleep(LONG_S)
            for host in THIRDS:
                hosts.plug(host)

        def narrow(_: Parties) -> None:
            hosts.narrow("third", 64)
            time.sleep(2 * AWAY_S)
            hosts.plug("third")

        def halted(parties: Parties) -> None:
            for party in parties.values():
                party.send_signal(signal.SIGSTOP)
            time.sleep(AWAY_S)
            for party in parties.values():
                party.send_signal(signal.SIGCONT)

        def killed(parties: Parties) -> None:
            for name, start in starts.items():
                if name in parties:
                    parties[name].kill()
                    parties[name].wait()
                    parties[name] = start()

        def joins_and_leaves(_: Parties) -> None:
            for party in (recorder(), operator()):
                time.sleep(AWAY_S)
                party.terminate()
                party.wait()

        starts: dict[str, Callable[[], Popen[bytes]]] = {"recorder": recorder, "operator": operator}
        starts |= {host: partial(recorder, host) for host in THIRDS}
        troubles: list[tuple[str, list[str], Callable[[Parties], None]]] = [
            ("nothing", ["recorder", "operator"], lambda _: time.sleep(AWAY_S)),
            ("the recorder's cable out for 2 s", ["recorder"], cable_out),
            ("an operator's cable out for 2 s", ["operator"], cable_out),
            ("a link of 64 kbit/s for 4 s", ["recorder", "operator"], narrow),
            ("both halted for 2 s", ["recorder", "operator"], halted),
            ("both killed and started again", ["recorder", "operator"], killed),
            ("a recorder and an operator join and leave", [], joins_and_leaves),
            ("four recorders' cables out for 25 s", list(THIRDS), four_cables_out),
        ]
        time.sleep(2 * SETTLE_S)
        for title, names, happens in troubles:
            parties = {name: starts[name]() for name in names}
            time.sleep(2 * SETTLE_S)
            lost, skipped = [], []
            for _ in range(trials):
                before = totals(seen())
                happens(parties)
                time.sleep(SETTLE_S)
                after = totals(seen())
                lost.append(after[0] - before[0])
                skipped.append(after[1] - before[1])
            for party in parties.values():
                party.terminate()
                party.wait()
            print(f"{title:44} sessions lost {sum(lost)} of {trials}, ticks skipped {skipped}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else TRIALS)
