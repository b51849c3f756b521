"""Publication: messages that a late or interrupted subscriber recovers from their publisher's cache.

Zenoh's advanced publisher numbers what it publishes and keeps the last of it; the advanced subscriber asks for what was
published before it came and for every number that it lacks. Messages are dropped where a peer does not keep up, so a
publisher never waits for a recorder, and the subscriber recovers them later. Each message bears its publisher's wall
clock, for logs alone.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterator
from math import ceil
from typing import Final, NamedTuple

import zenoh
import zenoh.ext
from zenoh.handlers import FifoChannel, Handler, RingChannel

KEPT_S: Final = 65.0
"""A cache holds what was published in this time, at the topic's rate [s]: 60 s and what a restart takes."""
HEARTBEAT_S: Final = 2.0
"""How often a publisher that has published says its last number [s]: the very last message can be recovered, too."""
CACHE_S: Final = 2.0
"""How long a publisher's cache may take to answer before it is queried again [s]."""
AGAIN_S: Final = 0.2
"""How long after an answer without what was published the cache is queried again [s]: Zenoh may not know of it yet."""
JOIN_S: Final = 10.0
"""How long messages of a new publisher are held back for the answer of its cache [s]."""
HISTORY: Final = 1_000_000
"""Messages of one publisher that a subscriber asks for at the most; the publisher's cache is smaller."""
WAITING: Final = 65_536
"""Messages of one topic that may wait to be taken; then the oldest is dropped, and counted by its number."""

_CLOCK: Final = struct.Struct("<q")

_Publisher = tuple[zenoh.ZenohId, int]
"""An EntityGlobalId cannot be compared."""


class CachedPublisher:
    """Publishes on one key from a cache.

    Args:
        session: An open session; it outlives the publisher.
        key: Where.
        per_s: Messages a second at the most, in the long run; the cache holds `KEPT_S` of them.
        lossless: Wait for peers that do not keep up instead of dropping; for lockstep.
        encoding: Of the payload.
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
    """A message as it was received.

    Attributes:
        key: Its key.
        payload: Its bytes.
        sequence: How many its publisher had published on this key before it, modulo 2³².
        published_ns: When it was published, on its publisher's wall clock [ns since 1970]; None if that is not said.
        source: Its publisher; None if that is not said.
    """

    key: str
    payload: bytes
    sequence: int
    published_ns: int | None
    source: zenoh.EntityGlobalId | None


class Missed(NamedTuple):
    """Messages that were published and can be recovered no more.

    Attributes:
        source: Their publisher.
        missing: How many.
    """

    source: zenoh.EntityGlobalId
    missing: int


class CacheQuery:
    """Queries the cache of a new publisher for what it published before the first message that was received.

    A message that is published while a link is being set up can be received before Zenoh's subscriber learns that
    there is a cache; it then drops the cache's older ones without a miss (seen with zenoh 1.10). The query includes
    that first message, which the cache holds: an answer without it is none, and the cache is queried again. Until then
    what is received of this publisher is held back, so that all is delivered in order.

    Args:
        session: An open session.
        first: The first message that was received.
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
        """Whether the cache has answered, or has had its time. Never waits."""
        now = time.monotonic()
        if now < self._again_at:
            return False
        try:
            while (reply := self._replies.try_recv()) is not None:
                if reply.ok is not None and (found := read_sample(reply.ok)).sequence <= self._first:
                    self._before[found.sequence] = found
        except zenoh.ZError:  # that was all
            if self._first in self._before or now > self._deadline:
                return True
            if self._answered:
                self._answered, self._replies = False, self._query()
            else:
                self._answered, self._again_at = True, now + AGAIN_S
        return False

    def deliver(self) -> list[Delivery]:
        """All that was received of this publisher so far, in order."""
        self._before.pop(self._first, None)
        return [*(self._before[number] for number in sorted(self._before)), *self.held]

    def _query(self) -> Handler[zenoh.Reply]:
        room: FifoChannel[zenoh.Reply] = FifoChannel(HISTORY)
        return self._session.get(self._key, room, consolidation=zenoh.ConsolidationMode.NONE, timeout=CACHE_S)


class RecoveringSubscriber:
    """Receives a key expression from its publishers' caches on. Nothing of Python runs when a message is received.

    Args:
        session: An open session; it outlives the subscriber.
        key: A key expression.
        waiting: Messages that may wait to be taken.
    """

    def __init__(self, session: zenoh.Session, key: str, waiting: int = WAITING) -> None:
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            RingChannel(waiting),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            subscriber_detection=True,
        )
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
        """What was received and not yet taken, each publisher's in order. Never waits.

        Args:
            held: Also take what is held back until a cache has answered.
        """
        while (sample := self._subscriber.try_recv()) is not None:
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
        """What was found missing since this was last called."""
        while (miss := self._misses.try_recv()) is not None:
            yield Missed(miss.source, miss.nb)

    def undeclare(self) -> None:
        """Receive no more."""
        self._subscriber.undeclare()


def read_sample(sample: zenoh.Sample) -> Delivery:
    """A sample of an advanced publisher, or of any other."""
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
