"""Recovery: puts each publisher's messages in order, and queries caches for those that were not received.

A subscriber queries the caches of its topic when it starts, whenever a number is missing, and every `POLL_S`, for
publishers and messages of which nothing was received. It asks for a page at a time, so no more is under way than a slow
link can carry, and whatever is dropped is asked for again.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from threading import Lock
from typing import Any, Final, NamedTuple

import zenoh
from zenoh.handlers import FifoChannel, Handler, RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.direct import direct
from aeroloop.protocol.transport.publication import PUBLISHERS, Delivery, Page, read_page, read_sample, request

POLL_S: Final = 0.5
"""Pause between two queries when nothing is missing [s]."""
AGAIN_S: Final = 0.025
"""Least pause [s]: a process takes 50 queries a second on a topic. It doubles while nothing new is found."""
ANSWER_S: Final = 2.0
"""Time-out of a query [s]."""
PATIENCE_S: Final = 10.0
"""How long later messages are held back for missing ones, while no page brings any [s]."""
WAITING: Final = 65_536
"""Messages of one topic that may wait to be taken; beyond that the oldest is dropped, and recovered from its cache."""
HELD: Final = 65_536
HELD_BYTES: Final = 8_388_608
"""Messages held back of all publishers, and bytes of their payloads; what finds no room is recovered, too."""
REPLIES: Final = 1_000_000
"""Replies that may wait to be taken: one for each publisher. A full channel would block the link."""

_Source = tuple[str, int]
"""Key and publisher: nobody speaks for the publisher of another key."""


class Missed(NamedTuple):
    """Messages that were published and cannot be recovered.

    Attributes:
        key: Their key.
        missing: How many.
    """

    key: str
    missing: int


class _Publisher:
    def __init__(self, key: str, now: float) -> None:
        self.key = key
        self.next = 0  # the number to be delivered
        self.end = 0  # more than the greatest number seen
        self.begun = False  # whether `next` is of a message that was seen, or of the oldest that its cache has
        self.held: dict[int, Delivery] = {}
        self.seen = now  # when anything of it was last received
        self.stuck = now  # since when nothing was delivered although something is missing

    @property
    def lacks(self) -> bool:
        return self.next < self.end


class Recovery:
    """Puts messages and pages in order. Without a network: `now` is any clock [s].

    Attributes:
        ready: Messages in order, each publisher's without a gap but for those in `missed`.
        missed: What cannot be recovered.
    """

    def __init__(self) -> None:
        self.ready: deque[Delivery] = deque()
        self.missed: deque[Missed] = deque()
        self._publishers: dict[_Source, _Publisher] = {}
        self._held = self._held_bytes = 0

    @property
    def lacks(self) -> bool:
        """Whether a message is missing that may be recovered."""
        return any(each.lacks for each in self._publishers.values())

    def wanted(self) -> dict[int, int]:
        """By publisher, the number of the message that comes next."""
        return {source[1]: each.next for source, each in self._publishers.items()}

    def receive(self, message: Delivery, now: float) -> None:
        """Take a message that was received."""
        if message.publisher is None:
            self.ready.append(message)
            return
        publisher = self._of((message.key, message.publisher), now)
        number = message.number
        if number == publisher.next and (publisher.begun or number == 0):
            publisher.begun, publisher.next, publisher.stuck = True, number + 1, now
            self.ready.append(message)
            self._go_on(publisher, now)
        elif number >= publisher.next and number not in publisher.held:
            if not publisher.lacks:
                publisher.stuck = now
            publisher.end = max(publisher.end, number + 1)
            size = len(message.payload)
            if self._held < HELD and self._held_bytes + size <= HELD_BYTES:
                publisher.held[number] = message
                self._held += 1
                self._held_bytes += size

    def read(self, key: str, page: Page, now: float) -> None:
        """Take a page of a cache on a key."""
        publisher = self._of((key, page.publisher), now)
        if not publisher.begun:
            publisher.begun, publisher.next = True, min(page.first, min(publisher.held, default=page.first))
        if not publisher.lacks:
            publisher.stuck = now
        publisher.end = max(publisher.end, page.end)
        self._skip(publisher, page.first, now)
        for number, (clock_ns, payload) in enumerate(page.messages, page.first):
            if number == publisher.next:
                self._forget(publisher, number)
                self.ready.append(Delivery(key, payload, number, clock_ns, page.publisher))
                publisher.next, publisher.stuck = number + 1, now
        self._go_on(publisher, now)

    def give_up(self, now: float, after_s: float = PATIENCE_S) -> None:
        """Go on where nothing was delivered for longer than `after_s` although something is missing."""
        for publisher in self._publishers.values():
            if publisher.lacks and now - publisher.stuck > after_s:
                self._leave(publisher, min(publisher.held, default=publisher.end), now)

    def _of(self, source: _Source, now: float) -> _Publisher:
        publisher = self._publishers.get(source)
        if publisher is None:
            if len(self._publishers) >= PUBLISHERS:
                longest = min(self._publishers, key=lambda each: self._publishers[each].seen)
                self._leave(self._publishers[longest], self._publishers[longest].end, now)
                del self._publishers[longest]
            publisher = self._publishers[source] = _Publisher(source[0], now)
        publisher.seen = now
        return publisher

    def _leave(self, publisher: _Publisher, number: int, now: float) -> None:
        """Leave what is missing before a number; before the first message that was seen nothing counts as missing."""
        if not publisher.begun:
            publisher.begun, publisher.next = True, min(publisher.held, default=number)
        self._skip(publisher, number, now)

    def _skip(self, publisher: _Publisher, number: int, now: float) -> None:
        """Go on with a number: deliver what is held before it, and count what is not."""
        missing = 0
        for found in (*sorted(each for each in publisher.held if each < number), number):
            missing += max(0, found - publisher.next)
            publisher.next = max(publisher.next, found)
            self._go_on(publisher, now)
        if missing:
            self.missed.append(Missed(publisher.key, missing))

    def _go_on(self, publisher: _Publisher, now: float) -> None:
        """Deliver what is held and comes next."""
        while publisher.held and (held := self._forget(publisher, publisher.next)) is not None:
            self.ready.append(held)
            publisher.next, publisher.stuck = publisher.next + 1, now
        publisher.end = max(publisher.end, publisher.next)

    def _forget(self, publisher: _Publisher, number: int) -> Delivery | None:
        held = publisher.held.pop(number, None)
        if held is not None:
            self._held -= 1
            self._held_bytes -= len(held.payload)
        return held


class ByteRing:
    """Samples that wait to be taken, bounded in number and in bytes of payload: the oldest are dropped."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._samples: deque[tuple[zenoh.Sample, int]] = deque()
        self._bytes = 0
        self._lock = Lock()

    def put(self, sample: zenoh.Sample) -> None:
        """Add a sample, in Zenoh's thread."""
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
    """Subscriber that recovers from publishers' caches what it did not receive.

    At most `waiting` messages wait to be taken, and no Python runs when one is received; if `waiting_bytes` bounds
    their bytes, too, it does: for a process without a loop. The session outlives the subscriber.
    """

    def __init__(
        self, session: zenoh.Session, key: str, waiting: int = WAITING, waiting_bytes: int | None = None
    ) -> None:
        bounded = None if waiting_bytes is None else ByteRing(waiting, waiting_bytes)
        # Any: the stubs have a type for each kind of handler.
        ring: Any = RingChannel(waiting) if bounded is None else direct(bounded.put)
        self._subscriber = session.declare_subscriber(key, ring)
        self._received = bounded or self._subscriber
        self._session = session
        self._key = topics.cache_key(key)
        self._recovery = Recovery()
        self._replies: Handler[zenoh.Reply] | None = None
        self._pause = AGAIN_S
        self._asked = self._due = 0.0
        self._lacked = False

    @property
    def recovering(self) -> bool:
        """Whether an answer is awaited, or messages are missing that may be recovered; take again soon."""
        return self._replies is not None or self._recovery.lacks

    def take(self, *, held: bool = False) -> Iterator[Delivery]:
        """Messages received and not yet taken, each publisher's in order. Never waits.

        If `held`, also those that are held back until a cache has answered.
        """
        recovery, now = self._recovery, time.monotonic()
        while (sample := self._received.try_recv()) is not None:
            recovery.receive(read_sample(sample), now)
            while recovery.ready:
                yield recovery.ready.popleft()
        self._query(now)
        recovery.give_up(now, after_s=-1.0 if held else PATIENCE_S)
        while recovery.ready:
            yield recovery.ready.popleft()

    def missed(self) -> Iterator[Missed]:
        """Losses found since the last call."""
        while self._recovery.missed:
            yield self._recovery.missed.popleft()

    def undeclare(self) -> None:
        """Stop receiving."""
        self._subscriber.undeclare()

    def _query(self, now: float) -> None:
        """Read answers, and query the caches again when it is time."""
        recovery = self._recovery
        if self._replies is not None:
            found, answered = len(recovery.ready), False
            try:
                while (reply := self._replies.try_recv()) is not None:
                    if reply.ok is not None and (page := read_page(reply.ok.payload.to_bytes())) is not None:
                        recovery.read(topics.cached_key(str(reply.ok.key_expr)), page, now)
            except zenoh.ZError:  # all have answered
                answered = True
            if len(recovery.ready) > found:  # the next pages, without waiting for a process that hangs
                answered, self._pause = True, AGAIN_S
            if not answered:
                return
            self._replies = None
            self._due, self._pause = self._asked + self._pause, min(2 * self._pause, POLL_S)
        if recovery.lacks and not self._lacked:  # a gap is new
            self._pause, self._due = AGAIN_S, min(self._due, now + AGAIN_S)
        self._lacked = recovery.lacks
        if now >= self._due:
            self._asked = now
            with suppress(zenoh.ZError):  # the session is closed
                self._replies = self._ask()

    def _ask(self) -> Handler[zenoh.Reply]:
        channel: FifoChannel[zenoh.Reply] = FifoChannel(REPLIES)
        return self._session.get(
            self._key,
            channel,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ANSWER_S,
            # An answer has its query's priority and is dropped as it is: it holds up nothing else.
            priority=zenoh.Priority.DATA_LOW,
            congestion_control=zenoh.CongestionControl.DROP,
            payload=request(self._recovery.wanted()),
        )
