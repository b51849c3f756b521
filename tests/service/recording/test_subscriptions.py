"""Subscriptions: every lost message is counted once, under its cause, and memory is bounded."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator

import pytest

from aeroloop.protocol.transport import history
from aeroloop.protocol.transport.history import KEPT_S, CachedPublisher, Delivery
from aeroloop.service.recording.backlog import MOST_BYTES, MOST_MESSAGES, Backlog
from aeroloop.service.recording.subscriptions import Subscriptions
from tests.support.zenoh_network import Gathering, eventually

EVENT, TRUTH = "aeroloop/aero/event/plant", "aeroloop/v2/truth"


@pytest.fixture
def gathering() -> Iterator[Gathering]:
    with Gathering() as gathering:
        yield gathering


def test_messages_published_while_a_link_is_set_up_do_not_hide_what_was_published_before(gathering: Gathering) -> None:
    """The publisher is met by gossip, in the midst of a thousand messages a second."""
    gathering.join()  # holds the rendezvous
    publisher, over = CachedPublisher(gathering.join(), EVENT, per_s=1000), threading.Event()

    def publish() -> None:
        while not over.wait(0.001):
            publisher.put(b"")

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        time.sleep(0.5)
        subscriptions, taken = Subscriptions(gathering.join()), list[int]()

        def take() -> bool:
            taken.extend(received.number for received in subscriptions.take())
            return len(taken) > 500

        eventually("some", take)
    finally:
        over.set()
        thread.join()
    eventually("the rest", lambda: bool(take() and sorted(taken) == list(range(len(taken)))))
    assert subscriptions.losses() == []


def test_numbers_that_no_cache_has_are_lost_and_those_that_found_no_room_are_recovered(
    gathering: Gathering, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history, "WAITING_BYTES", 2000)  # ten empty messages
    subscriptions = Subscriptions(gathering.join())
    session = gathering.join()
    cached, short = CachedPublisher(session, EVENT, per_s=10), CachedPublisher(session, TRUTH, per_s=20 / KEPT_S)
    taken: dict[str, list[int]] = {EVENT: [], TRUTH: []}
    lost: Counter[str] = Counter()

    def take() -> bool:
        for received in subscriptions.take():
            taken[received.key].append(received.number)
        for loss in subscriptions.losses():
            assert loss.reason == "cache"
            lost[loss.key] += loss.count
        return len(taken[EVENT]) == len(taken[TRUTH]) + lost[TRUTH] == 100

    cached.put(b"")
    short.put(b"")
    eventually("both", lambda: bool(take() or (taken[EVENT] and taken[TRUTH])))
    for _ in range(99):
        cached.put(b"")
        short.put(b"")
    time.sleep(0.2)  # nothing is taken meanwhile, so that there is no room for all
    eventually("all", take)
    assert sorted(taken[EVENT]) == list(range(100))
    # Its cache holds the last 20: all but these are lost, unless they found room.
    assert 0 < lost[TRUTH] < 80
    assert lost.keys() == {TRUTH}
    assert set(range(80, 100)) <= set(taken[TRUTH])
    assert subscriptions.losses() == []


@pytest.mark.parametrize(("size", "fit"), [(1_000_000, MOST_BYTES // 1_000_000), (1, MOST_MESSAGES)])
def test_what_waits_is_bounded_in_bytes_and_in_messages_and_the_oldest_are_kept_in_order(size: int, fit: int) -> None:
    backlog, payload = Backlog(), bytes(size)
    for number in range(fit + 5):
        backlog.put(Delivery("k", payload, number, None, None), number)
    assert len(backlog) == fit
    assert backlog.refused == {"k": 5}
    assert [entry[1] for entry in iter(backlog.next, None)] == list(range(fit))
    backlog.put(Delivery("k", payload, 0, None, None), 0)
    assert len(backlog) == 1
