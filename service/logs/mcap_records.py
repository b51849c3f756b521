"""The records of an MCAP file, whole or broken, one after another: https://mcap.dev/spec.

Readers by the index need a file that was closed. This one reads from the front, takes every complete record, checks
every chunk against its checksum, steps over a chunk that is damaged, and says what it could not read. A file cut at any
byte thus gives all that was complete before the cut. `records` gives everything; `messages` is for who reads hours of
a few channels, and makes no object of the others.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TypeVar

import lz4.frame
import zstandard

MAGIC: Final = b"\x89MCAP0\r\n"
HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
CHUNK_INDEX: Final = 0x08
ATTACHMENT: Final = 0x09
STATISTICS: Final = 0x0B
METADATA: Final = 0x0C
METADATA_INDEX: Final = 0x0D
DATA_END: Final = 0x0F

CONTRACT_METADATA: Final = "aeroloop.contract"
"""What our own logs call the metadata record with a role's contract, as JSON under the key `json`."""

CHANGE_METADATA: Final = "aeroloop.change"
"""A metadata record with what a controller followed when the file began: a Change as JSON, and its key."""

RECORDER_METADATA: Final = "aeroloop.recorder"
"""A metadata record about the file itself: its run, its part, when it was begun."""

CHUNK_BYTES: Final = 64 * 1024
"""A 64 KiB chunk compresses in under 3 ms; the writer's default of 1 MiB takes 39 ms at once."""

MAX_RECORD: Final = 1 << 30
"""A record said to be longer is damage: nobody writes a gigabyte at once."""

_HEAD: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<QQQI")
_FOOTER: Final = struct.Struct("<QQI")
_MESSAGE: Final = struct.Struct("<HIQQ")
_PUBLISH_TIME: Final = struct.Struct("<Q")
_PUBLISH_TIME_AT: Final = _MESSAGE.size - _PUBLISH_TIME.size
_HEAD_AND_ID: Final = struct.Struct("<BQH")
"""Whatever stands in a chunk begins with its id or, a message, with its channel's."""

T = TypeVar("T")


class Record(NamedTuple):
    """One record: its opcode, its content, and where the record that holds it begins in the file."""

    opcode: int
    content: bytes
    offset: int


class Message(NamedTuple):
    """A message record, taken apart. Times in ns."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes

    @classmethod
    def read(cls, content: bytes) -> Message:
        """A message out of its record's content. Raises struct.error if that is too short."""
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        return cls(channel, sequence, log_time, publish_time, content[_MESSAGE.size :])


class Channel(NamedTuple):
    """A channel record, as far as it is used here."""

    id: int
    topic: str

    @classmethod
    def read(cls, content: bytes) -> Channel:
        """A channel out of its record's content."""
        identifier, _ = struct.unpack_from("<HH", content)
        topic, _ = _text(content, 4)
        return cls(identifier, topic)


class Footer(NamedTuple):
    """A footer record: where the summary begins in the file, and its checksum; 0 if it has none."""

    summary_start: int
    checksum: int


class Damage(NamedTuple):
    """What could not be read, and where it begins in the file."""

    offset: int
    what: str


class NotMcapError(ValueError):
    """The file does not begin as an MCAP file does."""


def records(
    path: Path, damages: list[Damage] | None = None, progress: Callable[[int], None] | None = None
) -> Iterator[Record]:
    """Records up to the end of the data section, those inside chunks in their place; what is damaged is left out.

    Args:
        path: The file.
        damages: What could not be read is put here.
        progress: Called after each chunk with the bytes read so far.

    Raises:
        NotMcapError: It is no MCAP file.
        OSError: It cannot be read.
    """
    damages = [] if damages is None else damages
    for block in _blocks(path, damages, progress):
        if block.opcode == CHUNK:
            yield from inside(block, damages)
        else:
            yield block


def messages(
    path: Path,
    wanted: Callable[[Channel], T | None],
    damages: list[Damage] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[tuple[T, bytes, int]]:
    """Messages of some channels, in the file's order: what `wanted` said, content, time of publication [ns].

    Args:
        path: The file.
        wanted: Asked at the first message of a channel; None leaves all of them out.
        damages: What could not be read is put here.
        progress: Called after each chunk with the bytes read so far.

    Raises:
        NotMcapError: It is no MCAP file.
        OSError: It cannot be read.
    """
    damages = [] if damages is None else damages
    channels: dict[int, Channel] = {}
    answers: dict[int, T | None] = {}
    head_of, publish_time_of = _HEAD_AND_ID.unpack_from, _PUBLISH_TIME.unpack_from
    for block in chain(summary(path), _blocks(path, damages, progress)):
        if block.opcode == CHUNK:
            data = _plain(block, damages)
        elif block.opcode in (CHANNEL, MESSAGE):
            data = _HEAD.pack(block.opcode, len(block.content)) + block.content  # as a chunk of one
        else:
            continue
        at, end = 0, len(data)
        try:
            while at < end:
                opcode, length, identifier = head_of(data, at)
                content = at + _HEAD.size
                at = content + length
                if opcode == MESSAGE:
                    if identifier not in answers:
                        if identifier not in channels:
                            continue
                        answers[identifier] = wanted(channels[identifier])
                    answer = answers[identifier]
                    if answer is not None:
                        (published_ns,) = publish_time_of(data, content + _PUBLISH_TIME_AT)
                        yield answer, data[content + _MESSAGE.size : at], published_ns
                elif opcode == CHANNEL:
                    channels[identifier] = Channel.read(data[content:at])
        except struct.error:
            damages.append(Damage(block.offset, "a chunk ends within a record"))


def summary(path: Path) -> list[Record]:
    """Schemas and channels as the end of a file repeats them; none if it has no whole end.

    They stand in the chunk that first used them, too; this helps where that chunk is damaged.
    """
    with path.open("rb") as file:
        end = footer(file, path.stat().st_size)
        if end is None:
            return []
        file.seek(end.summary_start)
        found = []
        while (record := next_record(file, [])) is not None and record.opcode != FOOTER:
            if record.opcode in (SCHEMA, CHANNEL):
                found.append(record)
        return found


def footer(file: BinaryIO, size: int) -> Footer | None:
    """The end of a file that was closed and has an index; None of any other."""
    at = size - len(MAGIC) - _FOOTER.size - _HEAD.size
    if at <= len(MAGIC):
        return None
    file.seek(at)
    opcode, _ = _HEAD.unpack(file.read(_HEAD.size))
    start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    return Footer(start, checksum) if opcode == FOOTER and file.read() == MAGIC and 0 < start <= at else None


def metadata(content: bytes) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record."""
    name, at = _text(content, 0)
    (size,) = struct.unpack_from("<I", content, at)
    end = at + 4 + size
    at += 4
    entries = {}
    while at < end:
        key, at = _text(content, at)
        entries[key], at = _text(content, at)
    return name, entries


def _blocks(path: Path, damages: list[Damage], progress: Callable[[int], None] | None) -> Iterator[Record]:
    """Records as they stand in the file, chunks whole, up to the end of the data section."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise NotMcapError(f"{path} does not begin as an MCAP file")
        while (record := next_record(file, damages)) is not None and record.opcode not in (DATA_END, FOOTER):
            yield record
            if record.opcode == CHUNK and progress is not None:
                progress(file.tell())


def next_record(file: BinaryIO, damages: list[Damage]) -> Record | None:
    """The next whole record of a file, or None where there is no more."""
    offset = file.tell()
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        damages.append(Damage(offset, "the file ends here, without its index" if not head else "the file is cut here"))
        return None
    opcode, length = _HEAD.unpack(head)
    if not 0 < opcode <= 0x7F or length > MAX_RECORD:
        damages.append(Damage(offset, "no record begins here; what follows cannot be found"))
        return None
    content = file.read(length)
    if len(content) < length:
        damages.append(Damage(offset, f"the file is cut within a record of {length} bytes"))
        return None
    return Record(opcode, content, offset)


def inside(chunk: Record, damages: list[Damage]) -> Iterator[Record]:
    """The records of a chunk; none of one that is damaged."""
    data = _plain(chunk, damages)
    at, end = 0, len(data)
    while at + _HEAD.size <= end:
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        yield Record(opcode, data[at : at + length], chunk.offset)
        at += length


def _plain(chunk: Record, damages: list[Damage]) -> bytes:
    """What a chunk holds, decompressed and checked; nothing if it is damaged."""
    try:
        _, _, size, checksum = _CHUNK.unpack_from(chunk.content)
        compression, at = _text(chunk.content, _CHUNK.size)
        (length,) = struct.unpack_from("<Q", chunk.content, at)
        data = _decompressed(compression, chunk.content[at + 8 : at + 8 + length], size)
    except (struct.error, UnicodeDecodeError, ValueError, RuntimeError, zstandard.ZstdError) as error:
        damages.append(Damage(chunk.offset, f"a chunk cannot be read: {str(error).splitlines()[0]}"))
        return b""
    if checksum and zlib.crc32(data) != checksum:
        damages.append(Damage(chunk.offset, "a chunk does not match its checksum"))
        return b""
    return data


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    if compression == "lz4":
        plain: bytes = lz4.frame.decompress(data)
        return plain
    if compression == "":
        return data
    raise ValueError(f"its compression {compression!r} is not known")


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise struct.error("a text is longer than its record")
    return content[at + 4 : end].decode(), end
