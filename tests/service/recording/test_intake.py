"""The intake takes every message once, with when it was published; what finds no room is counted, not forgotten.

Real Zenoh sessions in this process, linked over loopback.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import zenoh

from protocol.links import Numbered
from service.recording.intake import Intake, Taken
from tests.protocol.gathering import Gathering, eventually

ALL = "aeroloop/**"
KEYS = tuple(f"aeroloop/aero/s/{name}" for name in ("measurement", "command", "other"))


@pytest.fixture
def gathering() -> Iterator[Gathering]:
    with Gathering() as gathering:
        yield gathering


def publisher(session: zenoh.Session, key: str) -> Numbered:
    """One that drops nothing, and that has found its listener."""
    declared = session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.BLOCK, priority=zenoh.Priority.REAL_TIME
    )
    eventually("the match", lambda: _matched(declared))
    return Numbered(declared)


def _matched(publisher: zenoh.Publisher) -> bool:
    matching: bool = publisher.matching_status.matching  # type: ignore[attr-defined]  # the stubs say it were a bool
    return matching


def all_of(intake: Intake) -> list[Taken]:
    return list(iter(intake.next, None))


def payload(number: int) -> bytes:
    return number.to_bytes(4, "big")


def numbers(messages: list[Taken]) -> dict[str, list[int]]:
    """What the payloads of each key say, in order."""
    found: dict[str, list[int]] = defaultdict(list)
    for message in messages:
        found[message.key].append(int.from_bytes(message.payload, "big"))
    return found


def finish(intake: Intake) -> list[Taken]:
    intake.settle()
    intake.close()
    return all_of(intake)


def sleeps(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """How long the intake sleeps, each time it does from now on [s]."""
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        time.sleep(seconds)

    watched = SimpleNamespace(
        sleep=sleep, time_ns=time.time_ns, monotonic=time.monotonic, monotonic_ns=time.monotonic_ns
    )
    monkeypatch.setattr("service.recording.intake.time", watched)
    return slept


@pytest.mark.parametrize("batch_s", [0.0, 0.05])
def test_every_message_comes_once_in_order_with_its_time_of_publication(gathering: Gathering, batch_s: float) -> None:
    sender = gathering.join()
    intake = Intake(gathering.join(), ALL, batch_s)
    publishers = [publisher(sender, key) for key in KEYS]
    sent: dict[str, list[tuple[int, int]]] = defaultdict(list)
    for number in range(1000):
        for key, one in zip(KEYS, publishers, strict=True):
            before = time.time_ns()
            one.put(payload(number))
            sent[key].append((before, time.time_ns()))
    messages = finish(intake)
    assert numbers(messages) == {key: list(range(1000)) for key in KEYS}
    positions: Counter[str] = Counter()
    for message in messages:
        before, after = sent[message.key][positions[message.key]]
        positions[message.key] += 1
        # Zenoh's clock counts parts of a second in steps of under 4 ns, and 1 µs further where two would be the same.
        assert before - 10 <= message.published_ns <= after + 10_000
        assert message.published_ns <= message.arrived_ns + 10_000
        assert message.missing == 0


def test_a_flood_is_taken_in_to_the_last_message_when_recording_ends(gathering: Gathering) -> None:
    """Nothing is told of it here, not even its number: what is there at the end is what was published before it."""
    sender = gathering.join()
    intake = Intake(gathering.join(), ALL, 0.05)
    one = publisher(sender, KEYS[0])
    for number in range(20_000):
        one.put(payload(number))
    messages = finish(intake)
    assert numbers(messages) == {KEYS[0]: list(range(20_000))}


def test_what_we_publish_ourselves_is_taken_in_at_once_and_once(gathering: Gathering) -> None:
    session = gathering.join()
    gathering.join()  # somebody it could come back from
    intake = Intake(session, ALL, 0.05)
    one = Numbered(session.declare_publisher(KEYS[2]))
    for number in range(300):
        one.put(payload(number))
        assert len(intake) == number + 1
    assert numbers(finish(intake)) == {KEYS[2]: list(range(300))}


def test_messages_gather_where_much_comes_and_none_is_late_where_little_comes(
    gathering: Gathering, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A handshake takes several messages each way, so a pause for each would keep whoever joins waiting."""
    sender, receiver = gathering.join(), gathering.join()
    pauses = sleeps(monkeypatch)
    intake = Intake(receiver, ALL, 0.017)
    one = publisher(sender, KEYS[0])
    for number in range(50):  # one by one, but fewer than 200: not known to be busy, however long it takes
        one.put(payload(number))
        time.sleep(0.001)
    eventually("all", lambda: len(intake) == 50)
    assert pauses == []
    until = time.monotonic() + 2.5
    number = 50
    while time.monotonic() < until and not pauses:  # well over 200 a second, for over a second
        one.put(payload(number))
        number += 1
        time.sleep(0.001)
    for _ in range(100):
        one.put(payload(number))
        number += 1
        time.sleep(0.001)
    assert set(pauses) == {0.017}, "it paused, and never for longer"
    assert numbers(finish(intake)) == {KEYS[0]: list(range(number))}


def test_a_full_queue_refuses_and_counts_by_key_and_what_was_lost_before_is_known_all_the_same(
    gathering: Gathering,
) -> None:
    sender, receiver = gathering.join(), gathering.join()
    intake = Intake(receiver, ALL, 0.0, most=10)
    intake.numbers.settled = True
    declared = [sender.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK) for key in KEYS[:2]]
    for one in declared:
        eventually("the match", lambda one=one: _matched(one))  # type: ignore[misc]

    def send(which: int, number: int) -> None:
        declared[which].put(payload(number), source_info=zenoh.SourceInfo(declared[which].id, number))

    for number in range(8):
        send(0, number)
    for number in range(8):
        send(1, number)
    eventually("sixteen", lambda: intake._refusals.messages.total() == 6)
    send(0, 11)  # 8, 9 and 10 never come
    eventually("one more", lambda: intake._refusals.messages.total() == 7)
    refusals = intake.refusals()
    assert refusals.messages == {KEYS[0]: 1, KEYS[1]: 6}
    assert +refusals.missing == {KEYS[0]: 3}
    assert intake.refusals().messages == {}

    assert len(all_of(intake)) == 10
    send(0, 12)
    send(1, 8)
    eventually("two", lambda: len(intake) == 2)
    assert [message.missing for message in all_of(intake)] == [0, 0], "what was refused is not missing, too"


def test_none_is_lost_between_those_refused_and_those_told_of(gathering: Gathering) -> None:
    """Whoever tells of refusals takes them while others are counted: three threads publish, and all is refused."""
    session = gathering.join()
    intake = Intake(session, ALL, 0.0, most=0)
    told: Counter[str] = Counter()
    threads = [
        threading.Thread(target=lambda: [session.put(key, b"") for key in KEYS for _ in range(1000)]) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        told += intake.refusals().messages
    told += intake.refusals().messages
    assert told == dict.fromkeys(KEYS, 3000)


def test_a_network_that_does_not_fall_silent_is_left_without_much_ado(
    gathering: Gathering, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loop that goes on is no backlog: a recorder is stopped, and started again, beside it."""
    sender = gathering.join()
    intake = Intake(gathering.join(), ALL, 0.0)
    one = publisher(sender, KEYS[0])
    over = threading.Event()

    def go_on() -> None:
        while not over.is_set():
            one.put(b"")
            time.sleep(0.002)

    loop = threading.Thread(target=go_on)
    loop.start()
    eventually("messages", lambda: len(intake) > 10)
    monkeypatch.setattr("service.recording.intake._QUIET_NS", 1 << 62)  # never silent, however busy this machine is
    monkeypatch.setattr("service.recording.intake.SETTLING_S", 1e9)
    waits = sleeps(monkeypatch)
    intake.settle()  # comes back
    intake.close()
    over.set()
    loop.join()
    assert waits
