"""Transmit policy: a frame at once for a new level, else at the heartbeat, and not before."""

from __future__ import annotations

from math import nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.transmit import Sender, Transmit

COUNTERS = 16
HEARTBEATS = st.integers(1, COUNTERS // 2 - 1)
CODES = st.tuples(st.integers(-1, 1), st.integers(0, 1))  # few, so that most ticks repeat the last
RUN = st.lists(CODES, min_size=1, max_size=100)
STEPS = st.lists(
    st.tuples(st.sampled_from((1, 1, 1, 2, COUNTERS - 1, COUNTERS, COUNTERS + 1, 2 * COUNTERS)), CODES),
    min_size=1,
    max_size=60,
)


@given(RUN, HEARTBEATS)
def test_without_a_change_a_frame_is_sent_exactly_a_heartbeat_after_the_last(
    run: list[tuple[int, int]], heartbeat: int
) -> None:
    sender = Sender("on_change", heartbeat, COUNTERS)
    sent = [k for k, codes in enumerate(run) if sender.due(k, codes)]
    assert sent[0] == 0
    for last, k in zip(sent, [*sent[1:], len(run)], strict=True):
        assert k - last <= heartbeat
        if k < len(run) and k - last < heartbeat:
            assert run[k] != run[last]


@settings(max_examples=500)
@given(STEPS, HEARTBEATS)
def test_where_ticks_are_missed_a_change_still_reaches_a_receiver_that_drops_repeated_counters(
    steps: list[tuple[int, tuple[int, int]]], heartbeat: int
) -> None:
    sender, k = Sender("on_change", heartbeat, COUNTERS), -1
    echo, held, ticks_wrong = -1, None, 0
    for ahead, codes in steps:
        k += ahead
        if sender.due(k, codes) and k % COUNTERS != echo:  # as a plant takes a command
            echo, held = k % COUNTERS, codes
        ticks_wrong = 0 if held == codes else ticks_wrong + 1
        # Only at a tick whose counter is the last one's, which no frame can mend before the next tick.
        assert ticks_wrong == 0 or k % COUNTERS == echo


@given(RUN, RUN, HEARTBEATS)
def test_a_sender_goes_on_from_the_memory_of_another(
    before: list[tuple[int, int]], after: list[tuple[int, int]], heartbeat: int
) -> None:
    first, second = Sender("on_change", heartbeat, COUNTERS), Sender("on_change", heartbeat, COUNTERS)
    for k, codes in enumerate(before):
        first.due(k, codes)
    second.resume(*first.memory)
    for k, codes in enumerate([before[-1], *after], start=len(before)):
        assert first.due(k, codes) == second.due(k, codes)


@pytest.mark.parametrize(
    ("before", "now", "sent"),
    [
        ((0.0, 1.5), (-0.0, 1.5), True),  # two frames, and a law may distinguish them
        ((-0.0, 1.5), (-0.0, 1.5), False),
        ((1, 0), (0, 1), True),
        ((-32, -32), (-32, -32), False),
        ((nan, nan), (nan, -nan), False),  # "no valid value"
    ],
)
def test_a_frame_whose_bits_differ_is_sent(before: tuple[float, ...], now: tuple[float, ...], sent: bool) -> None:
    sender = Sender("on_change", 7, COUNTERS)
    assert sender.due(0, before)
    assert sender.due(1, now) == sent


@given(st.integers(1, 127), st.integers(10, 7_800))
def test_a_heartbeat_of_so_many_periods_is_as_many_ticks(ticks: int, period_us: int) -> None:
    """However the binary fraction of it is rounded."""
    assert Transmit(heartbeat_s=ticks * period_us / 1e6).heartbeat_ticks(period_us * 1000, 256) == ticks
