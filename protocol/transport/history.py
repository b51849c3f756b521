"""History: numbered messages, the last of which their publisher keeps, and a subscriber that queries what it lacks.

A message is dropped where a peer does not keep up: no publisher ever waits. A subscriber keeps for each publisher the
ranges of numbers that it lacks, and queries them a page at a time, so no more is under way than a slow link carries.
"""

from __future__ import annotations

import secrets
import struct
import time
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from threading import Lock
from typing import Final, NamedTuple

import zenoh
from zenoh.handlers import Callback

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Loss, LossReason

KEPT_S: Final = 65.0  # for so long publishers keep what they publish; one that has been silent for so long is gone
LEAST_KEPT: Final = 520  # messages that a publisher keeps whatever their age: a description is published once
MOST_PER_S: Final = 10_000  # messages that a publisher may publish: one a tick of the fastest loop
MOST_KEPT: Final = 2 * round(KEPT_S) * MOST_PER_S  # messages that a publisher may keep
LARGEST_NUMBER: Final = 2**53  # JSON holds counts up to it exactly; at `MOST_PER_S` it takes 28 000 years to reach
ANSWER_S: Final = 3.0  # time-out of a query
SOON_S, SELDOM_S = 0.025, 0.5  # pause between two queries while pages bring messages, and else
PAGE_BYTES: Final = 16_384  # of a page with more than one message: 64 kbit/s carry it in 2 s
WAITING_BYTES: Final = 8_388_608  # that wait to be taken, with 200 for each message; what finds no room stays lacking
MOST: Final = 256  # publishers that a subscriber knows, ranges that it lacks of each, and ranges in a query

_ATTACHMENT: Final = struct.Struct("<qQQ")  # wall clock, publisher, number
_RANGE: Final = struct.Struct("<QQQ")  # publisher, first number, number after the last
_PAGE: Final = struct.Struct("<QQQ")  # publisher, oldest number that is kept, how many were published
_ITEM: Final = struct.Struct("<QqI")  # number, wall clock, length
_END: Final = 2**64 - 1
ADDED_BYTES: Final = _PAGE.size + _ITEM.size  # of a page with one message; an attachment adds less

Range = tuple[int, int]  # a number, and the one after the last


class Delivery(NamedTuple):
    """A received message. Of one without a number, `number` is 0, `publisher` None, and its time that of arrival."""

    key: str
    payload: bytes
    number: int
    published_ns: int  # since 1970, on the publisher's wall clock
    publisher: int | None


def attachment(clock_ns: int, publisher: int, number: int) -> bytes:
    """What goes with a message: time of publication [ns since 1970], publisher, number."""
    return _ATTACHMENT.pack(clock_ns, publisher, number)


def read_sample(sample: zenoh.Sample) -> Delivery:
    """Convert a sample of a cached publisher, or of any other."""
    key, payload, attached = str(sample.key_expr), sample.payload.to_bytes(), sample.attachment
    if attached is None or len(data := attached.to_bytes()) != _ATTACHMENT.size:
        return Delivery(key, payload, 0, time.time_ns(), None)
    clock_ns, publisher, number = _ATTACHMENT.unpack(data)
    return Delivery(key, payload, number, max(0, clock_ns), publisher)


def query(ranges: Iterable[tuple[int, Range]]) -> bytes:
    """Query of caches: publishers, each with a range that is wanted, the most wanted first."""
    return b"".join(_RANGE.pack(publisher, *each) for publisher, each in ranges)


def page(data: bytes, publisher: int, kept: Sequence[tuple[int, int, bytes]]) -> bytes | None:
    """Answer to a query by a publisher that keeps these messages (number, wall clock, payload); None to no query.

    The page has what is wanted from the end of the first range backwards, as much as fits.
    """
    if len(data) % _RANGE.size or len(data) > MOST * _RANGE.size:
        return None
    oldest, count = (kept[0][0], kept[-1][0] + 1) if kept else (0, 0)
    parts, size = [_PAGE.pack(publisher, oldest, count)], _PAGE.size
    ranges = [(first, end) for who, first, end in _RANGE.iter_unpack(data) if who == publisher] or [(0, _END)]
    for first, end in ranges:
        for i in range(min(end, count) - oldest - 1, max(first - oldest, 0) - 1, -1):
            number, clock_ns, payload = kept[i]
            size += _ITEM.size + len(payload)
            if len(parts) > 1 and size > PAGE_BYTES:
                return b"".join(parts)
            parts += [_ITEM.pack(number, clock_ns, len(payload)) + payload]
    return b"".join(parts)


class CachedPublisher:
    """Publishes on one key, from any thread, and answers for the last messages. The session outlives the publisher.

    It keeps what it published in the last `KEPT_S`, by `clock` [s], and never fewer than the last `LEAST_KEPT`.
    If `lossless`, for lockstep, it waits for peers that do not keep up instead of dropping. `json` is whether the
    messages are JSON.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        *,
        lossless: bool = False,
        json: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        control = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        encoding = zenoh.Encoding.APPLICATION_JSON if json else zenoh.Encoding.ZENOH_BYTES
        self._publisher = session.declare_publisher(key, encoding=encoding, congestion_control=control)
        self._id, self._count = secrets.randbits(64), 0
        self._kept: deque[tuple[int, int, bytes]] = deque()
        self._kept_since: deque[float] = deque()  # when each of them was published, by `clock`
        self._clock = clock
        self._lock, self._cache_key = Lock(), topics.cache_key(key)
        # Answered in a thread of Python: in Zenoh's own, all else would wait while a slow peer takes a page.
        self._queryable = session.declare_queryable(self._cache_key, self._answer)

    def put(self, payload: bytes) -> None:
        """Publish a message."""
        with self._lock:
            number, clock_ns = self._count, time.time_ns()
            self._count += 1
            self._kept.append((number, clock_ns, payload))
            self._kept_since.append(self._clock())
            self._drop_old()
            self._publisher.put(payload, attachment=attachment(clock_ns, self._id, number))

    def _drop_old(self) -> None:
        """Drop what need not be kept: two messages at the most, as thousands at once would hold up a loop."""
        before = self._kept_since[-1] - KEPT_S
        for _ in range(2):
            if len(self._kept) > LEAST_KEPT and self._kept_since[0] < before:
                self._kept.popleft()
                self._kept_since.popleft()

    def _answer(self, asked: zenoh.Query) -> None:
        wanted = asked.payload.to_bytes() if asked.payload else b""
        with asked, suppress(zenoh.ZError):  # closed meanwhile
            # Of tens of thousands that may be kept, a page has a few: copying all would take longer than the page.
            with self._lock:
                answer = page(wanted, self._id, self._kept)
            if answer is not None:
                asked.reply(self._cache_key, answer)


@dataclass
class _Source:
    """Numbers of one publisher on one key: a page on one key says nothing of another."""

    key: str
    publisher: int
    since: int  # number of the first contact: what is older is not lost if a cache drops it
    seen: float  # when something was last received of it [s]
    end: int = 0  # after the last number that is known
    newest: int = -1  # the highest number that was received
    answered: bool = False
    lacks: list[Range] = field(default_factory=list)  # ascending

    def extend(self, end: int) -> None:
        """All numbers before `end` were published."""
        if end > self.end:
            adjacent = self.lacks and self.lacks[-1][1] == self.end
            self.lacks.append((self.lacks.pop()[0] if adjacent else self.end, end))
            self.end = end

    def remove(self, number: int) -> bool:
        """Remove a number from what is lacking; whether it was."""
        at = bisect_right(self.lacks, (number, _END)) - 1
        if at < 0 or number >= self.lacks[at][1]:
            return False
        self.newest = max(self.newest, number)
        first, end = self.lacks[at]
        self.lacks[at : at + 1] = [each for each in ((first, number), (number + 1, end)) if each[0] < each[1]]
        return True

    def was_given_up(self, number: int) -> bool:
        """Whether a number that was not received yet, as it is above all that were, lacks no more."""
        if not self.newest < number < self.end:
            return False
        return not any(first <= number < end for first, end in self.lacks)

    def go_back(self, number: int) -> int:
        """Go back to what was known before a page that gave up a number, which was published only now.

        Returns how many numbers lack again that were counted as lost.
        """
        first_unreceived = self.newest + 1
        counted_from = max(first_unreceived, self.since)
        still_lacking = sum(max(0, end - max(first, counted_from)) for first, end in self.lacks)
        counted = max(0, self.end - counted_from - still_lacking)
        before = [(first, min(end, first_unreceived)) for first, end in self.lacks if first < first_unreceived]
        self.lacks = [*before, (first_unreceived, number + 1)]
        self.end = number + 1
        self.since = min(self.since, number)
        return counted


class RecoveringSubscriber:
    """Subscriber that queries publishers' caches for what it did not receive. The session outlives it; `clock` in s.

    Anyone may publish and answer where links have no certificates. A number that no publisher can have reached by now
    is refused: a message is then one without a number, a page is ignored. A page may still say that a publisher is
    ahead, and that it keeps nothing: the next message that is published refutes that.
    """

    def __init__(self, session: zenoh.Session, key: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._session, self._cache_key, self._clock, self._lock = session, topics.cache_key(key), clock, Lock()
        self._waiting, self._bytes = list[Delivery](), 0
        self._sources: dict[tuple[str, int], _Source] = {}
        self._lost: Counter[tuple[str, LossReason]] = Counter()
        self._asked = self._complete = self._paged = -inf  # the last query, the last complete one, the last news
        self._subscriber = session.declare_subscriber(key, Callback(self._receive, indirect=False))

    def take(self) -> list[Delivery]:
        """Messages that wait, each once, in the order of arrival; also queries the caches when that is due.

        A query is due once the last is answered: 25 ms later while pages bring messages, else twice a second.
        """
        paging = self._paged >= self._asked
        due = self._asked + (SOON_S if paging else SELDOM_S)
        if (paging or self._complete >= self._asked) and self._clock() >= due:
            self._query()
        with self._lock:
            taken, self._waiting, self._bytes = self._waiting, [], 0
        return taken

    def complete(self, since: float | None = None) -> bool:
        """Whether a query after `since` [s], or else the last, is answered, and nothing lacks that can be reached."""
        with self._lock:
            lacks = any(source.lacks and self._reachable(source) for source in self._sources.values())
            return self._complete >= (self._asked if since is None else since) and not lacks

    def losses(self, *, finished: bool = False) -> list[Loss]:
        """Losses since the last call; if `finished`, all that is lacking is lost."""
        with self._lock:
            for source in self._sources.values() if finished else ():
                there = self._reachable(source) and source.answered
                self._give_up(source, source.end, "end" if there else "gone")
            lost, self._lost = self._lost, Counter()
        return [Loss(key=key, count=count, reason=reason) for (key, reason), count in lost.items() if count]

    def silent(self) -> dict[str, float]:
        """For how long nothing was received of publishers that cannot be reached and may still have messages [s]."""
        with self._lock:
            ages = {one.key: self._age(one) for one in self._sources.values() if not self._reachable(one)}
        return {key: age for key, age in ages.items() if age < KEPT_S}

    def _age(self, source: _Source) -> float:
        return self._clock() - source.seen

    def _reachable(self, source: _Source) -> bool:  # two time-outs: a query or page that is dropped is repeated once
        return self._age(source) < 2 * ANSWER_S

    def _query(self) -> None:
        """Query the caches for what is lacking, of each publisher the newest first, or else for what is newer."""
        with self._lock:
            self._asked = asked = self._clock()
            wanted, each_has = list[tuple[int, Range]](), MOST // max(1, len(self._sources))
            for source in self._sources.values():
                if self._age(source) > KEPT_S:
                    self._give_up(source, source.end, "gone")
                ranges = source.lacks[: -each_has - 1 : -1] or [(source.end, _END)]
                wanted += [(source.publisher, each) for each in ranges]

        def completed() -> None:
            self._complete = max(self._complete, asked)

        with suppress(zenoh.ZError):  # the session is closed
            self._session.get(
                self._cache_key,
                Callback(self._read, completed, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_S,
                # An answer has its query's priority and is dropped as it is: it holds up nothing else.
                priority=zenoh.Priority.DATA_LOW,
                congestion_control=zenoh.CongestionControl.DROP,
                payload=query(wanted),
            )

    def _receive(self, sample: zenoh.Sample) -> None:
        message = read_sample(sample)
        with self._lock:
            if message.publisher is None:
                self._add(message)
                return
            if not self._is_plausible(message.key, message.publisher, message.number):
                self._add(message._replace(publisher=None, number=0))
                return
            source = self._source(message.key, message.publisher, message.number)
            if source.was_given_up(message.number):
                counted = source.go_back(message.number)
                self._lost[source.key, "cache"] = max(0, self._lost[source.key, "cache"] - counted)
            source.extend(message.number + 1)
            self._add(message, source)
            if len(source.lacks) > MOST:
                self._give_up(source, source.lacks[1][0], "cache")

    def _read(self, reply: zenoh.Reply) -> None:
        """Take a page; what is malformed is ignored."""
        if reply.ok is None or len(data := reply.ok.payload.to_bytes()) < _PAGE.size:
            return
        key, (publisher, oldest, count) = topics.cached_key(str(reply.ok.key_expr)), _PAGE.unpack_from(data)
        if not oldest <= count <= oldest + MOST_KEPT:
            return
        at, found = _PAGE.size, list[Delivery]()
        while at + _ITEM.size <= len(data):
            number, clock_ns, length = _ITEM.unpack_from(data, at)
            at += _ITEM.size + length
            found.append(Delivery(key, data[at - length : at], number, max(0, clock_ns), publisher))
        if at != len(data) or not all(oldest <= delivery.number < count for delivery in found):
            return
        with self._lock:
            if not self._is_plausible(key, publisher, count):
                return
            source = self._source(key, publisher, count)
            source.extend(count)
            new = [self._add(each, source) for each in reversed(found)]
            self._give_up(source, oldest, "cache")
            source.answered = True
            if any(new):
                self._paged = self._clock()

    def _is_plausible(self, key: str, publisher: int, number: int) -> bool:
        """Whether a publisher may have come as far as this number since something of it was received."""
        source = self._sources.get((key, publisher))
        if source is None:
            return number <= LARGEST_NUMBER
        ahead = MOST_PER_S * (self._age(source) + KEPT_S)  # its messages may have been held up for up to `KEPT_S`
        return number <= min(LARGEST_NUMBER, source.end + ahead)

    def _source(self, key: str, publisher: int, since: int) -> _Source:
        now = self._clock()
        if (key, publisher) not in self._sources:
            if len(self._sources) >= MOST:
                silent = min(self._sources.values(), key=lambda each: each.seen)
                self._give_up(silent, _END, "gone")
                del self._sources[silent.key, silent.publisher]
            self._sources[key, publisher] = _Source(key, publisher, since, now)
        source = self._sources[key, publisher]
        source.seen = now
        return source

    def _add(self, message: Delivery, source: _Source | None = None) -> bool:
        """Add a message to those that wait, unless there is no room or it is a duplicate."""
        size = len(message.payload) + 200
        if (self._bytes and self._bytes + size > WAITING_BYTES) or (source and not source.remove(message.number)):
            return False
        self._waiting.append(message)
        self._bytes += size
        return True

    def _give_up(self, source: _Source, before: int, reason: LossReason) -> None:
        """Give up what is lacking before a number, and count it: from the first contact on, or all that a cache had."""
        since = source.since if reason == "cache" or not source.answered else 0
        lost = sum(max(0, min(end, before) - max(first, since)) for first, end in source.lacks)
        source.lacks = [(max(first, before), end) for first, end in source.lacks if end > before]
        if lost:
            self._lost[source.key, reason] += lost
