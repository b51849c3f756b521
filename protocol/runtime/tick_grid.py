"""Tick grid: absolute deadlines on CLOCK_MONOTONIC.

A tick is due at `start + k·period`. After a stall the grid continues at the next deadline ahead and counts the missed
ticks; it never bursts to catch up, because a plant does not. The tick index is the law's time. The wall clock
only stamps logs.
"""

from __future__ import annotations

import time


class TickGrid:
    """Absolute deadlines at a fixed period.

    Args:
        period_ns: Period [ns].
        start_ns: When tick 0 is due, on `time.monotonic_ns()`; now if None.

    Attributes:
        tick: Index of the last tick waited for; −1 before the first.
        skipped: Ticks missed so far.
    """

    def __init__(self, period_ns: int, start_ns: int | None = None) -> None:
        self.period_ns = period_ns
        self.start_ns = time.monotonic_ns() if start_ns is None else start_ns
        self.tick = -1
        self.skipped = 0

    @property
    def due_ns(self) -> int:
        """When the last tick waited for was due, on `time.monotonic_ns()`."""
        return self.start_ns + self.tick * self.period_ns

    def wait(self) -> int:
        """Sleep until the next tick is due and return its index.

        A tick that is less than a period late is taken at once; after a longer stall, the next one ahead.
        """
        k = self.tick + 1
        now = time.monotonic_ns()
        late = now - self.start_ns - k * self.period_ns
        if late >= self.period_ns:
            missed = -(-late // self.period_ns)
            self.skipped += missed
            k += missed
        ahead = self.start_ns + k * self.period_ns - now
        if ahead > 0:
            time.sleep(ahead * 1e-9)
        self.tick = k
        return k
