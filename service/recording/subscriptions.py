"""Subscriptions of the recorder: traces and JSON messages of all vehicles, and the count of those lost.

Messages wait in rings, bounded in bytes, until they are taken. What is missing, also what a full ring dropped, is
queried from its publisher's cache; what that no longer holds is lost.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Final

import zenoh
from zenoh.handlers import RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Loss
from aeroloop.protocol.transport.publication import Delivery, read_sample
from aeroloop.protocol.transport.recovery import WAITING, RecoveringSubscriber

_RING_BYTES: Final = 8_388_608
"""Payload of one topic that may wait: the last minute of several vehicles, which caches send at once, is less."""

_SAMPLES: Final = 20_480
"""Messages of a topic of small ones that may wait, of 40 MiB at most: no Python runs when they are received."""


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

    @property
    def recovering(self) -> bool:
        """Whether caches are being queried for messages; take again soon."""
        return any(subscriber.recovering for subscriber in self._topics.values())

    def take(self, *, held: bool = False) -> Iterator[Delivery]:
        """Messages received and not yet taken, topic by topic, descriptions first; with `held` all. Never waits."""
        for subscriber in self._topics.values():
            yield from islice(subscriber.take(held=held), self._waiting)
        for frames in self._frames:
            for _ in range(self._waiting):
                if (sample := frames.try_recv()) is None:
                    break
                yield read_sample(sample)

    def losses(self) -> list[Loss]:
        """Losses found since the last call."""
        return [
            Loss(key=each.key, count=each.missing, reason="network")
            for subscriber in self._topics.values()
            for each in subscriber.missed()
        ]
