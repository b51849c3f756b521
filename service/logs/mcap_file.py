"""One MCAP file, whole or broken (https://mcap.dev/spec). Files are written by `mcap.writer.Writer`.

A file that was closed ends in an index: its records are read where the index says, and a damaged one costs itself. A
file of a killed recorder has none: it is read from the front up to the damage. Each damage is named with its byte and
the time up to which messages were read before it.
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
from typing import BinaryIO, Final, NamedTuple, TypeVar

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC as MAGIC

DESCRIPTION_METADATA: Final = "aeroloop.description"
"""Name of the metadata record with a role's description, as JSON under `json`, and its key under `key`."""

RECORDER_METADATA: Final = "aeroloop.recorder"
"""Name of the metadata record about the file itself: its run, the recording's identity, its part, its beginning."""

CHECKSUM: Final = "crc32"
"""Entry of a metadata record with the checksum of the others: outside of chunks, MCAP has none."""

CHUNK_BYTES: Final = 64 * 1024
"""A 64 KiB chunk compresses in under 3 ms; the writer's default of 1 MiB takes 39 ms at once."""

MAX_CHUNK: Final = 16 << 20
"""Bytes that a record or the content of a chunk may have: a forged size costs no memory."""

_HEAD: Final = struct.Struct("<BQ")
_FOOTER_BYTES: Final = _HEAD.size + 20 + len(MAGIC)
_CRC_BYTES: Final = 4
_NEEDED: Final = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.FOOTER,
)
_MALFORMED: Final = (struct.error, ValueError, OverflowError, McapError, zstandard.ZstdError)

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


class NotMcapError(ValueError):
    """The file does not begin as an MCAP file does."""


def records(
    path: Path, damages: list[Damage] | None = None, progress: Callable[[int], None] | None = None
) -> Iterator[McapRecord]:
    """Schemas, channels, messages, metadata and attachments in the file's order; damaged ones are left out.

    Schemas and channels of an index come first, so that a damaged chunk loses no other chunk's description.

    Args:
        path: The file.
        damages: What could not be read is appended.
        progress: Called after each record of the file with the bytes read so far.

    Raises:
        NotMcapError: It is no MCAP file.
        OSError: It cannot be read.
    """
    chunk: list[McapRecord] = []  # what the last one held
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise NotMcapError(f"{path} does not begin as an MCAP file")
        index = _index(file)
        yield from (one for one in index or () if isinstance(one, (Schema, Channel)))
        for at, size, opcode in _from_the_front(file) if index is None else _by_index(index):
            try:
                record = _record(file, at, size, opcode)
                found = [record] if record is not None else []
                if isinstance(record, Chunk):
                    found = chunk = _contents(record)
            except _MALFORMED as error:
                times = (one.log_time for one in chunk if isinstance(one, Message))
                if damages is not None:
                    damages.append(Damage(at, str(error) or "a record ends too early", max(times, default=0)))
                if index is None:
                    return
            else:
                yield from found
            if progress is not None:
                progress(at + size)


def messages(path: Path, wanted: Callable[[Channel], T | None]) -> Iterator[tuple[T, Message]]:
    """Messages of some channels, each with what `wanted` returns for its channel; None skips the channel.

    Damage and errors are as of `records`.
    """
    answers: dict[int, T | None] = {}
    for one in records(path):
        if isinstance(one, Channel) and one.id not in answers:
            answers[one.id] = wanted(one)
        elif isinstance(one, Message) and (answer := answers.get(one.channel_id)) is not None:
            yield answer, one


def opening(path: Path) -> Metadata | None:
    """The record after a file's header if it is metadata. Reads no further. Raises OSError."""
    with path.open("rb") as file, suppress(*_MALFORMED):
        reader = StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK)
        record = next(islice(reader.records, 1, 2), None)
        return record if isinstance(record, Metadata) else None
    return None


def with_checksum(name: str, entries: dict[str, str]) -> dict[str, str]:
    """The entries of a metadata record, and their checksum."""
    texts = [name, *(f"{key}={value}" for key, value in entries.items())]
    return entries | {CHECKSUM: f"{zlib.crc32(chr(0).join(texts).encode()):08x}"}


def _index(file: BinaryIO) -> list[McapRecord] | None:
    """The records of the index at the end; None if there is none, or it is damaged or not complete."""
    end = os.fstat(file.fileno()).st_size - _FOOTER_BYTES
    if end < len(MAGIC):
        return None
    with suppress(*_MALFORMED):
        footer = _record(file, end, _FOOTER_BYTES - len(MAGIC), Opcode.FOOTER)
        assert isinstance(footer, Footer)
        if file.read() != MAGIC or not 0 < footer.summary_start <= end < footer.summary_start + MAX_CHUNK:
            return None
        file.seek(footer.summary_start)
        data = file.read()
        if zlib.crc32(data[: -_CRC_BYTES - len(MAGIC)]) != footer.summary_crc:
            return None
        index = list(StreamReader(BytesIO(data), skip_magic=True).records)
        stated = (
            one.chunk_count + one.metadata_count + one.attachment_count for one in index if isinstance(one, Statistics)
        )
        return index if len(_by_index(index)) == next(stated, None) else None
    return None


def _by_index(index: list[McapRecord]) -> list[tuple[int, int, int]]:
    """Offset, size and opcode of each record that the index leads to, in the file's order."""
    places: list[tuple[int, int, int]] = []
    for one in index:
        if isinstance(one, ChunkIndex):
            places.append((one.chunk_start_offset, one.chunk_length, Opcode.CHUNK))
        elif isinstance(one, (MetadataIndex, AttachmentIndex)):
            kind = Opcode.METADATA if isinstance(one, MetadataIndex) else Opcode.ATTACHMENT
            places.append((one.offset, one.length, kind))
    return sorted(places)


def _from_the_front(file: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """Offset, size and opcode of each record of the data section; the last may be none, or cut."""
    at, opcode = len(MAGIC), 0
    while opcode != Opcode.DATA_END:
        file.seek(at)
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        yield at, _HEAD.size + length, opcode
        at += _HEAD.size + length


def _record(file: BinaryIO, at: int, size: int, opcode: int) -> McapRecord | None:
    """The record at a place; None if no reader needs it. Raises one of `_MALFORMED` if it is another, or damaged."""
    left = os.fstat(file.fileno()).st_size - at
    if left < _HEAD.size:
        raise ValueError("the file is cut here" if left > 0 else "the file ends here, without its index")
    if not 0 < opcode <= Opcode.DATA_END or size > MAX_CHUNK:
        raise ValueError("no record begins here, and the file has no index")
    if left < size:
        raise ValueError(f"the file is cut within a record of {size} bytes")
    file.seek(at)
    block = file.read(size)
    if block[: _HEAD.size] != _HEAD.pack(opcode, size - _HEAD.size):
        raise ValueError("the record that the index has here is damaged")
    if opcode not in _NEEDED:
        return None
    record = next(StreamReader(BytesIO(block), skip_magic=True, emit_chunks=True).records)
    if isinstance(record, Metadata) and CHECKSUM in record.metadata:
        entries = {key: value for key, value in record.metadata.items() if key != CHECKSUM}
        if with_checksum(record.name, entries) != record.metadata:
            raise ValueError(f"metadata {record.name} does not match its checksum")
    return record


def _contents(chunk: Chunk) -> list[McapRecord]:
    """The records in a chunk. Raises one of `_MALFORMED` if it is damaged, or claims to hold more than `MAX_CHUNK`."""
    if chunk.compression not in ("zstd", ""):
        raise ValueError(f"a chunk cannot be read: its compression {chunk.compression!r} is not known")
    # −1 of a zstd frame that does not say: it is decompressed up to the chunk's own size
    stated = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
    if max(chunk.uncompressed_size, stated) > MAX_CHUNK:
        raise ValueError(f"a chunk claims to hold {max(chunk.uncompressed_size, stated)} bytes")
    try:
        return breakup_chunk(chunk, validate_crc=True)
    except _MALFORMED as error:
        raise ValueError(f"a chunk cannot be read: {error}") from None
