"""Recorder process beside a running loop: late, killed, cut off, rotated, on a full disk.

Each end caches its last minute of trace, so in all of these cases a log lacks no tick of either end; `log review` and
`log replay` confirm it.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from aeroloop.protocol.messages.models import Status
from aeroloop.protocol.messages.topics import key
from aeroloop.service.config import Settings, load
from aeroloop.service.logs.recording import Recording
from aeroloop.service.logs.replay import replay
from aeroloop.service.recording.rolling import CHUNK_S
from aeroloop.service.review.report import Findings
from aeroloop.service.review.review import read, review
from aeroloop.service.testing.hil import Hil
from aeroloop.service.testing.process_group import ProcessGroup, free_rendezvous
from tests.hil.test_processes import AEROLOOP, aeroloop, events, grown
from tests.support.cable import Cable
from tests.support.zenoh_network import eventually, free_port

RATE = 100
"""Slow, so that several of these tests run beside each other: most of their time they wait."""

PATIENT = {"plant.watchdog_s": 2, "controller.stale_s": 2, "wire.counter_bits": 12, "loop.rate_hz": RATE,
           "controller.after_restart": "configured"}  # fmt: skip
"""As in test_processes.py: a machine that stalls for over 100 ms must not end the session."""

SLACK_S = 1.0
"""What a kill may cost beyond a chunk: messages wait for up to 0.3 s before they are in a chunk, and a machine with
two cores and other work keeps a process waiting for some hundred milliseconds."""


def assert_whole(logs: Path, at_least: int) -> Findings:
    """No tick of either end is missing, and both ends replay byte for byte. Returns what the review finds."""
    findings = read(logs).findings
    assert findings.missing_ticks == {"controller": 0, "plant": 0}, findings.missing
    replayed = replay([logs])
    for end in (replayed.controller, replayed.plant):
        assert end is not None, replayed.reasons
        assert end.differ == 0
        assert end.ticks >= at_least
    return findings


def test_a_rotated_run_in_lockstep_holds_every_tick_and_is_reviewed_and_replayed_as_a_whole(tmp_path: Path) -> None:
    """20 seconds of the law take more than a file, with the specification in it, may."""
    with Hil(tmp_path, lockstep=True) as hil:
        hil.start(settings={"recorder.max_file_mb": 0.2})
        hil.run(20.0)
    files = Recording([tmp_path]).paths
    assert len(files) >= 2
    found = assert_whole(tmp_path, 10_000)
    assert (found.skipped_ticks, found.duration_s) == (0, 20.0)
    printed = aeroloop("log", "review", str(tmp_path))
    assert printed["missing_ticks"] == {"controller": 0, "plant": 0}
    assert printed["z_track"] == found.z_track == review(*files).z_track
    replayed = aeroloop("log", "replay", str(tmp_path))
    assert {end: replayed[end]["differ"] for end in ("controller", "plant")} == {"controller": 0, "plant": 0}


@pytest.mark.smoke
def test_a_recorder_that_starts_late_and_one_that_was_killed_and_comes_back_have_it_from_the_first_tick(
    tmp_path: Path,
) -> None:
    """The time away is the promise itself, so it is waited for; that the caches keep a minute: test_trace_rows.py."""
    away_s, logs = 10, [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    settings = load(overrides=[
        *(f"{name}={value}" for name, value in PATIENT.items()),
        f"network.rendezvous={free_rendezvous()}", "controller.auto_arm=true",
    ])  # fmt: skip
    with ProcessGroup(settings) as processes:
        statuses = Statuses(processes, settings)
        processes.start("plant")
        processes.start("controller")
        eventually("driving", lambda: statuses.state("plant") == "driven")
        for log in logs:
            time.sleep(away_s)
            processes.replace_log(log)
            processes.start("recorder")
            processes.await_role("recorder")
            eventually("ticks in the log", grown(log))
            time.sleep(SLACK_S)
            if log == logs[0]:
                processes.stop("recorder", signal.SIGKILL)
        assert statuses.state("plant") == "driven"
    assert read(logs[0]).findings.damages, "it was killed, and left no whole file"
    for path in (logs[1], tmp_path):  # the second recorder needs nothing of the first, and is not disturbed by it
        judged = assert_whole(path, round(0.5 * RATE * 2 * away_s))
        assert judged.sessions == 1
        assert judged.duration_s >= 2 * away_s


def test_a_recorder_whose_links_are_cut_for_longer_than_a_lease_lacks_nothing(tmp_path: Path) -> None:
    """Its links to both ends pass no byte for 4 s; after a second of silence the ends give it up."""
    cut_s = 4
    ports = {"plant": free_port(), "controller": free_port()}
    settings = load(overrides=[
        *(f"{name}={value}" for name, value in PATIENT.items()),
        f"network.rendezvous={free_rendezvous()}", f"recorder.path={tmp_path / 'a.mcap'}", "controller.auto_arm=true",
    ])  # fmt: skip
    with ExitStack() as stack:
        cables = [stack.enter_context(Cable(port)) for port in ports.values()]
        processes = stack.enter_context(ProcessGroup(settings))
        statuses = Statuses(processes, settings)
        for role, port in ports.items():
            processes.start(role, "--set", f'network.listen=["tcp/127.0.0.1:{port}"]')  # type: ignore[arg-type]  # a role
        endpoints = ", ".join(f'"{cable.endpoint}"' for cable in cables)
        alone = ("network.rendezvous=''", "network.listen=[]", "network.gossip=false", f"network.connect=[{endpoints}]")
        processes.start("recorder", *(word for option in alone for word in ("--set", option)))
        eventually("driving", lambda: statuses.state("plant") == "driven")
        time.sleep(2)
        for cable in cables:
            cable.cut()
        time.sleep(cut_s)
        for cable in cables:
            cable.mend()
        time.sleep(3)
        processes.stop("controller")
        processes.stop("plant")
    assert_whole(tmp_path, round(0.5 * RATE * cut_s))


def test_a_recorder_that_is_killed_costs_a_chunk_and_the_loop_goes_on(tmp_path: Path) -> None:
    with Hil(tmp_path) as hil:
        hil.start(settings=PATIENT)
        hil.run(3)
        started_ticks = hil.status("plant").ticks
        hil.kill("recorder")
        hil.run(2)
        assert hil.state("plant") == "driven"
        assert hil.status("plant").ticks > started_ticks
    judged = aeroloop("log", "review", str(tmp_path / "hil-0.mcap"))
    assert judged["damages"]
    # A chunk is cut between two topics: the last batches of one end may be there without the other's.
    assert sum(judged["missing_ticks"].values()) <= (CHUNK_S + SLACK_S) * RATE
    assert judged["duration_s"] >= 3 - CHUNK_S - SLACK_S


def test_what_a_killed_end_computed_last_is_named(tmp_path: Path) -> None:
    """A controller that is killed takes up to 0.1 s of rows with it; the plant's rows show that they are missing."""
    with Hil(tmp_path) as hil:
        hil.start(settings={**PATIENT, "loop.trace_s": 1.0})
        hil.run(3.5)
        hil.kill("controller")
        hil.eventually("the trip", lambda: hil.state("plant") == "tripped")
        log = hil.log
    judged = aeroloop("log", "review", str(log.path))
    assert judged["missing_ticks"]["plant"] == 0
    assert 0 < judged["missing_ticks"]["controller"] <= (1.0 + SLACK_S) * RATE


class Statuses:
    """The last status of every role."""

    def __init__(self, processes: ProcessGroup, settings: Settings) -> None:
        self._last: dict[str, Status] = {}
        processes.zenoh.declare_subscriber(key("status", settings.vehicle), self._take)

    def _take(self, sample: Any) -> None:
        status = Status.model_validate_json(sample.payload.to_bytes())
        self._last[status.role] = status

    def state(self, role: str) -> str | None:
        status = self._last.get(role)
        return status.state if status else None

    def ticks(self) -> int:
        """Of the plant so far."""
        return self._last["plant"].ticks if "plant" in self._last else 0


# A disk that is really full


ON_A_DISK_OF_ITS_OWN = """
disk=$1 out=$2 pid=$3; shift 3
mount -t tmpfs -o size=4m none "$disk" || exit 99
"$@" & echo $! > "$pid"
wait $!; code=$?
cp "$disk"/*.mcap "$out"
exit $code
"""
"""What runs in a mount namespace: a command and its disk, which goes with it; so what it wrote is copied at the end."""


@pytest.fixture(scope="module")
def unshare() -> str:
    found = shutil.which("unshare")
    if found is None:
        pytest.skip("a full disk needs unshare(1), which is not installed")
    tried = subprocess.run(
        [found, "-rm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True, check=False
    )
    if tried.returncode:
        pytest.skip(f"a full disk needs a mount of its own, which this system refuses: {tried.stderr.strip()}")
    return found


class SmallDisk:
    """A recorder on a disk of 4 MB.

    Attributes:
        pid: Its process.
    """

    def __init__(self, unshare: str, folder: Path, settings: Settings) -> None:
        self._disk, self.out, pid, config = (folder / name for name in ("disk", "out", "pid", "config.toml"))
        self._disk.mkdir()
        self.out.mkdir()
        config.write_text(settings.toml())
        recorder = [*AEROLOOP, "recorder", "--config", str(config), "--log", str(self._disk / "a.mcap")]
        command = [unshare, "-rm", "sh", "-c", ON_A_DISK_OF_ITS_OWN, "sh", str(self._disk), str(self.out), str(pid)]
        with (folder / "stderr").open("wb") as stderr:
            self._process = subprocess.Popen([*command, *recorder], stderr=stderr, start_new_session=True)
        eventually("the recorder", lambda: pid.exists() and pid.read_text().endswith("\n"))
        self.pid = int(pid.read_text())
        self._ballast = Path(f"/proc/{self.pid}/root{self._disk}/ballast")

    def fill(self) -> None:
        """Leave no room."""
        with self._ballast.open("wb", buffering=0) as file, suppress(OSError):
            while True:
                file.write(bytes(4096))

    def empty(self) -> None:
        self._ballast.unlink()

    def stop(self) -> int:
        """SIGTERM. Its exit code; what it wrote is in `out` then."""
        os.kill(self.pid, signal.SIGTERM)
        return self._process.wait(30)

    def kill(self) -> None:
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


def test_a_full_disk_stops_neither_the_loop_nor_for_good_the_recorder_and_costs_nothing(
    tmp_path: Path, unshare: str
) -> None:
    patient = [f"{name}={value}" for name, value in PATIENT.items()]
    more = [f"network.rendezvous={free_rendezvous()}", "controller.auto_arm=true"]
    settings = load(overrides=[*patient, *more, "controller.require_recorder=true"])
    small = SmallDisk(unshare, tmp_path, settings)
    try:
        with ProcessGroup(settings) as processes:
            statuses = Statuses(processes, settings)
            processes.start("plant")
            processes.await_role("plant")
            processes.start("controller")  # which waits for the recorder by itself
            eventually("driving", lambda: statuses.state("plant") == "driven")
            small.fill()
            eventually("its word", lambda: statuses.state("recorder") == "not recording")
            before = statuses.ticks()
            eventually("the loop goes on", lambda: statuses.ticks() > before + 2 * RATE)
            small.empty()
            eventually("its word", lambda: statuses.state("recorder") == "recording")
            before = statuses.ticks()
            eventually("some more", lambda: statuses.ticks() > before + 2 * RATE)
            processes.stop("controller")
            processes.stop("plant")
            assert small.stop() == 0
    finally:
        small.kill()
    (log,) = small.out.glob("*.mcap")
    assert_whole(log, 4 * RATE)
    texts = [event.text for event in events(log) if event.role == "recorder"]
    assert [text for text in texts if "No space left on device" in text and "kept in memory" in text]
    assert [text for text in texts if text.startswith("recording again to ")]
