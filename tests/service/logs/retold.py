"""A log told again with something changed: messages moved, replaced, left out or added, everything else as it was.

And ticks made up, for an observer that is fed by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from protocol import topics
from protocol.attitude import IDENTITY, Quaternion
from protocol.verbs import Message as Model
from service.logs.observe import Observer
from service.logs.ticks import Ticks
from tests.service.logs.made_log import SESSION, START_NS, VEHICLE

PERIOD_NS = 2_000_000
ZEROS = bytes(7)  # a measurement of 8 bits a signal
LATENCY_NS = 300_000  # in the bin from 291.7 to 304.4 µs, whose middle is 297.9


class Said(NamedTuple):
    """A message: its key, when it was published [ns], what it says."""

    key: str
    published_ns: int
    data: bytes

    @property
    def topic(self) -> str:
        """The name of its topic."""
        address = topics.read_key(self.key)
        return address.topic.name if address else ""


def told(
    name: str, message: Model | bytes, published_ns: int, role: str = "controller", session: str = SESSION
) -> Said:
    """A message of the made log's vehicle."""
    key = topics.key(name, VEHICLE, session=session, role=role)
    return Said(key, published_ns, message if isinstance(message, bytes) else message.encode())


def retell(
    log: Path,
    out: Path,
    change: Callable[[Said], Said | None] = lambda one: one,
    more: Sequence[Said] = (),
    metadata: Iterable[tuple[str, dict[str, str]]] = (),
) -> Path:
    """Write a log again.

    Args:
        log: The log.
        out: The new one.
        change: What becomes of each message; None leaves it out.
        more: Messages to add.
        metadata: Metadata to add, by name.
    """
    with log.open("rb") as file:
        reader = make_reader(file)
        messages = [Said(channel.topic, one.publish_time, one.data) for _, channel, one in reader.iter_messages()]
        known = [(record.name, dict(record.metadata)) for record in reader.iter_metadata()]
    with out.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="aeroloop", library="test")
        for name, entries in [*known, *metadata]:
            writer.add_metadata(name, entries)
        channels: dict[str, int] = {}
        kept = [one for message in messages if (one := change(message)) is not None]
        for one in sorted([*kept, *more], key=lambda one: one.published_ns):
            if one.key not in channels:
                channels[one.key] = writer.register_channel(one.key, "", 0)
            writer.add_message(channels[one.key], one.published_ns, one.data, one.published_ns)
        writer.finish()
    return out


def feed(
    observer: Observer,
    k: int,
    attitude: Quaternion = IDENTITY,
    desired: Quaternion = IDENTITY,
) -> None:
    """Let an observer see a tick, with its measurement."""
    at = START_NS + k * PERIOD_NS
    zero = (0.0, 0.0, 0.0)
    observer.measurement(ZEROS, at)
    columns = (k, at, float(LATENCY_NS), attitude, desired, zero, zero, zero, zero, (0.0, 0.0), 1.0, zero, zero)
    observer.ticks(Ticks(*(np.array([column]) for column in columns)))
