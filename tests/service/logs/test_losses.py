"""What never came is counted exactly, by its senders' numbers, whoever else speaks on the same key."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from service.logs.losses import Numbers

WRAP = 1 << 32
KEY = "aeroloop/aero/event"
Sender = tuple[str, int]
"""Stands for a Zenoh session and the number of a publisher in it, of which only equality counts."""
A, B = ("a", 1), ("b", 1)


def source(sender: Sender, number: int) -> zenoh.SourceInfo:
    zid, eid = sender
    return cast(zenoh.SourceInfo, SimpleNamespace(source_id=SimpleNamespace(zid=zid, eid=eid), source_sn=number % WRAP))


def missing(numbers: Numbers, messages: Iterable[tuple[Sender, int]], key: str = KEY) -> list[int]:
    return [numbers.missing(key, source(sender, number)) for sender, number in messages]


@pytest.fixture
def numbers() -> Numbers:
    """As they are once everybody who was there before the recorder has been heard; A and B were not."""
    numbers = Numbers()
    numbers.settled = True
    return numbers


def test_nothing_is_missing_from_numbers_in_order(numbers: Numbers) -> None:
    assert missing(numbers, [(A, n) for n in range(100)]) == [0] * 100


def test_a_gap_is_counted_at_the_message_after_it_and_once(numbers: Numbers) -> None:
    assert missing(numbers, [(A, n) for n in (0, 1, 5, 6, 8)]) == [0, 0, 3, 0, 1]


def test_what_a_newcomer_published_before_it_was_first_heard_is_missing(numbers: Numbers) -> None:
    assert missing(numbers, [(A, 3), (A, 4)]) == [3, 0]


def test_who_was_there_before_the_recorder_has_lost_nothing_on_any_key() -> None:
    """A role tells its status every second, but an event only when one happens."""
    numbers = Numbers()
    assert missing(numbers, [(A, 700)], "aeroloop/aero/status/plant") == [0]
    numbers.settled = True
    assert missing(numbers, [(("a", 2), 12), (("a", 2), 14)]) == [0, 1]
    assert missing(numbers, [(B, 12)]) == [12]


def test_one_that_starts_again_is_another_and_begins_at_0(numbers: Numbers) -> None:
    assert missing(numbers, [(A, 0), (A, 1), (("c", 1), 0), (("c", 1), 1), (("d", 1), 2)]) == [0, 0, 0, 0, 2]


def test_each_publisher_and_each_key_has_numbers_of_its_own(numbers: Numbers) -> None:
    assert missing(numbers, [(A, 0), (A, 1), (("a", 2), 0), (A, 2), (("a", 2), 1)]) == [0] * 5
    assert missing(numbers, [(A, 0), (A, 1)], "aeroloop/aero/change") == [0, 0]


def test_numbers_begin_again_after_32_bits() -> None:
    numbers = Numbers()
    assert missing(numbers, [(A, n) for n in (WRAP - 2, WRAP - 1, WRAP, WRAP + 1)]) == [0] * 4
    assert missing(numbers, [(B, n) for n in (WRAP - 2, WRAP + 2)]) == [0, 3]


def test_a_message_that_comes_late_or_twice_takes_nothing_back_and_adds_nothing(numbers: Numbers) -> None:
    assert missing(numbers, [(A, n) for n in (0, 2, 1, 2, 3)]) == [0, 1, 0, 0, 0]


@given(
    turns=st.lists(st.tuples(st.integers(0, 2), st.booleans()), max_size=200),
    starts=st.tuples(*[st.integers(WRAP - 20, WRAP - 1)] * 3),
)
def test_what_is_dropped_of_senders_that_take_turns_is_counted_exactly(
    turns: list[tuple[int, bool]], starts: tuple[int, int, int]
) -> None:
    """Three senders at about the same numbers, just before these begin again; each message comes or does not."""
    numbers = Numbers()
    following = list(starts)
    dropped = [0, 0, 0]
    for member, start in enumerate(starts):
        assert missing(numbers, [((str(member), 1), start - 1)]) == [0]
    for member, comes in turns:
        if comes:
            assert missing(numbers, [((str(member), 1), following[member])]) == [dropped[member]]
        dropped[member] = 0 if comes else dropped[member] + 1
        following[member] += 1


def test_publishers_of_zenoh_are_told_apart(numbers: Numbers) -> None:
    """Their ids are other objects with every message, and not all of them compare by value."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        publishers = [session.declare_publisher("a") for _ in range(2)]

        def sent() -> Iterator[zenoh.SourceInfo]:
            for number in (0, 1, 3):
                for publisher in publishers:
                    yield zenoh.SourceInfo(publisher.id, number)

        assert [numbers.missing("a", one) for one in sent()] == [0, 0, 0, 0, 1, 1]
