"""Recovery: in order, each message once, and nothing lost that a cache still holds, whatever the network does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.transport import recovery
from aeroloop.protocol.transport.publication import (
    PAGE_MESSAGES,
    PUBLISHERS,
    Cache,
    CachedPublisher,
    Delivery,
    Page,
    attachment,
    read_page,
    read_request,
    request,
)
from aeroloop.protocol.transport.recovery import ByteRing, Missed, RecoveringSubscriber, Recovery
from tests.support.zenoh_network import Gathering, eventually

KEY = "aeroloop/aero/trace/plant"
ANY = "aeroloop/*/trace/*"
OURS = 4711


def page(cache: Cache, wanted: int) -> Page:
    read = read_page(cache.page(wanted))
    assert read is not None
    return read


def message(number: int, publisher: int = OURS) -> Delivery:
    return Delivery(KEY, b"%d" % number, number, number, publisher)


def taken(recovery: Recovery) -> list[int]:
    numbers = [each.number for each in recovery.ready]
    assert [each.payload for each in recovery.ready] == [b"%d" % number for number in numbers]
    recovery.ready.clear()
    return numbers


@given(
    kept=st.integers(1, 40),
    before=st.integers(0, 30),
    sent=st.lists(st.sampled_from(["received", "lost", "late", "page"]), max_size=60),
    wait=st.integers(1, 4),
)
def test_what_is_received_or_in_a_cache_is_delivered_once_and_in_order_and_the_rest_is_counted(
    kept: int, before: int, sent: list[str], wait: int
) -> None:
    cache, recovery = Cache(OURS, kept), Recovery()
    for number in range(before):
        cache.put(number, b"%d" % number)
    late, received, found, paged = list[int](), set[int](), list[int](), set[int]()

    def receive(number: int, now: float) -> None:
        passed = number < recovery.wanted().get(OURS, 0)  # so late that it was counted as missing
        recovery.receive(message(number), now)
        received.update(() if passed else {number})

    def read(now: float) -> None:
        seen = page(cache, recovery.wanted().get(OURS, 0))
        recovery.read(KEY, seen, now)
        paged.update(range(seen.first, seen.first + len(seen.messages)))

    for now, event in enumerate(sent):
        if event == "page":
            read(now)
        else:
            number = cache.put(cache.count, b"%d" % cache.count)
            if event == "late":
                late.append(number)
            elif event == "received":
                receive(number, now)
        if late and now % wait == 0:
            receive(late.pop(0), now)
        found += taken(recovery)
    while recovery.lacks:
        read(1e3)
        found += taken(recovery)
    assert found == sorted(set(found))
    assert set(found) == received | paged
    missed = sum(each.missing for each in recovery.missed)
    assert missed == (found[-1] + 1 - found[0] - len(found) if found else 0)


def test_what_no_cache_answers_for_is_left_after_a_while_and_counted() -> None:
    recovery = Recovery()
    for number in (7, 8, 40):  # the first that is received, whatever its number
        recovery.receive(message(number), now=1.0)
    recovery.give_up(now=10.9)
    assert taken(recovery) == []
    assert recovery.lacks
    recovery.give_up(now=11.1)
    assert taken(recovery) == [7, 8]
    recovery.give_up(now=20.9)
    assert taken(recovery) == []
    recovery.give_up(now=21.2)
    assert taken(recovery) == [40]
    assert list(recovery.missed) == [Missed(KEY, 31)]
    assert not recovery.lacks


def test_what_was_received_before_the_oldest_that_a_cache_has_is_delivered() -> None:
    ours = Recovery()
    for number in (5, 7):
        ours.receive(message(number), now=0.0)
    ours.read(KEY, Page(OURS, 10, 11, [(10, b"10")]), now=0.0)
    assert taken(ours) == [5, 7, 10]
    assert sum(each.missing for each in ours.missed) == 3  # 6, 8 and 9
    assert (ours._held, ours.lacks) == (0, False)


def test_a_message_that_came_again_is_neither_delivered_nor_held() -> None:
    ours = Recovery()
    for number in (0, 1, 0, 2, 1, 2):
        ours.receive(message(number), now=0.0)
    assert taken(ours) == [0, 1, 2]
    assert (ours._held, ours.lacks) == (0, False)


def test_a_page_that_is_not_the_last_says_so() -> None:
    cache, ours = Cache(OURS, 2 * PAGE_MESSAGES), Recovery()
    for _ in range(PAGE_MESSAGES + 1):
        cache.put(0, b"")
    for left in (True, False):
        ours.read(KEY, page(cache, ours.wanted().get(OURS, 0)), now=0.0)
        assert ours.lacks == left
    assert len(ours.ready) == PAGE_MESSAGES + 1


def test_nobody_speaks_for_the_publisher_of_another_key() -> None:
    recovery = Recovery()
    recovery.receive(message(0), now=0.0)
    recovery.receive(message(5)._replace(key="other"), now=0.0)
    recovery.read("other", Page(OURS, 1_000_000, 1_000_000, []), now=0.0)
    recovery.receive(message(1), now=0.0)
    assert [each.number for each in recovery.ready if each.key == KEY] == [0, 1]


def test_what_is_held_back_is_bounded_and_what_finds_no_room_is_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recovery, "HELD", 5)
    cache, ours = Cache(OURS, 100), Recovery()
    for number in range(50):
        cache.put(number, b"%d" % number)
        if number:
            ours.receive(message(number), now=0.0)
    assert ours._held == 5
    ours.read(KEY, page(cache, 0), now=0.0)
    assert taken(ours) == list(range(50))
    assert not ours.lacks
    assert (ours._held, ours._held_bytes) == (0, 0)


def test_publishers_that_are_known_are_bounded_and_the_longest_silent_is_forgotten() -> None:
    recovery = Recovery()
    for publisher in range(PUBLISHERS + 1):
        recovery.receive(message(0, publisher), now=publisher)
    assert set(recovery.wanted()) == set(range(1, PUBLISHERS + 1))
    assert read_request(request(recovery.wanted())) == recovery.wanted()


class Answering:
    """A session whose caches answer at once: with the pages given beforehand, for one query each."""

    def __init__(self) -> None:
        self.pages: list[bytes] = []
        self.asked = 0
        self.hangs = False  # whether one of those asked never answers
        self.samples: list[Any] = []

    def declare_subscriber(self, *_: object) -> Any:
        return SimpleNamespace(try_recv=lambda: self.samples.pop(0) if self.samples else None)

    def get(self, *_: object, **__: object) -> Any:
        self.asked += 1
        replies = [self.pages.pop(0)] if self.pages else []

        def try_recv() -> Any:
            if not replies and self.hangs:
                return None
            if not replies:
                raise zenoh.ZError("all have answered")
            ok = SimpleNamespace(payload=zenoh.ZBytes(replies.pop(0)), key_expr=KEY + "/@cache")
            return SimpleNamespace(ok=ok)

        return SimpleNamespace(try_recv=try_recv)


def test_caches_are_queried_at_once_for_what_is_missing_and_ever_more_seldom_for_what_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, session = [100.0], Answering()
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    subscriber = RecoveringSubscriber(session, ANY)  # type: ignore[arg-type]  # a double
    cache = Cache(OURS, 10 * PAGE_MESSAGES)

    def asked(seconds: float) -> int:
        """Queries within a time, in steps of 5 ms."""
        before = session.asked
        for _ in range(round(seconds / 0.005)):
            list(subscriber.take())
            now[0] += 0.005
        return session.asked - before

    assert asked(0.2) >= 3  # nobody may be linked yet
    asked(20.0)
    assert 38 <= asked(20.0) <= 41
    sample = SimpleNamespace(
        key_expr=KEY, payload=zenoh.ZBytes(b""), attachment=zenoh.ZBytes(attachment(0, OURS, 2 * PAGE_MESSAGES))
    )
    session.samples.append(sample)  # after a gap
    assert asked(0.05) == 1
    for _ in range(8 * PAGE_MESSAGES):
        cache.put(0, b"")
    session.pages = [cache.page(number) for number in range(0, 8 * PAGE_MESSAGES, PAGE_MESSAGES)]
    assert asked(0.4) >= 8  # pages after each other
    assert session.pages == []
    asked(20.0)
    assert 38 <= asked(20.0) <= 41


def test_a_process_that_hangs_does_not_hold_up_the_pages_of_others() -> None:
    session, cache = Answering(), Cache(OURS, 10 * PAGE_MESSAGES)
    session.hangs = True
    subscriber, found = RecoveringSubscriber(session, ANY), list[Delivery]()  # type: ignore[arg-type]  # a double
    for _ in range(8 * PAGE_MESSAGES):
        cache.put(0, b"")
    session.pages = [cache.page(number) for number in range(0, 8 * PAGE_MESSAGES, PAGE_MESSAGES)]

    def received() -> bool:
        found.extend(subscriber.take())
        return len(found) == 8 * PAGE_MESSAGES

    eventually("all pages", received)
    assert session.asked in (8, 9)


# ── between two sessions ──


@pytest.fixture
def network() -> Iterator[Gathering]:
    with Gathering() as gathering:
        yield gathering


def payload(i: int) -> bytes:
    return f"{i:06}".encode() + bytes(2000)


def collect(subscriber: RecoveringSubscriber, wanted: int) -> list[Delivery]:
    """What is received until there is so much of it."""
    found: list[Delivery] = []

    def received() -> bool:
        found.extend(subscriber.take())
        return len(found) >= wanted

    eventually("receiving", received)
    time.sleep(0.05)  # a duplicate would follow at once
    found.extend(subscriber.take())
    return found


def assert_complete(received: list[Delivery], count: int) -> None:
    assert [int(each.payload[:6]) for each in received] == list(range(count))
    assert [each.number for each in received] == list(range(count))
    assert {each.key for each in received} == {KEY}
    assert len({each.publisher for each in received}) == 1


def test_a_subscriber_that_comes_late_or_again_gets_everything_in_order_and_once(network: Gathering) -> None:
    publisher = CachedPublisher(network.join(), KEY, per_s=10)
    before_ns = time.time_ns()
    for i in range(300):
        publisher.put(payload(i))
    for _ in range(2):
        session = network.join()
        received = collect(RecoveringSubscriber(session, ANY), 300)
        assert_complete(received, 300)
        stamps = [each.published_ns or 0 for each in received]
        assert before_ns <= stamps[0]
        assert stamps == sorted(stamps)
        session.close()


def test_a_cache_keeps_what_it_is_made_for_and_no_more(network: Gathering) -> None:
    publisher = CachedPublisher(network.join(), KEY, per_s=2)
    for i in range(1000):
        publisher.put(payload(i))
    received = collect(RecoveringSubscriber(network.join(), ANY), 130)
    assert [each.number for each in received] == list(range(870, 1000))  # 65 s of 2 a second


@pytest.mark.parametrize("waiting_bytes", [None, 30_000], ids=["in number", "in bytes"])
def test_what_finds_no_room_to_wait_is_recovered(network: Gathering, waiting_bytes: int | None) -> None:
    publisher = CachedPublisher(network.join(), KEY, per_s=1)
    subscriber = RecoveringSubscriber(network.join(), ANY, waiting=10, waiting_bytes=waiting_bytes)
    for i in range(3):
        publisher.put(payload(i))
    found = collect(subscriber, 3)
    for i in range(3, 40):  # the ring of the subscriber holds ten
        publisher.put(payload(i))
    time.sleep(0.2)  # nothing is taken meanwhile, so the ring overflows
    assert_complete(found + collect(subscriber, 37), 40)


def test_all_publishers_of_a_topic_answer(network: Gathering) -> None:
    keys = [f"aeroloop/aero/trace/{role}" for role in ("plant", "controller")]
    publishers = [
        CachedPublisher(session, key, per_s=1) for session in (network.join(), network.join()) for key in keys
    ]
    for publisher in publishers:
        publisher.put(b"")
    received = collect(RecoveringSubscriber(network.join(), ANY), 4)
    assert sorted(each.key for each in received) == sorted(2 * keys)
    assert len({each.publisher for each in received}) == 4


def test_a_plain_publisher_is_received_too_and_carries_no_time(network: Gathering) -> None:
    session = network.join()
    subscriber = RecoveringSubscriber(network.join(), ANY)
    found: list[Delivery] = []

    def received() -> bool:
        session.put(KEY, b"plain")
        found.extend(subscriber.take())
        return bool(found)

    eventually("receiving", received)
    assert found[0] == Delivery(KEY, b"plain", 0, None, None)


def test_a_slow_reader_of_pages_holds_up_no_thread_of_zenoh_s(network: Gathering) -> None:
    """A page waits in a thread of Python; frames and messages go on meanwhile."""
    session, reading = network.join(), network.join()
    publisher = CachedPublisher(session, KEY, per_s=100)
    for i in range(100):
        publisher.put(payload(i))
    asked: list[str] = []
    released = SimpleNamespace(now=False)
    whole = publisher._cache.page

    def slow(wanted: int) -> bytes:
        asked.append("page")
        eventually("the release", lambda: released.now)
        return whole(wanted)

    publisher._cache.page = slow  # type: ignore[method-assign]
    subscriber = RecoveringSubscriber(reading, ANY)
    session.declare_queryable("t/word", lambda query: query.reply("t/word", b"") if query else None)

    def queried() -> bool:
        list(subscriber.take())
        return bool(asked)

    eventually("the query", queried)
    eventually("an answer meanwhile", lambda: any(reply.ok for reply in reading.get("t/word", timeout=1.0)))
    released.now = True
    assert_complete(collect(subscriber, 100), 100)
    assert isinstance(session, zenoh.Session)


@given(sizes=st.lists(st.integers(0, 40), max_size=30), most=st.integers(1, 8), most_bytes=st.integers(40, 100))
def test_a_byte_ring_keeps_the_newest_that_fit_in_order(sizes: list[int], most: int, most_bytes: int) -> None:
    ring = ByteRing(most, most_bytes)
    samples: list[Any] = [SimpleNamespace(payload=bytes(size), number=number) for number, size in enumerate(sizes)]
    for sample in samples:
        ring.put(sample)
    kept = list(iter(ring.try_recv, None))
    fit = 0
    while fit < min(most, len(sizes)) and sum(sizes[len(sizes) - fit - 1 :]) <= most_bytes:
        fit += 1
    assert kept == samples[len(sizes) - fit :]
    assert ring.try_recv() is None
