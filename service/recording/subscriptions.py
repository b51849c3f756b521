"""Subscriptions of the recorder: traces and JSON messages of all vehicles, and the count of those lost.

Messages wait in rings, bounded in bytes, until they are taken. A publisher numbers its messages; the
subscriber queries its cache for missing ones and reports those that the cache no longer holds. A number that is neither
taken nor reported was dropped by a full ring.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from typing import Final

import zenoh
from zenoh.handlers import RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Loss
from aeroloop.protocol.transport.publication import WAITING, Delivery, RecoveringSubscriber, read_sample

_MASK: Final = 0xFFFF_FFFF
"""Publishers' numbers have 32 bits and begin again at 0."""

_RING_BYTES: Final = 8_388_608
"""Payload of one topic that may wait: the last minute of several vehicles, which caches send at once, is less."""

_SAMPLES: Final = 20_480
"""Messages of a topic of small ones that may wait, of 40 MiB at most: no Python runs when they are received."""

_Source = tuple[zenoh.ZenohId, int]
"""A publisher: an EntityGlobalId cannot be compared."""


class Subscriptions:
    """Subscribers to every recorded topic of every vehicle.

    Args:
        session: An open session; it outlives the subscriptions.
        frames: Receive the loop's frames, too; these have no numbers, so their losses are not counted.
        waiting: Most messages of one topic that may wait to be taken, fewer where they may be long.
    """

    def __init__(self, session: zenoh.Session, *, frames: bool = False, waiting: int = WAITING) -> None:
        self._waiting = waiting
        self._topics = {
            key: RecoveringSubscriber(session, key, waiting, _RING_BYTES)
            if topic.limit >= topics.MESSAGE_BYTES
            else RecoveringSubscriber(session, key, min(waiting, _SAMPLES))
            for key, topic in ((topics.key(name, "*"), topics.TOPICS[name]) for name in topics.RECORDED)
        }
        self._frames = [
            session.declare_subscriber(topics.key(name, "*"), RingChannel(waiting)) for name in topics.FRAMES if frames
        ]
        self._keys: dict[_Source, str] = {}
        self._following: dict[_Source, int] = {}  # the number that comes next
        self._gaps: Counter[_Source] = Counter()  # numbers skipped since `losses` was last called
        self._unnamed: list[tuple[_Source, str, int]] = []  # losses of publishers of which nothing was taken yet
        self._reported: Counter[_Source] = Counter()  # numbers reported missing and not yet skipped

    @property
    def joining(self) -> bool:
        """Whether messages are held back until the cache of a new publisher has answered."""
        return any(subscriber.joining for subscriber in self._topics.values())

    def take(self, *, held: bool = False) -> Iterator[Delivery]:
        """Messages received and not yet taken, topic by topic, descriptions first; with `held` all. Never waits."""
        for subscriber in self._topics.values():
            for received in islice(subscriber.take(held=held), self._waiting):
                if received.source is not None:
                    self._follow(received.key, (received.source.zid, received.source.eid), received.sequence)
                yield received
        for frames in self._frames:
            for _ in range(self._waiting):
                if (sample := frames.try_recv()) is None:
                    break
                yield read_sample(sample)

    def losses(self) -> list[Loss]:
        """Losses found since the last call.

        Losses of a publisher of which nothing was taken yet are reported at the next call, when its key may be known;
        a key expression stands in for a key that is still unknown then.
        """
        found = [
            Loss(key=self._keys.get(source, key), count=count, reason="network") for source, key, count in self._unnamed
        ]
        self._unnamed.clear()
        for expression, subscriber in self._topics.items():
            for miss in subscriber.missed():
                source = miss.source.zid, miss.source.eid
                self._reported[source] += miss.missing
                if source in self._keys:
                    found.append(Loss(key=self._keys[source], count=miss.missing, reason="network"))
                else:
                    self._unnamed.append((source, expression, miss.missing))
        for source, gap in self._gaps.items():
            reported = min(gap, self._reported[source])
            self._reported[source] -= reported
            if gap > reported:
                found.append(Loss(key=self._keys[source], count=gap - reported, reason="queue"))
        self._gaps.clear()
        return found

    def _follow(self, key: str, source: _Source, number: int) -> None:
        expected = self._following.get(source)
        if expected is None:
            self._keys[source] = key
        elif gap := number - expected & _MASK:
            if gap > _MASK >> 1:
                return  # an older one
            self._gaps[source] += gap
        self._following[source] = number + 1 & _MASK
