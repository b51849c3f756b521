"""Log on a full, broken or missing disk: in the end every message is written once and each failure reported once."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.records import Message

from aeroloop.service.logs.mcap_file import Damage, records
from aeroloop.service.logs.recover import recover
from aeroloop.service.recording import rolling
from aeroloop.service.recording.rolling import RecorderError
from tests.support.made_recording import (
    EVERYTHING,
    Clock,
    Disk,
    EventLog,
    Recording,
    decoded_count,
    every_message,
    in_order,
    numbered,
    raw,
)


def test_a_full_disk_loses_nothing_wherever_it_was_full(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
) -> None:
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
    for room in range(header, whole, (whole - header) // 31):
        recording = record(f"{room}.mcap", room)
        assert recording.waiting == []
        path = tmp_path / f"{room}.mcap"
        assert list(raw(path)) == expected, f"full at {room}"
        assert decoded_count([path]) == decoded
        assert recording.log.written == len(messages)
        if recording.reported:  # else the last bytes, of the index, came when there was room again
            refused += 1
            assert [bad for _, bad in recording.reported] == [True, False]
            assert os.strerror(errno.ENOSPC) in recording.reported[0][0]
            assert recording.reported[1][0] == f"recording again to {path}"
    assert refused > 10
    assert not list(tmp_path.glob("*-0*.mcap")), "all went into one file each"


def _header_size(path: Path) -> int:
    """Where the first chunk begins."""
    data, at = path.read_bytes(), 8
    while data[at] != Opcode.CHUNK:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


def test_a_disk_that_writes_a_little_at_a_time_is_written_to_the_end(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
) -> None:
    disk.at_once = 1000
    recording = Recording(clock, story, path=tmp_path / "a.mcap")
    recording.take(story.messages[:200])
    recording.log.close()
    assert list(raw(tmp_path / "a.mcap")) == numbered(story.messages[:200])


def test_while_a_disk_is_full_it_is_tried_once_a_second_reported_once_and_what_is_on_it_can_be_read(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
) -> None:
    """No half of a chunk stays behind, and the room that it took is given back."""
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.03)
    disk.room = recording.log.path.stat().st_size + 10_000
    recording.take(story.messages[:400])
    assert not recording.log.writable
    damages: list[Damage] = []
    assert Message in list(map(type, records(tmp_path / "a.mcap", damages)))
    assert [damage.what for damage in damages] == ["the file ends here, without its index"]
    disk.room, before = 0, disk.writes
    for _ in range(100):
        recording.wait(0.1)
    assert 9 <= disk.writes - before <= 10
    assert len(recording.reported) == 1
    disk.room = EVERYTHING
    recording.log.tend(at_once=True)  # as a recorder that is stopped does
    recording.wait(0.0)
    recording.log.close(len(recording.waiting))
    assert list(raw(tmp_path / "a.mcap")) == numbered(story.messages[:400])


@pytest.mark.parametrize("errors", [(errno.EIO,), (errno.EIO, errno.ENOSPC), (errno.ENOSPC, None)])
def test_a_file_that_cannot_be_used_is_left_for_a_new_one_and_nothing_is_lost_or_doubled(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk, errors: tuple[int | None, ...]
) -> None:
    """On a broken disk; also if at first there is no room for the new file: what came to nothing is removed.

    And where the file was removed (None) while the disk was full: what is not written yet goes into a new one.
    """
    old, recovered = tmp_path / "a.mcap", tmp_path / "recovered"
    recording = Recording(clock, story, path=old, chunk_s=0.05)
    recording.take(story.messages[:330])
    for error in errors:
        if error is None:
            recover(old, recovered)
            old.unlink()
        else:
            disk.broken = error
        recording.take(story.messages[330:500] if error == errors[0] else [])
        recording.wait(2.0)
        assert not recording.log.writable
        assert in_order(tmp_path) == [old][: error is not None]
    disk.broken = 0
    recording.wait(1.0)
    recording.take(story.messages[500:])
    recording.log.close()
    if old.exists():
        recover(old, recovered)
    assert every_message([recovered, tmp_path / "a-0001.mcap"]) == numbered(story.messages)


def test_a_file_that_is_moved_or_removed_is_reported_and_another_begun(
    tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05)
    recording.take(story.messages[:100])
    (tmp_path / "a.mcap").rename(tmp_path / "moved")
    recording.wait(1.0)
    recording.take(story.messages[100:200])
    (tmp_path / "a-0001.mcap").unlink()
    recording.wait(1.0)
    recording.take(story.messages[200:300])
    recording.log.close()
    assert recording.reported_bad() == [
        f"{tmp_path / name} was moved or removed while it was written" for name in ("a.mcap", "a-0001.mcap")
    ]
    expected = numbered(story.messages[:300])
    assert list(raw(tmp_path / "moved")) == expected[:100]
    assert list(raw(tmp_path / "a-0002.mcap")) == expected[200:]


def test_while_the_folder_is_gone_nothing_counts_as_recorded_and_a_reminder_comes_once_a_minute(
    tmp_path: Path, story: EventLog, clock: Clock
) -> None:
    folder = tmp_path / "logs"
    recording = Recording(clock, story, path=folder / "a.mcap", chunk_s=0.05)
    recording.take(story.messages[:100])
    folder.rename(tmp_path / "moved")
    recording.wait(1.0)
    recording.take(story.messages[100:200])
    why = f"{folder / 'a.mcap'} cannot be written: {os.strerror(errno.ENOENT)}"
    assert recording.log.trouble == why
    for _ in range(40):
        recording.wait(rolling.RETRY_S)
        assert not recording.log.writable
    told = f"{why}; messages are kept in memory and written when it can be"
    assert recording.reported == [(told, True)]
    recording.wait(rolling.REMIND_S)
    assert recording.reported == [(told, True)] * 2
    folder.mkdir()
    recording.wait(rolling.RETRY_S)
    assert recording.log.writable
    recording.take(story.messages[200:300])
    recording.log.close()
    assert recording.reported[2:] == [(f"recording again to {folder / 'a-0001.mcap'}", False)]
    expected = numbered(story.messages[:300])
    assert list(raw(tmp_path / "moved" / "a.mcap")) == expected[:100]
    assert list(raw(folder / "a-0001.mcap")) == expected[100:]


def test_where_no_new_file_can_be_begun_the_old_one_goes_on(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.05, max_file_s=2.0)
    recording.take(story.messages[:100])
    disk.new_files = errno.EACCES
    recording.wait(2.5)
    recording.take(story.messages[100:200])
    recording.wait(1.5)  # time enough to look again, but not to try again
    assert recording.reported_bad() == [
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
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
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


def test_the_end_on_a_full_disk_is_reported_in_one_line_and_what_was_written_can_be_recovered(
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
) -> None:
    recording = Recording(clock, story, path=tmp_path / "a.mcap", chunk_s=0.1)
    recording.take(story.messages[:250])
    size = (tmp_path / "a.mcap").stat().st_size
    disk.room = size
    recording.take(story.messages[250:270])
    recording.log.tend(at_once=True)
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
    tmp_path: Path, story: EventLog, clock: Clock, disk: Disk
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
