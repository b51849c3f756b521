"""Reads one MCAP file, whole or broken: https://mcap.dev/spec. Files are written by `mcap.writer.Writer`.

`records` reads from the front: it yields every complete record, checks each chunk against its checksum, skips damage
and reports it. A file cut at any byte yields all that was complete before the cut; if the index at the end is whole,
reading resumes after a damaged record. `messages` is fast: it parses a few channels and skips the others. `skim` reads
metadata and a few topics by the index.

Memory and time are bounded by the file's size: damage is a record over `MAX_RECORD`, a chunk that claims over
`MAX_CHUNK` or another size than it has, and one that is compressed beyond `MAX_RATIO` when `DENSE_BYTES` are used up.
Of a chunk, the first record that cannot be read is damage, and no later one is read.
"""

from __future__ import annotations

import os
import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final, Generic, NamedTuple, TypeVar

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Metadata, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC

DESCRIPTION_METADATA: Final = "aeroloop.description"
"""Name of the metadata record with a role's description, as JSON under `json`, and its key under `key`."""

RECORDER_METADATA: Final = "aeroloop.recorder"
"""Name of the metadata record about the file itself: its run, the recording's identity, its part, its beginning."""

CHECKSUM: Final = "crc32"
"""Entry of a metadata record with the checksum of the others: outside of chunks, MCAP has none."""

CHUNK_BYTES: Final = 64 * 1024
"""A 64 KiB chunk compresses in under 3 ms; the writer's default of 1 MiB takes 39 ms at once."""

MAX_CHUNK: Final = 64 << 20
"""Bytes that a chunk may hold, uncompressed."""

MAX_RATIO: Final = 100
"""Times its compressed bytes that a chunk may hold; ours compress to a tenth."""

DENSE_BYTES: Final = 64 << 20
"""Bytes that all chunks beyond `MAX_RATIO` may hold together: zeros on the network must not cost the log."""

MAX_RECORD: Final = 72 << 20
"""Bytes of one record: a chunk that does not compress, and its head."""

MAX_INDEX: Final = 16 << 20
"""Bytes of a whole index; a larger one is not used. An hour's has 1 MB."""

_HEAD: Final = struct.Struct("<BQ")
_HEAD_AND_ID: Final = struct.Struct("<BQH")  # schemas, channels and messages begin with an id
_MESSAGE: Final = struct.Struct("<9xHIQQ")
_FOOTER: Final = struct.Struct("<BQQQI")
_END: Final = _FOOTER.size + len(MAGIC)
_CRC_BYTES: Final = 4
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)  # an enumeration's member takes longer to compare
_CHANNEL_OPCODE: Final = int(Opcode.CHANNEL)
_DESCRIBING: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL})
_IN_CHUNKS: Final = _DESCRIBING | {Opcode.MESSAGE}
_READ: Final = _IN_CHUNKS | {Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT}
_STARTS: Final[dict[int, int]] = {Opcode.CHUNK_INDEX: 25, Opcode.METADATA_INDEX: 9, Opcode.ATTACHMENT_INDEX: 9}
"""Position, in a record of the index, of the offset that it points to."""

_MALFORMED: Final = (struct.error, ValueError, OverflowError, RuntimeError, McapError, zstandard.ZstdError)

T = TypeVar("T")


class Damage(NamedTuple):
    """What could not be read, and where it begins in the file."""

    offset: int
    what: str

    def __str__(self) -> str:
        return f"{self.what} (byte {self.offset})" if self.offset else self.what


class Logged(NamedTuple, Generic[T]):
    """A message: what `wanted` returned for its channel, its content, times [ns], and its publisher's number."""

    answer: T
    data: bytes
    publish_time: int
    log_time: int
    sequence: int


class NotMcapError(ValueError):
    """The file does not begin as an MCAP file does."""


def records(
    path: Path, damages: list[Damage] | None = None, progress: Callable[[int], None] | None = None
) -> Iterator[McapRecord]:
    """Header, schemas, channels, messages, metadata and attachments, in the file's order; damaged ones are left out.

    Schemas and channels of the index come first, so that a damaged chunk loses no other chunk's description; those in
    the chunks follow in their place. A message comes only after its channel.

    Args:
        path: The file.
        damages: What could not be read is appended.
        progress: Called after each chunk with the bytes read so far.

    Raises:
        NotMcapError: It is no MCAP file.
        OSError: It cannot be read.
    """
    damages = [] if damages is None else damages
    described: dict[int, bool] = {}  # channels
    for offset, data in _pieces(path, damages, progress):
        for opcode, start, end in _scan(data, offset, damages):
            if opcode not in _READ:
                continue
            try:
                record = _parsed(data[start:end])
            except _MALFORMED as error:
                damages.append(Damage(offset, f"a record cannot be read: {error}"))
                break
            if isinstance(record, Channel):
                described[record.id] = True
            elif isinstance(record, Message):
                if record.channel_id not in described:
                    _undescribed(record.channel_id, offset, damages)
                if not described.setdefault(record.channel_id, False):
                    continue
            yield record


def messages(
    path: Path,
    wanted: Callable[[Channel], T | None],
    damages: list[Damage] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Logged[T]]:
    """Messages of some channels, in the file's order.

    `wanted` is called at the first message of a channel; None drops the channel. The rest is as in `records`, which
    raises the same errors.
    """
    damages = [] if damages is None else damages
    channels: dict[int, Channel] = {}
    answers: dict[int, T | None] = {}
    head_of, message_of = _HEAD_AND_ID.unpack_from, _MESSAGE.unpack_from
    for offset, data in _pieces(path, damages, progress):
        at, size = 0, len(data)
        try:
            while at < size:  # as `_scan`, which takes twice as long
                start = at
                opcode, length, identifier = head_of(data, start)
                at += _HEAD.size + length
                if at > size or not opcode:
                    raise struct.error("it is longer than its chunk" if opcode else "it has no kind")
                if opcode == _MESSAGE_OPCODE:
                    if identifier not in answers:
                        if identifier not in channels:
                            _undescribed(identifier, offset, damages)
                        answers[identifier] = wanted(channels[identifier]) if identifier in channels else None
                    answer = answers[identifier]
                    if answer is not None:
                        _, sequence, log_time, publish_time = message_of(data, start)
                        yield Logged(answer, data[start + _MESSAGE.size : at], publish_time, log_time, sequence)
                elif opcode == _CHANNEL_OPCODE and identifier not in channels:
                    channel = _parsed(data[start:at])
                    assert isinstance(channel, Channel)
                    channels[identifier] = channel
                    answers.pop(identifier, None)
        except _MALFORMED as error:
            damages.append(Damage(offset, f"a record cannot be read: {error}"))


def skim(path: Path, wanted: Callable[[str], bool]) -> list[McapRecord] | None:
    """Schemas, channels, metadata, the file's first message, and every message of some topics, by way of the index.

    The index is used if it matches its checksum, has everything that the statistics count, and points to the right
    records. A damaged chunk is skipped silently: `messages` reports it.

    Returns the records, each kind in the file's order; None without a usable index. Raises OSError.
    """
    with path.open("rb") as file, suppress(*_MALFORMED):
        index = [_parsed(record) for _, record in _index(file)]
        chunks = [record for record in index if isinstance(record, ChunkIndex)]
        places = [record.offset for record in index if isinstance(record, MetadataIndex)]
        if not _is_complete(index, chunks, places):
            return None
        found: list[McapRecord] = [record for record in index if isinstance(record, (Schema, Channel))]
        ids = {record.id for record in found if isinstance(record, Channel) and wanted(record.topic)}
        found += [_parsed(_at(file, place, Opcode.METADATA)) for place in sorted(places)]
        first, room = True, DENSE_BYTES
        for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
            if not first and ids.isdisjoint(chunk.message_index_offsets):
                continue
            block = _at(file, chunk.chunk_start_offset, Opcode.CHUNK)
            with suppress(*_MALFORMED):
                data = _plain(block, room)
                room -= len(data) if len(data) > MAX_RATIO * len(block) else 0
                for opcode, start, end in _scan(data, 0, []):
                    if opcode == Opcode.MESSAGE and (first or _HEAD_AND_ID.unpack_from(data, start)[2] in ids):
                        found.append(_parsed(data[start:end]))
                        first = False
        return found
    return None


def opening(path: Path) -> Metadata | None:
    """The record after a file's header if it is metadata. Reads no further. Raises OSError."""
    with path.open("rb") as file, suppress(*_MALFORMED):
        if file.read(len(MAGIC)) == MAGIC:
            for _, opcode, block in islice(_blocks(file, [], []), 1, 2):
                record = _parsed(block) if opcode == Opcode.METADATA else None
                return record if isinstance(record, Metadata) else None
    return None


def _pieces(path: Path, damages: list[Damage], progress: Callable[[int], None] | None) -> Iterator[tuple[int, bytes]]:
    """Offset and bytes of each piece: all records of a chunk, or one record outside of chunks."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise NotMcapError(f"{path} does not begin as an MCAP file")
        index = _index(file)
        yield 0, b"".join(record for opcode, record in index if opcode in _DESCRIBING)
        starts = sorted(
            int.from_bytes(record[_STARTS[opcode] :][:8], "little") for opcode, record in index if opcode in _STARTS
        )
        chunked, room = False, DENSE_BYTES
        for offset, opcode, block in _blocks(file, starts, damages):
            if opcode != Opcode.CHUNK:
                if chunked and opcode in _IN_CHUNKS:  # a flipped bit turns a message index into this
                    damages.append(Damage(offset, "a schema, channel or message outside of the chunks"))
                else:
                    yield offset, block
                continue
            chunked = True
            try:
                data = _plain(block, room)
            except _MALFORMED as error:
                damages.append(Damage(offset, f"a chunk cannot be read: {error}"))
            else:
                room -= len(data) if len(data) > MAX_RATIO * len(block) else 0
                yield offset, data
            if progress is not None:
                progress(file.tell())


def _blocks(file: BinaryIO, starts: list[int], damages: list[Damage]) -> Iterator[tuple[int, int, bytes]]:
    """Offset, opcode and bytes of each record in the file, up to the end of the data section.

    `starts` has the offsets of records by the index, in order: after a damaged record, reading resumes at the next.
    """
    size = os.fstat(file.fileno()).st_size
    named, checksum = len(damages), zlib.crc32(MAGIC)
    last = offset = len(MAGIC)  # `last`: the last record that was yielded, whose length may be damaged
    while True:
        file.seek(offset)
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        wrong = ""
        if len(head) < _HEAD.size:
            wrong = "the file is cut here" if head else "the file ends here, without its index"
        elif not 0 < opcode <= 0x7F or opcode == Opcode.FOOTER or length > MAX_RECORD:
            wrong = "no record begins here"
        elif offset + _HEAD.size + length > size:
            wrong = f"the file is cut within a record of {length} bytes"
        elif bisect_left(starts, offset + _HEAD.size + length) > bisect_right(starts, offset):
            wrong = f"a record of {length} bytes ends beyond the next one's begin"
        elif opcode == Opcode.DATA_END and starts and offset < starts[-1]:
            wrong = "the data end here, though not by the index"
        if wrong:
            damages.append(Damage(offset, wrong))
            i = bisect_right(starts, last)
            i += starts[i : i + 1] == [offset]
            if i >= len(starts):
                return
            last = offset = starts[i]
            continue
        block = head + file.read(length)
        if opcode == Opcode.DATA_END:
            if int.from_bytes(block[_HEAD.size :], "little") not in (0, checksum) and len(damages) == named:
                damages.append(Damage(offset, "what stands before, outside the chunks, does not match its checksum"))
            return
        yield offset, opcode, block
        checksum = zlib.crc32(block, checksum)
        last, offset = offset, offset + len(block)


def _index(file: BinaryIO) -> list[tuple[int, bytes]]:
    """Opcodes and records of the index at the end; none if there is no end, or it does not match its checksum."""
    end = os.fstat(file.fileno()).st_size - _END
    if end < len(MAGIC):
        return []
    file.seek(end)
    footer = file.read(_END)
    opcode, _, start, _, checksum = _FOOTER.unpack_from(footer)
    if opcode != Opcode.FOOTER or footer[_FOOTER.size :] != MAGIC or not 0 < start <= end or end - start > MAX_INDEX:
        return []
    file.seek(start)
    data = file.read(end - start)
    if zlib.crc32(footer[: _FOOTER.size - _CRC_BYTES], zlib.crc32(data)) != checksum:
        return []
    return [(opcode, data[start:end]) for opcode, start, end in _scan(data, start, [])]


def _is_complete(index: list[McapRecord], chunks: list[ChunkIndex], metadata: list[int]) -> bool:
    """Whether an index has every chunk, channel and metadata record that its statistics count."""
    counts = next((record for record in index if isinstance(record, Statistics)), None)
    indexed = set().union(*(chunk.message_index_offsets for chunk in chunks))
    return (
        counts is not None
        and counts.chunk_count == len(chunks)
        and counts.metadata_count == len(metadata)
        and {channel for channel, count in counts.channel_message_counts.items() if count} == indexed
        and indexed <= {record.id for record in index if isinstance(record, Channel)}
    )


def _at(file: BinaryIO, offset: int, opcode: int) -> bytes:
    """The record at an offset in the file. Raises ValueError if it is not of that kind, or not whole."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    there, length = _HEAD.unpack(head)
    if there != opcode or offset + length > os.fstat(file.fileno()).st_size or length > MAX_RECORD:
        raise ValueError("the index points elsewhere")
    return head + file.read(length)


def _plain(block: bytes, room: int) -> bytes:
    """The records that a chunk holds, decompressed and checked. Raises one of `_MALFORMED` if it is damaged.

    `room` is the most bytes that it may hold if they are more than `MAX_RATIO` times its own.
    """
    chunk = _parsed(block)
    assert isinstance(chunk, Chunk)
    size = chunk.uncompressed_size
    # what a zstd frame claims would be allocated; -1 if it claims nothing
    claimed = zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else -1
    if size > min(MAX_CHUNK, max(room, MAX_RATIO * len(block))) or claimed not in (-1, size):
        raise ValueError(f"it claims to hold {max(size, claimed)} bytes in {len(chunk.data)}")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        data = chunk.data
    else:
        raise ValueError(f"its compression {chunk.compression!r} is not known")
    if len(data) != size:
        raise ValueError(f"it does not hold the {size} bytes that it claims")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("it does not match its checksum")
    return data


def _scan(data: bytes, offset: int, damages: list[Damage]) -> Iterator[tuple[int, int, int]]:
    """Opcode of each record in a chunk, and where in it the record begins and ends."""
    at, size = 0, len(data)
    while at + _HEAD.size <= size:
        start = at
        opcode, length = _HEAD.unpack_from(data, start)
        if not opcode:
            break
        at += _HEAD.size + length
        if at <= size:
            yield opcode, start, at
    if at != size:
        damages.append(Damage(offset, "a chunk ends within a record"))


def _parsed(record: bytes) -> McapRecord:
    """A parsed record. Raises one of `_MALFORMED`."""
    if record[0] == _MESSAGE_OPCODE:  # mcap's own parser takes 5 µs
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(record)
        return Message(channel, log_time, record[_MESSAGE.size :], publish_time, sequence)
    if record[0] == Opcode.ATTACHMENT:
        checksum = int.from_bytes(record[-_CRC_BYTES:], "little")
        if checksum and zlib.crc32(record[_HEAD.size : -_CRC_BYTES]) != checksum:
            raise ValueError("an attachment does not match its checksum")
    try:
        parsed = next(StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True).records)
    except (StopIteration, EndOfFile):
        raise ValueError("it ends too early") from None
    if isinstance(parsed, Metadata) and parsed.metadata.get(CHECKSUM, (right := _checksum(parsed))) != right:
        raise ValueError(f"metadata {parsed.name} does not match its checksum")
    return parsed


def with_checksum(name: str, entries: dict[str, str]) -> dict[str, str]:
    """The entries of a metadata record, and their checksum."""
    return entries | {CHECKSUM: _checksum(Metadata(name, entries))}


def _checksum(record: Metadata) -> str:
    texts = [record.name, *(f"{key}={value}" for key, value in record.metadata.items() if key != CHECKSUM)]
    return f"{zlib.crc32(chr(0).join(texts).encode()):08x}"


def _undescribed(channel: int, offset: int, damages: list[Damage]) -> None:
    damages.append(Damage(offset, f"messages of channel {channel} from here on: what describes it was lost"))
