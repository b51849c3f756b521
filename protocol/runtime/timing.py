"""Timing statistics of a loop: wake-up latency, tick duration and period, in histograms of fixed size."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from math import exp2, log2
from typing import Final

from aeroloop.protocol.messages.models import Percentiles, Timing

_BINS_PER_OCTAVE: Final = 16
_LONGEST_US: Final = 2.0**32 - 1  # over an hour, in the last bin
_SHORTEST_WINDOW_NS: Final = 900_000_000


class Histogram:
    """Durations in bins 4.4 % wide (16 an octave, from 1 µs): memory stays bounded."""

    def __init__(self) -> None:
        self._bins: dict[int, int] = {}
        self.max_us = 0.0

    @property
    def count(self) -> int:
        """Number of durations."""
        return sum(self._bins.values())

    def add(self, nanoseconds: int) -> None:
        """Count one duration [ns]; under 1 µs counts as 1 µs, over an hour as an hour."""
        us = nanoseconds * 1e-3
        i = int(log2(us if us < _LONGEST_US else _LONGEST_US) * _BINS_PER_OCTAVE) if us > 1.0 else 0
        self._bins[i] = self._bins.get(i, 0) + 1
        if us > self.max_us:
            self.max_us = us

    def merge(self, other: Histogram) -> None:
        """Add the counts of another histogram."""
        for i, n in other._bins.items():
            self._bins[i] = self._bins.get(i, 0) + n
        self.max_us = max(self.max_us, other.max_us)

    def percentile(self, percent: float) -> float:
        """The middle of the bin that holds this percentile [µs]; NaN if nothing was counted."""
        wanted = self.count * percent / 100
        seen = 0
        for i in sorted(self._bins):
            seen += self._bins[i]
            if seen >= wanted:
                return min(exp2((i + 0.5) / _BINS_PER_OCTAVE), self.max_us)
        return float("nan")


class RollingHistogram:
    """Histograms of all durations, and of those in the last ten seconds.

    Attributes:
        add: Counts one duration [ns]: `Histogram.add` of this window, without a Python function in between.
    """

    add: Callable[[int], None]

    WINDOWS: Final = 10

    def __init__(self) -> None:
        self.total = Histogram()
        self._windows: deque[Histogram] = deque([Histogram()], maxlen=self.WINDOWS)
        self._current = self._windows[0]
        self.add = self._current.add
        self._turned_at = 0

    def turn(self) -> None:
        """End a window."""
        self._turned_at = time.monotonic_ns()
        self.total.merge(self._current)
        self._current = Histogram()
        self.add = self._current.add
        self._windows.append(self._current)

    def turn_when_due(self) -> None:
        """End a one-second window, if it is over; called with every report."""
        if time.monotonic_ns() - self._turned_at >= _SHORTEST_WINDOW_NS:
            self.turn()

    def recent(self) -> Histogram:
        """The last ten windows."""
        merged = Histogram()
        for window in self._windows:
            merged.merge(window)
        return merged


class LoopTiming:
    """Timing of a loop: wake-up latency, duration of a tick, period between ticks.

    The first `warm_up_ns` [ns] of ticks are left out: caches are cold, and code and memory are used for the first time.
    """

    def __init__(self, warm_up_ns: int = 1_000_000_000) -> None:
        self.wake = RollingHistogram()
        self.busy = RollingHistogram()
        self.period = RollingHistogram()
        self._warm_up_ns = warm_up_ns
        self._warm_at: int | None = None
        self._woke_at = 0

    def woke(self, due_ns: int, woke_ns: int | None = None) -> None:
        """Count the start of a tick, due at `due_ns`, at `woke_ns`, now if None; on `time.monotonic_ns()`."""
        now = time.monotonic_ns() if woke_ns is None else woke_ns
        if self._warm_at is None:
            self._warm_at = now + self._warm_up_ns
        if now >= self._warm_at:
            self.wake.add(now - due_ns)
            if self._woke_at:
                self.period.add(now - self._woke_at)
            self._woke_at = now

    def done(self) -> None:
        """Count the end of the tick."""
        if self._woke_at:
            self.busy.add(time.monotonic_ns() - self._woke_at)

    def pause(self) -> None:
        """Pause: the time until the next tick is no period."""
        self._woke_at = 0

    def turn(self) -> None:
        """End a one-second window."""
        for histogram in (self.wake, self.busy, self.period):
            histogram.turn_when_due()


def summary(durations: Histogram) -> Percentiles | None:
    """Percentiles of a histogram; None if it is empty."""
    if not durations.count:
        return None
    return Percentiles(
        count=durations.count,
        p50=round(durations.percentile(50), 1),
        p99=round(durations.percentile(99), 1),
        p999=round(durations.percentile(99.9), 1),
        max=round(durations.max_us, 1),
    )


def report(timing: LoopTiming) -> Timing:
    """End a one-second window of a loop's timing, and return its percentiles."""
    timing.turn()
    return Timing(
        wake=summary(timing.wake.total),
        busy=summary(timing.busy.total),
        period=summary(timing.period.total),
        recent_wake=summary(timing.wake.recent()),
        recent_busy=summary(timing.busy.recent()),
        recent_period=summary(timing.period.recent()),
    )
