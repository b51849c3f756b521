"""Wake-up: lateness of a loop on the tick grid, against cyclictest at the same rate and priority, in turns.

Ours is a process prepared as a daemon is, which waits on `TickGrid` and measures with `LoopTiming`. Without cyclictest
(Debian's rt-tests), or where it may not have real-time priority, the floor is the shortest loop in Python: the system
call clock_nanosleep to an absolute time, in a process prepared in the same way.

A virtual machine loses its CPUs for milliseconds now and then. So turns are short, and the p99.9 that is reported is
the median over the turns.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from statistics import median
from typing import Final, NamedTuple

from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.runtime.tick_grid import TickGrid
from aeroloop.protocol.runtime.timing import Histogram, LoopTiming
from aeroloop.protocol.wire.loop import LoopSettings

AIM: Final = 1.5
"""Largest ratio of our p99.9 to the floor's."""
PERCENT: Final = 99.9
CYCLICTEST: Final = "cyclictest"
OWN_FLOOR: Final = "clock_nanosleep"

_WARM_UP_S: Final = 0.25
_LONGEST_US: Final = 50_000
"""Length of cyclictest's histogram; what is later counts as this."""
_TIMER_ABSTIME: Final = 1


class Plan(NamedTuple):
    """How long to measure: at each rate, idle and loaded, so many turns of so many seconds for ours and the floor."""

    rates_hz: tuple[float, ...]
    turns: int
    seconds: float


FULL: Final = Plan(rates_hz=(500.0, 1000.0), turns=5, seconds=3.0)
QUICK: Final = Plan(rates_hz=(1000.0,), turns=3, seconds=1.5)


class WakeUp(NamedTuple):
    """One comparison.

    Attributes:
        rate_hz: Rate of the grid [Hz].
        loaded: Whether a busy process of normal priority ran on every core.
        ours_us: p99.9 of our lateness [µs].
        floor_us: p99.9 of the floor's [µs].
        floor: CYCLICTEST or OWN_FLOOR.
    """

    rate_hz: float
    loaded: bool
    ours_us: float
    floor_us: float
    floor: str


def measure(*, quick: bool = False) -> Iterator[WakeUp]:
    """Compare at each rate, idle and loaded. A comparison takes half a minute, or 10 s if `quick`."""
    plan = QUICK if quick else FULL
    for rate_hz in plan.rates_hz:
        for loaded in (False, True):
            yield _compare(LoopSettings(rate_hz=rate_hz), loaded, plan)


def _compare(loop: LoopSettings, loaded: bool, plan: Plan) -> WakeUp:
    name, floor = (
        (OWN_FLOOR, _in_a_process(nanosleep_us)) if cyclictest_us(loop, 0.1) is None else (CYCLICTEST, cyclictest_us)
    )
    ours = _in_a_process(grid_us)
    found: list[tuple[float, float]] = []
    for _ in range(plan.turns):
        with _busy(os.cpu_count() or 1 if loaded else 0, 3 * plan.seconds + 10):
            found.append((ours(loop, plan.seconds), floor(loop, plan.seconds) or float("nan")))
    ours_us, floor_us = (median(each) for each in zip(*found, strict=True))
    return WakeUp(loop.rate_hz, loaded, ours_us, floor_us, name)


def grid_us(loop: LoopSettings, seconds: float) -> float:
    """p99.9 of the lateness of a loop on the grid [µs]; makes this process a real-time one."""
    prepare_process(loop)
    timing, grid = LoopTiming(round(_WARM_UP_S * 1e9)), TickGrid(loop.period_ns)
    for _ in range(loop.ticks(_WARM_UP_S + seconds)):
        grid.wait()
        timing.woke(grid.due_ns)
    timing.wake.turn()
    return timing.wake.total.percentile(PERCENT)


def nanosleep_us(loop: LoopSettings, seconds: float) -> float:
    """As `grid_us`, of a loop that only calls clock_nanosleep with absolute deadlines."""
    prepare_process(loop)
    sleep, until, late = ctypes.CDLL(None).clock_nanosleep, _Timespec(), Histogram()
    due, last_warm_up = time.monotonic_ns(), loop.ticks(_WARM_UP_S)
    for k in range(loop.ticks(_WARM_UP_S + seconds)):
        due += loop.period_ns
        until.seconds, until.nanoseconds = divmod(due, 1_000_000_000)
        sleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)
        now = time.monotonic_ns()
        if k > last_warm_up:
            late.add(now - due)
        due += (now - due) // loop.period_ns * loop.period_ns  # a stall is one late wake-up, as on the grid
    return late.percentile(PERCENT)


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def cyclictest_us(loop: LoopSettings, seconds: float) -> float | None:
    """p99.9 of cyclictest's lateness [µs]; None where it is not installed, or may not have real-time priority."""
    program = shutil.which(CYCLICTEST)
    if program is None:
        return None
    interval_us, loops = round(loop.period_ns / 1000), max(1, loop.ticks(seconds))
    options = f"--quiet --mlockall --priority={loop.priority} --interval={interval_us} --loops={loops}"
    done = subprocess.run(
        [program, *options.split(), f"--histogram={_LONGEST_US}"], capture_output=True, text=True, check=False
    )
    return None if done.returncode else percentile_of_cyclictest(done.stdout, PERCENT)


def percentile_of_cyclictest(output: str, percent: float) -> float | None:
    """A percentile [µs] of the histogram that cyclictest prints, a line `lateness count` each; None if it is empty."""
    rows = [tuple(map(int, line.split()[:2])) for line in output.splitlines() if line[:1].isdigit()]
    overflows = [int(line.split()[-1]) for line in output.splitlines() if line.startswith("# Histogram Overflows:")]
    wanted = (sum(count for _, count in rows) + sum(overflows)) * percent / 100
    seen = 0
    for us, count in rows:
        seen += count
        if count and seen >= wanted:
            return float(us)
    return float(len(rows)) if any(overflows) else None


def _in_a_process(work: Callable[[LoopSettings, float], float]) -> Callable[[LoopSettings, float], float]:
    """The function, run in a new process, which becomes a real-time one; this process does not."""

    def run(loop: LoopSettings, seconds: float) -> float:
        with ProcessPoolExecutor(
            1,
            mp_context=get_context("spawn"),
            initializer=signal.signal,
            initargs=(signal.SIGINT, signal.SIG_IGN),  # ^C is this process's
        ) as child:
            return child.submit(work, loop, seconds).result()

    return run


@contextmanager
def _busy(processes: int, longest_s: float) -> Iterator[None]:
    """So many busy processes of normal priority, which end by themselves should this process be killed."""
    code = f"import time\nend = time.monotonic() + {longest_s}\nwhile time.monotonic() < end: pass"
    started = [subprocess.Popen([sys.executable, "-S", "-c", code]) for _ in range(processes)]
    try:
        yield
    finally:
        for each in started:
            each.kill()
            each.wait()
