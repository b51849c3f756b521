"""The records of an MCAP file, whole or broken, one after another: https://mcap.dev/spec.

Readers by the index need a file that was closed. This one reads from the front, takes every complete record, checks
every chunk against its checksum, steps over a chunk that is damaged, and says what it could not read. A file cut at any
byte thus gives all that was complete before the cut.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import lz4.frame
import zstandard

MAGIC: Final = b"\x89MCAP0\r\n"
HEADER: Final = 0x01
FOOTER: Final = 0x02
SCHEMA: Final = 0x03
CHANNEL: Final = 0x04
MESSAGE: Final = 0x05
CHUNK: Final = 0x06
ATTACHMENT: Final = 0x09
METADATA: Final = 0x0C
DATA_END: Final = 0x0F

CONTRACT_METADATA: Final = "aeroloop.contract"
"""What our own logs call the metadata record with a role's contract, as JSON under the key `json`."""

CHUNK_BYTES: Final = 64 * 1024
"""A 64 KiB chunk compresses in under 3 ms; the writer's default of 1 MiB takes 39 ms at once."""

MAX_RECORD: Final = 1 << 30
"""A record said to be longer is damage: nobody writes a gigabyte at once."""

_HEAD: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<QQQI")
_FOOTER: Final = struct.Struct("<QQI")
_MESSAGE: Final = struct.Struct("<HIQQ")


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
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise NotMcapError(f"{path} does not begin as an MCAP file")
        while (record := _next(file, damages)) is not None:
            if record.opcode == CHUNK:
                yield from _inside(record, damages)
                if progress is not None:
                    progress(file.tell())
            elif record.opcode in (DATA_END, FOOTER):
                return
            else:
                yield record


def summary(path: Path) -> list[Record]:
    """Schemas and channels as the end of a file repeats them; none if it has no whole end.

    They stand in the chunk that first used them, too; this helps where that chunk is damaged.
    """
    size = path.stat().st_size
    end = _HEAD.size + _FOOTER.size + len(MAGIC)
    if size < end + len(MAGIC):
        return []
    with path.open("rb") as file:
        file.seek(size - end)
        opcode, _ = _HEAD.unpack(file.read(_HEAD.size))
        start, _, _ = _FOOTER.unpack(file.read(_FOOTER.size))
        if opcode != FOOTER or file.read() != MAGIC or not 0 < start < size:
            return []
        file.seek(start)
        found = []
        while (record := _next(file, [])) is not None and record.opcode != FOOTER:
            if record.opcode in (SCHEMA, CHANNEL):
                found.append(record)
        return found


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


def _next(file: BinaryIO, damages: list[Damage]) -> Record | None:
    """The next whole record, or None where there is no more."""
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


def _inside(chunk: Record, damages: list[Damage]) -> Iterator[Record]:
    try:
        _, _, size, checksum = _CHUNK.unpack_from(chunk.content)
        compression, at = _text(chunk.content, _CHUNK.size)
        (length,) = struct.unpack_from("<Q", chunk.content, at)
        data = _decompressed(compression, chunk.content[at + 8 : at + 8 + length], size)
    except (struct.error, UnicodeDecodeError, ValueError, RuntimeError, zstandard.ZstdError) as error:
        damages.append(Damage(chunk.offset, f"a chunk cannot be read: {str(error).splitlines()[0]}"))
        return
    if checksum and zlib.crc32(data) != checksum:
        damages.append(Damage(chunk.offset, "a chunk does not match its checksum"))
        return
    at, end = 0, len(data)
    while at + _HEAD.size <= end:
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        yield Record(opcode, data[at : at + length], chunk.offset)
        at += length


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
