"""History: each message once, and nothing lost that a cache still holds, whatever the network does."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from threading import Event
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import Loss
from aeroloop.protocol.transport import history
from aeroloop.protocol.transport.history import (
    ANSWER_S,
    KEPT_S,
    LEAST_KEPT,
    MOST,
    MOST_KEPT,
    MOST_PER_S,
    PAGE_BYTES,
    CachedPublisher,
    RecoveringSubscriber,
    attachment,
    page,
    query,
)
from tests.support.clock import FakeClock
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually

KEY = "aeroloop/aero/trace/plant"
ANY = "aeroloop/*/trace/*"
OURS = 4711


class Made:
    """A publisher and a subscriber, with a network between them that does what a test says."""

    def __init__(self, kept: int, size: int = 0) -> None:
        self.now, self.count, self._size = 0.0, 0, size
        self.queries: list[tuple[bytes, Any]] = []
        self.found: list[int] = []
        self.kept: deque[tuple[int, int, bytes]] = deque(maxlen=kept)
        self.subscriber = RecoveringSubscriber(self, ANY, lambda: self.now)  # type: ignore[arg-type]  # as a session

    def declare_subscriber(self, _: str, handler: Any) -> Any:
        self.receive_sample = handler.callback
        return SimpleNamespace(undeclare=lambda: None)

    def get(self, _: str, handler: Any, *, payload: bytes, **__: object) -> None:
        self.queries.append((payload, handler))

    def publish(self) -> int:
        number = self.count
        self.kept.append((number, 10 * number, b"%d" % number + bytes(self._size)))
        self.count += 1
        return number

    def receive(self, number: int, publisher: int = OURS, key: str = KEY) -> None:
        attached = zenoh.ZBytes(attachment(min(10 * number, 2**63 - 1), publisher, number))
        payload = zenoh.ZBytes(b"%d" % number + bytes(self._size))
        self.receive_sample(SimpleNamespace(key_expr=key, payload=payload, attachment=attached))

    def receive_next(self, dropped: int = 0) -> None:
        """Publish some messages that are dropped, and one that is received."""
        for _ in range(dropped):
            self.publish()
        self.receive(self.publish())

    def answer(self, asked: bytes) -> bytes:
        found = page(asked, OURS, self.kept)
        assert found is not None
        return found

    def reply(self, handler: Any, data: bytes, key: str = KEY) -> None:
        ok = SimpleNamespace(payload=zenoh.ZBytes(data), key_expr=f"{key}/@cache")
        handler.callback(SimpleNamespace(ok=ok))

    def take(self) -> list[int]:
        taken = self.subscriber.take()
        for each in taken:
            assert each.payload.rstrip(b"\0") == b"%d" % each.number
            assert (each.published_ns, each.publisher) == (10 * each.number, OURS)
        self.found += [each.number for each in taken]
        return [each.number for each in taken]

    def answer_all(self) -> None:
        """Answer every query, and what follows from it, until nothing is lacking."""
        self.now += 0.5
        begun = self.now
        while not self.subscriber.complete(begun):
            assert self.now < begun + 1e3, "what is lacking is neither received nor lost"
            self.take()
            self.now += 0.5
            while self.queries:
                asked, handler = self.queries.pop()
                self.reply(handler, self.answer(asked))
                handler.drop()
        self.take()

    def lost(self, *, finished: bool = False) -> list[tuple[int, str]]:
        return [(loss.count, loss.reason) for loss in self.subscriber.losses(finished=finished)]


@settings(deadline=None)
@given(
    kept=st.integers(1, 40),
    before=st.integers(0, 60),
    events=st.lists(
        st.sampled_from(["received", "twice", "dropped", "late", "catch up", "ask", "page", "none"]), max_size=60
    ),
    size=st.sampled_from([0, PAGE_BYTES // 5, PAGE_BYTES]),
)
def test_what_a_cache_still_has_is_delivered_exactly_once_and_what_is_lost_is_counted_once(
    kept: int, before: int, events: list[str], size: int
) -> None:
    """Whatever is received, dropped, duplicated or reordered, and whatever pages come, or are lost on the way."""
    made, late, answers = Made(kept, size=size), list[int](), list[tuple[Any, bytes, int]]()
    since: int | None = None
    for _ in range(before):
        made.publish()
    for event in events:
        made.now += 0.3
        if event in ("received", "twice", "dropped", "late"):
            number = made.publish()
            if event == "late":
                late.insert(0, number)
            for _ in range({"received": 1, "twice": 2}.get(event, 0)):
                made.receive(number)
                since = number if since is None else since
        elif event == "catch up" and late:
            made.receive(late[0])
            since = late[0] if since is None else since
            late.pop(0)
        made.take()
        answers += [(handler, made.answer(asked), made.count) for asked, handler in made.queries]
        made.queries.clear()
        if event in ("page", "none") and answers:
            handler, data, count = answers.pop()
            if event == "page":
                made.reply(handler, data)
                since = count if since is None else since
            handler.drop()
    for handler, *_ in answers:
        handler.drop()
    made.answer_all()
    for number in late:
        made.receive(number)
    made.take()
    assert len(made.found) == len(set(made.found))
    assert set(made.found) >= {number for number, _, _ in made.kept}
    lost = sum(count for count, _ in made.lost(finished=True))
    assert lost == len(set(range(made.count if since is None else since, made.count)) - set(made.found))


def test_after_outages_in_any_order_nothing_is_given_up_while_its_publisher_may_have_it() -> None:
    """Nothing of it was received for a minute, in the midst of what it has to catch up with."""
    made = Made(1000, size=PAGE_BYTES // 10)
    made.receive_next()
    made.receive_next(dropped=100)
    made.take()
    for _ in range(int(KEPT_S) - 1):  # queries and answers are lost
        made.now += 1.0
        made.take()
        for _, handler in made.queries:
            handler.drop()
        made.queries.clear()
    assert made.lost() == []
    made.answer_all()
    assert sorted(made.found) == list(range(102))
    assert made.lost(finished=True) == []


def test_a_loss_says_what_is_known() -> None:
    """The cache has it no longer; its publisher does not answer; recording ended before it was taken."""
    made = Made(10)
    made.receive_next()
    for _ in range(100):
        made.publish()
    made.answer_all()
    assert made.lost() == [(90, "cache")]
    assert sorted(made.found) == [0, *range(91, 101)]
    made.receive_next(dropped=10)
    assert made.lost(finished=True) == [(10, "end")]
    made.receive_next(dropped=10)
    made.now += 2 * ANSWER_S + 1
    assert made.lost() == []
    made.now += KEPT_S
    made.take()
    assert made.subscriber.losses() == [Loss(key=KEY, count=10, reason="gone")]


def test_what_cannot_be_reached_but_may_have_more_is_named_and_not_waited_for() -> None:
    made = Made(10)
    for number in (0, 2):
        made.receive(number)
    found, complete = [], []
    for pause_s in (2 * ANSWER_S - 0.1, 1.0, KEPT_S):
        made.take()
        made.queries.pop()[1].drop()  # answered by none
        complete.append(made.subscriber.complete())
        made.now += pause_s
        complete.append(made.subscriber.complete())
        found.append(made.subscriber.silent())
    assert found == [{}, {KEY: pytest.approx(2 * ANSWER_S + 0.9)}, {}]
    assert complete == [False, False, False, True, True, True]


def test_what_waits_is_bounded_and_what_finds_no_room_is_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "WAITING_BYTES", 10_000)
    made = Made(1000, size=1000)
    for _ in range(500):
        made.receive_next()
    assert 1 < len(made.take()) < 10
    made.answer_all()
    assert sorted(made.found) == list(range(500))
    assert made.lost(finished=True) == []


def test_nobody_speaks_for_the_publisher_of_another_key() -> None:
    made, far = Made(10), Made(10)
    made.receive_next()
    made.receive(5, key="other")
    made.subscriber.take()
    far.count = 100_000
    far.publish()
    made.reply(made.queries.pop()[1], far.answer(b""), "other")
    made.receive_next()
    assert [each.number for each in made.subscriber.take() if each.key == KEY] == [1]
    assert {loss.key for loss in made.subscriber.losses(finished=True)} == {"other"}


def test_publishers_and_ranges_that_are_known_are_bounded_and_what_is_given_up_is_counted() -> None:
    """Forgotten are the longest silent publisher and the oldest range."""
    made = Made(10)
    for publisher in range(MOST + 1):
        made.now += 1e-3
        made.receive(0, publisher + 1)
    made.subscriber.take()
    ((asked, _),) = made.queries
    assert asked == query([(publisher + 1, (1, 2**64 - 1)) for publisher in range(1, MOST + 1)])
    made = Made(10)
    for number in range(0, 2 * MOST + 3, 2):
        made.receive(number)
    assert made.lost() == [(1, "cache")]
    made.take()
    ((asked, _),) = made.queries
    assert asked == query([(OURS, (number, number + 1)) for number in range(2 * MOST + 1, 1, -2)])


@given(st.binary(max_size=200))
def test_bad_bytes_are_refused_whole(data: bytes) -> None:
    """As a page, and as a query."""
    made = Made(10)
    made.publish()
    made.take()
    made.reply(made.queries.pop()[1], data)
    assert (page(data, OURS, made.kept) is None) == bool(len(data) % 24)
    assert page(bytes(24 * MOST), OURS, made.kept) is not None
    assert page(bytes(24 * MOST + 24), OURS, made.kept) is None


# ── strangers: what nobody can have published is refused, and what is plausible blinds nobody ──


def forged_page(oldest: int, count: int) -> bytes:
    """A page without messages, in the publisher's name."""
    return struct.pack("<QQQ", OURS, oldest, count)


@pytest.mark.parametrize("number", [2**64 - 1, 2**63, 2**53 + 1])
def test_a_number_that_no_publisher_reaches_is_none_and_the_message_is_delivered_without_one(number: int) -> None:
    """2⁶⁴ − 1 in an attachment ended the recorder: there is no number after it."""
    made = Made(10)
    made.receive(number)
    (message,) = made.subscriber.take()
    assert (message.number, message.publisher) == (0, None)
    made.receive_next()
    assert made.take() == [0]
    made.answer_all()
    assert made.lost(finished=True) == []


@pytest.mark.parametrize("ahead_s", [0.0, 20.0])
def test_a_publisher_may_be_as_far_ahead_as_the_fastest_loop_in_the_time_and_no_farther(ahead_s: float) -> None:
    made = Made(10)
    made.receive_next()
    made.take()
    made.now += ahead_s
    farthest = 1 + round(MOST_PER_S * (ahead_s + KEPT_S))
    made.receive(farthest + 1)
    assert [message.publisher for message in made.subscriber.take()] == [None]
    made.receive(farthest)
    assert [message.publisher for message in made.subscriber.take()] == [OURS]


@pytest.mark.parametrize(
    ("oldest", "count"),
    [
        (2**64 - 1, 2**64 - 1),
        (0, 2**64 - 1),
        (2**53 + 1, 2**53 + 1),
        (0, MOST_KEPT + 1),
        (10_000_000, 10_000_000),
        (5, 3),
        (700_000, 700_000),
        (600_000, 600_000),
        (3, 3),
        (1, 600_000),
    ],
)
def test_no_forged_page_hides_what_is_published_afterwards(oldest: int, count: int) -> None:
    """Whatever it says, each later message is delivered once; what the network drops of them is recovered."""
    made = Made(1000)
    made.receive_next()
    made.take()
    _, handler = made.queries.pop()
    made.reply(handler, forged_page(oldest, count))
    handler.drop()
    made.lost()
    for _ in range(5):
        made.receive_next()
        made.receive_next(dropped=1)
        made.take()
    made.now += 0.5
    made.take()
    for asked, handler in made.queries:
        made.reply(handler, made.answer(asked))
        handler.drop()
    made.take()
    assert sorted(made.found) == list(range(16))


def test_what_a_forged_page_gave_up_counts_as_lost_only_if_it_is() -> None:
    """One is the first that is received in the publisher's name; of 30 dropped messages the cache has the last 9."""
    made = Made(10)
    made.take()
    _, handler = made.queries.pop()
    made.reply(handler, forged_page(600_000, 600_000))
    handler.drop()
    made.receive_next()
    made.receive_next(dropped=30)
    made.answer_all()
    assert made.lost() == [(21, "cache")]
    made.now += 0.5
    made.take()
    _, handler = made.queries.pop()
    made.reply(handler, forged_page(600_000, 600_000))
    handler.drop()
    made.receive_next()
    assert made.lost(finished=True) == []


@pytest.mark.parametrize(("oldest", "count"), [(0, MOST_KEPT + 1), (5, 3)])
def test_a_page_that_no_publisher_sends_tells_nothing_of_it(oldest: int, count: int) -> None:
    made = Made(10)
    made.take()
    _, handler = made.queries.pop()
    made.reply(handler, forged_page(oldest, count))
    handler.drop()
    assert made.subscriber.complete()
    assert made.lost(finished=True) == []


def test_a_page_with_a_message_outside_of_what_it_keeps_is_refused_whole() -> None:
    made = Made(10)
    made.take()
    item = struct.pack("<QqI", 7, 0, 1) + b"x"
    _, handler = made.queries.pop()
    for oldest, count in ((0, 7), (8, 9)):
        made.reply(handler, forged_page(oldest, count) + item)
        assert made.subscriber.take() == []
    made.reply(handler, forged_page(7, 8) + item)
    assert [message.number for message in made.subscriber.take()] == [7]


# ── publishers ──


@pytest.mark.parametrize(("rate_hz", "kept"), [(100, 6_501), (10, 651), (0.1, LEAST_KEPT)])
def test_a_publisher_keeps_what_it_published_in_the_last_minute_at_any_rate_and_never_fewer_than_the_last(
    rate_hz: float, kept: int
) -> None:
    """True states a hundred times a second were kept for 5 s."""
    session, count = FakeSession(), round(rate_hz * 4 * KEPT_S) + LEAST_KEPT
    published = iter(range(count))
    publisher = CachedPublisher(session, KEY, clock=lambda: next(published) / rate_hz)  # type: ignore[arg-type]
    for number in range(count):
        publisher.put(b"%d" % number)
    oldest, after = struct.unpack_from("<8xQQ", session.answer(query([])))
    assert after == count
    assert after - oldest == kept


def test_what_a_pause_has_made_old_is_dropped_two_at_a_time() -> None:
    """Dropping tens of thousands at once would hold up the loop that publishes."""
    session, clock = FakeSession(), FakeClock()
    publisher = CachedPublisher(session, KEY, clock=clock.monotonic)  # type: ignore[arg-type]
    for _ in range(2 * LEAST_KEPT):
        publisher.put(b"")
    clock.advance(10 * KEPT_S)
    for number in range(LEAST_KEPT, 0, -1):
        publisher.put(b"")
        oldest, after = struct.unpack_from("<8xQQ", session.answer(query([])))
        assert after - oldest == LEAST_KEPT + number - 1


class FakeSession:
    """A session that a publisher is declared on, and whose cache can be asked."""

    def declare_publisher(self, *_: object, **__: object) -> Any:
        return SimpleNamespace(put=lambda *_, **__: None)

    def declare_queryable(self, _: str, answer: Callable[[Any], None]) -> None:
        self._answer = answer

    def answer(self, asked: bytes) -> bytes:
        answers: list[bytes] = []
        query = MagicMock(payload=zenoh.ZBytes(asked), reply=lambda _, page: answers.append(page))
        self._answer(query)
        (page,) = answers
        return page


def test_a_slow_reader_of_pages_holds_up_no_thread_of_zenoh_s_and_gets_all_that_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A page waits in a thread of Python; frames and messages go on meanwhile."""
    asked, released = list[str](), Event()

    def slow(*given: Any, whole: Callable[..., bytes | None] = history.page) -> bytes | None:
        asked.append("page")
        assert released.wait(PATIENCE_S)
        return whole(*given)

    monkeypatch.setattr(history, "page", slow)
    with Gathering() as network:
        session, reading = network.join(), network.join()
        publisher = CachedPublisher(session, KEY)
        for i in range(300):
            publisher.put(f"{i:06}".encode() + bytes(2000))
        subscriber, taken = RecoveringSubscriber(reading, ANY), dict[int, bytes]()
        session.declare_queryable("t/word", lambda query: query.reply("t/word", b"") if query else None)

        def received(enough: Callable[[], bool]) -> bool:
            taken.update((each.number, each.payload) for each in subscriber.take())
            return enough()

        eventually("the query", lambda: received(lambda: bool(asked)))
        eventually("an answer meanwhile", lambda: any(reply.ok for reply in reading.get("t/word", timeout=1.0)))
        released.set()
        eventually("the rest", lambda: received(lambda: set(taken) == set(range(300))))
        assert all(int(payload[:6]) == number for number, payload in taken.items())
