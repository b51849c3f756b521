"""The recorder over real Zenoh sessions, in this process, where its disk and its queue are the test's to fill.

What it promises as a process of its own is in tests/hil/test_recorder.py.
"""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import zenoh
from mcap.reader import make_reader

from protocol.messages import Loss, Status
from protocol.role import Role
from service.recording import recorder as recorder_module
from service.recording import rolling
from service.recording.intake import Intake
from service.recording.recorder import Recorder
from service.recording.rolling import RecorderError
from service.settings import RecorderSettings
from tests.protocol.gathering import Gathering, eventually

KEY = "aeroloop/aero/s1/measurement"
ROOM = 50


class Running:
    """A recorder in a thread of its own.

    Attributes:
        full: Whether its disk is full.
        error: What it ended with, if it did not end well.
    """

    def __init__(self, path: Path, gathering: Gathering) -> None:
        self.path = path
        self.full = False
        self.error: Exception | None = None
        self.state: list[str] = []
        self._write = os.pwrite
        self.role = Role("recorder", "aero", gathering.settings, {})
        settings = RecorderSettings(path=path, chunk_s=0.05, batch_s=0.0, decoded_hz=0.0)
        self.recorder = Recorder(self.role, settings)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.recorder.run()
        except RecorderError as error:
            self.error = error

    def write(self, fd: int, data: memoryview, offset: int) -> int:
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._write(fd, data, offset)

    def end(self) -> None:
        """Stop it and wait until its log is closed."""
        self.role.stop.set()
        self._thread.join()
        self.role.__exit__(None, None, None)

    def messages(self) -> list[tuple[str, bytes]]:
        with self.path.open("rb") as file:
            return [(channel.topic, one.data) for _, channel, one in make_reader(file).iter_messages()]

    def frames(self) -> list[int]:
        return [int.from_bytes(data, "big") for topic, data in self.messages() if topic == KEY]

    def losses(self) -> list[tuple[str, int, str]]:
        """Key, how many and why, in the log."""
        told = [Loss.model_validate_json(data) for topic, data in self.messages() if topic.endswith("/loss")]
        return [(loss.key, loss.count, loss.reason) for loss in told]


@pytest.fixture
def gathering() -> Iterator[Gathering]:
    with Gathering() as gathering:
        yield gathering


@pytest.fixture
def running(tmp_path: Path, gathering: Gathering, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    """A recorder whose queue holds fifty messages and whose disk is tried ten times a second."""
    monkeypatch.setattr(recorder_module, "Intake", partial(Intake, most=ROOM))
    monkeypatch.setattr(rolling, "RETRY_S", 0.1)
    running = Running(tmp_path / "a.mcap", gathering)
    monkeypatch.setattr(os, "pwrite", running.write)
    yield running
    running.full = False
    running.end()


Send = Callable[[int], None]


@pytest.fixture
def send(gathering: Gathering, running: Running) -> Send:
    """Publishes a message with a number, as a sender that the recorder knows from the start."""
    declared = gathering.join().declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
    eventually("the match", lambda: bool(declared.matching_status.matching))  # type: ignore[attr-defined]

    def put(number: int) -> None:
        declared.put(number.to_bytes(4, "big"), source_info=zenoh.SourceInfo(declared.id, number))

    put(0)
    eventually("the first", lambda: running.recorder.log.written > 0)
    return put


def statuses(gathering: Gathering) -> list[Status]:
    """The recorder's, as they come."""
    found: list[Status] = []
    gathering.join().declare_subscriber(
        "aeroloop/aero/status/recorder",
        lambda sample: found.append(Status.model_validate_json(sample.payload.to_bytes())),
    )
    return found


def test_while_the_disk_is_full_it_says_so_and_what_finds_no_room_in_memory_is_counted_in_the_log(
    running: Running, send: Send, gathering: Gathering
) -> None:
    """Every message is in the log or in the count of those that are not; none is in both, and none is lost twice."""
    told = statuses(gathering)
    running.full = True
    send(1)
    eventually("trouble", lambda: not running.recorder.log.writable)
    for number in range(2, 502):
        send(number)
    eventually("its word", lambda: any(status.state == "waiting for the disk" for status in told))
    assert len(running.recorder._intake) == ROOM
    running.full = False
    eventually(
        "its word", lambda: told[-1].state == "recording" and any("lost: disk" in note for note in told[-1].notes)
    )
    for number in range(502, 510):
        send(number)
    running.end()
    frames = running.frames()
    lost = sum(count for key, count, reason in running.losses() if key == KEY and reason == "disk")
    assert frames == sorted(set(frames))
    assert frames[-8:] == list(range(502, 510))
    assert lost == 510 - len(frames)
    assert 502 - ROOM < lost + 3 <= 502
    assert {reason for _, _, reason in running.losses()} == {"disk"}
    assert running.error is None


def test_what_comes_faster_than_it_is_written_is_no_fault_of_the_disk(
    running: Running, send: Send, gathering: Gathering
) -> None:
    """Even if the disk was full before, and had room for all."""
    told = statuses(gathering)
    running.full = True
    send(1)
    eventually("trouble", lambda: not running.recorder.log.writable)
    running.full = False
    before = len(told)
    eventually("its word", lambda: "recording" in [status.state for status in told[before:]])
    written = threading.Event()
    running.role.later(lambda: written.wait(20))  # the thread that writes is busy
    for number in range(2, 200):
        send(number)
    eventually("a full queue", lambda: len(running.recorder._intake) == ROOM)
    eventually("refusals", lambda: running.recorder._intake._refusals.messages[KEY] > 0)
    written.set()
    eventually("its word", lambda: any("lost: queue" in note for note in told[-1].notes))
    running.end()
    losses = running.losses()
    assert {reason for _, _, reason in losses} == {"queue"}
    assert sum(count for key, count, _ in losses if key == KEY) == 200 - len(running.frames())


def test_a_recorder_that_is_stopped_when_the_disk_has_room_again_writes_what_waited(
    running: Running, send: Send, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rolling, "RETRY_S", 1e6)
    running.full = True
    send(1)
    eventually("trouble", lambda: not running.recorder.log.writable)
    for number in range(2, 30):
        send(number)
    eventually(
        "the last", lambda: (29).to_bytes(4, "big") in [one.payload for one in list(running.recorder._intake._queue)]
    )
    running.full = False
    running.end()
    assert running.error is None
    assert running.frames() == list(range(30))


def test_a_recorder_that_is_stopped_while_the_disk_is_full_says_how_much_is_lost(running: Running, send: Send) -> None:
    running.full = True
    send(1)
    eventually("trouble", lambda: not running.recorder.log.writable)
    for number in range(2, 30):
        send(number)
    running.end()
    assert isinstance(running.error, RecorderError)
    count, _, rest = str(running.error).partition(" ")
    assert int(count) >= 29
    assert rest.startswith(f"messages and the index of {running.path} could not be written")
    running.recorder.log._file.abandon()


def test_a_loss_that_is_found_as_recording_ends_is_in_the_log(running: Running, send: Send) -> None:
    for number in (1, 2, 3, 1000):
        send(number)
    running.end()
    assert running.frames() == [0, 1, 2, 3, 1000]
    assert running.losses() == [(KEY, 996, "network")]


def test_the_last_word_in_a_log_is_that_recording_stopped(running: Running, send: Send) -> None:
    send(1)
    running.end()
    key, said = running.messages()[-1]
    assert key == "aeroloop/aero/status/recorder"
    assert Status.model_validate_json(said).state == "stopped"
    assert Status.model_validate_json(said).received == len(running.messages()) - 1
