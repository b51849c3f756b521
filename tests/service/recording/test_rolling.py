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
from aeroloop.service.recording import rolling
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

TRACE = "aeroloop/aero/trace/controller"
LARGE = Path("protocol/SPEC.md").stat().st_size + 15_000
"""Bytes of a file: what stands at its head, and some chunks."""

ROTATIONS = {"by size": {"max_file_mb": LARGE / 1e6}, "by time": {"max_file_s": 0.4}}


@pytest.fixture(params=ROTATIONS)
def rotated(
    request: pytest.FixtureRequest, tmp_path: Path, story: EventLog, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A folder with the session in several files."""
    monkeypatch.setattr(rolling, "LOOK_S", 0.01)
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1, **ROTATIONS[request.param])
    recording.take(story.messages)
    recording.log.close()
    assert recording.reported == []
    return tmp_path


# Rotation


def test_over_all_files_every_message_stands_once_and_their_numbers_go_on(rotated: Path, story: EventLog) -> None:
    files = in_order(rotated)
    assert len(files) >= 3
    assert [path.name for path in files] == ["a.mcap", *(f"a-{part:04}.mcap" for part in range(1, len(files)))]
    assert all(any(raw(path)) for path in files)
    assert every_message(files) == numbered(story.messages)


def test_no_file_is_larger_or_older_than_configured_by_more_than_a_chunk(
    tmp_path: Path, story: EventLog, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rolling, "LOOK_S", 0.01)
    for name, settings in ROTATIONS.items():
        folder = tmp_path / name
        recording = Recording(clock, story, path=folder / "a.mcap", chunk_s=0.1, **settings)
        recording.take(story.messages)
        recording.log.close()
        if name == "by size":
            data = [_without_index(path) for path in in_order(folder)[:-1]]
            most = LARGE + 12_000 + len(story.description)
            assert all(LARGE <= size < most for size in data), "a chunk of 100 ms has up to 12 kB"
        else:
            starts = [next(raw(path))[3] for path in in_order(folder)]
            assert all(0.35e9 < b - a < 0.55e9 for a, b in pairwise(starts))


def _without_index(path: Path) -> int:
    return int.from_bytes(path.read_bytes()[-28:-20], "little")  # what the footer says


def test_every_file_has_all_that_it_takes_to_read_it_alone(rotated: Path, story: EventLog) -> None:
    identities = set()
    for path in in_order(rotated):
        with path.open("rb") as file:
            reader = make_reader(file)
            found = [(one.name, dict(one.metadata)) for one in reader.iter_metadata()]
            attachments = {one.name: one.data for one in reader.iter_attachments()}
        assert attachments == {"protocol/SPEC.md": Path("protocol/SPEC.md").read_bytes()}
        description = with_checksum(DESCRIPTION_METADATA, {"key": story.key, "json": story.description.decode()})
        assert [entries for name, entries in found if name == DESCRIPTION_METADATA] == [description] * 2
        (said,) = [entries["json"] for name, entries in found if name == RECORDER_METADATA]
        known = json.loads(said)
        assert (known["run"], known["part"]) == ("a", path.stem)
        identities.add(known["id"])
    assert len(identities) == 1


def test_a_log_given_as_a_folder_is_written_in_it_and_its_oldest_files_go(
    tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    (tmp_path / "logs").mkdir()
    for _ in range(2):
        recording = Recording(clock, story, path=tmp_path / "logs", chunk_s=0.05, keep_gb=1e-9)
        recording.take(story.messages[:100])
        recording.log.close()
        assert re.fullmatch(r"aeroloop-\d{8}-\d{6}(-\d{4})?\.mcap", recording.log.path.name)
    assert list(tmp_path.iterdir()) == [tmp_path / "logs"]
    assert list((tmp_path / "logs").iterdir()) == [recording.log.path]


def test_no_log_is_written_over(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    (tmp_path / "a.mcap").write_bytes(b"mine")
    for _ in range(2):
        recording = Recording(clock, story, path=tmp_path / "a.mcap")
        recording.take(story.messages[:50])
        recording.log.close()
    assert (tmp_path / "a.mcap").read_bytes() == b"mine"
    assert every_message([tmp_path / "a-0001.mcap"]) == numbered(story.messages[:50])
    assert every_message([tmp_path / "a-0002.mcap"]) == numbered(story.messages[:50])


def test_of_a_folder_the_log_goes_into_it_under_a_name_by_the_time(
    tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    (tmp_path / "here").mkdir()
    recording = Recording(clock, story, path=tmp_path / "here", max_file_s=1e6, keep_gb=1e-9)
    recording.take(story.messages[:50])
    recording.wait(1e6)
    recording.log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["here"]
    (left,) = (tmp_path / "here").iterdir()  # the second; the first went, because logs so named are the recorder's own
    assert re.fullmatch(r"aeroloop-\d{8}-\d{6}-0001\.mcap", left.name)


def test_where_no_log_can_be_made_it_is_reported_in_one_line(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RecorderError) as refused:
        Recording(clock, story, path=tmp_path / "file" / "a.mcap")
    assert str(tmp_path / "file" / "a.mcap") in str(refused.value)
    assert "\n" not in str(refused.value)


# What a crash costs


def test_a_crash_costs_what_came_since_the_last_chunk_was_closed(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    """Whatever stands in the file at any moment is older than `chunk_s`: nothing was closed here."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.25)
    for i in range(0, 1000, 50):
        recording.take(story.messages[i : i + 50])
        done = i + 50
        on_disk = sum(not topic.startswith("/") for topic in _topics_of_messages(tmp_path / "a.mcap"))
        assert done - on_disk <= 0.25 / (TICK_S / 2) + 1
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


def _topics_of_messages(path: Path) -> list[str]:
    channels: dict[int, str] = {}
    found = []
    for record in records(path):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            found.append(channels[record.channel_id])
    return found


# Retention


def test_the_oldest_of_ones_own_go_and_no_other_file(
    tmp_path: Path, story: EventLog, clock: Clock, monkeypatch: pytest.MonkeyPatch
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


def test_the_file_that_is_written_stays_however_little_may_be_kept(
    tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=2.0, keep_gb=1e-9)
    recording.take(story.messages[:100])
    recording.wait(3.0)
    recording.take(story.messages[100:200])
    recording.log.close()
    assert [path.name for path in in_order(tmp_path)] == ["a-0001.mcap"]
    assert every_message(in_order(tmp_path)) == numbered(story.messages[:200])[100:]


def test_logs_named_by_the_time_are_kept_together_over_runs(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    for name in ("aeroloop-20200101-000000", "demo-1"):
        recording = Recording(clock, story, path=tmp_path / f"{name}.mcap")
        recording.log.close()
    recording = Recording(clock, story, directory=tmp_path, keep_gb=1e-9)
    recording.log.close()
    assert not (tmp_path / "aeroloop-20200101-000000.mcap").exists()
    assert (tmp_path / "demo-1.mcap").exists()


def test_a_name_without_an_ending_is_a_folder(tmp_path: Path, story: EventLog, clock: Clock) -> None:
    """A review of the folder above finds it only with its ending."""
    recording = Recording(clock, story, path=tmp_path / "run1")
    recording.log.close()
    assert [path.parent.name for path in tmp_path.rglob("*.mcap")] == ["run1"]
