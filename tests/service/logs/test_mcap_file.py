"""MCAP reader: whole records are read, damaged ones are named, and forged sizes allocate no memory."""

from __future__ import annotations

import os
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import CompressionType, Writer

from aeroloop.service.logs import mcap_file
from aeroloop.service.logs.files import LogFiles, ReviewError
from aeroloop.service.logs.mcap_file import (
    DESCRIPTION_METADATA,
    MAX_CHUNK,
    MAX_RECORD,
    Damage,
    messages,
    opening,
    records,
    skim,
)
from aeroloop.service.logs.recover import recover
from aeroloop.service.logs.replay import replay
from aeroloop.service.review.review import review
from tests.support.made_log import AN_OPERATORS_WORDS, make_log

TICKS: Final = 600
HEAD: Final = struct.Struct("<BQ")
FOOTER: Final = struct.Struct("<QQI")
END: Final = HEAD.size + FOOTER.size + len(MAGIC)

Read = tuple[str, int, int, int, bytes]
"""A message: topic, sequence, log time, publish time [ns], content."""


class Part(NamedTuple):
    """A record as it stands in the file."""

    offset: int
    opcode: int
    content: bytes

    @property
    def bytes(self) -> bytes:
        return HEAD.pack(self.opcode, len(self.content)) + self.content


def parts(data: bytes, at: int = 0) -> list[Part]:
    found = []
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        found.append(Part(at, opcode, data[at + HEAD.size : at + HEAD.size + length]))
        at += HEAD.size + length
    return found


def parts_of_log(data: bytes) -> list[Part]:
    return parts(data[: -len(MAGIC)], len(MAGIC))


def read(path: Path, damages: list[Damage]) -> list[Read]:
    """Every message, which `records` and `messages` must agree on, and on whether anything is damaged."""
    channels: dict[int, str] = {}
    found = []
    for record in records(path, damages):
        if isinstance(record, Channel):
            channels[record.id] = record.topic
        elif isinstance(record, Message):
            found.append(
                (channels[record.channel_id], record.sequence, record.log_time, record.publish_time, record.data)
            )
    by_topic: list[Damage] = []
    logged = messages(path, lambda channel: channel.topic, by_topic)
    assert [(one.answer, one.sequence, one.log_time, one.publish_time, one.data) for one in logged] == found
    assert bool(by_topic) == bool(damages)
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    make_log(path, TICKS, changes=AN_OPERATORS_WORDS, chunk_every=5)
    return path


@pytest.fixture(scope="module")
def everything(whole: Path) -> list[Read]:
    """As mcap's own reader has it."""
    with whole.open("rb") as file:
        return [
            (channel.topic, one.sequence, one.log_time, one.publish_time, one.data)
            for _, channel, one in make_reader(file).iter_messages(log_time_order=False)
        ]


# Broken files


def test_a_whole_file_gives_what_mcaps_own_reader_has(whole: Path, everything: list[Read]) -> None:
    damages: list[Damage] = []
    assert read(whole, damages) == everything
    assert damages == []
    named = [
        (one.answer, one.data) for one in messages(whole, lambda channel: channel.topic.endswith("/telemetry") or None)
    ]
    assert named == [(True, one[-1]) for one in everything if one[0].endswith("/telemetry")]


def test_a_file_cut_anywhere_gives_every_whole_chunk_before_the_cut(
    whole: Path, everything: list[Read], tmp_path: Path
) -> None:
    data, cut, rng = whole.read_bytes(), tmp_path / "cut.mcap", random.Random(1)
    ends = [part.offset + len(part.bytes) for part in parts_of_log(data) if part.opcode == Opcode.CHUNK]
    end = next(part.offset + len(part.bytes) for part in parts_of_log(data) if part.opcode == Opcode.DATA_END)
    of_chunk = len(everything) / len(ends)
    for size in {
        *(rng.randrange(8, len(data)) for _ in range(300)),
        *(place + d for place in (*ends, end) for d in (-1, 0, 1)),
    }:
        cut.write_bytes(data[:size])
        damages: list[Damage] = []
        got = read(cut, damages)
        assert got == everything[: len(got)]
        assert len(got) > (sum(place <= size for place in ends) - 0.1) * of_chunk * 0.9
        assert len(damages) == (size < end)


def test_a_flipped_bit_anywhere_is_named_and_costs_one_chunk_at_most(
    whole: Path, everything: list[Read], tmp_path: Path
) -> None:
    """Also in the head of a record: the index of a closed file says where the next one begins."""
    data, flipped, rng = whole.read_bytes(), tmp_path / "flipped.mcap", random.Random(2)
    log = parts_of_log(data)
    data_end = next(part.offset for part in log if part.opcode == Opcode.DATA_END)
    in_heads = [part.offset * 8 + rng.randrange(HEAD.size * 8) for part in log for _ in range(3)]
    chunks = sum(part.opcode == Opcode.CHUNK for part in log)
    for bit in (*in_heads, *(rng.randrange(len(MAGIC) * 8, len(data) * 8) for _ in range(150))):
        bent = bytearray(data)
        bent[bit // 8] ^= 1 << bit % 8
        flipped.write_bytes(bent)
        damages: list[Damage] = []
        got = read(flipped, damages)
        if bit // 8 < data_end:
            assert damages, f"bit {bit} is not named"
        assert len(damages) == len(set(damages)), f"bit {bit}"
        lost = len(everything) - len(got)
        assert lost < 1.5 * len(everything) / chunks, f"bit {bit}"
        start = next((i for i, one in enumerate(got) if one != everything[i]), len(got))
        assert got == everything[:start] + everything[start + lost :]  # the rest, in one piece on either side


def test_a_log_of_a_killed_recorder_keeps_what_follows_a_damaged_chunk(whole: Path, tmp_path: Path) -> None:
    """Without an index, the first chunk alone describes its channels: their messages are named as lost, once."""
    data = bytearray(whole.read_bytes()[:-END])
    first, second = [part for part in parts_of_log(whole.read_bytes()) if part.opcode == Opcode.CHUNK][:2]
    data[second.offset + len(second.bytes) // 2] ^= 0x10
    (tmp_path / "killed.mcap").write_bytes(data)
    damages: list[Damage] = []
    assert len(read(tmp_path / "killed.mcap", damages)) > 0.8 * len(read(whole, []))
    assert damages[0].offset == second.offset
    data[first.offset + len(first.bytes) // 2] ^= 0x10
    (tmp_path / "killed.mcap").write_bytes(data)
    damages = []
    assert read(tmp_path / "killed.mcap", damages) == []
    undescribed = [damage for damage in damages if "describes" in damage.what]
    assert len(undescribed) == len({damage.what for damage in undescribed}) == 3
    damages = []
    assert list(messages(tmp_path / "killed.mcap", lambda _: True, damages)) == []
    assert [damage for damage in damages if "describes" in damage.what] == undescribed


def test_an_attachment_with_a_flipped_bit_is_left_out_and_named(tmp_path: Path) -> None:
    path, damages = tmp_path / "a.mcap", list[Damage]()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name in ("a", "b"):
            writer.add_attachment(0, 0, name, "", b"content")
        writer.finish()
    data = bytearray(path.read_bytes())
    data[data.index(b"content")] ^= 0x01
    path.write_bytes(data)
    assert [record.name for record in records(path, damages) if isinstance(record, Attachment)] == ["b"]
    assert len(damages) == 1


def test_a_description_with_a_flipped_bit_is_named_and_another_one_is_used(whole: Path, tmp_path: Path) -> None:
    """Where there is no other, the log is refused."""
    description = next(record for record in records(whole) if isinstance(record, Metadata))
    log = tmp_path / "twice.mcap"
    with whole.open("rb") as old, log.open("wb") as new:
        writer, ids = Writer(new, enable_data_crcs=True), {}
        writer.start()
        for _ in range(2):
            writer.add_metadata(description.name, description.metadata)
        for _, channel, one in make_reader(old).iter_messages():
            if channel.id not in ids:
                ids[channel.id] = writer.register_channel(channel.topic, "", 0)
            writer.add_message(ids[channel.id], one.log_time, one.data, one.publish_time)
        writer.finish()
    data = log.read_bytes()
    at = data.index(b'{"protocol":2,"role"')
    shorter = next(bit for bit in range(8) if data[at - 4] >> bit & 1)
    for byte, mask in ((at, 0x04), (at + 5, 0x80), (at - 4, 1 << shorter)):  # JSON, UTF-8, the length of a text
        bent = bytearray(data)
        bent[byte] ^= mask
        log.write_bytes(bent)
        files = LogFiles([log])
        assert list(files.descriptions) == [("aero", "controller")]
        assert len(list(files.routed(lambda address: address))) > TICKS / 10
        assert files.damages[log], f"byte {byte}"
        bent[data.rindex(b'{"protocol":2,"role"')] ^= 0x04  # the other one too
        log.write_bytes(bent)
        with pytest.raises(ReviewError, match="has no description of aero's controller"):
            review(log)


# What a file claims


def chunk_of(data: bytes, size: int, compression: str = "zstd") -> bytes:
    builder = RecordBuilder()
    Chunk(compression, data, 0, 0, 0, size).write(builder)
    return bytes(builder.end())


def _unsized(data: bytes) -> bytes:
    return zstandard.ZstdCompressor(write_content_size=False).compress(data)


BOMB: Final = bytes(2 * MAX_CHUNK)
LIES: Final[dict[str, Callable[[], bytes]]] = {
    "a record of 2^62 bytes": lambda: HEAD.pack(Opcode.METADATA, 1 << 62),
    "a record that is too long": lambda: HEAD.pack(Opcode.CHUNK, MAX_RECORD + 1) + bytes(100),
    "a record that is longer than the file": lambda: HEAD.pack(Opcode.CHUNK, MAX_RECORD) + bytes(100),
    "a chunk with 2^63 bytes of data": lambda: _lying_length(),
    "a chunk that claims too much": lambda: chunk_of(_unsized(bytes(100)), MAX_CHUNK + 1),
    "a frame that claims more than its chunk": lambda: chunk_of(zstandard.compress(BOMB), 1000),
    "a bomb of zstd": lambda: chunk_of(_unsized(BOMB), 1000),
    "a bomb of lz4": lambda: chunk_of(lz4.frame.compress(BOMB), 1000, "lz4"),
    "a chunk with less than it claims": lambda: chunk_of(_unsized(bytes(100)), MAX_CHUNK),
    "a chunk that is not compressed, with less": lambda: chunk_of(bytes(99), 1000, ""),
    "an unknown compression": lambda: chunk_of(bytes(100), 100, "rar"),
    "a message in a chunk that is longer than it": lambda: _cut_message(),
    "a message in a chunk that is too short": lambda: chunk_of(HEAD.pack(Opcode.MESSAGE, 2) + bytes(2), 11, ""),
}


def _cut_message() -> bytes:
    builder = RecordBuilder()
    Channel(1, "a", "", {}, 0).write(builder)
    data = bytes(builder.end()) + HEAD.pack(Opcode.MESSAGE, 100) + struct.pack("<HIQQ", 1, 2, 3, 4)
    return chunk_of(data, len(data), "")


def _lying_length() -> bytes:
    chunk = bytearray(chunk_of(b"", 0))
    chunk[-8:] = struct.pack("<Q", 1 << 63)
    return bytes(chunk)


@pytest.mark.parametrize("lie", LIES)
def test_what_a_file_claims_costs_no_memory_and_is_damage(tmp_path: Path, whole: Path, lie: str) -> None:
    path, damages = tmp_path / "lie.mcap", list[Damage]()
    first = next(part.offset for part in parts_of_log(whole.read_bytes()) if part.opcode == Opcode.CHUNK)
    block = LIES[lie]()
    path.write_bytes(whole.read_bytes()[:first] + block)
    if lie == "a record that is too long":
        os.truncate(path, 2 * MAX_RECORD)  # as long as it says, on a disk that keeps no zeros
    tracemalloc.start()
    assert read(path, damages) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert damages[0].offset == first
    held = MAX_CHUNK if "less than it claims" in lie else 0  # as much as a chunk may hold is given it
    assert peak < held + 10 * len(block) + 1_000_000


def _messages(size: int) -> bytes:
    """A channel and as many empty messages."""
    builder = RecordBuilder()
    Channel(1, "a", "", {}, 0).write(builder)
    message = HEAD.pack(Opcode.MESSAGE, 22) + struct.pack("<HIQQ", 1, 0, 0, 0)
    head = bytes(builder.end())
    return head + message * ((size - len(head)) // len(message))


BOMBS: Final[dict[str, bytes]] = {
    "zeros": bytes(MAX_CHUNK),
    "messages": _messages(1 << 20),
    "records without a kind": HEAD.pack(0, 0) * 100_000,
    "records that cannot be read": HEAD.pack(Opcode.CHANNEL, 0) * 100_000,
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_small_file_of_bombs_costs_bounded_memory_and_a_bounded_number_of_messages(
    tmp_path: Path, whole: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "DENSE_BYTES", 4 << 20)
    content = BOMBS[kind]
    first = next(part.offset for part in parts_of_log(whole.read_bytes()) if part.opcode == Opcode.CHUNK)
    path, damages = tmp_path / "bombs.mcap", list[Damage]()
    path.write_bytes(whole.read_bytes()[:first] + chunk_of(zstandard.compress(content), len(content)) * 200)
    assert path.stat().st_size < 1_000_000
    tracemalloc.start()
    count = sum(isinstance(record, Message) for record in records(path, damages))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count <= (4 << 20) / 31
    assert peak < 8 * (1 << 20)
    assert 190 <= len(damages) <= 201


@pytest.mark.parametrize("compression", CompressionType)
def test_every_compression_is_read(tmp_path: Path, compression: CompressionType) -> None:
    path, damages = tmp_path / "a.mcap", list[Damage]()
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000, compression=compression)
        writer.start()
        channel = writer.register_channel("a", "", 0)
        for i in range(100):
            writer.add_message(channel, i, bytes(i), 2 * i, 3 * i)
        writer.finish()
    assert read(path, damages) == [("a", 3 * i, i, 2 * i, bytes(i)) for i in range(100)]
    assert damages == []


# The index


def with_index(data: bytes, edit: Callable[[list[Part]], list[Part]]) -> bytes:
    """The file with other records in its index, under a checksum that fits them."""
    start, offsets, _ = FOOTER.unpack_from(data, len(data) - END + HEAD.size)
    index = b"".join(part.bytes for part in edit(parts(data[start:-END])))
    footer = data[-END : -END + HEAD.size] + struct.pack("<QQ", start, offsets)
    checksum = zlib.crc32(index + footer)
    return data[:start] + index + footer + struct.pack("<I", checksum) + data[-len(MAGIC) :]


def is_telemetry(key: str) -> bool:
    return key.endswith("/telemetry")


def metadata_of(path: Path) -> tuple[object, object]:
    files = LogFiles([path])
    return files.descriptions, files.metadata


def test_what_the_index_leads_to_is_what_the_whole_file_holds(whole: Path, tmp_path: Path) -> None:
    """The same file without its end has to be read from the front."""
    endless = tmp_path / "endless.mcap"
    endless.write_bytes(whole.read_bytes()[:-END])
    assert skim(endless, is_telemetry) is None
    assert metadata_of(endless) == metadata_of(whole)
    assert len(LogFiles([whole]).descriptions) == 2


def test_of_all_messages_only_the_first_and_the_wanted_are_touched(whole: Path) -> None:
    kinds = list(map(type, skim(whole, is_telemetry) or []))
    assert {Channel, Metadata} <= set(kinds)
    assert kinds.count(Message) == 1 + TICKS // 10  # the first is what the plant did before the session


def test_the_record_behind_the_header_opens_the_file(whole: Path, tmp_path: Path) -> None:
    head = opening(whole)
    assert head is not None
    assert head.name == DESCRIPTION_METADATA
    for data in (b"", MAGIC, b"something else", whole.read_bytes()[:100]):
        (tmp_path / "a.mcap").write_bytes(data)
        assert opening(tmp_path / "a.mcap") is None


def test_a_damaged_chunk_that_the_index_steps_over_is_still_named_when_messages_are_read(
    whole: Path, tmp_path: Path
) -> None:
    data = bytearray(whole.read_bytes())
    chunk = [part.offset for part in parts_of_log(bytes(data)) if part.opcode == Opcode.CHUNK][-1]
    data[chunk + 100] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    files = LogFiles([path])
    assert files.descriptions == LogFiles([whole]).descriptions
    assert not files.damages  # nothing of it was needed so far
    list(files.routed(lambda address: address))
    assert [damage.offset for damage in files.damages[path]] == [chunk]
    assert len(review(path).damages) == 1


def _elsewhere(index: list[Part], opcode: int, at: int) -> list[Part]:
    """The last entry of a kind points at the file's header."""
    last = max(i for i, part in enumerate(index) if part.opcode == opcode)
    content = bytearray(index[last].content)
    struct.pack_into("<Q", content, at, len(MAGIC))
    return [*index[:last], index[last]._replace(content=bytes(content)), *index[last + 1 :]]


def _without(index: list[Part], opcode: int) -> list[Part]:
    last = max(i for i, part in enumerate(index) if part.opcode == opcode)
    return [*index[:last], *index[last + 1 :]]


WRONG: Final[dict[str, Callable[[list[Part]], list[Part]]]] = {
    "a chunk is not in it": lambda index: _without(index, Opcode.CHUNK_INDEX),
    "a chunk is elsewhere": lambda index: _elsewhere(index, Opcode.CHUNK_INDEX, 16),
    "metadata is not in it": lambda index: _without(index, Opcode.METADATA_INDEX),
    "metadata is elsewhere": lambda index: _elsewhere(index, Opcode.METADATA_INDEX, 0),
    "a channel is not in it": lambda index: _without(index, Opcode.CHANNEL),
    "a record of it is cut": lambda index: [*index[:-1], index[-1]._replace(content=b"")],
}


@pytest.mark.parametrize("wrong", WRONG)
def test_an_index_that_is_wrong_is_not_believed(whole: Path, tmp_path: Path, wrong: str) -> None:
    """Its checksum fits: only what it says of the file does not."""
    path = tmp_path / "wrong.mcap"
    path.write_bytes(with_index(whole.read_bytes(), WRONG[wrong]))
    wanted = (lambda _: True) if wrong == "a chunk is elsewhere" else is_telemetry
    assert skim(path, wanted) is None
    assert metadata_of(path) == metadata_of(whole)
    (session,) = replay([path]).sessions
    assert (session.ticks, session.differ) == (TICKS, 0)


def test_the_index_as_it_was_written_is_accepted_until_a_bit_of_it_flips(whole: Path, tmp_path: Path) -> None:
    """What puts wrong ones together puts this one together right."""
    data, path = whole.read_bytes(), tmp_path / "a.mcap"
    assert with_index(data, lambda index: index) == data
    start, _, _ = FOOTER.unpack_from(data, len(data) - END + HEAD.size)
    for bit in random.Random(3).sample(range(start * 8, len(data) * 8), 50):
        bent = bytearray(data)
        bent[bit // 8] ^= 1 << bit % 8
        path.write_bytes(bent)
        assert skim(path, is_telemetry) is None
        assert metadata_of(path) == metadata_of(whole)


def test_what_was_recovered_ends_in_an_index_that_is_believed(whole: Path, tmp_path: Path) -> None:
    recover(whole, tmp_path / "out.mcap")
    again = 2  # descriptions, at the end
    assert len(skim(tmp_path / "out.mcap", is_telemetry) or []) == len(skim(whole, is_telemetry) or []) + again
