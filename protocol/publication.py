"""Publication: messages that a late or interrupted subscriber recovers from their publisher's cache.

Zenoh's advanced publisher numbers what it publishes and keeps the last of it; the advanced subscriber asks for what was
published before it came and for every number that it lacks. Messages are dropped where a peer does not keep up, so a
publisher never waits for a recorder, and the subscriber recovers them later. Each message bears its publisher's wall
clock, for logs alone.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from math import ceil
from typing import Final, NamedTuple

import zenoh
import zenoh.ext
from zenoh.handlers import RingChannel

KEPT_S: Final = 65.0
"""A cache holds what was published in this time, at the topic's rate [s]: 60 s and what a restart takes."""
HEARTBEAT_S: Final = 2.0
"""How often a publisher that has published says its last number [s]: the very last message can be recovered, too."""
CACHE_S: Final = 2.0
"""How long a publisher's cache may take to answer [s]."""
HISTORY: Final = 1_000_000
"""Messages of one publisher that a subscriber asks for at the most; the publisher's cache is smaller."""
WAITING: Final = 65_536
"""Messages of one topic that may wait to be taken; then the oldest is dropped, and counted by its number."""

_CLOCK: Final = struct.Struct("<q")


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
        self._known: set[tuple[zenoh.ZenohId, int]] = set()  # publishers

    def take(self) -> Iterator[Delivery]:
        """What was received and not yet taken, oldest first. Waits for nothing but the cache of a new publisher."""
        while (sample := self._subscriber.try_recv()) is not None:
            received = read_sample(sample)
            if received.source is not None:
                publisher = received.source.zid, received.source.eid
                if publisher not in self._known:
                    self._known.add(publisher)
                    yield from self._before(received)
            yield received

    def _before(self, first: Delivery) -> list[Delivery]:
        """What its cache holds of a publisher before the first message that was received of it.

        A message that is published while a link is being set up can be received before Zenoh's subscriber learns that
        there is a cache; it then drops the cache's older ones without a miss (seen with zenoh 1.10).
        """
        assert first.source is not None
        if not first.sequence:
            return []
        cache = f"{first.key}/@adv/*/{first.source.zid}/{first.source.eid}/**?_anyke;_sn=..{first.sequence - 1}"
        replies = self._session.get(cache, consolidation=zenoh.ConsolidationMode.NONE, timeout=CACHE_S)
        found = [read_sample(reply.ok) for reply in replies if reply.ok is not None]
        return sorted(found, key=lambda received: received.sequence)

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
