"""Links and mailboxes: the newest frame, once, and no queue."""

from __future__ import annotations

import threading
import time
from collections.abc import Container, Iterator

import pytest
import zenoh

from aeroloop.protocol.transport.link import Arrival, Link, Mailbox, ZenohLink
from tests.support.zenoh_network import PATIENCE_S, Gathering, eventually


def test_an_empty_mailbox_gives_nothing() -> None:
    assert Mailbox().take() is None


def test_the_newest_frame_wins_and_is_given_once() -> None:
    mailbox = Mailbox()
    before = time.monotonic_ns()
    for frame in (b"1", b"2", b"3"):
        mailbox.put(frame)
    after = time.monotonic_ns()
    arrival = mailbox.take()
    assert arrival is not None
    assert arrival.frame == b"3"
    assert before <= arrival.at_ns <= after
    assert mailbox.take() is None


def test_waiting_takes_what_is_there_without_waiting() -> None:
    mailbox = Mailbox()
    mailbox.put(b"1")
    started = time.monotonic()
    arrival = mailbox.wait(PATIENCE_S)
    assert arrival is not None
    assert arrival.frame == b"1"
    assert time.monotonic() - started < PATIENCE_S
    assert mailbox.take() is None


@pytest.mark.parametrize("timeout_s", [0.0, 0.05])
def test_waiting_for_nothing_ends_at_the_timeout(timeout_s: float) -> None:
    started = time.monotonic()
    assert Mailbox().wait(timeout_s) is None
    assert timeout_s <= time.monotonic() - started < timeout_s + PATIENCE_S


def test_a_frame_put_by_another_thread_wakes_the_waiting_one() -> None:
    # Two threads wait for each other in turn, so that each is asleep when its frame comes; one wake-up that is missed
    # would take the whole timeout.
    there, back = Mailbox(), Mailbox()
    rounds = 200

    def echo() -> None:
        for _ in range(rounds):
            arrival = there.wait(PATIENCE_S)
            if arrival is not None:
                back.put(arrival.frame)

    thread = threading.Thread(target=echo, daemon=True)
    thread.start()
    started = time.monotonic()
    for i in range(rounds):
        there.put(b"%d" % i)
        arrival = back.wait(PATIENCE_S)
        assert arrival is not None
        assert arrival.frame == b"%d" % i
        assert time.monotonic() - started < PATIENCE_S
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


ANY = range(256)
"""Lengths of frames, where a test is not about them."""
SETTLE_S = 0.1
"""What should not arrive would have arrived by then: a frame takes less than a millisecond."""


@pytest.fixture
def pair() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """Two sessions that see each other."""
    with Gathering() as gathering:
        a, b = gathering.join(), gathering.join()
        eventually("meeting", lambda: bool(a.info.peers_zid()) and bool(b.info.peers_zid()))
        yield a, b


def connect(sender: Link, receiver: Link) -> None:
    """Send until the first frame arrives: a put right after a subscription may be lost. Then nothing is under way."""
    seen: list[Arrival] = []

    def received() -> bool:
        sender.send(b"hello")
        arrival = receiver.wait(0.05)
        if arrival is not None:
            seen.append(arrival)
        return bool(seen)

    eventually("the first frame", received)
    sender.send(b"ready")
    eventually("the last of the greetings", lambda: (got := receiver.take()) is not None and got.frame == b"ready")


def links(
    pair: tuple[zenoh.Session, zenoh.Session],
    session: str = "s1",
    *,
    lossless: bool = True,
    lengths: Container[int] = ANY,
) -> tuple[ZenohLink, ZenohLink]:
    """Both ends of a link, connected in both directions. Lossless, so that a slow machine drops nothing."""
    plant = ZenohLink(pair[0], f"t/{session}/measurement", f"t/{session}/command", lengths, lossless=lossless)
    controller = ZenohLink(pair[1], f"t/{session}/command", f"t/{session}/measurement", lengths, lossless=lossless)
    connect(plant, controller)
    connect(controller, plant)
    return plant, controller


@pytest.mark.parametrize("lossless", [True, False])
def test_frames_arrive_both_ways_as_they_were_sent(pair: tuple[zenoh.Session, zenoh.Session], lossless: bool) -> None:
    plant, controller = links(pair, lossless=lossless)
    for i in range(50):
        before = time.monotonic_ns()
        plant.send(bytes([i]) * 7)
        measurement = controller.wait(PATIENCE_S)
        assert measurement is not None
        assert measurement.frame == bytes([i]) * 7
        assert before <= measurement.at_ns <= time.monotonic_ns()
        controller.send(bytes([i, 255]))
        command = plant.wait(PATIENCE_S)
        assert command is not None
        assert command.frame == bytes([i, 255])
    assert plant.take() is None
    assert controller.take() is None


def test_of_many_frames_only_the_newest_is_given(pair: tuple[zenoh.Session, zenoh.Session]) -> None:
    plant, controller = links(pair)
    marker, marked = links(pair, "s2")
    for i in range(100):
        plant.send(bytes([i]))
    plant.send(b"last")
    marker.send(b"after it")
    assert marked.wait(PATIENCE_S) is not None  # both links are of one connection, which keeps the order
    newest = controller.take()
    assert newest is not None
    assert newest.frame == b"last"
    assert controller.take() is None


def test_a_frame_that_waits_is_pending_until_it_is_taken(pair: tuple[zenoh.Session, zenoh.Session]) -> None:
    plant, controller = links(pair)
    assert not controller.pending
    plant.send(b"old")
    eventually("the frame", lambda: controller.pending)
    taken = controller.take()
    assert taken is not None
    assert taken.frame == b"old"
    assert not controller.pending
    plant.send(b"old")
    eventually("the frame", lambda: controller.pending)
    plant.send(b"new")
    eventually("the newer frame", lambda: (got := controller.take()) is not None and got.frame == b"new")
    assert not controller.pending


@pytest.mark.parametrize("lossless", [True, False])
def test_a_frame_of_a_wrong_length_is_counted_and_never_takes_the_place_of_a_good_one(
    pair: tuple[zenoh.Session, zenoh.Session], lossless: bool
) -> None:
    plant, controller = links(pair, lossless=lossless, lengths={5, 0})
    for sender, receiver in ((plant, controller), (controller, plant)):
        for frame in (b"good!", b""):
            before = receiver.refused
            for sent in (b"long..", frame, b"four", bytes(200)):
                sender.send(sent)
            eventually("the refusals", lambda r=receiver, n=before: r.refused == n + 3)  # type: ignore[misc]
            assert receiver.pending
            arrival = receiver.wait(PATIENCE_S)
            assert arrival is not None
            assert arrival.frame == frame
            assert receiver.take() is None


def test_a_frame_that_was_taken_does_not_end_the_next_wait() -> None:
    mailbox = Mailbox()
    mailbox.put(b"1")
    assert mailbox.take() is not None
    started = time.monotonic()
    assert mailbox.wait(0.05) is None
    assert time.monotonic() - started >= 0.05


def test_a_mailbox_holds_as_many_frames_as_its_depth_and_gives_the_oldest_first() -> None:
    mailbox = Mailbox(depth=3)
    for frame in (b"1", b"2", b"3", b"4"):
        mailbox.put(frame)
    taken = [arrival.frame for arrival in iter(mailbox.take, None)]
    assert taken == [b"2", b"3", b"4"]


def test_a_link_receives_only_its_own_session(pair: tuple[zenoh.Session, zenoh.Session]) -> None:
    plant, controller = links(pair)
    other_plant, other_controller = links(pair, "s2")
    other_plant.send(b"theirs")
    assert other_controller.wait(PATIENCE_S) is not None
    assert controller.wait(SETTLE_S) is None
    plant.send(b"ours")
    assert controller.wait(PATIENCE_S) is not None
    assert other_controller.wait(SETTLE_S) is None


def test_waiting_for_a_frame_that_does_not_come_ends_at_the_timeout(
    pair: tuple[zenoh.Session, zenoh.Session],
) -> None:
    plant, _ = links(pair)
    started = time.monotonic()
    assert plant.wait(0.05) is None
    assert time.monotonic() - started >= 0.05


def test_a_closed_link_receives_nothing_and_closing_twice_does_no_harm(
    pair: tuple[zenoh.Session, zenoh.Session],
) -> None:
    plant, controller = links(pair)
    marker, marked = links(pair, "s2")
    controller.close()
    controller.close()
    plant.send(b"late")
    marker.send(b"after it")
    assert marked.wait(PATIENCE_S) is not None  # the sessions outlive the link
    assert controller.wait(SETTLE_S) is None
    assert not pair[1].is_closed()


def test_sending_to_a_peer_that_went_away_raises_nothing(pair: tuple[zenoh.Session, zenoh.Session]) -> None:
    plant, _ = links(pair)
    pair[1].close()
    for _ in range(10):
        plant.send(b"is anybody there?")
    eventually("noticing", lambda: not pair[0].info.peers_zid())
    plant.send(b"nobody")
    assert plant.take() is None
