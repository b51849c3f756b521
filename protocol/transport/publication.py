"""Publication: publishes numbered messages, and answers for those of the last minute that a subscriber lacks.

Messages are dropped where a peer does not keep up, so a publisher never waits for a recorder; the recorder queries the
cache for them, a page at a time (recovery.py). Each message carries its publisher's wall clock, for logs alone.
"""

from __future__ import annotations

import secrets
import struct
import time
from contextlib import suppress
from math import ceil
from threading import Lock
from typing import Final, NamedTuple

import zenoh

from aeroloop.protocol.messages import topics

KEPT_S: Final = 65.0
"""A cache holds the messages of this time at the topic's rate [s]: 60 s and the duration of a restart."""
PAGE_BYTES: Final = 49_152
"""A page ends with the message that exceeds it: what a link sends at once is 65 536 bytes."""
PAGE_MESSAGES: Final = 250
"""Messages of a page, which are put together while the loop may wait for Python's lock."""
PUBLISHERS: Final = 256
"""Publishers that a query may name."""

_ATTACHMENT: Final = struct.Struct("<qQQ")  # wall clock, publisher, number
_WANTED: Final = struct.Struct("<QQ")  # publisher, number
_PAGE: Final = struct.Struct("<QQQ")  # publisher, number of the first message, number that comes after the last
_ITEM: Final = struct.Struct("<qI")  # wall clock, length
ADDED_BYTES: Final = _PAGE.size + _ITEM.size
"""More than a message's attachment: what a page adds to the only message in it."""


class Page(NamedTuple):
    """Consecutive messages of a cache.

    Attributes:
        publisher: Whose they are.
        first: Number of the first; greater than the one queried if older messages are no longer kept.
        end: How many messages have been published.
        messages: Times of publication on the publisher's wall clock [ns since 1970], and payloads.
    """

    publisher: int
    first: int
    end: int
    messages: list[tuple[int, bytes]]


class Cache:
    """The last `size` messages of a publisher. One thread at a time puts; another may read meanwhile."""

    def __init__(self, publisher: int, size: int) -> None:
        self._publisher = publisher
        self._kept: list[tuple[int, int, bytes]] = [(-1, 0, b"")] * size
        self.count = 0

    def put(self, clock_ns: int, payload: bytes) -> int:
        """Keep a message in place of the oldest. Returns its number."""
        number = self.count
        self._kept[number % len(self._kept)] = number, clock_ns, payload
        self.count = number + 1
        return number

    def page(self, wanted: int) -> bytes:
        """The messages from a number on, as many as fit a page, as `read_page` reads them."""
        end = self.count
        number = first = min(max(wanted, end - len(self._kept), 0), end)
        size, found = 0, list[bytes]()
        while number < end and size < PAGE_BYTES and len(found) < 2 * PAGE_MESSAGES:
            kept, clock_ns, payload = self._kept[number % len(self._kept)]
            number += 1
            if kept >= number:  # replaced meanwhile, and all before it
                first, size = number, 0
                found.clear()
                continue
            found += _ITEM.pack(clock_ns, len(payload)), payload
            size += _ITEM.size + len(payload)
        return b"".join([_PAGE.pack(self._publisher, first, end), *found])


def read_page(data: bytes) -> Page | None:
    """Parse a page; None if it is none."""
    if len(data) < _PAGE.size:
        return None
    publisher, first, end = _PAGE.unpack_from(data)
    at, messages = _PAGE.size, list[tuple[int, bytes]]()
    while at < len(data):
        if len(data) - at < _ITEM.size:
            return None
        clock_ns, length = _ITEM.unpack_from(data, at)
        at += _ITEM.size
        if length > len(data) - at:
            return None
        messages.append((clock_ns, data[at : at + length]))
        at += length
    return Page(publisher, first, end, messages) if first + len(messages) <= end else None


def request(wanted: dict[int, int]) -> bytes:
    """A query of caches: the number from which each publisher's messages are wanted; all of others."""
    return b"".join(_WANTED.pack(*each) for each in wanted.items())


def read_request(data: bytes) -> dict[int, int] | None:
    """Parse a query of caches; None if it is none."""
    if len(data) % _WANTED.size or len(data) > PUBLISHERS * _WANTED.size:
        return None
    return dict(_WANTED.iter_unpack(data))


def attachment(clock_ns: int, publisher: int, number: int) -> bytes:
    """What goes with a message: time of publication [ns since 1970], publisher, number."""
    return _ATTACHMENT.pack(clock_ns, publisher, number)


class CachedPublisher:
    """Publishes on one key, from any thread, and answers queries of its cache. The session outlives the publisher.

    `per_s` bounds the messages per second, in the long run; the cache holds `KEPT_S` of them. If `lossless`, for
    lockstep, it waits for peers that do not keep up instead of dropping.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        per_s: float,
        *,
        lossless: bool = False,
        encoding: zenoh.Encoding = zenoh.Encoding.APPLICATION_JSON,
    ) -> None:
        self._publisher = session.declare_publisher(
            key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
        )
        self._id = secrets.randbits(64)
        self._cache = Cache(self._id, ceil(KEPT_S * per_s))
        self._putting = Lock()
        self._cache_key = topics.cache_key(key)
        # Answered in a thread of Python: in Zenoh's own, all else would wait while a slow peer takes a page.
        self._queryable = session.declare_queryable(self._cache_key, self._answer)

    def put(self, payload: bytes) -> None:
        """Publish a message."""
        with self._putting:
            clock_ns = time.time_ns()
            number = self._cache.put(clock_ns, payload)
            self._publisher.put(payload, attachment=attachment(clock_ns, self._id, number))

    def _answer(self, query: zenoh.Query) -> None:
        with query, suppress(zenoh.ZError):  # closed meanwhile
            wanted = read_request(query.payload.to_bytes() if query.payload else b"")
            if wanted is not None:
                query.reply(self._cache_key, self._cache.page(wanted.get(self._id, 0)))


class Delivery(NamedTuple):
    """A received message.

    Attributes:
        key: Its key.
        payload: Its bytes.
        number: How many messages its publisher published before it; 0 if it has no number.
        published_ns: Time of publication on its publisher's wall clock [ns since 1970]; None if absent.
        publisher: A number that its publisher drew by lot; None if absent.
    """

    key: str
    payload: bytes
    number: int
    published_ns: int | None
    publisher: int | None


def read_sample(sample: zenoh.Sample) -> Delivery:
    """Convert a sample of a cached publisher, or of any other."""
    key, payload, attached = str(sample.key_expr), sample.payload.to_bytes(), sample.attachment
    if attached is None or len(data := attached.to_bytes()) != _ATTACHMENT.size:
        return Delivery(key, payload, 0, None, None)
    clock_ns, publisher, number = _ATTACHMENT.unpack(data)
    return Delivery(key, payload, number, clock_ns, publisher)
