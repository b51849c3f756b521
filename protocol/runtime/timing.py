"""Timing of a loop: clock, grid of deadlines, limit of repeated messages, histograms of durations.

CLOCK_MONOTONIC paces everything; the wall clock only stamps logs, and the tick index is the law's time.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterable
from itertools import accumulate
from math import exp2, log2
from typing import Final, Protocol

from aeroloop.protocol.messages.models import LATENCY_BOUNDS_US, LatencyCounts, Percentiles, Timing


class Clock(Protocol):
    """What a loop needs of the module `time`, which is the real clock: seconds, nanoseconds, ns since 1970.

    `thread_time` is the calling thread's time on a CPU [s], which does not pass while the thread waits or is halted.
    """

    def monotonic(self) -> float: ...  # noqa: D102
    def monotonic_ns(self) -> int: ...  # noqa: D102
    def time_ns(self) -> int: ...  # noqa: D102
    def thread_time(self) -> float: ...  # noqa: D102
    def sleep(self, seconds: float, /) -> None: ...  # noqa: D102


class TickGrid:
    """Absolute deadlines: tick k is due at `start_ns + k·period_ns`, on `Clock.monotonic_ns`.

    `tick` is the index of the last tick waited for, −1 before the first; `skipped` counts missed ticks.
    """

    def __init__(self, period_ns: int, start_ns: int | None = None, clock: Clock = time) -> None:
        self._clock = clock
        self.period_ns = period_ns
        self.start_ns = clock.monotonic_ns() if start_ns is None else start_ns
        self.tick = -1
        self.skipped = 0

    @property
    def due_ns(self) -> int:
        """When the last tick waited for was due."""
        return self.start_ns + self.tick * self.period_ns

    def wait(self) -> int:
        """Sleep until the next tick is due and return its index.

        A tick that is less than a period late is taken at once. After a longer stall it is the next one ahead: the grid
        never bursts to catch up, because a plant does not.
        """
        self.tick += 1
        now_ns = self._clock.monotonic_ns()
        late_ns = now_ns - self.due_ns
        if late_ns >= self.period_ns:
            missed = -(-late_ns // self.period_ns)
            self.skipped += missed
            self.tick += missed
        if self.due_ns > now_ns:
            self._clock.sleep((self.due_ns - now_ns) * 1e-9)
        return self.tick


class Throttle:
    """Passes one message of each kind per `period_s` [s], and counts those it holds back."""

    MAX_KINDS: Final = 1000

    def __init__(self, period_s: float = 10.0, clock: Clock = time) -> None:
        self.period_s = period_s
        self._clock = clock
        self._passed: dict[str, tuple[float, int]] = {}

    def let_pass(self, kind: str) -> int | None:
        """None if the message is held back; else the number held back since the last one passed."""
        now = self._clock.monotonic()
        at, held_back = self._passed.get(kind, (-self.period_s, 0))
        if now - at < self.period_s:
            self._passed[kind] = at, held_back + 1
            return None
        if len(self._passed) >= self.MAX_KINDS:
            self._passed.clear()
        self._passed[kind] = now, 0
        return held_back


class Histogram:
    """Durations in bins 4.4 % wide (16 an octave, from 1 µs): memory stays bounded."""

    PER_OCTAVE: Final = 16

    def __init__(self, parts: Iterable[Histogram] = ()) -> None:
        self._bins: Counter[int] = Counter()
        self.max_us = 0.0
        for part in parts:
            self._bins.update(part._bins)
            self.max_us = max(self.max_us, part.max_us)

    def add(self, nanoseconds: int) -> None:
        """Count one duration [ns]; under 1 µs counts as 1 µs."""
        us = nanoseconds * 1e-3
        self._bins[int(log2(max(us, 1.0)) * self.PER_OCTAVE)] += 1
        self.max_us = max(self.max_us, us)

    def percentile(self, percent: float) -> float:
        """The middle of the bin that holds this percentile [µs]; NaN if nothing was counted."""
        bins = sorted(self._bins.items())
        wanted = self._bins.total() * percent / 100
        for (i, _), seen in zip(bins, accumulate(n for _, n in bins), strict=True):
            if seen >= wanted:
                return min(exp2((i + 0.5) / self.PER_OCTAVE), self.max_us)
        return float("nan")

    def summary(self) -> Percentiles | None:
        """Percentiles for a status; None if nothing was counted."""
        if not self._bins:
            return None
        found = {name: round(self.percentile(at), 1) for name, at in (("p50", 50), ("p99", 99), ("p999", 99.9))}
        return Percentiles(count=self._bins.total(), max=round(self.max_us, 1), **found)


class RollingHistogram:
    """Histograms of all durations, `total`, and of those in the last ten seconds, in windows of a second."""

    WINDOWS: Final = 10
    SHORTEST_NS: Final = 900_000_000

    def __init__(self, clock: Clock = time) -> None:
        self.total = Histogram()
        self._clock = clock
        self._windows = deque([Histogram()], maxlen=self.WINDOWS)
        self._turned_ns = 0

    def add(self, nanoseconds: int) -> None:
        """Count one duration [ns]."""
        self.total.add(nanoseconds)
        self._windows[-1].add(nanoseconds)

    def recent(self) -> Percentiles | None:
        """Percentiles of the last ten windows; ends the newest one if it is a second old. Called with every status."""
        if (now_ns := self._clock.monotonic_ns()) - self._turned_ns >= self.SHORTEST_NS:
            self._turned_ns = now_ns
            self._windows.append(Histogram())
        return Histogram(self._windows).summary()


class LatencyHistogram:
    """Latencies since start-up, counted between the bounds of `LatencyCounts`."""

    BOUNDS_NS: Final = tuple(1000 * bound for bound in LATENCY_BOUNDS_US)

    def __init__(self) -> None:
        self._between = [0] * (len(self.BOUNDS_NS) + 1)
        self._sum_ns = 0

    def add(self, nanoseconds: int) -> None:
        """Count one latency [ns]."""
        self._between[bisect_left(self.BOUNDS_NS, nanoseconds)] += 1
        self._sum_ns += nanoseconds

    def report(self) -> LatencyCounts:
        """The counts up to each bound."""
        return LatencyCounts(counts=list(accumulate(self._between)), sum_us=self._sum_ns * 1e-3)


class LoopTiming:
    """Timing of a loop: wake-up latency, duration of a tick, period between ticks.

    The first `warm_up_ns` [ns] of ticks are left out: caches are cold, and code and memory are used for the first time.
    """

    def __init__(self, warm_up_ns: int = 1_000_000_000, clock: Clock = time) -> None:
        self.wake, self.busy, self.period = (RollingHistogram(clock) for _ in range(3))
        self._clock = clock
        self._warm_up_ns = warm_up_ns
        self._warm_at: int | None = None
        self._woke_at = 0

    def woke(self, due_ns: int, woke_ns: int | None = None) -> None:
        """Count the start of a tick, due at `due_ns`, at `woke_ns`, now if None; on `Clock.monotonic_ns`."""
        now = self._clock.monotonic_ns() if woke_ns is None else woke_ns
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
            self.busy.add(self._clock.monotonic_ns() - self._woke_at)

    def pause(self) -> None:
        """Pause: the time until the next tick is no period."""
        self._woke_at = 0

    def report(self) -> Timing:
        """All percentiles."""
        each = {"wake": self.wake, "busy": self.busy, "period": self.period}
        recent = {f"recent_{name}": durations.recent() for name, durations in each.items()}
        return Timing(**{name: durations.total.summary() for name, durations in each.items()}, **recent)
