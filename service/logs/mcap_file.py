"""One MCAP file, whole or broken (https://mcap.dev/spec). Files are written by `mcap.writer.Writer`.

A file that was closed ends in an index: its records are read where the index says, and a damaged one costs itself. A
file of a killed recorder has none: it is read from the front up to the damage.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC as MAGIC

DESCRIPTION_METADATA: Final = "aeroloop.description"  # a role's description as JSON under `json`, its key under `key`
FORK_METADATA: Final = "aeroloop.fork"  # of a fork's log: which session was forked, at which tick
RECORDER_METADATA: Final = "aeroloop.recorder"  # about the file: its run, the recording's identity, its part, its start
CHUNK_BYTES: Final = 64 * 1024  # compresses in under 3 ms; the writer's default of 1 MiB takes 39 ms at once
MAX_CHUNK: Final = 16 << 20  # bytes of a record, or of what a chunk holds: a forged size costs no memory

_CHECKSUM: Final = "crc32"
_HEAD: Final = struct.Struct("<BQ")  # opcode and length of a record
_FOOTER: Final = struct.Struct("<BQQQI8s")  # with its head, and the magic after it
_MALFORMED: Final = (struct.error, ValueError, OverflowError, McapError, zstandard.ZstdError)


class NotMcapError(ValueError):
    """The file does not begin as an MCAP file does."""


class FileEndsError(ValueError):
    """The file ends where a record should begin or go on, as a recorder leaves it that was killed."""


def records(
    path: Path,
    damages: list[str] | None = None,
    progress: Callable[[int], None] | None = None,
    unfinished: list[str] | None = None,
) -> Iterator[McapRecord]:
    """Schemas, channels, messages, metadata and attachments in the file's order; damaged ones are left out.

    Schemas and channels of an index come first, so that a damaged chunk loses no other chunk's description. What could
    not be read is appended to `damages`, each with its byte and the time of the last message before it; that the file
    ends without its index, to `unfinished` instead, if that is given. `progress` is called with the bytes read so far.

    Raises NotMcapError, or OSError if the file cannot be read.
    """
    last_ns = 0
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise NotMcapError(f"{path} does not begin as an MCAP file")
        index = _index(file)
        yield from (one for one in index or () if isinstance(one, (Schema, Channel)))
        for at, opcode in _places(file, index):
            try:
                record = _record(file, at, opcode)
                found = _contents(record) if isinstance(record, Chunk) else [record]
            except _MALFORMED as error:
                after = f", after {datetime.fromtimestamp(last_ns * 1e-9, UTC):%Y-%m-%d %H:%M:%S} UTC" * bool(last_ns)
                lines = damages
                if isinstance(error, FileEndsError) and index is None and unfinished is not None:
                    lines = unfinished
                if lines is not None:
                    lines.append(f"{error or 'a record ends too early'} (byte {at}{after})")
                if index is None:
                    return
            else:
                if isinstance(record, DataEnd):
                    return
                yield from found
                last_ns = max((one.log_time for one in found if isinstance(one, Message)), default=last_ns)
            if progress is not None:
                progress(file.tell())


def with_checksum(name: str, entries: dict[str, str]) -> dict[str, str]:
    """The entries of a metadata record, and their checksum: outside of chunks, MCAP has none."""
    texts = [name, *(f"{key}={value}" for key, value in entries.items())]
    return entries | {_CHECKSUM: f"{zlib.crc32(chr(0).join(texts).encode()):08x}"}


def _index(file: BinaryIO) -> list[McapRecord] | None:
    """The records of the index at the end; None if there is none, or it is damaged."""
    with suppress(OSError, *_MALFORMED):
        file.seek(-_FOOTER.size, os.SEEK_END)
        *_, start, _, checksum, magic = _FOOTER.unpack(file.read())
        file.seek(start)
        data = file.read()
        if magic == MAGIC and start and zlib.crc32(data[: -4 - len(MAGIC)]) == checksum:
            return list(StreamReader(BytesIO(data), skip_magic=True).records)
    return None


def _places(file: BinaryIO, index: list[McapRecord] | None) -> Iterator[tuple[int, int | None]]:
    """Where each record begins, in the file's order, and its opcode: by the index, else each after the one before."""
    if index is not None:
        places = [(one.chunk_start_offset, Opcode.CHUNK) for one in index if isinstance(one, ChunkIndex)]
        places += [(one.offset, Opcode.METADATA) for one in index if isinstance(one, MetadataIndex)]
        places += [(one.offset, Opcode.ATTACHMENT) for one in index if isinstance(one, AttachmentIndex)]
        yield from sorted(places)
    at = len(MAGIC)
    while index is None:
        yield at, None
        at = file.tell()


def _record(file: BinaryIO, at: int, opcode: int | None) -> McapRecord:
    """The record at a place, of this kind. Raises one of `_MALFORMED` if it is another, or damaged."""
    file.seek(at)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise FileEndsError("the file is cut here" if head else "the file ends here, without its index")
    kind, length = _HEAD.unpack(head)
    if not 0 < kind <= Opcode.DATA_END or length > MAX_CHUNK:
        raise ValueError("no record begins here")
    content = file.read(length)
    if len(content) < length:
        raise FileEndsError(f"the file is cut within a record of {_HEAD.size + length} bytes")
    if opcode not in (None, kind):
        raise ValueError("the record that the index has here is damaged")
    record = next(StreamReader(BytesIO(head + content), skip_magic=True, emit_chunks=True).records)
    if isinstance(record, Metadata) and _CHECKSUM in record.metadata:
        entries = {key: value for key, value in record.metadata.items() if key != _CHECKSUM}
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
