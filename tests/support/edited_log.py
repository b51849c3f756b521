"""Edited logs: copies with messages replaced, dropped or added, rows of batches edited, or a part of the file damaged.

Also builds ticks by hand.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from math import nan
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import Writer

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.operator import Message as Model
from aeroloop.protocol.messages.trace import HEADER_BYTES, STEPS, End, read_batch
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.service.logs.ticks import Ticks
from tests.support.made_log import ONE_WAY_NS, SESSION, START_NS, VEHICLE

PERIOD_NS = 2_000_000
LATENCY_NS = 2 * ONE_WAY_NS
HEAD: Final = struct.Struct("<BQ")
FOOTER: Final = struct.Struct("<QQI")
END: Final = HEAD.size + FOOTER.size + len(MAGIC)


class Said(NamedTuple):
    """A message: its key, when it was published [ns], what it says, and when it was recorded if not at once."""

    key: str
    published_ns: int
    data: bytes
    recorded_ns: int | None = None

    @property
    def at_ns(self) -> int:
        return self.published_ns if self.recorded_ns is None else self.recorded_ns

    @property
    def topic(self) -> str:
        address = topics.read_key(self.key)
        return address.topic.name if address else ""


def message_of(
    name: str, message: Model | bytes, published_ns: int, role: str | None = None, session: str = SESSION
) -> Said:
    """A message of the made log's vehicle, of its controller where neither `role` nor an event names one."""
    if role is None:
        role = message.role if isinstance(message, Event) else "controller"
    key = topics.key(name, VEHICLE, session=session, role=role)
    return Said(key, published_ns, message if isinstance(message, bytes) else message.encode())


def contents(log: Path) -> tuple[list[Said], list[tuple[str, dict[str, str]]]]:
    with log.open("rb") as file:
        reader = make_reader(file)
        messages = [
            Said(channel.topic, one.publish_time, one.data, one.log_time) for _, channel, one in reader.iter_messages()
        ]
        return messages, [(record.name, dict(record.metadata)) for record in reader.iter_metadata()]


def rewrite(
    log: Path,
    out: Path,
    change: Callable[[Said], Said | None] = lambda one: one,
    more: Sequence[Said] = (),
    metadata: Iterable[tuple[str, dict[str, str]]] = (),
) -> Path:
    """Write a log again, with each message changed (None leaves it out), and with more messages and metadata."""
    messages, known = contents(log)
    kept = [one for message in messages if (one := change(message)) is not None]
    return write_messages(out, sorted([*kept, *more], key=lambda one: one.at_ns), [*known, *metadata])


def write_messages(out: Path, messages: Iterable[Said], metadata: Iterable[tuple[str, dict[str, str]]] = ()) -> Path:
    with out.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="aeroloop", library="test")
        for name, entries in metadata:
            writer.add_metadata(name, entries)
        channels: dict[str, int] = {}
        for one in messages:
            if one.key not in channels:
                channels[one.key] = writer.register_channel(one.key, "", 0)
            writer.add_message(channels[one.key], one.at_ns, one.data, one.published_ns)
        writer.finish()
    return out


def edited(end: End, edit: Callable[[Any], None]) -> Callable[[Said], Said]:
    """What edits the columns of an end's batches in place."""

    def change(one: Said) -> Said:
        if one.topic != "trace" or not one.key.endswith(end):
            return one
        batch = read_batch(one.data)
        assert batch is not None
        columns = {name: column.copy() for name, column in batch.columns.items()}
        edit(columns)
        for name in set(STEPS) & set(columns):
            columns[name] = np.diff(columns[name], prepend=columns[name].dtype.type(0))
        packed = b"".join(column.tobytes() for column in columns.values())
        at = HEADER_BYTES + len(packed)
        return one._replace(data=one.data[:HEADER_BYTES] + packed + one.data[at:])

    return change


def at_rest(k: Sequence[int] | npt.NDArray[np.int64], **columns: Any) -> Ticks:
    """Ticks of the default configuration at rest, where the body shall be; `columns` are others, by name."""
    k = np.asarray(k, dtype=np.int64)
    n, at_ns = len(k), START_NS + k * PERIOD_NS
    upright, zeros, unknown = np.tile(IDENTITY, (n, 1)), np.zeros((n, 3)), np.full(n, nan)
    state = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))  # θ̂, and the sign
    volts = np.zeros((n, 2))
    ticks = Ticks(
        k, at_ns, at_ns, np.full(n, float(LATENCY_NS)), unknown, unknown, upright, upright, zeros, zeros, zeros,
        volts, volts, np.full((n, 9), 0.3), state, state,
    )  # fmt: skip
    return ticks._replace(**columns)


class Part(NamedTuple):
    offset: int
    opcode: int
    content: bytes

    @property
    def end(self) -> int:
        return self.offset + HEAD.size + len(self.content)


class Read(NamedTuple):
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
    with path.open("rb") as file:
        return [
            Read(channel.topic, one.sequence, one.log_time, one.publish_time, one.data)
            for _, channel, one in make_reader(file).iter_messages(log_time_order=False)
        ]
