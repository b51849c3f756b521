"""Cached publication between two Zenoh sessions on loopback: late, restarted and interrupted subscribers."""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh.handlers import RingChannel

from aeroloop.protocol.transport import publication
from aeroloop.protocol.transport.publication import ByteRing, CachedPublisher, Delivery, RecoveringSubscriber
from tests.support.zenoh_network import Gathering, eventually

KEY = "aeroloop/aero/trace/plant"
ANY = "aeroloop/*/trace/*"


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
    assert [each.sequence for each in received] == list(range(count))
    assert {each.key for each in received} == {KEY}
    assert len({str(each.source) for each in received}) == 1


def test_a_subscriber_that_comes_late_or_again_gets_everything_in_order_and_once(network: Gathering) -> None:
    publisher = CachedPublisher(network.join(network.settings), KEY, per_s=10)
    before_ns = time.time_ns()
    for i in range(300):
        publisher.put(payload(i))
    for _ in range(2):
        session = network.join(network.settings)
        subscriber = RecoveringSubscriber(session, ANY)
        received = collect(subscriber, 300)
        assert_complete(received, 300)
        stamps = [each.published_ns or 0 for each in received]
        assert before_ns <= stamps[0]
        assert stamps == sorted(stamps)
        session.close()


def test_a_cache_keeps_what_it_is_made_for_and_no_more(network: Gathering) -> None:
    publisher = CachedPublisher(network.join(network.settings), KEY, per_s=2)
    for i in range(1000):
        publisher.put(payload(i))
    received = collect(RecoveringSubscriber(network.join(network.settings), ANY), 130)
    assert [each.sequence for each in received] == list(range(870, 1000))  # 65 s of 2 a second


def test_what_finds_no_room_to_wait_shows_as_a_gap_in_the_sequence(network: Gathering) -> None:
    """The newest are kept."""
    publisher = CachedPublisher(network.join(network.settings), KEY, per_s=1)
    subscriber = RecoveringSubscriber(network.join(network.settings), ANY, waiting=10)
    for i in range(3):
        publisher.put(payload(i))
    assert_complete(collect(subscriber, 3), 3)
    for i in range(3, 40):  # the ring of the subscriber holds ten
        publisher.put(payload(i))
    found: list[Delivery] = []
    time.sleep(0.2)  # nothing is taken meanwhile, so the ring overflows

    def received() -> bool:
        found.extend(subscriber.take())
        return bool(found) and found[-1].sequence == 39

    eventually("receiving", received)
    assert [each.sequence for each in found] == list(range(40 - len(found), 40))


def test_a_plain_publisher_is_received_too_and_carries_no_time(network: Gathering) -> None:
    session = network.join(network.settings)
    subscriber = RecoveringSubscriber(network.join(network.settings), ANY)
    found: list[Delivery] = []

    def received() -> bool:
        session.put(KEY, b"plain")
        found.extend(subscriber.take())
        return bool(found)

    eventually("receiving", received)
    assert found[0][:2] == (KEY, b"plain")
    assert found[0].published_ns is None
    assert isinstance(session, zenoh.Session)


class Unreachable:
    """A session from which the first few queries reach no cache."""

    def __init__(self, session: zenoh.Session, queries: int) -> None:
        self._session = session
        self.left = queries

    def get(self, key: str, *arguments: Any, **options: Any) -> Any:
        self.left -= 1
        return self._session.get(key if self.left < 0 else "nowhere", *arguments, **options)


def sixth(network: Gathering, session: zenoh.Session) -> tuple[CachedPublisher, Delivery]:
    """A publisher and its sixth message, as a subscriber that asks for no history receives it."""
    publisher = CachedPublisher(network.join(network.settings), KEY, per_s=1)
    for i in range(5):
        publisher.put(payload(i))
    subscriber = session.declare_subscriber(KEY, RingChannel(1))
    eventually("the link", lambda: bool(list(session.info.peers_zid())))
    time.sleep(0.2)  # for the declaration to cross it
    publisher.put(payload(5))
    # The fifth may be on its way while the subscriber is declared: a link that is set up carries what waits for it.
    while (received := publication.read_sample(subscriber.recv())).sequence < 5:
        pass
    return publisher, received


def test_a_cache_that_is_not_yet_known_is_queried_again_and_what_is_received_meanwhile_follows(
    network: Gathering,
) -> None:
    session = network.join(network.settings)
    _publisher, first = sixth(network, session)
    unreachable = Unreachable(session, queries=2)
    join = publication.CacheQuery(unreachable, first)  # type: ignore[arg-type]  # a double
    later = first._replace(sequence=6)
    join.held.append(later)
    eventually("the answer", join.finished)
    assert unreachable.left == -1
    assert [each.sequence for each in join.deliver()] == [0, 1, 2, 3, 4, 5, 6]
    assert_complete(join.deliver()[:6], 6)


def test_a_cache_that_never_answers_holds_messages_back_for_a_while_only(
    network: Gathering, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publication, "JOIN_S", 0.3)
    session = network.join(network.settings)
    _publisher, first = sixth(network, session)
    unreachable = Unreachable(session, queries=1000)
    join = publication.CacheQuery(unreachable, first)  # type: ignore[arg-type]  # a double
    assert not join.finished()
    eventually("giving up", join.finished)
    assert unreachable.left < 999
    assert join.deliver() == [first]


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


def test_a_subscriber_that_bounds_bytes_recovers_what_was_published_before(network: Gathering) -> None:
    publisher = CachedPublisher(network.join(network.settings), KEY, per_s=100)
    for number in range(100):
        publisher.put(number.to_bytes(4, "big") * 250)
    received = collect(RecoveringSubscriber(network.join(network.settings), ANY, 1000, 200_000), 100)
    assert [one.sequence for one in received] == list(range(100))
