"""Recorder over real Zenoh sessions in this process, with disk and memory under the test's control.

tests/hil covers the recorder as a process.
"""

from __future__ import annotations

import errno
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest
import zenoh
from mcap.reader import make_reader

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Loss, Status
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport import history
from aeroloop.protocol.transport.history import CachedPublisher, Delivery, RecoveringSubscriber, attachment
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.service.config import load
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA
from aeroloop.service.recording import rolling
from aeroloop.service.recording.recorder import Recorder
from aeroloop.service.recording.rolling import parts
from aeroloop.service.settings import RecorderSettings
from tests.support.edited_log import by_mcap, contents
from tests.support.made_log import description, made
from tests.support.zenoh_network import Gathering, eventually

KEY, TRACE = "aeroloop/aero/telemetry", "aeroloop/aero/trace/plant"
DESCRIPTION, OWN_STATUS = "aeroloop/aero/description/plant", "aeroloop/aero/status/recorder"
START_NS = 1_800_000_000_000_000_000


class Running:
    """A recorder in a thread of its own; `full` is whether its disk is, `error` what it ended with."""

    def __init__(self, path: Path, network: NetworkSettings) -> None:
        self.path, self.full = path, False
        self.error: Exception | None = None
        self.role = Node("recorder", "aero", network, {})
        self.recorder = Recorder(self.role, RecorderSettings(path=path))
        self._write = os.pwrite
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.recorder.run()
        except Exception as error:
            self.error = error

    def write(self, fd: int, data: memoryview, offset: int) -> int:
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._write(fd, data, offset)

    def await_written(self, count: int = 3) -> None:
        """Wait until so many messages are written; two are the recorder's own."""
        eventually(f"{count} messages", lambda: self.recorder.log.written >= count)

    def fill_disk(self, publisher: Publisher, until: int) -> None:
        """Fill the disk, publish, and wait until the recorder knows."""
        self.full = True
        publisher.send(until)
        eventually("trouble", lambda: bool(self.recorder.log.trouble))

    def end(self) -> None:
        """Stop it and wait until its log is closed."""
        self.role.stop.set()
        self._thread.join()
        if not self.role.zenoh.is_closed():
            self.role.__exit__(None, None, None)

    def messages(self) -> list[tuple[str, int, bytes]]:
        """Key, number and payload, in the order of arrival."""
        return [(one.topic, one.sequence, one.data) for path in parts(self.path) for one in by_mcap(path)]

    def of(self, key: str) -> list[bytes]:
        """Payloads of one publisher, by its numbers."""
        return [data for _, data in sorted((number, data) for topic, number, data in self.messages() if topic == key)]

    def numbers(self) -> list[int]:
        """Numbers of the recorded messages of `KEY`, ascending."""
        return sorted(number for topic, number, _ in self.messages() if topic == KEY)

    def losses(self) -> list[tuple[str, int, str]]:
        """Key, how many and why, in the log."""
        losses = [Loss.model_validate_json(data) for data in self.of("aeroloop/aero/loss")]
        return [(loss.key, loss.count, loss.reason) for loss in losses]

    def last_status(self) -> Status:
        """The recorder's own, in the log."""
        return Status.model_validate_json(self.of(OWN_STATUS)[-1])


@pytest.fixture
def gathering() -> Iterator[Gathering]:
    with Gathering() as gathering:
        yield gathering


Record = Callable[..., Running]


@pytest.fixture
def record(tmp_path: Path, gathering: Gathering, monkeypatch: pytest.MonkeyPatch) -> Iterator[Record]:
    """Starts recorders that write a chunk twenty times a second and try a full disk ten times a second."""
    monkeypatch.setattr(rolling, "CHUNK_S", 0.05)
    monkeypatch.setattr(rolling, "RETRY_S", 0.1)
    running: list[Running] = []

    def start(network: NetworkSettings | None = None) -> Running:
        running.append(Running(tmp_path / f"log{len(running)}.mcap", network or gathering.settings))
        monkeypatch.setattr(os, "pwrite", running[-1].write)
        return running[-1]

    yield start
    for one in running:
        one.full = False
        one.end()


class Publisher:
    """Publishes messages, and keeps those of the last minute."""

    def __init__(self, session: zenoh.Session) -> None:
        self.count = 0
        self._publisher = CachedPublisher(session, KEY, lossless=True)

    def send(self, until: int, size: int = 1) -> None:
        for _ in range(self.count, until):
            self._publisher.put(bytes(size))
        self.count = until


@pytest.fixture
def publisher(gathering: Gathering) -> Publisher:
    return Publisher(gathering.join())


def publish_without_cache(gathering: Gathering, key: str, messages: dict[int, bytes]) -> None:
    """Publish messages by their numbers, each a ns later, once the recorder subscribes."""
    declared = gathering.join().declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    eventually("the match", lambda: bool(declared.matching_status.matching))  # type: ignore[attr-defined]
    for number, payload in messages.items():
        declared.put(payload, attachment=attachment(START_NS + number, 4711, number))


def descriptions(path: Path) -> dict[str, bytes]:
    """The last description of each key that a file has as metadata."""
    return {entry["key"]: entry["json"].encode() for name, entry in contents(path)[1] if name == DESCRIPTION_METADATA}


# ── what is recorded ──


def test_a_recorder_that_starts_late_or_again_records_all_that_was_published_and_every_file_can_be_read_alone(
    gathering: Gathering, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, settings = gathering.join(), load()
    publishers: dict[str, CachedPublisher] = {}
    published: dict[str, list[bytes]] = {}

    def publish(key: str, payload: bytes) -> None:
        if key not in publishers:
            publishers[key] = CachedPublisher(session, key)
        publishers[key].put(payload)
        published.setdefault(key, []).append(payload)

    publish(DESCRIPTION, description(settings, "plant").encode())
    for message in made(settings, 500, truth_every=10):
        publish(message.key, message.payload)
    monkeypatch.setattr(rolling, "MAX_FILE_S", 0.001)
    for _ in range(2):
        running = record()
        eventually("two files", lambda running=running: len(parts(running.path)) > 2)  # type: ignore[misc]
        running.end()
        assert {key: running.of(key) for key in published} == published
        assert running.losses() == []
        assert descriptions(parts(running.path)[-1])[DESCRIPTION] == published[DESCRIPTION][0]
        assert 0 < len(running.of("/aero/tf")) <= 11  # of a second; rows before the description are not decoded


def test_a_recorder_that_ends_takes_what_caches_still_hold(
    gathering: Gathering, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends as soon as it has recorded anything at all: most of the 0.9 MB is still with their publisher."""
    monkeypatch.setattr(history, "ANSWER_S", 0.5)  # until a topic that nobody publishes counts as complete
    published = Publisher(gathering.join())
    published.send(600, 1500)
    running = record()
    running.await_written()
    running.end()
    assert running.numbers() == list(range(600)), running.losses()
    assert running.losses() == []


def test_the_last_message_in_a_log_is_that_recording_stopped_and_traces_that_cannot_be_reached_are_named(
    gathering: Gathering, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It cannot know whether their publishers have ended or its cable is out."""
    monkeypatch.setattr(history, "ANSWER_S", 0.1)
    session = gathering.join()
    published, running = CachedPublisher(session, TRACE), record()
    published.put(b"")
    running.await_written()
    session.close()
    closed = time.monotonic()
    time.sleep(1.0)
    running.end()
    key, _, said = [message for message in running.messages() if message[0].startswith("aeroloop/")][-1]
    status = running.last_status()
    assert (key, Status.model_validate_json(said)) == (OWN_STATUS, status)
    assert status.state == "stopped"
    (note,) = status.notes
    silent = f"nothing of {TRACE} was received for (\\d+) s: what it has published since is not in the log"
    assert (age_s := re.fullmatch(silent, note)) is not None
    assert 1 <= int(age_s[1]) <= time.monotonic() - closed + 1
    assert note in str(running.of("aeroloop/aero/event/recorder")[-1])


def test_no_description_and_one_older_than_the_last_are_recorded_as_they_are_and_replace_none(
    gathering: Gathering, record: Record
) -> None:
    running, session = record(), gathering.join()
    names = [topics.key(name, "aero", role="plant") for name in topics.RECORDED if name != "description"]
    publishers = [CachedPublisher(session, key) for key in names]  # as long as they live, so do their caches
    for publisher in publishers:
        publisher.put(b"\xff\x00")
    settings = {number: load(None, [f"loop.rate_hz={rate_hz}"]) for number, rate_hz in ((1, 200), (0, 100))}
    said = {number: description(each, "plant").encode() for number, each in settings.items()}
    publish_without_cache(gathering, DESCRIPTION, said | {2: b"\xff\x00"})
    running.await_written(len(names) + 5)
    running.end()
    assert {key for key, _, data in running.messages() if data == b"\xff\x00"} == {*names, DESCRIPTION}
    assert b'"rate_hz":200.0' in descriptions(running.path)[DESCRIPTION]


def test_a_recorder_that_fails_closes_its_log_with_an_index(
    record: Record, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: RecoveringSubscriber) -> list[Delivery]:
        raise RuntimeError("a defect")

    running = record()
    publisher.send(1)
    running.await_written()
    monkeypatch.setattr(RecoveringSubscriber, "take", fail)
    eventually("the failure", lambda: running.error is not None)
    assert str(running.error) == "a defect"
    with running.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count >= 3


# ── what is lost ──


def test_a_full_disk_is_reported_and_what_its_cache_holds_no_longer_is_counted_in_the_log(
    record: Record, publisher: Publisher, gathering: Gathering, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every message is in the log or in the count of those that are not; none is in both, and none is lost twice."""
    monkeypatch.setattr(history, "WAITING_BYTES", 50 * 201)
    monkeypatch.setattr(history, "LEAST_KEPT", 65)
    hours = count(step=2 * history.KEPT_S)  # each message is too old to be kept once the next is published
    short = CachedPublisher(gathering.join(), KEY.replace("aero/", "beta/"), lossless=True, clock=lambda: next(hours))
    running, reported = record(), list[Status]()
    gathering.join().declare_subscriber(
        OWN_STATUS, lambda sample: reported.append(Status.model_validate_json(sample.payload.to_bytes()))
    )
    publisher.send(1)
    running.await_written()
    running.fill_disk(publisher, 2)
    publisher.send(502)
    for _ in range(500):
        short.put(b"x")
    reported.clear()
    eventually("its word", lambda: any(status.state == "not recording" and status.cause for status in reported))
    running.full = False
    eventually("its word", lambda: reported[-1].state == "recording" and reported[-1].lost > 0)
    running.end()
    assert running.numbers() == list(range(502))  # its cache had them all
    kept = len(running.of(KEY.replace("aero/", "beta/")))
    assert running.losses() == [(KEY.replace("aero/", "beta/"), 500 - kept, "cache")]
    assert 0 < kept < 200
    assert running.error is None


def test_losses_of_several_keys_add_up_in_the_status(
    gathering: Gathering, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their publishers have no cache; a time-out is short, so that what does not answer is soon given up."""
    monkeypatch.setattr(history, "ANSWER_S", 0.1)
    running, other = record(), KEY.replace("aero/", "beta/")
    for key, lost in ((KEY, 10), (other, 5)):
        publish_without_cache(gathering, key, {number: bytes(4) for number in (0, lost + 1)})
    running.await_written(6)
    running.end()
    assert sorted(running.losses()) == [(KEY, 10, "gone"), (other, 5, "gone")]
    status = running.last_status()
    assert status.lost == 15
    assert status.notes[0].startswith("15 messages lost: not received")


@pytest.mark.realtime
def test_a_loss_that_is_found_as_recording_ends_is_in_the_log(gathering: Gathering, record: Record) -> None:
    """A publisher without a cache: what it did not publish cannot be recovered."""
    running = record()
    publish_without_cache(gathering, KEY, {number: bytes(4) for number in (0, 1, 2, 3, 1000)})
    running.end()
    assert running.numbers() == [0, 1, 2, 3, 1000]
    assert running.losses() == [(KEY, 996, "gone")]
    *_, said = running.of("aeroloop/aero/event/recorder")
    assert f"996 messages of {KEY} are not in the log: not received, and their publisher does not answer" in str(said)
    assert running.last_status().notes[0].startswith("996 messages lost: not received")


@pytest.mark.parametrize("full", [False, True])
def test_a_recorder_that_is_stopped_writes_what_waited_or_reports_how_much_the_disk_refused(
    record: Record, publisher: Publisher, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    running = record()
    publisher.send(1)
    running.await_written()
    monkeypatch.setattr(rolling, "RETRY_S", 1e6)
    running.fill_disk(publisher, 2)
    received: list[zenoh.Sample] = []
    running.role.zenoh.declare_subscriber(KEY, received.append)
    publisher.send(30)
    eventually("28 more are received", lambda: len(received) >= 28)
    running.full = full
    running.end()
    if full:
        count, _, rest = str(running.error).partition(" ")
        assert 27 <= int(count) <= 40  # the last may still be on its way; the recorder's own are counted, too
        assert rest.startswith(f"messages and the index of {running.path} could not be written")
    else:
        assert running.error is None
        assert running.numbers() == list(range(30))
