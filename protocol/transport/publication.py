"""Publication: publishes messages from a cache, from which late or interrupted subscribers recover them.

Zenoh's advanced publisher numbers its messages and caches the last of them; the advanced subscriber queries what was
published before it joined, and every missing number. Messages are dropped where a peer does not keep up, so a publisher
never waits for a recorder, and the subscriber recovers them later. Each message carries its publisher's wall clock, for
logs alone.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterator
from math import ceil
from threading import Lock
from typing import Any, Final, NamedTuple

import zenoh
import zenoh.ext
from zenoh.handlers import FifoChannel, Handler, RingChannel

from aeroloop.protocol.transport.direct import direct

KEPT_S: Final = 65.0
"""A cache holds the messages of this time at the topic's rate [s]: 60 s and the duration of a restart."""
HEARTBEAT_S: Final = 2.0
"""Interval at which a publisher repeats its last number [s], so that the very last message can be recovered, too."""
CACHE_S: Final = 2.0
"""Time-out of a cache query, which is then repeated [s]."""
AGAIN_S: Final = 0.2
"""Delay before an incomplete cache query is repeated [s]: Zenoh may not have discovered the cache yet."""
JOIN_S: Final = 10.0
"""How long messages of a new publisher are held back for the answer of its cache [s]."""
HISTORY: Final = 1_000_000
"""Bound on the messages queried of one publisher; the publisher's cache is smaller."""
WAITING: Final = 65_536
"""Messages of one topic that may wait to be taken; beyond that the oldest is dropped, and counted by its number."""

_CLOCK: Final = struct.Struct("<q")
ATTACHMENT_BYTES: Final = _CLOCK.size

_Publisher = tuple[zenoh.ZenohId, int]
"""An EntityGlobalId cannot be compared."""


class CachedPublisher:
    """Publishes on one key from a cache. The session outlives the publisher.

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
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session,
            key,
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(max_samples=ceil(KEPT_S * per_s)),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
            publisher_detection=True,
        )

    def put(self, payload: bytes) -> None:
        """Publish a message."""
        self._publisher.put(payload, attachment=_CLOCK.pack(time.time_ns()))


class Delivery(NamedTuple):
    """A received message.

    Attributes:
        key: Its key.
        payload: Its bytes.
        sequence: Number of messages that its publisher published on this key before it, modulo 2³².
        published_ns: Publication time on its publisher's wall clock [ns since 1970]; None if absent.
        source: Its publisher; None if absent.
    """

    key: str
    payload: bytes
    sequence: int
    published_ns: int | None
    source: zenoh.EntityGlobalId | None


class Missed(NamedTuple):
    """Messages that were published and can no longer be recovered.

    Attributes:
        source: Their publisher.
        missing: How many.
    """

    source: zenoh.EntityGlobalId
    missing: int


class CacheQuery:
    """Queries the cache of a new publisher for messages before the first one received.

    A message that is published while a link is being set up can be received before Zenoh's subscriber discovers the
    cache; it then drops the cache's older messages without a miss (seen with zenoh 1.10). The query includes that first
    message, which the cache holds: an answer without it is incomplete, and the cache is queried again. Until then all
    messages of this publisher are held back, so that they are delivered in order.
    """

    def __init__(self, session: zenoh.Session, first: Delivery) -> None:
        assert first.source is not None
        self.held = [first]
        self._session = session
        self._first = first.sequence
        self._key = f"{first.key}/@adv/*/{first.source.zid}/{first.source.eid}/**?_anyke;_sn=..{first.sequence}"
        self._before: dict[int, Delivery] = {}
        self._deadline = time.monotonic() + JOIN_S
        self._answered, self._again_at = False, 0.0
        self._replies = self._query()

    def finished(self) -> bool:
        """Whether the cache has answered, or `JOIN_S` are over. Never waits."""
        now = time.monotonic()
        if now < self._again_at:
            return False
        try:
            while (reply := self._replies.try_recv()) is not None:
                if reply.ok is not None and (found := read_sample(reply.ok)).sequence <= self._first:
                    self._before[found.sequence] = found
        except zenoh.ZError:  # no more replies
            if self._first in self._before or now > self._deadline:
                return True
            if self._answered:
                self._answered, self._replies = False, self._query()
            else:
                self._answered, self._again_at = True, now + AGAIN_S
        return False

    def deliver(self) -> list[Delivery]:
        """All messages of this publisher so far, in order."""
        self._before.pop(self._first, None)
        return [*(self._before[number] for number in sorted(self._before)), *self.held]

    def _query(self) -> Handler[zenoh.Reply]:
        channel: FifoChannel[zenoh.Reply] = FifoChannel(HISTORY)
        return self._session.get(self._key, channel, consolidation=zenoh.ConsolidationMode.NONE, timeout=CACHE_S)


class ByteRing:
    """Samples that wait to be taken, bounded in number and in bytes of payload: the oldest are dropped."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._samples: deque[tuple[zenoh.Sample, int]] = deque()
        self._bytes = 0
        self._lock = Lock()

    def put(self, sample: zenoh.Sample) -> None:
        """Add a sample, in one of Zenoh's threads."""
        size = len(sample.payload)
        with self._lock:
            self._samples.append((sample, size))
            self._bytes += size
            while len(self._samples) > self._most or self._bytes > self._most_bytes:
                self._bytes -= self._samples.popleft()[1]

    def try_recv(self) -> zenoh.Sample | None:
        """Remove and return the oldest sample; None if there is none."""
        with self._lock:
            if not self._samples:
                return None
            sample, size = self._samples.popleft()
            self._bytes -= size
            return sample


class RecoveringSubscriber:
    """Subscriber that recovers earlier messages from publishers' caches.

    At most `waiting` messages wait to be taken, and no Python runs when one is received; if `waiting_bytes` bounds
    their bytes, too, it does: for a process without a loop. The session outlives the subscriber.
    """

    def __init__(
        self, session: zenoh.Session, key: str, waiting: int = WAITING, waiting_bytes: int | None = None
    ) -> None:
        bounded = None if waiting_bytes is None else ByteRing(waiting, waiting_bytes)
        # Any: the stubs have a type for each kind of handler.
        ring: Any = RingChannel(waiting) if bounded is None else direct(bounded.put)
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            ring,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._received = bounded or self._subscriber
        self._misses = self._subscriber.sample_miss_listener(RingChannel(1024))
        self._session = session
        self._known: set[_Publisher] = set()
        self._joins: dict[_Publisher, CacheQuery] = {}
        self._ready: deque[Delivery] = deque()  # no longer held back, and not yet taken

    @property
    def joining(self) -> bool:
        """Whether messages are held back until a publisher's cache has answered."""
        return bool(self._joins)

    def take(self, *, held: bool = False) -> Iterator[Delivery]:
        """Messages received and not yet taken, each publisher's in order. Never waits.

        If `held`, also those that are held back until a cache has answered.
        """
        while (sample := self._received.try_recv()) is not None:
            received = read_sample(sample)
            if received.source is None:
                yield received
                continue
            publisher = received.source.zid, received.source.eid
            if publisher in self._joins:
                self._joins[publisher].held.append(received)
            elif publisher in self._known or not received.sequence:
                self._known.add(publisher)
                yield received
            else:
                self._known.add(publisher)
                self._joins[publisher] = CacheQuery(self._session, received)
        for publisher, join in list(self._joins.items()):
            if join.finished() or held:
                del self._joins[publisher]
                self._ready.extend(join.deliver())
        while self._ready:
            yield self._ready.popleft()

    def missed(self) -> Iterator[Missed]:
        """Losses found since the last call."""
        while (miss := self._misses.try_recv()) is not None:
            yield Missed(miss.source, miss.nb)

    def undeclare(self) -> None:
        """Stop receiving."""
        self._subscriber.undeclare()


def read_sample(sample: zenoh.Sample) -> Delivery:
    """Convert a sample of an advanced publisher, or of any other."""
    clock, source = sample.attachment, sample.source_info
    published_ns: int | None = None
    if clock is not None and len(stamp := clock.to_bytes()) == _CLOCK.size:
        (published_ns,) = _CLOCK.unpack(stamp)
    return Delivery(
        str(sample.key_expr),
        sample.payload.to_bytes(),
        0 if source is None else source.source_sn,
        published_ns,
        None if source is None else source.source_id,
    )
