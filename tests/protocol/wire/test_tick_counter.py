"""Tick counter: true ticks from a few bits, in spite of loss, delay, reordering and drifting clocks."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.frames import TickCounter

PERIOD_NS = 2_000_000


@st.composite
def runs(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]]]:
    """A counter's range, and measurements (tick, time of arrival) in order of arrival, on a clock with any offset.

    The clock drifts by up to 1 %. Frames are dropped, ticks are skipped, frames overtake each other, each late by
    less than 3/4 of the counter's range, less what the clocks drift over a gap before it. One frame in every `counters`
    ticks is late by an eighth of the range at the most, so that the mark, which moves by 3 % of a period a tick against
    the true grid, is never a quarter of the range late.
    """
    counters = 2 ** draw(st.sampled_from([4, 5, 8, 10]))
    offset_ns = draw(st.integers(-(10**18), 10**18))
    period_ns = PERIOD_NS * (1 + draw(st.sampled_from([-0.01, -0.003, 0.0, 0.005, 0.01])))
    punctual = counters // 8
    skips = st.one_of(st.just(1), st.integers(1, 3), st.integers(1, counters))
    steps = draw(st.lists(st.tuples(skips, st.floats(0, 1)), max_size=300))
    tick, last_punctual = 0, 0
    arrivals = [(0, offset_ns + round(draw(st.floats(0, 1)) * punctual * PERIOD_NS))]
    for skip, late in steps:
        tick += skip
        most = 0.74 * counters - 0.01 * skip
        if tick - last_punctual >= counters:
            most, last_punctual = punctual, tick
        arrivals.append((tick, offset_ns + round(tick * period_ns + late * most * PERIOD_NS)))
    return counters, sorted(arrivals, key=lambda arrival: arrival[1])


@settings(max_examples=150)
@given(runs())
def test_a_frame_has_its_true_tick_however_it_was_held_up_and_whatever_the_clocks_say(
    run: tuple[int, list[tuple[int, int]]],
) -> None:
    counters, arrivals = run
    ticks, last = TickCounter(PERIOD_NS, counters, lockstep=False), -1
    for tick, at_ns in arrivals:
        assert ticks.advance(tick % counters, at_ns) == (tick if tick > last else None)
        last = max(last, tick)
        assert ticks.tick == last


@given(st.sampled_from([16, 256]), st.lists(st.integers(1, 15), max_size=60))
def test_in_lockstep_the_counter_gives_the_tick_and_a_frame_again_is_none(counters: int, steps: list[int]) -> None:
    ticks, tick = TickCounter(PERIOD_NS, counters, lockstep=True), -1
    for step in steps:
        tick += step
        assert ticks.advance(tick % counters, 0) == tick
        assert ticks.advance(tick % counters, 0) is None
        assert ticks.tick == tick


def test_how_late_a_frame_is_counts_from_the_fastest_ones() -> None:
    start, late = 10**15, 3_000_000
    ticks = TickCounter(PERIOD_NS, 256, lockstep=False)
    assert not ticks.known
    assert ticks.late_ns(0, start) == 0
    for tick in range(100):
        at_ns = start + tick * PERIOD_NS
        assert ticks.advance(tick, at_ns) == tick
        assert (ticks.late_ns(tick, at_ns), ticks.due_ns(tick), ticks.tick_at(at_ns)) == (0, at_ns, tick)
    at_ns = start + 100 * PERIOD_NS + late
    assert ticks.advance(100, at_ns) == 100
    assert late - PERIOD_NS // TickCounter.DRIFT <= ticks.late_ns(100, at_ns) <= late
    assert ticks.advance(101, start + 101 * PERIOD_NS) == 101  # one late frame moves the mark by no more than that
    assert ticks.late_ns(101, start + 101 * PERIOD_NS) == 0
    assert ticks.advance(101, start + 101 * PERIOD_NS + 100) is None  # not newer


def test_a_frame_held_up_for_too_long_is_judged_wrongly_alone() -> None:
    ticks = TickCounter(PERIOD_NS, 16, lockstep=False)
    assert ticks.advance(0, 3 * PERIOD_NS) == 0  # a first frame that was held up misleads nothing
    for k in range(3, 10):
        assert ticks.advance(k, k * PERIOD_NS) == k
    assert ticks.advance(10, (10 + 14) * PERIOD_NS) == 26  # sixteen too many
    # The plant goes on where its grid is; what would step back is passed over until the grid is past the error.
    found = [ticks.advance(k % 16, k * PERIOD_NS) for k in range(25, 40)]
    assert found == [None, None, *range(27, 40)]


def test_in_lockstep_a_counter_is_unwrapped_without_time() -> None:
    ticks = TickCounter(PERIOD_NS, 16, lockstep=True, tick=29)
    assert [ticks.advance(counter, 0) for counter in (14, 15, 0, 1)] == [30, 31, 32, 33]
    assert ticks.late_ns(33, 10**18) == 0
