"""The recorder as a process beside a running loop: rotated, killed, losing messages, on a disk that is really full."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh

from protocol import topics
from protocol.messages import Loss, Status
from service.bench import Bench, free_rendezvous
from service.config import Settings, load
from service.hil import Hil
from service.logs.files import LogFiles
from service.logs.mcap_records import CHANNEL, MESSAGE, Channel, Message, records
from service.logs.replay import replay
from service.logs.review import review
from tests.hil.test_processes import AEROLOOP, aeroloop, events, eventually

PATIENT = {"plant.watchdog_s": 2, "controller.stale_s": 2, "wire.counter_bits": 11}
"""As in test_processes.py: a machine that stalls for over 100 ms must not end the session."""

SLACK_S = 1.0
"""What a kill may cost beyond `chunk_s`: messages gather for up to 0.1 s before they are in a chunk, and a machine with
two cores and other work keeps a process waiting for some hundred milliseconds."""

Frames = dict[str, list[tuple[int, bytes]]]
"""Time of publication [ns] and content of the frames of each key."""


def frames(*paths: Path) -> Frames:
    """What logs hold, with or without their end; numbers of each key must go on from file to file."""
    found: Frames = {}
    for path, key, message in _frames(paths):
        held = found.setdefault(key, [])
        held.append((message.publish_time, message.data))
        assert message.sequence == len(held), f"{key} in {path}"
    return found


def _frames(paths: Sequence[Path]) -> Iterator[tuple[Path, str, Message]]:
    """File, key and message."""
    for path in paths:
        channels: dict[int, str] = {}
        for record in records(path):
            if record.opcode == CHANNEL:
                channel = Channel.read(record.content)
                channels[channel.id] = channel.topic
            elif record.opcode == MESSAGE:
                message = Message.read(record.content)
                key = channels[message.channel]
                address = topics.read_key(key)
                if address is not None and address.topic.carries == "frame":
                    yield path, key, message


class Heard:
    """Frames as another subscriber on this network hears them, and what the recorder says."""

    def __init__(self, session: zenoh.Session, vehicle: str) -> None:
        self.frames: Frames = {}
        self.states: list[str] = []
        for name in ("measurement", "command"):
            session.declare_subscriber(topics.key(name, vehicle), self._frame)
        session.declare_subscriber(topics.key("status", vehicle, role="recorder"), self._status)

    def count(self) -> int:
        return sum(len(heard) for heard in list(self.frames.values()))

    def _frame(self, sample: zenoh.Sample) -> None:
        assert sample.timestamp is not None
        at_ns = sample.timestamp.get_time_as_ntp64().as_nanos()
        self.frames.setdefault(str(sample.key_expr), []).append((at_ns, sample.payload.to_bytes()))

    def _status(self, sample: zenoh.Sample) -> None:
        self.states.append(Status.model_validate_json(sample.payload.to_bytes()).state)


def losses(*paths: Path) -> list[Loss]:
    return [Loss.model_validate_json(payload) for _, payload, _ in LogFiles(paths).messages({"loss"})]


def test_a_rotated_run_in_lockstep_holds_every_frame_and_is_reviewed_and_replayed_as_a_whole(tmp_path: Path) -> None:
    """Six seconds of the law: as fast as this machine allows, they take more than one of the recorder's files."""
    with Hil(tmp_path, lockstep=True) as hil:
        hil.start(settings={"recorder.max_file_s": 1.0, "recorder.chunk_s": 0.1})
        hil.run(6.0)
    ticks = 3000
    files = LogFiles([tmp_path]).paths
    assert len({path for path, _, _ in _frames(files)}) >= 2, "not in one file, as it is"
    (measurements,), (commands,) = (
        [held for key, held in frames(*files).items() if key.endswith(name)] for name in ("measurement", "command")
    )
    counters = [frame[0] >> 4 for _, frame in measurements]
    assert all(later == (earlier + 1) % 16 for earlier, later in pairwise(counters))
    assert ticks <= len(commands) <= len(measurements) <= ticks + 1
    (session,) = replay([tmp_path])
    assert (session.first_tick, session.commands, session.differing) == (0, len(commands), 0)
    assert losses(tmp_path) == []
    figures = aeroloop("log", "review", str(tmp_path))
    assert figures["skipped_ticks"] == 0
    assert figures["z_track"] == review(*files).z_track


def test_a_recorder_that_is_killed_costs_a_chunk_and_the_loop_goes_on(tmp_path: Path) -> None:
    """So slow a loop that a chunk would take ten seconds to be closed by its size."""
    chunk_s = 0.5
    slow = {"loop.rate_hz": 100, "controller.telemetry_rate_hz": 1, "plant.truth_rate_hz": 1, "recorder.decoded_hz": 0}
    with Hil(tmp_path) as hil:
        hil.start(settings={"recorder.chunk_s": chunk_s, **slow, **PATIENT})
        heard = Heard(hil.bench.zenoh, hil.settings.vehicle)
        hil.eventually("three seconds", lambda: heard.count() > 600)
        killed_ns = time.time_ns()
        hil.kill("recorder")
        before = heard.count()
        hil.eventually("the loop goes on", lambda: heard.count() > before + 200)
        assert hil.state("plant") == "driven"
        log = tmp_path / "hil-0.mcap"
        assert_held(heard.frames, log, until_ns=killed_ns - round((chunk_s + SLACK_S) * 1e9))
        assert len(frames(log)) == 2


def assert_held(heard: Frames, *paths: Path, until_ns: int) -> None:
    """Every frame published until then is in a log, but for those of which the log says that they never came."""
    held = frames(*paths)
    lost = sum(loss.count for loss in losses(*paths) if loss.reason == "network")
    older = {key: {one for one in list(of_key) if one[0] < until_ns} for key, of_key in heard.items()}
    assert sum(len(of_key) for of_key in older.values()) > 200
    assert sum(len(of_key.difference(held[key])) for key, of_key in older.items()) <= lost


def test_what_two_senders_numbered_and_nobody_got_is_told_in_the_log(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    settings = load(overrides=[f"network.rendezvous={free_rendezvous()}", f"recorder.path={log}"])
    key = topics.key("reference", settings.vehicle)
    with Bench(settings) as bench:
        told: list[Loss] = []
        bench.zenoh.declare_subscriber(
            topics.key("loss", settings.vehicle),
            lambda sample: told.append(Loss.model_validate_json(sample.payload.to_bytes())),
        )
        bench.start("recorder")
        bench.await_role("recorder")
        senders = [bench.zenoh.declare_publisher(key) for _ in range(2)]
        for sender in senders:
            eventually("the match", lambda sender=sender: sender.matching_status.matching)  # type: ignore[misc]
        for numbers in ((0, 0), (1, 5), (4, 6), (5, 10)):  # by turns, and often with the same number
            for sender, number in zip(senders, numbers, strict=True):
                sender.put(b"{}", source_info=zenoh.SourceInfo(sender.id, number))
        eventually("three losses", lambda: len(told) == 3)
    assert [(loss.key, loss.count, loss.reason) for loss in losses(log)] == [
        (key, count, "network") for count in (4, 2, 3)
    ]
    times = [at_ns for _, _, at_ns in LogFiles([log]).messages({"reference"})]
    assert [loss.until_ns for loss in losses(log)] == [times[3], times[4], times[7]]


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
        pytest.skip("there is no unshare(1) here")
    tried = subprocess.run(
        [found, "-rm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True, check=False
    )
    if tried.returncode:
        pytest.skip(f"this system lets nobody mount a disk of his own: {tried.stderr.strip()}")
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
    more = [f"network.rendezvous={free_rendezvous()}", "recorder.chunk_s=0.1", "controller.auto_arm=true"]
    settings = load(overrides=[*patient, *more, "controller.require_recorder=true"])
    small = SmallDisk(unshare, tmp_path, settings)
    try:
        with Bench(settings) as bench:
            heard = Heard(bench.zenoh, settings.vehicle)
            bench.start("plant")
            bench.await_role("plant")
            bench.start("controller")  # which waits for the recorder by itself
            eventually("frames", lambda: heard.count() > 500)
            small.fill()
            eventually("its word", lambda: heard.states[-1] == "waiting for the disk")
            before = heard.count()
            eventually("the loop goes on", lambda: heard.count() > before + 500)
            small.empty()
            eventually("its word", lambda: heard.states[-1] == "recording")
            before = heard.count()
            eventually("some more", lambda: heard.count() > before + 500)
            bench.stop("controller")
            bench.stop("plant")
            assert small.stop() == 0
    finally:
        small.kill()
    (log,) = small.out.glob("*.mcap")
    assert_held(heard.frames, log, until_ns=time.time_ns())
    assert {loss.reason for loss in losses(log)} <= {"network"}
    (session,) = replay([log])
    assert session.differing == 0
    told = [event.text for event in events(log) if event.role == "recorder"]
    assert [text for text in told if "No space left on device" in text and "kept in memory" in text]
    assert [text for text in told if text.startswith("recording again to ")]
