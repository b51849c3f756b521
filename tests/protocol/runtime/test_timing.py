"""Tick grid and timing: absolute ticks without drift or bursts, durations exact to their bins."""

from __future__ import annotations

from itertools import pairwise
from math import isnan

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from aeroloop.protocol.runtime import tick_grid, timing
from aeroloop.protocol.runtime.tick_grid import TickGrid
from aeroloop.protocol.runtime.timing import Histogram, LoopTiming, RollingHistogram, summary
from aeroloop.protocol.wire.spec import LoopSettings

START = 123_456_789_012_345
PERIOD = 2_000_000


class FakeTime:
    """A clock that moves only when set, or by a sleep, which may take longer than asked for."""

    def __init__(self) -> None:
        self.now = START
        self.oversleep = 0
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        """The time [ns]."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        assert seconds > 0
        self.slept.append(seconds)
        self.now += round(seconds * 1e9) + self.oversleep


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    """The fake clock in place of the module's `time`."""
    clock = FakeTime()
    for module in (tick_grid, timing):
        monkeypatch.setattr(module, "time", clock)
    return clock


def test_tick_0_is_due_at_once_or_at_the_start_that_is_given(fake: FakeTime) -> None:
    grid = TickGrid(PERIOD)
    assert (grid.tick, grid.skipped) == (-1, 0)
    assert grid.wait() == 0
    assert fake.now == START
    later = TickGrid(PERIOD, start_ns=START + 7 * PERIOD)
    assert later.wait() == 0
    assert fake.now == START + 7 * PERIOD


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    work=st.lists(st.integers(0, PERIOD - 200_001), min_size=1, max_size=200),
    oversleep=st.integers(0, 200_000),
    period=st.integers(PERIOD, 10 * PERIOD),
)
def test_deadlines_are_absolute_whatever_work_and_sleep_take(
    fake: FakeTime, work: list[int], oversleep: int, period: int
) -> None:
    fake.now, fake.oversleep = START, oversleep
    grid = TickGrid(period)
    for k, busy in enumerate(work):
        assert grid.wait() == grid.tick == k
        assert fake.now == START + k * period + (oversleep if k else 0)
        fake.now += busy
    assert grid.skipped == 0


def test_a_day_of_ticks_does_not_drift(fake: FakeTime) -> None:
    grid = TickGrid(PERIOD)
    grid.tick = 43_200_000 - 1  # a day at 500 Hz
    fake.now = START + 43_200_000 * PERIOD - 1_000_000
    fake.slept.clear()
    assert grid.wait() == 43_200_000
    assert fake.now == START + 43_200_000 * PERIOD
    assert fake.slept == [pytest.approx(1e-3)]


def test_a_tick_late_by_less_than_a_period_is_taken_at_once(fake: FakeTime) -> None:
    grid = TickGrid(PERIOD)
    grid.wait()
    fake.now += 2 * PERIOD - 1
    assert grid.wait() == 1
    assert (fake.slept, grid.skipped) == ([], 0)
    assert grid.wait() == 2
    assert fake.now == START + 2 * PERIOD


def test_what_a_stall_misses_is_counted_and_not_made_up_for(fake: FakeTime) -> None:
    grid = TickGrid(PERIOD)
    grid.wait()
    fake.now = START + 10 * PERIOD  # ticks 1…9 are past and 10 is due now
    assert grid.wait() == 10
    assert grid.skipped == 9
    assert grid.wait() == 11
    assert fake.now == START + 11 * PERIOD
    assert grid.skipped == 9


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(work=st.lists(st.integers(0, PERIOD) | st.integers(0, 20 * PERIOD), min_size=1, max_size=100))
def test_it_never_bursts_and_every_tick_is_taken_or_counted(fake: FakeTime, work: list[int]) -> None:
    fake.now = START
    grid = TickGrid(PERIOD)
    ticks = []
    for n, busy in enumerate(work, start=1):
        k = grid.wait()
        ticks.append(k)
        assert k + 1 == n + grid.skipped
        due = START + k * PERIOD
        assert due <= fake.now < due + PERIOD  # the tick of now: not an old one, not one to come
        fake.now += busy
    assert all(early < late for early, late in pairwise(ticks))


def test_after_a_stall_the_next_tick_is_one_that_is_still_ahead(fake: FakeTime) -> None:
    grid = TickGrid(PERIOD)
    grid.wait()
    fake.now = START + 4 * PERIOD + 900_000
    assert grid.wait() == 5  # "at the next deadline ahead", SPEC.md, section 6
    assert fake.now == START + 5 * PERIOD
    assert grid.skipped == 4


@pytest.mark.parametrize(("rate", "period_ns"), [(500.0, 2_000_000), (1000.0, 1_000_000), (3.0, 333_333_333)])
def test_a_rate_gives_a_period_in_whole_nanoseconds(rate: float, period_ns: int) -> None:
    loop = LoopSettings(rate_hz=rate)
    assert loop.period_ns == period_ns
    assert loop.period == pytest.approx(period_ns * 1e-9, rel=2.0**-52)
    assert loop.ticks(50.0) == round(50.0 * rate)
    assert loop.ticks(0.0) == 0


@pytest.mark.parametrize("broken", [{"rate_hz": 0.5}, {"rate_hz": 10_001}, {"rate_hz": "nan"}, {"rate": 500}])
def test_loop_settings_out_of_bounds_are_refused_by_name(broken: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(broken))):
        LoopSettings.model_validate(broken)


HALF_A_BIN = 2 ** (1 / 32) * (1 + 1e-9)
"""The middle of a bin is at most half a bin, 2.2 %, from whatever is in it; 1e-9 for rounding at its edge."""


@settings(max_examples=80)
@given(st.lists(st.integers(1000, 3_600_000_000_000), min_size=1, max_size=60), st.integers(0, 100))
def test_a_percentile_is_within_half_a_bin(durations_ns: list[int], percent: int) -> None:
    histogram = Histogram()
    for duration in durations_ns:
        histogram.add(duration)
    # The least duration that at least this part of all do not exceed, in whole numbers.
    rank = max(-(-len(durations_ns) * percent // 100), 1)
    exact_us = sorted(durations_ns)[rank - 1] * 1e-3
    assert exact_us / HALF_A_BIN <= histogram.percentile(percent) <= exact_us * HALF_A_BIN
    assert histogram.percentile(percent) <= histogram.max_us


@pytest.mark.parametrize("seed", range(3))
def test_percentiles_agree_with_numpy_to_a_bin(seed: int) -> None:
    samples = np.random.default_rng(seed).lognormal(
        mean=5.0, sigma=1.5, size=20_011
    )  # 20 011: no rank is whole, so none rounds
    histogram = Histogram()
    for us in samples:
        histogram.add(round(float(us) * 1e3))
    inside = np.round(samples * 1e3) * 1e-3
    for percent in (1, 10, 50, 90, 99, 99.9):
        exact_us = float(np.percentile(np.maximum(inside, 1.0), percent, method="inverted_cdf"))
        assert exact_us / HALF_A_BIN <= histogram.percentile(percent) <= exact_us * HALF_A_BIN
    assert histogram.count == 20_011
    assert histogram.max_us == float(inside.max())


def test_an_empty_histogram_knows_no_percentile() -> None:
    histogram = Histogram()
    assert isnan(histogram.percentile(50))
    assert (histogram.count, histogram.max_us) == (0, 0.0)


def test_one_duration_is_reported_exactly_where_the_bin_lies_above_it() -> None:
    histogram = Histogram()
    histogram.add(1001)
    assert histogram.percentile(50) == pytest.approx(1.001, rel=2.0**-50) == histogram.max_us


def test_what_lies_outside_the_bins_counts_in_the_outermost_and_the_maximum_stays_exact() -> None:
    histogram = Histogram()
    for nanoseconds in (0, 1, 999):
        histogram.add(nanoseconds)
    assert histogram.count == 3
    assert histogram.percentile(100) == histogram.max_us == pytest.approx(0.999, rel=2.0**-50)
    histogram.add(2**80)
    assert histogram.max_us == pytest.approx(2**80 * 1e-3, rel=2.0**-50)
    assert histogram.percentile(100) == pytest.approx(2.0**32, rel=0.022)  # the last bin's middle, half a bin wide


def test_a_histogram_is_of_fixed_size_however_long_it_runs() -> None:
    histogram = Histogram()

    def size() -> int:
        return sum(len(kept) if isinstance(kept, (list, dict)) else 1 for kept in vars(histogram).values())

    def fill() -> None:
        for i in range(20_000):
            histogram.add(1 << (i % 70))

    fill()
    before = size()
    fill()
    assert histogram.count == 40_000
    assert size() == before


def test_a_rolling_histogram_keeps_all_and_forgets_what_is_ten_windows_old() -> None:
    histogram = RollingHistogram()
    histogram.add(500_000)
    for _ in range(RollingHistogram.WINDOWS):
        histogram.turn()
        histogram.add(10_000)
    histogram.turn()
    assert (histogram.total.count, histogram.total.max_us) == (11, 500.0)
    assert (histogram.recent().count, histogram.recent().max_us) == (9, 10.0)


def test_loop_timing_measures_from_when_a_tick_was_due_and_leaves_the_start_out(fake: FakeTime) -> None:
    timing = LoopTiming(warm_up_ns=10 * PERIOD)
    for k in range(20):
        fake.now = START + k * PERIOD + 30_000
        timing.woke(START + k * PERIOD)
        fake.now += 100_000
        timing.done()
    fake.now = START + 10**10
    timing.turn()
    # The warm-up ends at 10 periods; ticks 10…19 began after it, and between ten beginnings lie nine periods.
    assert [h.total.count for h in (timing.wake, timing.busy, timing.period)] == [10, 10, 9]
    assert [h.total.max_us for h in (timing.wake, timing.busy, timing.period)] == [30.0, 100.0, PERIOD / 1000]


def test_the_warm_up_begins_with_the_first_tick_however_long_the_loop_waited_for_it(fake: FakeTime) -> None:
    timing = LoopTiming(warm_up_ns=10 * PERIOD)
    fake.now = START + 1000 * PERIOD
    timing.woke(START)
    timing.turn()
    assert timing.wake.total.count == 0


def test_a_pause_is_no_period(fake: FakeTime) -> None:
    timing = LoopTiming(warm_up_ns=0)
    timing.woke(START)
    timing.pause()
    fake.now = START + 1000 * PERIOD
    timing.woke(START + 1000 * PERIOD)
    timing.turn()
    assert timing.period.total.count == 0


def test_a_summary_is_that_of_the_histogram_in_tenths_of_a_microsecond() -> None:
    durations = Histogram()
    assert summary(durations) is None
    for us in range(1, 101):
        durations.add(us * 1000)
    percentiles = summary(durations)
    assert percentiles is not None
    assert (percentiles.count, percentiles.max) == (100, 100.0)
    assert percentiles.p50 == round(durations.percentile(50), 1)
    assert percentiles.p99 == round(durations.percentile(99), 1)
    assert percentiles.p50 < percentiles.p99
