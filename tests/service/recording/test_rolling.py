"""Rolling log: every message stands in a file that can be read alone, whatever disk and folder do meanwhile."""

from __future__ import annotations

import errno
import json
import os
import random
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Attachment, Channel, Message

from aeroloop.protocol.transport.history import Delivery
from aeroloop.service.logs.mcap_file import DESCRIPTION_METADATA, RECORDER_METADATA, records, with_checksum
from aeroloop.service.recording import rolling
from aeroloop.service.recording.rolling import RecorderError, RollingLog, parts
from aeroloop.service.settings import RecorderSettings
from aeroloop.service.viewers.schemas import Decoded, Shape
from tests.support.edited_log import by_mcap, contents

KEY, DESCRIPTION = "aeroloop/aero/telemetry", "aeroloop/aero/description/plant"
START_NS = 1_800_000_000_000_000_000
HEAD = Path("protocol/SPEC.md").stat().st_size + 1000
"""Bytes at a file's beginning, about."""
SHAPE = Shape("x", "jsonschema", b"{}", "json")
EVERYTHING = 1 << 60


class Disk:
    """Where files are written: `room` bytes for each, `at_once` per call.

    Every call gives `error`, the first into a file `at_heads`; 0 is none.
    """

    def __init__(self) -> None:
        self.room = self.at_once = EVERYTHING
        self.error = self.at_heads = self.calls = 0
        self._write = os.pwrite

    def write(self, fd: int, data: memoryview, offset: int) -> int:
        self.calls += 1
        size = min(len(data), self.at_once, self.room - offset)
        if error := self.error or (self.at_heads if not offset else 0) or (errno.ENOSPC if size <= 0 else 0):
            raise OSError(error, os.strerror(error))
        return self._write(fd, data[:size], offset)


@pytest.fixture(autouse=True)
def every_50_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks are written so often."""
    monkeypatch.setattr(rolling, "CHUNK_S", 0.05)


@pytest.fixture
def disk() -> Iterator[Disk]:
    disk = Disk()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "pwrite", disk.write)
        patch.setattr(os, "fdatasync", lambda _: None)
        yield disk


class Run:
    """A log that is fed as the recorder does: a message of 200 bytes a millisecond; what the disk refuses waits."""

    def __init__(self, path: Path, **options: float) -> None:
        self.now, self.count, self.reported = 1000.0, 0, list[tuple[str, bool]]()
        self.waiting: list[int] = []
        settings = RecorderSettings.model_validate({"path": path, **options})
        self.log = RollingLog(settings, lambda *reported: self.reported.append(reported), lambda: self.now)
        self.log.add_description(DESCRIPTION, b'{"a":1}')

    def take(self, count: int) -> None:
        for _ in range(count):
            self.waiting.append(self.count)
            self.count += 1
            self.wait(0.001)

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.log.tend()
        while self.waiting and not self.log.trouble:
            number = self.waiting.pop(0)
            at_ns = START_NS + number * 1_000_000
            decoded = [Decoded("/aero/x", SHAPE, b"{}", at_ns)]
            self.log.add(Delivery(KEY, payload(number), number, at_ns, 1), at_ns + 77, decoded)

    def faults(self) -> list[str]:
        return [text for text, bad in self.reported if bad]


def payload(number: int) -> bytes:
    """Does not compress."""
    return random.Random(number).randbytes(200)


def numbers(path: Path, damages: list[str] | None = None) -> list[int]:
    """Of the messages in a file, also in one without index, all as they were given."""
    read = list(records(path, damages))
    ours = {one.id for one in read if isinstance(one, Channel) and one.topic == KEY}
    found = [one for one in read if isinstance(one, Message) and one.channel_id in ours]
    for one in found:
        at_ns = START_NS + one.sequence * 1_000_000
        assert (one.data, one.publish_time, one.log_time) == (payload(one.sequence), at_ns, at_ns + 77)
    return [one.sequence for one in found]


def indexed(path: Path) -> tuple[int, int]:
    """How many messages, raw and decoded, mcap's own reader finds by the index; checksums checked."""
    topics = [one.topic for one in by_mcap(path)]
    return topics.count(KEY), topics.count("/aero/x")


WHAT = st.sampled_from(["take", "wait", "full", "broken", "slow", "no file", "mend", "move", "remove"])
STEPS = st.tuples(WHAT, st.integers(1, 150))


@settings(max_examples=60, deadline=None)
@given(steps=st.lists(STEPS, max_size=25), max_file_s=st.sampled_from([0.2, 3600.0]))
def test_whatever_happens_to_disk_and_files_every_message_is_recorded_and_every_closed_file_is_whole(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]], max_file_s: float
) -> None:
    folder, aside = tmp_path_factory.mktemp("log"), tmp_path_factory.mktemp("aside")
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk()
        patch.setattr(os, "pwrite", disk.write)
        patch.setattr(rolling, "MAX_FILE_S", max_file_s)
        run = Run(folder / "a.mcap")
        for i, (step, n) in enumerate(steps):
            size = run.log.path.stat().st_size if run.log.path.exists() else 0
            match step:
                case "take":
                    run.take(n)
                case "wait":
                    run.wait(n / 50)
                case "full":
                    disk.room = size + 100 * n
                case "broken":
                    disk.error = errno.EIO
                case "slow":
                    disk.at_once = 100 * n
                case "no file":
                    disk.at_heads = errno.EACCES
                case "mend":
                    disk.room, disk.error, disk.at_heads = EVERYTHING, 0, 0
                case "move" if run.log.path.exists():
                    run.log.path.rename(aside / f"{i}.moved")
                case "remove" if run.log.path.exists():  # what is on the disk goes with it
                    shutil.copy(run.log.path, aside / f"{i}.removed")
                    run.log.path.unlink()
        disk.room, disk.at_once, disk.error, disk.at_heads = EVERYTHING, EVERYTHING, 0, 0
        run.wait(rolling.RETRY_S)
        run.take(1)
        run.log.close(len(run.waiting))
    files = [*folder.iterdir(), *aside.iterdir()]
    assert {number for path in files for number in numbers(path)} == set(range(run.count))
    assert run.log.written == run.count
    said = " ".join(run.faults())
    for path in files:
        found = numbers(path)
        assert found == sorted(set(found))
        if path.suffix == ".mcap" and f"the index of {path}" not in said:
            assert indexed(path) == (len(found), len(found))


def test_a_fault_that_lasts_is_tried_every_second_and_reported_every_minute(tmp_path: Path, disk: Disk) -> None:
    run, path = Run(tmp_path / "a.mcap"), tmp_path / "a.mcap"
    disk.room, before = 0, disk.calls
    run.take(100)
    refused = f"{path} cannot be written: {os.strerror(errno.ENOSPC)}"
    assert run.log.trouble == refused
    for _ in range(600):
        run.wait(0.1)
    assert 55 <= disk.calls - before <= 62
    assert run.faults() == [f"{refused}; messages are kept in memory and written when it can be"]
    for _ in range(10):
        run.wait(0.1)
    assert len(run.faults()) == 2
    disk.room = EVERYTHING
    run.log.tend(at_once=True)  # as a recorder that is stopped does
    assert run.reported[-1] == (f"recording again to {path}", False)
    run.wait(0.0)
    run.log.close(len(run.waiting))
    assert (numbers(path), indexed(path)) == (list(range(100)), (100, 100))


def test_a_removed_file_and_a_missing_folder_are_reported(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    run = Run(folder / "a.mcap")
    run.take(100)
    (folder / "a.mcap").unlink()
    run.wait(1.0)
    assert run.faults() == [f"{folder / 'a.mcap'} was removed while it was written"]
    shutil.rmtree(folder)
    run.take(100)
    assert run.log.trouble == f"{folder / 'a-0001.mcap'} cannot be written: {os.strerror(errno.ENOENT)}"
    folder.mkdir()
    run.wait(rolling.RETRY_S)
    run.log.close()
    assert numbers(folder / "a-0002.mcap")[-100:] == list(range(100, 200))


def test_a_file_that_is_removed_to_make_room_gives_its_room_back(tmp_path: Path, disk: Disk) -> None:
    run = Run(tmp_path / "a.mcap")
    disk.room = 0
    run.take(100)
    (tmp_path / "a.mcap").unlink()
    run.wait(rolling.RETRY_S)
    assert str(tmp_path) not in str([os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")])
    assert run.log.trouble


def test_the_end_on_a_full_disk_is_one_line_and_what_was_written_can_be_read(tmp_path: Path, disk: Disk) -> None:
    run = Run(tmp_path / "a.mcap")
    run.take(250)
    disk.room = (tmp_path / "a.mcap").stat().st_size
    with pytest.raises(RecorderError) as refused:
        run.log.close(waiting=3)
    kept = numbers(tmp_path / "a.mcap")
    assert 0 < len(kept) < 250
    assert kept == list(range(len(kept)))
    assert str(refused.value) == (
        f"{250 - len(kept) + 3} messages and the index of {tmp_path / 'a.mcap'} could not be written: "
        f"{os.strerror(errno.ENOSPC)}; what came before is whole, "
        "and `aeroloop log export --format mcap` gives it an index"
    )


def test_a_disk_that_is_full_in_the_midst_of_a_chunk_leaves_no_torn_one(tmp_path: Path, disk: Disk) -> None:
    """What the disk had taken of it is taken back at once: a crash then would leave a file that ends in it."""
    run, path = Run(tmp_path / "a.mcap"), tmp_path / "a.mcap"
    run.take(250)
    whole, kept = path.stat().st_size, numbers(path)
    disk.room = whole + 100
    run.take(100)
    assert run.log.trouble
    assert path.stat().st_size == whole
    assert numbers(path) == kept
    disk.room = EVERYTHING
    run.log.close()


def test_a_description_that_is_published_again_unchanged_is_written_once_and_at_the_end(tmp_path: Path) -> None:
    run = Run(tmp_path / "a.mcap")
    for text in (b'{"a":1}', b'{"a":2}', b'{"a":2}', b'{"a":2}'):
        run.log.add_description(DESCRIPTION, text)
    run.log.close()
    written = [entry["json"] for name, entry in contents(tmp_path / "a.mcap")[1] if name == DESCRIPTION_METADATA]
    assert written == ['{"a":1}', '{"a":2}', '{"a":2}']


@pytest.mark.parametrize(("number", "sequence"), [(70_000, 70_000), (2**32 - 1, 2**32 - 1), (2**32 + 5, 5)])
def test_a_sequence_is_the_number_of_the_message_modulo_its_32_bits(tmp_path: Path, number: int, sequence: int) -> None:
    run = Run(tmp_path / "a.mcap")
    run.log.add(Delivery(KEY, b"x", number, START_NS, 1), START_NS, [])
    run.log.close()
    assert [message.sequence for message in by_mcap(tmp_path / "a.mcap")] == [sequence]


# ── files of a run ──


@pytest.mark.parametrize("by_size", [True, False])
def test_each_file_of_a_run_can_be_read_alone_and_is_no_longer_than_configured_by_more_than_a_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_size: bool
) -> None:
    """Also while it is written: a crash costs what came since the last chunk was due."""
    monkeypatch.setattr(rolling, "MAX_FILE_S", 3600.0 if by_size else 0.4)
    run = Run(tmp_path / "a.mcap", max_file_mb=(HEAD + 50_000) / 1e6 if by_size else 256.0)
    for _ in range(60):
        run.take(20)
        assert sum(len(numbers(path)) for path in parts(tmp_path / "a.mcap")) >= run.count - 51
    run.log.close()
    files, identities = parts(tmp_path / "a.mcap"), set()
    assert [path.name for path in files] == ["a.mcap", *(f"a-{part:04}.mcap" for part in range(1, len(files)))]
    assert [number for path in files for number in numbers(path)] == list(range(1200))
    if by_size:
        sizes = [int.from_bytes(path.read_bytes()[-28:-20], "little") for path in files[:-1]]  # without their indexes
        assert all(HEAD + 49_000 < size < HEAD + 70_000 for size in sizes)
    else:
        assert all(399 <= len(numbers(path)) <= 460 for path in files[:-1])
    for path in files:
        (attached,) = [one for one in records(path) if isinstance(one, Attachment)]
        assert (attached.name, attached.data) == ("protocol/SPEC.md", Path("protocol/SPEC.md").read_bytes())
        _, found = contents(path)
        description = with_checksum(DESCRIPTION_METADATA, {"key": DESCRIPTION, "json": '{"a":1}'})
        assert [entries for name, entries in found if name == DESCRIPTION_METADATA] == [description] * 2
        (known,) = [json.loads(entries["json"]) for name, entries in found if name == RECORDER_METADATA]
        assert (known["run"], known["part"]) == ("a", path.stem)
        identities.add(known["id"])
    assert len(identities) == 1
    assert run.reported == []


def test_no_log_is_written_over_and_where_none_can_be_made_one_line_names_it(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"mine")
    for _ in range(2):
        run = Run(tmp_path / "a.mcap")
        run.take(10)
        run.log.close()
    assert (tmp_path / "a.mcap").read_bytes() == b"mine"
    assert [numbers(tmp_path / name) for name in ("a-0001.mcap", "a-0002.mcap")] == [list(range(10))] * 2
    with pytest.raises(RecorderError) as refused:
        Run(tmp_path / "a.mcap" / "b.mcap")
    assert str(tmp_path / "a.mcap" / "b.mcap") in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_oldest_of_ones_own_go_and_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rolling, "MAX_FILE_S", 0.1)
    for name in ("another", "a"):
        Run(tmp_path / f"{name}.mcap").log.close()
    (tmp_path / "another.mcap").rename(tmp_path / "a-0400.mcap")
    (tmp_path / "a.mcap").rename(tmp_path / "a-kept.mcap")  # somebody puts it aside
    for name in ("b.mcap", "a-20261121.mcap", "a-0500.mcap", "a-0001.txt"):
        (tmp_path / name).write_bytes(b"not ours")
    others = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for path in others:
        os.utime(path, (0, 0))  # older than any of ours
    run = Run(tmp_path / "a.mcap", keep_gb=350e-6)  # some four files
    for i in range(1500):
        run.take(1)
        os.utime(run.log.path, (1000 + i, 1000 + i))
    run.log.close()
    assert {path: path.read_bytes() for path in others} == others
    own = [path for path in parts(tmp_path / "a.mcap") if path not in others]
    first = int(own[0].stem.removeprefix("a-"))
    assert [path.name for path in own] == [f"a-{first + i:04}.mcap" for i in range(len(own))]
    assert own[-1] == run.log.path
    sizes = [path.stat().st_size for path in own]
    assert sum(sizes[:-1]) < 350e3 < sum(sizes) + max(sizes), "no more than needed"
    assert len([text for text, _ in run.reported if text.startswith("removed")]) == first > 1


@pytest.mark.parametrize("name", ["run1", "with.dot"])
def test_in_a_folder_logs_are_named_by_the_time_and_kept_together_over_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file that is written stays, however little may be kept. A name without an ending is a folder."""
    monkeypatch.setattr(rolling, "MAX_FILE_S", 2.0)
    folder = tmp_path / name
    if folder.suffix:
        folder.mkdir()
    for other in ("aeroloop-20200101-000000", "demo-1"):
        Run(folder / f"{other}.mcap").log.close()
    run = Run(folder, keep_gb=1e-9)
    run.take(100)
    run.wait(3.0)
    run.take(100)
    run.log.close()
    assert re.fullmatch(r"aeroloop-\d{8}-\d{6}-0001\.mcap", run.log.path.name)
    assert set(folder.iterdir()) == {folder / "demo-1.mcap", run.log.path}
    assert numbers(run.log.path) == list(range(100, 200))
