"""The index of a whole log is the short way to what is said once in hours; one that is wrong leads nowhere else."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from service.logs.files import LogFiles
from service.logs.mcap_index import skim
from service.logs.mcap_records import CHANNEL, CHUNK, CHUNK_INDEX, DATA_END, MAGIC, MESSAGE, METADATA, METADATA_INDEX
from service.logs.replay import replay
from service.logs.review import review
from tests.service.logs.made_log import AN_OPERATORS_WORDS, make_log

TICKS: Final = 600
HEAD: Final = struct.Struct("<BQ")
FOOTER: Final = struct.Struct("<QQI")
END: Final = HEAD.size + FOOTER.size + len(MAGIC)


class Part(NamedTuple):
    """A record as it lies in the file."""

    opcode: int
    content: bytes

    @property
    def bytes(self) -> bytes:
        return HEAD.pack(self.opcode, len(self.content)) + self.content


def parts(data: bytes) -> list[Part]:
    found, at = [], 0
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        found.append(Part(opcode, data[at + HEAD.size : at + HEAD.size + length]))
        at += HEAD.size + length
    return found


def with_index(data: bytes, edit: Callable[[list[Part]], list[Part]]) -> bytes:
    """The file with other records in its index, under a checksum that fits them."""
    start, offsets, _ = FOOTER.unpack_from(data, len(data) - END + HEAD.size)
    index = b"".join(part.bytes for part in edit(parts(data[start:-END])))
    footer = data[-END : -END + HEAD.size] + struct.pack("<QQ", start, offsets)
    checksum = zlib.crc32(index + footer)
    return data[:start] + index + footer + struct.pack("<I", checksum) + data[-len(MAGIC) :]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    make_log(path, TICKS, changes=AN_OPERATORS_WORDS, chunk_every=50)
    return path


def is_change(key: str) -> bool:
    return key.endswith("/change")


def told(path: Path) -> tuple[object, object]:
    files = LogFiles([path])
    return files.contracts, files.changes


def test_what_the_index_leads_to_is_what_the_whole_file_holds(whole: Path, tmp_path: Path) -> None:
    """The last change is late in the log; the same file without its end has to be read from the front."""
    endless = tmp_path / "endless.mcap"
    endless.write_bytes(whole.read_bytes()[:-END])
    assert skim(endless, is_change) is None
    assert told(endless) == told(whole)
    (changes,) = LogFiles([whole]).changes.values()
    assert [change.tick for change in changes] == [0, *AN_OPERATORS_WORDS]


def test_of_all_messages_only_the_first_and_the_wanted_are_touched(whole: Path) -> None:
    found = skim(whole, is_change)
    assert found is not None
    kinds = [record.opcode for record in found]
    assert set(kinds) >= {CHANNEL, METADATA, MESSAGE}
    assert kinds.count(MESSAGE) == 1 + len(AN_OPERATORS_WORDS)  # the first is what the session began with


def test_a_damaged_chunk_that_the_index_steps_over_is_still_named_by_who_reads_the_messages(
    whole: Path, tmp_path: Path
) -> None:
    data = bytearray(whole.read_bytes())
    last = data.rindex(HEAD.pack(DATA_END, 4))
    chunk = _chunks(bytes(data[:last]))[-1]  # after the last change
    data[chunk + 100] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    files = LogFiles([path])
    assert files.changes == LogFiles([whole]).changes
    assert not files.damages  # nothing of it was needed so far
    list(files.messages({"measurement"}))
    assert [damage.offset for damage in files.damages[path]] == [chunk]
    assert len(review(path).damages) == 1


def _chunks(data: bytes) -> list[int]:
    """Where each chunk begins."""
    at, starts = len(MAGIC), []
    for part in parts(data[at:]):
        if part.opcode == CHUNK:
            starts.append(at)
        at += HEAD.size + len(part.content)
    return starts


def _elsewhere(index: list[Part], opcode: int, at: int) -> list[Part]:
    """The last entry of a kind points at the file's header."""
    last = max(i for i, part in enumerate(index) if part.opcode == opcode)
    content = bytearray(index[last].content)
    struct.pack_into("<Q", content, at, len(MAGIC))
    return [*index[:last], Part(opcode, bytes(content)), *index[last + 1 :]]


def _without(index: list[Part], opcode: int) -> list[Part]:
    last = max(i for i, part in enumerate(index) if part.opcode == opcode)
    return [*index[:last], *index[last + 1 :]]


WRONG: Final[dict[str, Callable[[list[Part]], list[Part]]]] = {
    "a chunk is not in it": lambda index: _without(index, CHUNK_INDEX),
    "metadata is not in it": lambda index: _without(index, METADATA_INDEX),
    "metadata is elsewhere": lambda index: _elsewhere(index, METADATA_INDEX, 0),
    "a channel is not in it": lambda index: _without(index, CHANNEL),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_an_index_that_is_wrong_is_not_believed(whole: Path, tmp_path: Path, wrong: str) -> None:
    """Its checksum fits: only what it says of the file does not."""
    path = tmp_path / "wrong.mcap"
    path.write_bytes(with_index(whole.read_bytes(), WRONG[wrong]))
    assert skim(path, is_change) is None
    assert told(path) == told(whole)
    (session,) = replay([path])
    assert (session.commands, session.differing) == (TICKS, 0)


def test_a_chunk_that_is_not_where_the_index_says_is_not_believed_either(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "wrong.mcap"
    path.write_bytes(with_index(whole.read_bytes(), lambda index: _elsewhere(index, CHUNK_INDEX, 16)))
    assert skim(path, lambda key: key.endswith("/measurement")) is None
    assert told(path) == told(whole)


def test_an_index_with_a_flipped_bit_is_not_believed(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    data[-END - 20] ^= 0x01
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    assert skim(path, is_change) is None
    assert told(path) == told(whole)


def test_the_index_as_it_was_written_is_believed(whole: Path, tmp_path: Path) -> None:
    """What puts wrong ones together puts this one together right."""
    path = tmp_path / "right.mcap"
    path.write_bytes(with_index(whole.read_bytes(), lambda index: index))
    assert path.read_bytes() == whole.read_bytes()
