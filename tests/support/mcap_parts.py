"""Parts of an MCAP file: where its records stand, and copies of it with a part damaged."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Final, NamedTuple

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC as MAGIC

HEAD: Final = struct.Struct("<BQ")
FOOTER: Final = struct.Struct("<QQI")
END: Final = HEAD.size + FOOTER.size + len(MAGIC)


class Part(NamedTuple):
    """A record as it stands in the file."""

    offset: int
    opcode: int
    content: bytes

    @property
    def bytes(self) -> bytes:
        return HEAD.pack(self.opcode, len(self.content)) + self.content

    @property
    def end(self) -> int:
        return self.offset + HEAD.size + len(self.content)


class Read(NamedTuple):
    """A message."""

    topic: str
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


def parts(data: bytes, at: int = 0) -> list[Part]:
    found = []
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        found.append(Part(at, opcode, data[at + HEAD.size : at + HEAD.size + length]))
        at = found[-1].end
    return found


def chunks(data: bytes) -> list[Part]:
    return [part for part in parts(data[: -len(MAGIC)], len(MAGIC)) if part.opcode == Opcode.CHUNK]


def with_a_damaged_chunk(whole: Path, out: Path, which: int | None = None) -> Path:
    """A copy with a bit flipped in the middle of a chunk, of the middle one if None."""
    data = bytearray(whole.read_bytes())
    places = chunks(bytes(data))
    chunk = places[len(places) // 2 if which is None else which]
    data[(chunk.offset + chunk.end) // 2] ^= 0x55
    out.write_bytes(data)
    return out


def by_mcap(path: Path) -> list[Read]:
    """Every message of a whole file, as mcap's own reader has them by the index."""
    with path.open("rb") as file:
        return [
            Read(channel.topic, one.sequence, one.log_time, one.publish_time, one.data)
            for _, channel, one in make_reader(file).iter_messages(log_time_order=False)
        ]
