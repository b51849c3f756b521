"""One MCAP file, whole or broken (https://mcap.dev/spec). Files are written by `mcap.writer.Writer`.

A file that was closed ends in an index: its chunks are read where the index says, and a damaged one costs itself. A
file of a killed recorder has none: it is read from the front up to where no record begins. Each damage is named with
its byte, and the time up to which messages were read before it.

Memory and time are bounded by the file's size: damage is a record over `MAX_RECORD`, a chunk that claims over
`MAX_CHUNK` or another size than it has, and one that is compressed beyond `MAX_RATIO` when `DENSE_BYTES` are used up.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final, Generic, NamedTuple, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
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
_MESSAGE: Final = struct.Struct("<9xHIQQ")
_FOOTER: Final = struct.Struct("<BQQQI")
_END: Final = _FOOTER.size + len(MAGIC)
_CRC_BYTES: Final = 4
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)  # an enumeration's member takes longer to compare
_PARSED: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT})
_BEFORE_THE_END: Final = frozenset(range(1, 0x80)) - {Opcode.DATA_END, Opcode.FOOTER}
_MALFORMED: Final = (struct.error, ValueError, OverflowError, RuntimeError, McapError, zstandard.ZstdError)

T = TypeVar("T")


class Damage(NamedTuple):
    """What could not be read, where it begins in the file, and the time of the last message before it [ns]."""

    offset: int
    what: str
    after_ns: int = 0

    def __str__(self) -> str:
        if not self.offset:
            return self.what
        after = ""
        if 0 < self.after_ns < 1 << 62:
            after = f", after {datetime.fromtimestamp(self.after_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC"
        return f"{self.what} (byte {self.offset}{after})"


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
    path: Path,
    damages: list[Damage] | None = None,
    progress: Callable[[int], None] | None = None,
    wanted: Callable[[Channel], bool] = lambda _: True,
) -> Iterator[McapRecord]:
    """Schemas, channels, messages, metadata and attachments in the file's order; damaged ones are left out.

    Schemas and channels of the index come first, so that a damaged chunk loses no other chunk's description. A message
    comes only after its channel.

    Args:
        path: The file.
        damages: What could not be read is appended.
        progress: Called after each chunk with the bytes read so far.
        wanted: Called once per channel; messages of the others are skipped.

    Raises:
        NotMcapError: It is no MCAP file.
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise NotMcapError(f"{path} does not begin as an MCAP file")
        yield from _Reader(file, [] if damages is None else damages, progress).records(wanted)


def messages(
    path: Path,
    wanted: Callable[[Channel], T | None],
    damages: list[Damage] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Logged[T]]:
    """Messages of some channels; `wanted` is called once per channel, None skips it. The rest is as of `records`."""
    answers: dict[int, T] = {}

    def chosen(channel: Channel) -> bool:
        if (answer := wanted(channel)) is not None:
            answers[channel.id] = answer
        return answer is not None

    for one in records(path, damages, progress, chosen):
        if isinstance(one, Message):
            yield Logged(answers[one.channel_id], one.data, one.publish_time, one.log_time, one.sequence)


def opening(path: Path) -> Metadata | None:
    """The record after a file's header if it is metadata. Reads no further. Raises OSError."""
    with path.open("rb") as file, suppress(*_MALFORMED):
        if file.read(len(MAGIC)) == MAGIC:
            for _, opcode, block in islice(_Reader(file, []).from_the_front(), 1, 2):
                record = _parsed(block) if opcode == Opcode.METADATA else None
                return record if isinstance(record, Metadata) else None
    return None


def with_checksum(name: str, entries: dict[str, str]) -> dict[str, str]:
    """The entries of a metadata record, and their checksum."""
    return entries | {CHECKSUM: _checksum(Metadata(name, entries))}


class _Reader:
    """Reads one open file; arguments as of `records`."""

    def __init__(self, file: BinaryIO, damages: list[Damage], progress: Callable[[int], None] | None = None) -> None:
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._damages = damages
        self._progress = progress
        self._read_ns = 0
        self._room = DENSE_BYTES

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[McapRecord]:
        described: dict[int, bool] = {}
        undescribed: set[int] = set()
        for offset, data in self._pieces():
            at, size = 0, len(data)
            try:
                while at < size:
                    start = at
                    opcode, length = _HEAD.unpack_from(data, start)
                    at += _HEAD.size + length
                    if at > size or not opcode:
                        raise ValueError("it is longer than its chunk" if opcode else "it has no kind")
                    if opcode == _MESSAGE_OPCODE and at >= start + _MESSAGE.size:
                        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
                        if described.get(channel, False):
                            yield Message(channel, log_time, data[start + _MESSAGE.size : at], publish_time, sequence)
                        elif channel not in described and channel not in undescribed:
                            undescribed.add(channel)
                            lost = "from here on: what describes it was lost"
                            self._damage(offset, f"messages of channel {channel} {lost}")
                    elif opcode in _PARSED:
                        record = _parsed(data[start:at])
                        if isinstance(record, Channel) and record.id not in described:
                            described[record.id] = wanted(record)
                        yield record
                    elif opcode == _MESSAGE_OPCODE:
                        raise ValueError("a message ends within its head")
            except _MALFORMED as error:
                self._damage(offset, f"a record cannot be read: {error}")

    def _damage(self, offset: int, what: str) -> None:
        self._damages.append(Damage(offset, what, self._read_ns))

    def _pieces(self) -> Iterator[tuple[int, bytes]]:
        """Offset and bytes of each piece: all records of a chunk, or one record outside of chunks."""
        index = self._index()
        descriptions, blocks = (b"", self.from_the_front()) if index is None else self._by_index(index)
        yield 0, descriptions
        for offset, opcode, block in blocks:
            if opcode != Opcode.CHUNK:
                yield offset, block
                continue
            try:
                chunk = _parsed(block)
                assert isinstance(chunk, Chunk)
                data = self._plain(chunk)
            except _MALFORMED as error:
                self._damage(offset, f"a chunk cannot be read: {error}")
            else:
                yield offset, data
                self._read_ns = max(self._read_ns, chunk.message_end_time)
            if self._progress is not None:
                self._progress(offset + len(block))

    def from_the_front(self) -> Iterator[tuple[int, int, bytes]]:
        """Offset, opcode and bytes of each record of the data section, up to where no record begins."""
        offset = len(MAGIC)
        while True:
            self._file.seek(offset)
            head = self._file.read(_HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            ends = opcode == Opcode.DATA_END and length == _CRC_BYTES
            wrong = ""
            if len(head) < _HEAD.size:
                wrong = "the file is cut here" if head else "the file ends here, without its index"
            elif not ends and (opcode not in _BEFORE_THE_END or length > MAX_RECORD):
                wrong = "no record begins here, and the file has no index"
            elif offset + _HEAD.size + length > self._size:
                wrong = f"the file is cut within a record of {length} bytes"
            if wrong:
                self._damage(offset, wrong)
            if wrong or ends:
                return
            yield offset, opcode, head + self._file.read(length)
            offset += _HEAD.size + length

    def _index(self) -> list[McapRecord] | None:
        """The records of the index at the end; None if there is none, or it is damaged or not complete."""
        end = self._size - _END
        self._file.seek(max(0, end))
        footer = self._file.read(_END)
        if end < len(MAGIC) or footer[_FOOTER.size :] != MAGIC:
            return None
        opcode, _, start, _, checksum = _FOOTER.unpack_from(footer)
        if opcode != Opcode.FOOTER or not 0 < start <= end or end - start > MAX_INDEX:
            return None
        self._file.seek(start)
        data = self._file.read(end - start)
        if zlib.crc32(footer[: _FOOTER.size - _CRC_BYTES], zlib.crc32(data)) != checksum:
            return None
        try:
            index = list(StreamReader(BytesIO(data + footer), skip_magic=True, emit_chunks=True).records)
        except _MALFORMED:
            return None
        counts = next((record for record in index if isinstance(record, Statistics)), None)
        if counts is None:
            return None
        stated = counts.chunk_count, counts.metadata_count, counts.attachment_count, counts.channel_count
        kinds = ChunkIndex, MetadataIndex, AttachmentIndex, Channel
        found = tuple(sum(isinstance(record, kind) for record in index) for kind in kinds)
        return index if found == stated else None

    def _by_index(self, index: list[McapRecord]) -> tuple[bytes, Iterator[tuple[int, int, bytes]]]:
        """Schemas and channels as they are in a chunk, and the blocks that the index leads to, as `from_the_front`."""
        builder = RecordBuilder()
        for record in index:
            if isinstance(record, (Schema, Channel)):
                record.write(builder)
        places: dict[int, tuple[int, int]] = {}  # kind and length of the record at an offset
        for record in index:
            if isinstance(record, ChunkIndex):
                places[record.chunk_start_offset] = Opcode.CHUNK, record.chunk_length
            elif isinstance(record, (MetadataIndex, AttachmentIndex)):
                kind = Opcode.METADATA if isinstance(record, MetadataIndex) else Opcode.ATTACHMENT
                places[record.offset] = kind, record.length

        def blocks() -> Iterator[tuple[int, int, bytes]]:
            after = 0
            for offset, (opcode, size) in sorted(places.items()):
                whole = after <= offset <= self._size - size and _HEAD.size <= size <= MAX_RECORD
                self._file.seek(offset if whole else 0)
                block = self._file.read(size) if whole else b""
                if block[: _HEAD.size] != _HEAD.pack(opcode, max(0, size - _HEAD.size)):
                    self._damage(offset, "the record that the index has here is damaged")
                    continue
                yield offset, opcode, block
                after = offset + size

        return bytes(builder.end()), blocks()

    def _plain(self, chunk: Chunk) -> bytes:
        """The records that a chunk holds, decompressed and checked. Raises one of `_MALFORMED` if it is damaged."""
        size = chunk.uncompressed_size
        dense = size > MAX_RATIO * (len(chunk.data) + _HEAD.size)
        # what a zstd frame claims would be allocated; -1 if it claims nothing
        claimed = zstandard.frame_content_size(chunk.data) if chunk.compression == "zstd" else -1
        if size > MAX_CHUNK or (dense and size > self._room) or claimed not in (-1, size):
            raise ValueError(f"it claims to hold {max(size, claimed)} bytes in {len(chunk.data)}")
        match chunk.compression:
            case "zstd":
                data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
            case "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
            case "":
                data = chunk.data
            case other:
                raise ValueError(f"its compression {other!r} is not known")
        if len(data) != size:
            raise ValueError(f"it does not hold the {size} bytes that it claims")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("it does not match its checksum")
        self._room -= size if dense else 0
        return data


def _parsed(record: bytes) -> McapRecord:
    """A parsed record. Raises one of `_MALFORMED`; also where its own checksum does not match."""
    if record[0] == Opcode.ATTACHMENT:
        checksum = int.from_bytes(record[-_CRC_BYTES:], "little")
        if checksum and zlib.crc32(record[_HEAD.size : -_CRC_BYTES]) != checksum:
            raise ValueError("an attachment does not match its checksum")
    try:
        parsed = next(StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True).records)
    except (StopIteration, EndOfFile):
        raise ValueError("it ends too early") from None
    if isinstance(parsed, Metadata) and parsed.metadata.get(CHECKSUM, right := _checksum(parsed)) != right:
        raise ValueError(f"metadata {parsed.name} does not match its checksum")
    return parsed


def _checksum(record: Metadata) -> str:
    texts = [record.name, *(f"{key}={value}" for key, value in record.metadata.items() if key != CHECKSUM)]
    return f"{zlib.crc32(chr(0).join(texts).encode()):08x}"
