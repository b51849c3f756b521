"""Subscriptions of the recorder: traces and JSON messages of all vehicles, and the count of those lost."""

from __future__ import annotations

from collections.abc import Iterator

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Loss
from aeroloop.protocol.transport.history import Delivery, RecoveringSubscriber


class Subscriptions:
    """Subscribers to every recorded topic of every vehicle, on an open session that outlives them."""

    def __init__(self, session: zenoh.Session) -> None:
        self._topics = [RecoveringSubscriber(session, topics.key(name, "*")) for name in topics.RECORDED]

    @property
    def recovering(self) -> bool:
        """Whether caches are being queried for messages; take again soon."""
        return any(subscriber.recovering for subscriber in self._topics)

    @property
    def news(self) -> float:
        """When a cache last brought a message, by `time.monotonic` [s]."""
        return max(subscriber.news for subscriber in self._topics)

    def complete(self, since: float) -> bool:
        """Whether all that was published before a time [s], by `time.monotonic`, was received, where it can be."""
        return all(subscriber.complete(since) for subscriber in self._topics)

    def take(self, *, last: bool = False) -> Iterator[Delivery]:
        """Messages received and not yet taken, topic by topic, descriptions first. Never waits.

        If these are the `last` messages, caches are queried as often as they may be.
        """
        for subscriber in self._topics:
            yield from subscriber.take(last=last)

    def losses(self, *, finished: bool = False) -> list[Loss]:
        """Losses since the last call; if `finished`, all that is lacking is lost."""
        return [loss for subscriber in self._topics for loss in subscriber.losses(finished=finished)]

    def silent(self) -> dict[str, float]:
        """For how long nothing was received of traces whose publishers cannot be reached [s]."""
        return {key: age for each in self._topics for key, age in each.silent().items() if "/trace/" in key}
