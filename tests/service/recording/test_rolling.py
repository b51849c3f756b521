"""Rotated run: every message once, every file readable alone, the oldest deleted, none overwritten."""

from __future__ import annotations

import json
import os
import re
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Message

from aeroloop.service.logs.mcap_file import (
    CHUNK_BYTES,
    DESCRIPTION_METADATA,
    RECORDER_METADATA,
    records,
    with_checksum,
)
from aeroloop.service.recording.rolling import RecorderError
from tests.support.made_recording import (
    TICK_S,
    Arrived,
    Clock,
    Disk,
    EventLog,
    Recording,
    every_message,
    in_order,
    numbered,
    raw,
)

LARGE = Path("protocol/SPEC.md").stat().st_size + 15_000
"""Bytes of a file: what stands at its head, and some chunks."""

TIMED = re.compile(r"aeroloop-\d{8}-\d{6}(-\d{4})?\.mcap")


@pytest.mark.parametrize("settings", [{"max_file_mb": LARGE / 1e6}, {"max_file_s": 0.4}], ids=["by size", "by time"])
def test_over_all_files_every_message_stands_once_and_each_file_can_be_read_alone(
    settings: dict[str, float], tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    """No file is larger or older than configured by more than a chunk."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1, **settings)
    recording.take(story.messages)
    recording.log.close()
    assert recording.reported == []
    files, identities = in_order(tmp_path), set()
    assert len(files) >= 3
    assert [path.name for path in files] == ["a.mcap", *(f"a-{part:04}.mcap" for part in range(1, len(files)))]
    assert every_message(files) == numbered(story.messages)
    if "max_file_mb" in settings:
        data = [int.from_bytes(path.read_bytes()[-28:-20], "little") for path in files[:-1]]  # by their footers
        assert all(LARGE <= size < LARGE + 12_000 + len(story.description) for size in data), "100 ms are up to 12 kB"
    else:
        starts = [next(raw(path))[3] for path in files]
        assert all(0.35e9 < b - a < 0.55e9 for a, b in pairwise(starts))
    for path in files:
        with path.open("rb") as file:
            reader = make_reader(file)
            found = [(one.name, dict(one.metadata)) for one in reader.iter_metadata()]
            attachments = {one.name: one.data for one in reader.iter_attachments()}
        assert attachments == {"protocol/SPEC.md": Path("protocol/SPEC.md").read_bytes()}
        description = with_checksum(DESCRIPTION_METADATA, {"key": story.key, "json": story.description.decode()})
        assert [entries for name, entries in found if name == DESCRIPTION_METADATA] == [description] * 2
        (known,) = [json.loads(entries["json"]) for name, entries in found if name == RECORDER_METADATA]
        assert (known["run"], known["part"]) == ("a", path.stem)
        identities.add(known["id"])
    assert len(identities) == 1


def test_no_log_is_written_over(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    (tmp_path / "a.mcap").write_bytes(b"mine")
    for _ in range(2):
        recording = Recording(clock, story, path=tmp_path / "a.mcap")
        recording.take(story.messages[:50])
        recording.log.close()
    assert (tmp_path / "a.mcap").read_bytes() == b"mine"
    assert every_message([tmp_path / "a-0001.mcap"]) == numbered(story.messages[:50])
    assert every_message([tmp_path / "a-0002.mcap"]) == numbered(story.messages[:50])


def test_where_no_log_can_be_made_it_is_reported_in_one_line(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RecorderError) as refused:
        Recording(clock, story, path=tmp_path / "file" / "a.mcap")
    assert str(tmp_path / "file" / "a.mcap") in str(refused.value)
    assert "\n" not in str(refused.value)


# ── what a crash costs ──


def test_a_crash_costs_what_came_since_the_last_chunk_was_closed(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    """Whatever stands in the file at any moment is older than `chunk_s`: nothing was closed here."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.25)
    for done in range(50, 1001, 50):
        recording.take(story.messages[done - 50 : done])
        on_disk = list(records(tmp_path / "a.mcap"))
        keys = {one.id for one in on_disk if isinstance(one, Channel) and not one.topic.startswith("/")}
        count = sum(isinstance(one, Message) and one.channel_id in keys for one in on_disk)
        assert done - count <= 0.25 / (TICK_S / 2) + 1
    recording.log.close()


def test_a_chunk_is_closed_when_it_is_large_though_it_is_not_yet_due(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=60)
    small = story.messages[0]
    recording.take([small])  # the very first is written at once
    before = disk.writes
    large = [Arrived(small.received._replace(payload=os.urandom(1000)), small.at_ns) for _ in range(1000)]
    recording.take(large)
    assert (tmp_path / "a.mcap").stat().st_size > 1e6 - CHUNK_BYTES
    assert disk.writes - before == 1000 * (1000 + 31) // CHUNK_BYTES
    recording.log.close()


def test_chunks_that_are_full_before_they_are_due_put_off_no_new_file(
    tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1, max_file_s=0.4)
    small = story.messages[0]
    large = [Arrived(small.received._replace(payload=os.urandom(CHUNK_BYTES)), small.at_ns) for _ in range(600)]
    recording.take(large)
    recording.log.close()
    assert len(in_order(tmp_path)) >= 600 * TICK_S / 2 / 0.5


# ── names and retention ──


def test_the_oldest_of_ones_own_go_and_no_other_file(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    others = {
        "b.mcap": b"of another name",
        "a-20261121.mcap": b"called as ours could be, and is not",
        "a-0500.mcap": b"",
        "a-0001.txt": b"no log",
    }
    for name, content in others.items():
        (tmp_path / name).write_bytes(content)
    Recording(clock, story, path=tmp_path / "another.mcap").log.close()
    (tmp_path / "another.mcap").rename(tmp_path / "a-0400.mcap")
    Recording(clock, story, path=tmp_path / "a.mcap").log.close()
    (tmp_path / "a.mcap").rename(tmp_path / "a-kept.mcap")  # somebody puts it aside
    others |= {name: (tmp_path / name).read_bytes() for name in ("a-0400.mcap", "a-kept.mcap")}
    for path in tmp_path.iterdir():
        os.utime(path, (0, 0))  # older than any of ours

    recording = Recording(
        clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=0.1, keep_gb=400e-6
    )  # some five files
    for i, arrived in enumerate(story.messages):
        recording.take([arrived])
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
    removed = [text for text, _ in recording.reported if text.startswith("removed")]
    assert len(removed) == numbers[0]
    kept = every_message(own)
    assert kept == numbered(story.messages)[-len(kept) :]


@pytest.mark.parametrize("name", ["run1", "with.dot"])
def test_in_a_folder_logs_are_named_by_the_time_and_kept_together_over_runs(
    name: str, tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    """The file that is written stays, however little may be kept. A name without an ending is a folder."""
    folder = tmp_path / name
    if folder.suffix:
        folder.mkdir()
    for other in ("aeroloop-20200101-000000", "demo-1"):
        Recording(clock, story, path=folder / f"{other}.mcap").log.close()
    for place in ({"path": folder}, {"directory": folder}):
        recording = Recording(clock, story, **place, chunk_s=0.05, max_file_s=2.0, keep_gb=1e-9)
        recording.take(story.messages[:100])
        recording.wait(3.0)
        recording.take(story.messages[100:200])
        recording.log.close()
        assert TIMED.fullmatch(recording.log.path.name)
        assert set(folder.iterdir()) == {folder / "demo-1.mcap", recording.log.path}
        assert every_message([recording.log.path]) == numbered(story.messages[:200])[100:]
    assert list(tmp_path.iterdir()) == [folder]
