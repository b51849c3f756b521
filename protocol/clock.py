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
from collections import deque
from math import exp2, log2
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from protocol.errors import AeroloopError

WATCHDOG_S: Final = 0.1
"""0 V after this long without a fresh command [s], unless configured; as drives in the field do."""

FIRST_COMMAND_S: Final = 1.0
"""How long a granted claim may wait for its first command [s]."""

_BINS_PER_OCTAVE: Final = 16
_BINS: Final = 32 * _BINS_PER_OCTAVE  # 1 µs … 2^32 µs, over an hour
_PR_SET_TIMERSLACK: Final = 29
_SHORTEST_WINDOW_NS: Final = 900_000_000
_MCL_CURRENT: Final = 1
_MCL_FUTURE: Final = 2


class LoopSettings(BaseModel):
    """The grid that both ends keep."""

    model_config = ConfigDict(extra="forbid")

    rate_hz: float = Field(default=500.0, ge=1, le=10_000, description="ticks a second [Hz]")
    lockstep: bool = Field(
        default=False, description="the plant waits for each answer before it steps: repeatable, and as fast as it goes"
    )

    realtime: Literal["strict", "try", "off"] = Field(
        default="try",
        description="ask for SCHED_FIFO, locked memory, affinity; strict: refuse to run without; off: do not ask",
    )
    priority: int = Field(default=10, ge=1, le=99, description="SCHED_FIFO priority")
    cpus: list[int] = Field(default=[], description="CPUs to run on; all if empty")
    trace_s: float = Field(
        default=0.1, ge=0.01, le=10, description="publish what was done tick by tick this often, for the log [s]"
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

    @property
    def due_ns(self) -> int:
        """When the last tick waited for was due, on `time.monotonic_ns()`."""
        return self.start_ns + self.tick * self.period_ns

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
        self._bins: dict[int, int] = {}
        self.count = 0
        self.max_us = 0.0

    def add(self, nanoseconds: int) -> None:
        """Count one duration [ns]; under 1 µs counts as 1 µs, over an hour as an hour."""
        us = nanoseconds * 1e-3
        i = min(int(log2(us) * _BINS_PER_OCTAVE), _BINS - 1) if us > 1.0 else 0
        self._bins[i] = self._bins.get(i, 0) + 1
        self.count += 1
        if us > self.max_us:
            self.max_us = us

    def merge(self, other: Histogram) -> None:
        """Count all that another has counted."""
        for i, n in other._bins.items():
            self._bins[i] = self._bins.get(i, 0) + n
        self.count += other.count
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
    """A histogram of all durations, and one of those of the last ten seconds."""

    WINDOWS: Final = 10

    def __init__(self) -> None:
        self.total = Histogram()
        self._windows: deque[Histogram] = deque([Histogram()], maxlen=self.WINDOWS)
        self._current = self._windows[0]
        self._turned_at = 0

    def add(self, nanoseconds: int) -> None:
        """Count one duration [ns]."""
        self._current.add(nanoseconds)

    def turn(self) -> None:
        """End a window."""
        self._turned_at = time.monotonic_ns()
        self.total.merge(self._current)
        self._current = Histogram()
        self._windows.append(self._current)

    def turn_when_due(self) -> None:
        """End a one-second window; called by whoever reports. A report that comes sooner ends none."""
        if time.monotonic_ns() - self._turned_at >= _SHORTEST_WINDOW_NS:
            self.turn()

    def recent(self) -> Histogram:
        """The last ten windows."""
        merged = Histogram()
        for window in self._windows:
            merged.merge(window)
        return merged


class LoopTiming:
    """How well a loop keeps time: wake-up latency, time a tick takes, period between ticks.

    The first second is left out: caches are cold, and code runs for the first time.

    Args:
        warm_up_ns: What counts as start-up [ns].
    """

    def __init__(self, warm_up_ns: int = 1_000_000_000) -> None:
        self.wake = RollingHistogram()
        self.busy = RollingHistogram()
        self.period = RollingHistogram()
        self._warm_at = time.monotonic_ns() + warm_up_ns
        self._woke_at = 0

    def woke(self, due_ns: int) -> None:
        """A tick begins that was due at `due_ns` on `time.monotonic_ns()`."""
        now = time.monotonic_ns()
        if now >= self._warm_at:
            self.wake.add(now - due_ns)
            if self._woke_at:
                self.period.add(now - self._woke_at)
            self._woke_at = now

    def done(self) -> None:
        """The tick is over."""
        if self._woke_at:
            self.busy.add(time.monotonic_ns() - self._woke_at)

    def pause(self) -> None:
        """No ticks for a while: the time until the next is no period."""
        self._woke_at = 0

    def turn(self) -> None:
        """End a one-second window."""
        for histogram in (self.wake, self.busy, self.period):
            histogram.turn_when_due()


class Throttle:
    """Lets one of each kind pass in a while, and counts what it holds back.

    Args:
        period_s: How long the next of a kind is held back [s].
    """

    MAX_KINDS: Final = 1000

    def __init__(self, period_s: float = 10.0) -> None:
        self.period_s = period_s
        self._passed: dict[str, tuple[float, int]] = {}

    def let_pass(self, kind: str) -> int | None:
        """None if it is to be held back; else how many were since the last that passed."""
        now = time.monotonic()
        at, held_back = self._passed.get(kind, (-self.period_s, 0))
        if now - at < self.period_s:
            self._passed[kind] = at, held_back + 1
            return None
        if len(self._passed) >= self.MAX_KINDS:
            self._passed.clear()
        self._passed[kind] = now, 0
        return held_back


class RealtimeError(AeroloopError):
    """`loop.realtime = "strict"`, and this machine refused something; one line that names it."""


def prepare_process(settings: LoopSettings) -> list[str]:
    """Make this process fit for a timed loop, and say what was refused.

    The garbage collector is switched off (the loop makes no cycles), the timer slack set to its least, memory locked,
    the process bound to `cpus`, SCHED_FIFO asked for.

    Returns:
        One line for each thing that this machine refused; nothing is asked for with `realtime = "off"`.

    Raises:
        RealtimeError: Something was refused, and `realtime` is strict.
    """
    if settings.realtime == "off":
        return []
    gc.collect()
    gc.freeze()
    gc.disable()
    refused = []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0):
        refused.append("timer slack stays at the system's default")
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        refused.append(f"memory lock: {os.strerror(ctypes.get_errno())} (raise LimitMEMLOCK)")
    try:
        # Every thread: what carries the frames must not wait for other work any more than the loop itself.
        for thread in os.listdir("/proc/self/task"):
            if settings.cpus:
                os.sched_setaffinity(int(thread), settings.cpus)
    except OSError as error:
        refused.append(f"affinity to CPUs {settings.cpus}: {error.strerror}")
    try:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(settings.priority))
    except OSError as error:
        refused.append(f"SCHED_FIFO {settings.priority}: {error.strerror} (raise LimitRTPRIO)")
    if refused and settings.realtime == "strict":
        raise RealtimeError(f"loop.realtime is strict, but this machine refuses: {'; '.join(refused)}")
    return refused
