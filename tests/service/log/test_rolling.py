"""A run in several files, on a disk that may be full, broken or gone: every message once, every file enough by itself.

No network and no clock: a session's messages are made once, time is what the test says, and the disk fails when asked.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest
from mcap.reader import make_reader

from protocol import topics
from protocol.messages import Contract
from service.log import rolling, writer
from service.log.decoded import Decoded, Decoder
from service.log.intake import Taken
from service.log.mcap_records import (
    CHANGE_METADATA,
    CHANNEL,
    CHUNK_BYTES,
    CONTRACT_METADATA,
    MESSAGE,
    METADATA,
    RECORDER_METADATA,
    Channel,
    Damage,
    Message,
    footer,
    metadata,
    records,
)
from service.log.recover import recover
from service.log.replay import replay
from service.log.review import review
from service.log.rolling import RecorderError, RollingLog
from service.settings import RecorderSettings
from tests.service.log.made_log import AN_OPERATORS_WORDS, make_log

TICKS = 600
TICK_S = 0.002
EVERYTHING = 1 << 60


class Story(NamedTuple):
    """A session's messages as they came, and its contract."""

    key: str
    contract: bytes
    messages: list[Taken]


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Story:
    """A session of 1.2 s, in which an operator speaks at 0.24, 0.5 and 0.8 s."""
    path = tmp_path_factory.mktemp("made") / "made.mcap"
    make_log(path, TICKS, changes=AN_OPERATORS_WORDS)
    channels: dict[int, str] = {}
    messages: list[Taken] = []
    contract: dict[str, str] = {}
    for record in records(path):
        if record.opcode == METADATA:
            _, contract = metadata(record.content)
        elif record.opcode == CHANNEL:
            channel = Channel.read(record.content)
            channels[channel.id] = channel.topic
        elif record.opcode == MESSAGE:
            message = Message.read(record.content)
            # it comes some time after it was published, so that the two cannot be taken for each other
            messages.append(Taken(channels[message.channel], message.data, message.publish_time, message.log_time + 77))
    return Story(contract["key"], contract["json"].encode(), messages)


class Clock:
    """What `time.monotonic()` says, in s."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.logs: list[RollingLog] = []  # that run by it


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    clock = Clock()
    monkeypatch.setattr(rolling, "time", SimpleNamespace(monotonic=lambda: clock.now))
    yield clock
    for log in clock.logs:
        log._file.abandon()  # of a test that failed, it may be open still


class Disk:
    """Where files are written, which fails when told to.

    Attributes:
        room: Bytes that a file can hold.
        at_once: Bytes that one call writes at the most.
        broken: An error that every write gives; 0: none.
        new_files: An error that a new file gives; 0: none.
        changes: Called before each write with where in its file it goes, to change any of these.
        writes: How often something was to be written.
    """

    def __init__(self) -> None:
        self.room = self.at_once = EVERYTHING
        self.broken = self.new_files = self.writes = 0
        self.changes: Callable[[int], None] = lambda _: None

    def write(self, fd: int, data: memoryview, offset: int) -> int:
        self.writes += 1
        self.changes(offset)
        if self.broken:
            raise OSError(self.broken, os.strerror(self.broken))
        size = min(len(data), self.at_once, self.room - offset)
        if size <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._write(fd, data[:size], offset)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._write = os.pwrite
        make = writer.LogFile

        def made(path: Path) -> writer.LogFile:
            if self.new_files:
                raise OSError(self.new_files, os.strerror(self.new_files))
            return make(path)

        monkeypatch.setattr(os, "pwrite", self.write)
        monkeypatch.setattr(os, "fdatasync", lambda _: None)
        monkeypatch.setattr(rolling, "LogFile", made)


@pytest.fixture(autouse=True)
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    disk.install(monkeypatch)
    return disk


class Recording:
    """A RollingLog, fed as the recorder feeds it: what the disk refuses waits, and a message takes a millisecond.

    Attributes:
        told: What it told, and whether it was bad news.
    """

    def __init__(self, clock: Clock, story: Story, **settings: object) -> None:
        self.told: list[tuple[str, bool]] = []
        self._clock = clock
        self.waiting: list[Taken] = []
        self.log = RollingLog(RecorderSettings.model_validate(settings), lambda *told: self.told.append(told))
        clock.logs.append(self.log)
        self.log.add_contract(story.key, story.contract)
        self._decoder = Decoder(25.0)
        self._decoder.configure(Contract.model_validate_json(story.contract))

    def take(self, messages: list[Taken]) -> None:
        for taken in messages:
            self.waiting.append(taken)
            while self.waiting and self.log.writable:
                self._add(self.waiting.pop(0))
            self._clock.now += TICK_S / 2
            self.log.tend()

    def _add(self, taken: Taken) -> None:
        address = topics.read_key(taken.key)
        assert address is not None
        if address.topic.name == "change":
            self.log.add_change(taken)
        decoded: list[Decoded] = self._decoder.take(address, taken.payload, taken.published_ns)
        self.log.add(taken, decoded)

    def wait(self, seconds: float) -> None:
        """Nothing comes for so long."""
        self._clock.now += seconds
        self.take([])
        self.log.tend()
        while self.waiting and self.log.writable:
            self._add(self.waiting.pop(0))

    def told_bad(self) -> list[str]:
        return [text for text, bad in self.told if bad]


def in_order(folder: Path) -> list[Path]:
    """The files of a run, by their numbers."""
    return sorted(folder.glob("*.mcap"), key=lambda path: (len(path.stem), path.stem))


def raw(path: Path) -> Iterator[tuple[str, int, int, int, bytes]]:
    """Raw messages by mcap's own reader, which wants the index; checksums checked."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if not channel.topic.startswith("/"):
                yield channel.topic, message.sequence, message.log_time, message.publish_time, message.data


def decoded_count(paths: list[Path]) -> int:
    count = 0
    for path in paths:
        with path.open("rb") as file:
            count += sum(channel.topic.startswith("/") for _, channel, _ in make_reader(file).iter_messages())
    return count


def numbered(messages: list[Taken]) -> list[tuple[str, int, int, int, bytes]]:
    """Messages as they must stand in the log: numbered by key from 1, over all files, in order of their log times."""
    sequences: dict[str, int] = {}
    found = []
    for taken in messages:
        sequences[taken.key] = sequences.get(taken.key, 0) + 1
        found.append((taken.key, sequences[taken.key], taken.arrived_ns, taken.published_ns, taken.payload))
    return sorted(found, key=lambda one: one[2])


def every_message(paths: list[Path]) -> list[tuple[str, int, int, int, bytes]]:
    return sorted((one for path in paths for one in raw(path)), key=lambda one: one[2])


ROTATIONS = {"by size": {"max_file_mb": 0.045}, "by time": {"max_file_s": 0.4}}


@pytest.fixture(params=ROTATIONS)
def rotated(
    request: pytest.FixtureRequest, tmp_path: Path, story: Story, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A folder with the session in several files."""
    monkeypatch.setattr(rolling, "LOOK_S", 0.01)
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1, **ROTATIONS[request.param])
    recording.take(story.messages)
    recording.log.close()
    assert recording.told == []
    return tmp_path


# Rotation


def test_over_all_files_every_message_stands_once_and_their_numbers_go_on(rotated: Path, story: Story) -> None:
    files = in_order(rotated)
    assert len(files) >= 3
    assert [path.name for path in files] == ["a.mcap", *(f"a-{part:04}.mcap" for part in range(1, len(files)))]
    assert all(any(raw(path)) for path in files)
    assert every_message(files) == numbered(story.messages)


def test_no_file_is_larger_or_older_than_told_by_more_than_a_chunk(
    tmp_path: Path, story: Story, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rolling, "LOOK_S", 0.01)
    for name, settings in ROTATIONS.items():
        folder = tmp_path / name
        recording = Recording(clock, story, path=folder / "a.mcap", chunk_s=0.1, **settings)
        recording.take(story.messages)
        recording.log.close()
        if name == "by size":
            data = [_without_index(path) for path in in_order(folder)[:-1]]
            assert all(45_000 <= size < 45_000 + 12_000 for size in data), "a chunk of 100 ms has up to 12 kB"
        else:
            starts = [next(raw(path))[3] for path in in_order(folder)]
            assert all(0.35e9 < b - a < 0.55e9 for a, b in pairwise(starts))


def _without_index(path: Path) -> int:
    with path.open("rb") as file:
        end = footer(file, path.stat().st_size)
    assert end is not None
    return end.summary_start


def test_every_file_has_all_that_it_takes_to_read_it_alone(rotated: Path, story: Story) -> None:
    """Of what the controller follows, all that it was told since the session began and before the file did."""
    changes = [taken for taken in story.messages if taken.key.endswith("/change")]
    assert len(changes) == 1 + len(AN_OPERATORS_WORDS)
    for path in in_order(rotated):
        begins = min(one[2] for one in raw(path))
        with path.open("rb") as file:
            reader = make_reader(file)
            found = [(one.name, dict(one.metadata)) for one in reader.iter_metadata()]
            attachments = {one.name: one.data for one in reader.iter_attachments()}
        assert attachments == {"protocol/SPEC.md": Path("protocol/SPEC.md").read_bytes()}
        told = [entries["json"].encode() for name, entries in found if name == CHANGE_METADATA]
        assert told == [taken.payload for taken in changes if taken.arrived_ns < begins]
        assert [entries for name, entries in found if name == CONTRACT_METADATA] == [
            {"key": story.key, "json": story.contract.decode()}
        ]
        (said,) = [entries["json"] for name, entries in found if name == RECORDER_METADATA]
        assert f'"run": "a", "part": "{path.stem}"' in said


def test_a_rotated_run_is_replayed_to_the_last_byte_and_so_is_a_file_of_its_middle_alone(rotated: Path) -> None:
    (whole,) = replay([rotated])
    assert (whole.first_tick, whole.commands, whole.differing) == (0, TICKS, 0)
    for path in in_order(rotated):
        (part,) = replay([path])
        assert part.commands > 10, path.name
        assert part.differing == 0, path.name


def test_a_rotated_run_has_the_figures_of_the_same_run_in_one_file(
    rotated: Path, story: Story, clock: Clock, tmp_path: Path
) -> None:
    recording = Recording(clock, story, path=tmp_path / "one" / "one.mcap")
    recording.take(story.messages)
    recording.log.close()
    assert len(in_order(tmp_path / "one")) == 1
    apart, together = review(rotated), review(tmp_path / "one")
    assert apart.model_copy(update={"log": None}) == together.model_copy(update={"log": None})
    middle = review(in_order(rotated)[1])
    assert middle.z_track is not None
    assert middle.damages == []


def test_a_new_session_is_the_only_one_of_which_the_next_file_tells(tmp_path: Path, story: Story, clock: Clock) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.01, max_file_s=1e6)
    first = next(taken for taken in story.messages if taken.key.endswith("/change"))
    second = first._replace(payload=first.payload.replace(b'"s1"', b'"s2"'))
    assert second != first
    recording.take([first, second])
    recording.wait(1e6)
    recording.log.close()
    with in_order(tmp_path)[1].open("rb") as file:
        changes = [one.metadata["json"] for one in make_reader(file).iter_metadata() if one.name == CHANGE_METADATA]
    assert changes == [second.payload.decode()]


def test_no_log_is_written_over(tmp_path: Path, story: Story, clock: Clock) -> None:
    (tmp_path / "a.mcap").write_bytes(b"mine")
    for _ in range(2):
        recording = Recording(clock, story, path=tmp_path / "a.mcap")
        recording.take(story.messages[:50])
        recording.log.close()
    assert (tmp_path / "a.mcap").read_bytes() == b"mine"
    assert every_message([tmp_path / "a-0001.mcap"]) == numbered(story.messages[:50])
    assert every_message([tmp_path / "a-0002.mcap"]) == numbered(story.messages[:50])


def test_where_no_log_can_be_made_it_is_told_in_one_line(tmp_path: Path, story: Story, clock: Clock) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RecorderError) as refused:
        Recording(clock, story, path=tmp_path / "file" / "a.mcap")
    assert str(tmp_path / "file" / "a.mcap") in str(refused.value)
    assert "\n" not in str(refused.value)


# What a crash costs


def test_a_crash_costs_what_came_since_the_last_chunk_was_closed(tmp_path: Path, story: Story, clock: Clock) -> None:
    """Whatever stands in the file at any moment is older than `chunk_s`: nothing was closed here."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.25)
    for i in range(0, 1000, 50):
        recording.take(story.messages[i : i + 50])
        done = i + 50
        on_disk = sum(not topic.startswith("/") for topic in _topics_of_messages(tmp_path / "a.mcap"))
        assert done - on_disk <= 0.25 / (TICK_S / 2) + 1
    recording.log.close()


def test_a_chunk_is_closed_when_it_is_large_though_it_is_not_yet_due(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=60)
    small = next(taken for taken in story.messages if taken.key.endswith("/command"))
    recording.take([small])  # the very first is written at once
    before = disk.writes
    recording.take([small._replace(payload=os.urandom(1000)) for _ in range(1000)])
    assert (tmp_path / "a.mcap").stat().st_size > 1e6 - CHUNK_BYTES
    assert disk.writes - before == 1000 * (1000 + 31) // CHUNK_BYTES
    recording.log.close()


def _topics_of_messages(path: Path) -> list[str]:
    channels: dict[int, str] = {}
    found = []
    for record in records(path):
        if record.opcode == CHANNEL:
            channel = Channel.read(record.content)
            channels[channel.id] = channel.topic
        elif record.opcode == MESSAGE:
            found.append(channels[Message.read(record.content).channel])
    return found


# Retention


def test_the_oldest_of_ones_own_go_and_nobody_elses(
    tmp_path: Path, story: Story, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rolling, "LOOK_S", 0.01)
    others = {
        "b.mcap": b"of another name",
        "a-20261121.mcap": b"called as ours could be, and is not",
        "a-0500.mcap": b"",
        "a-0001.txt": b"no log",
    }
    for name, content in others.items():
        (tmp_path / name).write_bytes(content)
    another = Recording(clock, story, path=tmp_path / "another.mcap")
    another.log.close()
    (tmp_path / "another.mcap").rename(tmp_path / "a-0400.mcap")
    ours = Recording(clock, story, path=tmp_path / "a.mcap")
    ours.log.close()
    (tmp_path / "a.mcap").rename(tmp_path / "a-kept.mcap")  # somebody puts it aside
    others |= {name: (tmp_path / name).read_bytes() for name in ("a-0400.mcap", "a-kept.mcap")}
    for path in tmp_path.iterdir():
        os.utime(path, (0, 0))  # older than any of ours

    recording = Recording(
        clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=0.1, keep_gb=400e-6
    )  # some five files
    for i, taken in enumerate(story.messages):
        recording.take([taken])
        os.utime(recording.log.path, (1000 + i, 1000 + i))  # by the test's clock
    recording.log.close()

    assert {name: (tmp_path / name).read_bytes() for name in others} == others
    own = [path for path in in_order(tmp_path) if path.name not in others]
    numbers = [int(path.stem.removeprefix("a-")) for path in own]
    assert numbers == list(range(numbers[0], numbers[0] + len(own)))
    assert numbers[0] > 1, "the first ones are gone"
    assert own[-1] == recording.log.path
    sizes = [path.stat().st_size for path in own]
    assert sum(sizes[:-1]) < 400e3 < sum(sizes) + max(sizes), "no more than needed"
    removed = [text for text, _ in recording.told if text.startswith("removed")]
    assert len(removed) == numbers[0]
    kept = every_message(own)
    assert kept == numbered(story.messages)[-len(kept) :]


def test_the_file_that_is_written_stays_however_little_may_be_kept(tmp_path: Path, story: Story, clock: Clock) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=2.0, keep_gb=1e-9)
    recording.take(story.messages[:100])
    recording.wait(3.0)
    recording.take(story.messages[100:200])
    recording.log.close()
    assert [path.name for path in in_order(tmp_path)] == ["a-0001.mcap"]
    assert every_message(in_order(tmp_path)) == numbered(story.messages[:200])[100:]


def test_logs_named_by_the_time_are_kept_together_over_runs(tmp_path: Path, story: Story, clock: Clock) -> None:
    for name in ("aeroloop-20200101-000000", "demo-1"):
        recording = Recording(clock, story, path=tmp_path / f"{name}.mcap")
        recording.log.close()
    recording = Recording(clock, story, directory=tmp_path, keep_gb=1e-9)
    recording.log.close()
    assert not (tmp_path / "aeroloop-20200101-000000.mcap").exists()
    assert (tmp_path / "demo-1.mcap").exists()


# A disk that refuses


def test_a_full_disk_loses_nothing_wherever_it_was_full(tmp_path: Path, story: Story, clock: Clock, disk: Disk) -> None:
    """At every size that the file can come to: within the first chunk's head, its data, its index, between two."""
    messages = story.messages[:120]
    expected = numbered(messages)

    def record(name: str, room: int) -> Recording:
        disk.room = EVERYTHING
        recording = Recording(clock, story, path=tmp_path / name, chunk_s=0.03)
        disk.room = room
        recording.take(messages)
        disk.room = EVERYTHING
        recording.wait(rolling.RETRY_S)
        recording.log.close()
        return recording

    record("whole.mcap", EVERYTHING)
    decoded, whole = decoded_count([tmp_path / "whole.mcap"]), (tmp_path / "whole.mcap").stat().st_size
    header = _header_size(tmp_path / "whole.mcap")
    refused = 0
    for room in range(header, whole, (whole - header) // 61):
        recording = record(f"{room}.mcap", room)
        assert recording.waiting == []
        path = tmp_path / f"{room}.mcap"
        assert list(raw(path)) == expected, f"full at {room}"
        assert decoded_count([path]) == decoded
        assert recording.log.written == len(messages)
        if recording.told:  # else the last bytes, of the index, came when there was room again
            refused += 1
            assert [bad for _, bad in recording.told] == [True, False]
            assert os.strerror(errno.ENOSPC) in recording.told[0][0]
            assert recording.told[1][0] == f"recording again to {path}"
    assert refused > 20
    assert not list(tmp_path.glob("*-0*.mcap")), "all went into one file each"


def _header_size(path: Path) -> int:
    """Where the first chunk begins."""
    return next(record.offset for record in records(path) if record.opcode in (MESSAGE, CHANNEL))


def test_what_is_on_a_full_disk_can_be_read_as_it_is(tmp_path: Path, story: Story, clock: Clock, disk: Disk) -> None:
    """No half of a chunk stays behind, and the room that it took is given back."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.03)
    disk.room = 40_000
    recording.take(story.messages[:400])
    assert not recording.log.writable
    damages: list[Damage] = []
    assert MESSAGE in [record.opcode for record in records(tmp_path / "a.mcap", damages)]
    assert [damage.what for damage in damages] == ["the file ends here, without its index"]
    disk.room = EVERYTHING
    recording.wait(rolling.RETRY_S)
    recording.log.close()


def test_a_disk_that_writes_a_little_at_a_time_is_written_to_the_end(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    disk.at_once = 1000
    recording = Recording(clock, story, path=tmp_path / "a.mcap")
    recording.take(story.messages[:200])
    recording.log.close()
    assert list(raw(tmp_path / "a.mcap")) == numbered(story.messages[:200])


def test_while_a_disk_is_full_it_is_tried_once_a_second_and_told_of_once(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.03)
    disk.room = 0
    recording.take(story.messages[:100])
    assert not recording.log.writable
    before = disk.writes
    for _ in range(100):
        recording.wait(0.1)
    assert 9 <= disk.writes - before <= 10
    assert len(recording.told) == 1
    disk.room = EVERYTHING
    recording.wait(1.0)
    recording.log.close()


@pytest.mark.parametrize(
    "first", [None, (errno.EIO, errno.ENOSPC), (errno.EIO, 0, errno.ENOSPC)], ids=["it", "its head", "its messages"]
)
def test_a_broken_disk_is_left_for_a_new_file_and_nothing_is_lost_or_doubled(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk, first: tuple[int, ...] | None
) -> None:
    """Even if at first there is no room for the new file: what came to nothing is removed."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05)
    recording.take(story.messages[:330])
    disk.broken = errno.EIO
    recording.take(story.messages[330:500])
    recording.wait(2.0)
    assert not recording.log.writable
    if first:
        _errors(disk, *first)
        recording.wait(1.0)
        assert not recording.log.writable
        assert [path.name for path in in_order(tmp_path)] == ["a.mcap"]
    _errors(disk, errno.EIO, 0)  # the old file's, and then none
    recording.wait(1.0)
    recording.take(story.messages[500:])
    recording.log.close()
    old, new = in_order(tmp_path)
    recover(old, tmp_path / "recovered")
    assert every_message([tmp_path / "recovered", new]) == numbered(story.messages)
    (session,) = replay([old, new])
    assert (session.commands, session.differing) == (TICKS, 0)


def _errors(disk: Disk, *errors: int) -> None:
    """What the next writes give, and all that follow as the last one does."""
    coming = list(errors)

    def changes(_: int) -> None:
        disk.broken = coming.pop(0) if len(coming) > 1 else coming[0]

    disk.changes = changes


def test_a_file_that_is_moved_or_removed_is_told_of_and_another_begun(
    tmp_path: Path, story: Story, clock: Clock
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05)
    recording.take(story.messages[:100])
    (tmp_path / "a.mcap").rename(tmp_path / "moved")
    recording.wait(rolling.LOOK_S)
    recording.take(story.messages[100:200])
    (tmp_path / "a-0001.mcap").unlink()
    recording.wait(rolling.LOOK_S)
    recording.take(story.messages[200:300])
    recording.log.close()
    assert recording.told_bad() == [
        f"{tmp_path / name} was moved or removed while it was written" for name in ("a.mcap", "a-0001.mcap")
    ]
    expected = numbered(story.messages[:300])
    assert list(raw(tmp_path / "moved")) == expected[:100]
    assert list(raw(tmp_path / "a-0002.mcap")) == expected[200:]


def test_where_no_new_file_can_be_begun_the_old_one_goes_on(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=2.0)
    recording.take(story.messages[:100])
    disk.new_files = errno.EACCES
    recording.wait(2.5)
    recording.take(story.messages[100:200])
    recording.wait(1.5)  # time enough to look again, but not to try again
    assert recording.told_bad() == [
        f"no new file can be begun ({os.strerror(errno.EACCES)}), so {tmp_path / 'a.mcap'} goes on"
    ]
    disk.new_files = 0
    recording.wait(1.0)
    recording.take(story.messages[200:300])
    recording.log.close()
    expected = numbered(story.messages[:300])
    assert list(raw(tmp_path / "a.mcap")) == expected[:200]
    assert list(raw(tmp_path / "a-0001.mcap")) == expected[200:]


def test_a_new_file_that_finds_the_disk_full_leaves_nothing_behind(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=2.0)
    recording.take(story.messages[:600])
    size = (tmp_path / "a.mcap").stat().st_size

    def changes(offset: int) -> None:
        disk.room = EVERYTHING if offset >= size else 1000  # there is none for the head of another

    disk.changes = changes
    recording.wait(2.5)
    assert [path.name for path in in_order(tmp_path)] == ["a.mcap"]
    assert recording.log.writable
    recording.log.close()
    assert list(raw(tmp_path / "a.mcap")) == numbered(story.messages[:600])


# The end


def test_the_end_on_a_full_disk_is_told_in_one_line_and_what_was_written_can_be_recovered(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1)
    recording.take(story.messages[:250])
    size = (tmp_path / "a.mcap").stat().st_size
    disk.room = size
    recording.take(story.messages[250:270])
    recording.log.try_again()
    with pytest.raises(RecorderError) as refused:
        recording.log.close(waiting=3)
    written = recover(tmp_path / "a.mcap", tmp_path / "recovered")
    kept = every_message([tmp_path / "recovered"])
    assert written.messages == len(kept) + decoded_count([tmp_path / "recovered"])
    assert kept == numbered(story.messages[:270])[: len(kept)]
    assert str(refused.value) == (
        f"{270 - len(kept) + 3} messages and the index of {tmp_path / 'a.mcap'} could not be written: "
        f"{os.strerror(errno.ENOSPC)}; what came before is whole, and `aeroloop log recover` gives it an index"
    )
    assert 0 < len(kept) < 270


def test_the_last_messages_are_written_even_where_the_index_has_no_room(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    whole = Recording(clock, story, path=tmp_path / "whole.mcap", chunk_s=0.1)
    whole.take(story.messages[:250])
    whole.log.close()
    disk.room = (tmp_path / "whole.mcap").stat().st_size - 200  # the index is larger
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1)
    recording.take(story.messages[:250])
    with pytest.raises(RecorderError, match=r"^the index of "):
        recording.log.close()
    disk.room = EVERYTHING
    recover(tmp_path / "a.mcap", tmp_path / "recovered")
    assert every_message([tmp_path / "recovered"]) == numbered(story.messages[:250])


def test_a_disk_that_has_room_again_is_tried_before_the_end(
    tmp_path: Path, story: Story, clock: Clock, disk: Disk
) -> None:
    """A recorder that is stopped need not wait for the next try."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.03)
    disk.room = 0
    recording.take(story.messages[:100])
    disk.room = EVERYTHING
    recording.log.try_again()
    recording.wait(0.0)
    recording.log.close(len(recording.waiting))
    assert list(raw(tmp_path / "a.mcap")) == numbered(story.messages[:100])
