"""Time as both ends keep it: a grid of absolute deadlines on CLOCK_MONOTONIC.

A tick is due at `start + k·period`. After a stall the grid goes on at the next tick that is still ahead and counts what
it missed; it never bursts to catch up, because a plant does not. The tick index is the law's time. The wall clock only
stamps logs.
"""

from __future__ import annotations

import ctypes
import gc
import os
import time
from math import exp2, log2
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

WATCHDOG_S: Final = 0.1
"""0 V after this long without a fresh command [s], unless configured; as drives in the field do."""

FIRST_COMMAND_S: Final = 1.0
"""How long a granted claim may wait for its first command [s]."""

_BINS_PER_OCTAVE: Final = 16
_BINS: Final = 32 * _BINS_PER_OCTAVE  # 1 µs … 2^32 µs, over an hour
_PR_SET_TIMERSLACK: Final = 29


class LoopSettings(BaseModel):
    """The grid that both ends keep."""

    model_config = ConfigDict(extra="forbid")

    rate_hz: float = Field(default=500.0, ge=1, le=10_000, description="ticks a second [Hz]")
    lockstep: bool = Field(
        default=False, description="the plant waits for each answer before it steps: repeatable, and as fast as it goes"
    )

    @property
    def period_ns(self) -> int:
        """Period of the grid [ns]."""
        return round(1e9 / self.rate_hz)

    @property
    def period(self) -> float:
        """Period of the grid [s]: the law's time step."""
        return self.period_ns * 1e-9

    def ticks(self, seconds: float) -> int:
        """How many ticks make up this time, rounded."""
        return round(seconds * 1e9 / self.period_ns)


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

    def wait(self) -> int:
        """Sleep until the next tick is due and return its index.

        A tick that is a little late is taken at once; after a stall of a period or more, the next one still ahead.
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


class Histogram:
    """Durations in bins 4.4 % wide (16 an octave, from 1 µs): of fixed size, however long it runs."""

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count = 0
        self.max_us = 0.0

    def add(self, nanoseconds: int) -> None:
        """Count one duration [ns]; under 1 µs counts as 1 µs."""
        us = nanoseconds * 1e-3
        self._bins[min(int(log2(us) * _BINS_PER_OCTAVE), _BINS - 1) if us > 1.0 else 0] += 1
        self.count += 1
        if us > self.max_us:
            self.max_us = us

    def percentile(self, percent: float) -> float:
        """The middle of the bin that holds this percentile [µs]; NaN if nothing was counted."""
        wanted = self.count * percent / 100
        seen = 0
        for i, n in enumerate(self._bins):
            seen += n
            if n and seen >= wanted:
                return min(exp2((i + 0.5) / _BINS_PER_OCTAVE), self.max_us)
        return float("nan")


def prepare_process() -> list[str]:
    """Make this process fit for a timed loop, and say what was refused.

    The garbage collector is switched off (the loop makes no cycles), the timer slack set to its least, SCHED_FIFO
    asked for. Returns one line for each thing that this machine refused.
    """
    refused = []
    gc.collect()
    gc.freeze()
    gc.disable()
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0):
        refused.append("timer slack stays at the system's default")
    try:
        # Every thread: what carries the frames must not wait for other work any more than the loop itself.
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(10))
    except OSError as error:
        refused.append(f"SCHED_FIFO: {error.strerror}")
    return refused
