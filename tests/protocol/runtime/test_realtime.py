"""Real time: a process that is ready before its first tick, its tick grid, and what it measures."""

from __future__ import annotations

import json
import platform
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import LATENCY_BOUNDS_US
from aeroloop.protocol.runtime.timing import (
    Histogram,
    LatencyHistogram,
    LoopTiming,
    RollingHistogram,
    Throttle,
    TickGrid,
)
from tests.support.clock import FakeClock

PREPARED = """
import ctypes, gc, json, mmap, os
from aeroloop.protocol.runtime.realtime import RealtimeError, prepare_process
from aeroloop.protocol.wire.spec import LoopSettings

def kilobytes(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))

asked = prepare_process(LoopSettings(realtime="off")), gc.isenabled()
refused = prepare_process(LoopSettings())
slack = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)  # PR_GET_TIMERSLACK [ns]
before = kilobytes("VmRSS")
untouched = mmap.mmap(-1, 64 << 20)
memory = [kilobytes("VmLck"), kilobytes("VmRSS") - before]
realtime = os.sched_getscheduler(0) == os.SCHED_FIFO
awake = "/dev/cpu_dma_latency" in [os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")]
try:
    prepare_process(LoopSettings(realtime="strict"))
    strict = ""
except RealtimeError as error:
    strict = str(error)
print(json.dumps([asked, refused, gc.isenabled(), gc.get_freeze_count(), slack, realtime, memory, awake, strict]))
"""


def test_a_prepared_process_is_as_it_reports() -> None:
    # In a process of its own: collector and scheduler are the process's, and pytest needs its own as they are.
    done = subprocess.run([sys.executable, "-c", PREPARED], capture_output=True, text=True, timeout=60, check=True)
    asked, refused, collects, frozen, slack, fifo, (locked_kb, grown_kb), awake, strict = json.loads(done.stdout)
    assert asked == [[], True]  # off: nothing is requested
    assert not collects
    assert frozen > 0
    reported = "\n".join(refused)
    assert ("timer slack" in reported) == (slack > 1)  # a real-time process may be shown 0
    assert ("SCHED_FIFO" in reported) == (not fifo)
    assert ("memory lock" in reported) == (locked_kb == 0)
    assert grown_kb < 32 << 10  # half of what was mapped and not touched: locked, but not resident
    assert ("idle CPUs sleep" in reported) == (not awake)
    grave = [line for line in refused if "idle CPUs sleep" not in line]  # a strict process starts without those
    assert len(refused) == (slack > 1) + (not fifo) + (locked_kb == 0) + (not awake)
    assert strict == (f"loop.realtime is strict, but this machine refuses: {'; '.join(grave)}" if grave else "")


LINGERING = """
import socket, struct, threading
from aeroloop.protocol.runtime.realtime import no_linger

def lingers():
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        one.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        others = one.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE), one.getsockopt(socket.IPPROTO_TCP, 1)
        print(struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0], *others)

lingers()
print(no_linger())
lingers()
thread = threading.Thread(target=lingers)
thread.start()
thread.join()
"""


ENDED_THREAD = """
import os
from aeroloop.protocol.runtime import realtime
from aeroloop.protocol.wire.spec import LoopSettings

there, asked = os.listdir("/proc/self/task"), []
os.listdir = lambda path: ["999999999", *there]  # the first has ended since

def ask(thread, *_):
    asked.append(thread)
    if thread == 999999999:
        raise ProcessLookupError(3, "No such process")

os.sched_setaffinity = os.sched_setscheduler = ask
refused = realtime.prepare_process(LoopSettings(cpus=[0]))
assert not any("No such process" in line for line in refused), refused
assert asked == 2 * [999999999, *map(int, there)], asked
"""


def test_a_thread_that_ends_meanwhile_leaves_the_others_their_settings() -> None:
    subprocess.run([sys.executable, "-c", ENDED_THREAD], timeout=60, check=True)


@pytest.mark.skipif(
    (platform.system(), platform.machine()) not in {("Linux", "x86_64"), ("Linux", "aarch64")},
    reason="other systems have no such filter",
)
@pytest.mark.processes
def test_no_socket_lingers_and_every_other_option_is_set() -> None:
    """In a process of its own: the filter cannot be taken off."""
    done = subprocess.run([sys.executable, "-c", LINGERING], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["1 1 1", "None", "0 1 1", "0 1 1"]


# ── tick grid, throttle and histograms: absolute ticks without drift or bursts, durations exact to their bins ──


START = 123_456_789_012_345
PERIOD = 2_000_000


@pytest.mark.parametrize(
    ("stall_ns", "tick", "skipped", "waits"),
    [
        (2 * PERIOD - 1, 1, 0, False),  # late by less than a period: taken at once
        (10 * PERIOD, 10, 9, False),  # ticks 1…9 are past, and 10 is due now
        (4 * PERIOD + 900_000, 5, 4, True),  # "at the next deadline ahead", SPEC.md, section 6
    ],
)
def test_what_a_stall_misses_is_counted_and_not_made_up_for(
    stall_ns: int, tick: int, skipped: int, waits: bool
) -> None:
    clock = FakeClock(START)
    grid = TickGrid(PERIOD, clock=clock)
    grid.wait()
    clock.now_ns += stall_ns
    assert grid.wait() == tick
    assert (bool(clock.slept), grid.skipped) == (waits, skipped)
    assert grid.wait() == tick + 1
    assert (clock.now_ns, grid.skipped) == (START + (tick + 1) * PERIOD, skipped)


@settings(max_examples=80)
@given(
    work=st.lists(st.integers(0, PERIOD // 2) | st.integers(0, 20 * PERIOD), min_size=1, max_size=100),
    oversleep=st.integers(0, 200_000),
    period=st.integers(PERIOD, 10 * PERIOD),
)
def test_deadlines_are_absolute_never_burst_and_every_tick_is_taken_or_counted(
    work: list[int], oversleep: int, period: int
) -> None:
    clock, last = FakeClock(START), -1
    clock.oversleep_ns = oversleep
    grid = TickGrid(period, clock=clock)
    for n, busy in enumerate(work, start=1):
        clock.slept.clear()
        k, late = grid.wait(), clock.now_ns - START - grid.tick * period
        assert grid.tick == k > last
        assert k + 1 == n + grid.skipped
        assert late == oversleep if clock.slept else 0 <= late < period
        clock.now_ns += busy
        last = k


def test_a_tick_that_is_a_whole_period_late_is_skipped_and_the_next_one_is_due_now() -> None:
    clock = FakeClock()
    grid = TickGrid(PERIOD, clock=clock)
    grid.wait()
    clock.now_ns += 2 * PERIOD  # tick 1 was due a period ago, and tick 2 is due now
    assert (grid.wait(), grid.skipped, clock.slept) == (2, 1, [])


def test_the_first_of_a_kind_passes_and_what_follows_is_held_back_and_counted() -> None:
    clock = FakeClock(0)  # a machine that has just started
    throttle = Throttle(10.0, clock)
    assert throttle.let_pass("stall") == 0
    for _ in range(7):
        clock.advance(1.0)
        assert throttle.let_pass("stall") is None
    assert throttle.let_pass("set-point") == 0  # of another kind
    clock.advance(2.75)
    assert throttle.let_pass("stall") is None
    clock.advance(0.25)
    assert throttle.let_pass("stall") == 8  # what was held back did not put it off
    assert throttle.let_pass("stall") is None
    assert throttle.let_pass("set-point") is None
    clock.advance(10.0)
    assert throttle.let_pass("stall") == 1  # counted anew
    for i in range(Throttle.MAX_KINDS):
        throttle.let_pass(f"from {i}")
    assert throttle.let_pass("stall") == 0  # forgotten with all others: it remembers a bounded number of kinds


HALF_A_BIN = 2 ** (1 / 32) * (1 + 1e-9)
"""The middle of a bin is at most half a bin, 2.2 %, from whatever is in it; 1e-9 for rounding at its edge."""


@settings(max_examples=80)
@given(st.lists(st.integers(0, 3_600_000_000_000), min_size=1, max_size=60), st.floats(0, 100))
@example([1001], 50.0)
@example([round(us * 1e3) for us in np.random.default_rng(0).lognormal(5.0, 1.5, 2011)], 99.9)
def test_a_percentile_is_within_half_a_bin_and_the_maximum_exact(durations_ns: list[int], percent: float) -> None:
    """What is below the first bin, 1 µs, counts in it."""
    histogram = Histogram()
    for duration_ns in durations_ns:
        histogram.add(duration_ns)
    ordered_us = np.sort(durations_ns) * 1e-3
    rank = max(int(np.ceil(len(ordered_us) * percent / 100)), 1)  # the least that this part of all does not exceed
    exact_us = max(float(ordered_us[rank - 1]), 1.0)
    assert histogram.percentile(percent) <= exact_us * HALF_A_BIN
    assert histogram.percentile(percent) >= min(exact_us / HALF_A_BIN, histogram.max_us)
    assert histogram.percentile(percent) <= histogram.max_us == ordered_us[-1]
    summary = histogram.summary()
    assert summary
    assert summary.count == len(durations_ns)


@given(st.lists(st.integers(0, 200_000_000) | st.sampled_from([1000 * bound for bound in LATENCY_BOUNDS_US])))
def test_latencies_are_counted_up_to_each_bound_and_summed(latencies_ns: list[int]) -> None:
    histogram = LatencyHistogram()
    for latency_ns in latencies_ns:
        histogram.add(latency_ns)
    report = histogram.report()
    expected = [sum(each <= 1000 * bound for each in latencies_ns) for bound in LATENCY_BOUNDS_US]
    assert report.counts == [*expected, len(latencies_ns)]
    assert report.sum_us == pytest.approx(sum(latencies_ns) * 1e-3)


def test_a_rolling_histogram_keeps_all_and_forgets_what_is_ten_seconds_old() -> None:
    clock = FakeClock()
    histogram = RollingHistogram(clock)
    histogram.add(500_000)
    for _ in range(RollingHistogram.WINDOWS):
        clock.advance(1.0)
        histogram.recent()
        histogram.recent()  # a report too many in the same second
        histogram.add(10_000)
    assert [(each.count, each.max) for each in (histogram.total.summary(), histogram.recent()) if each] == [
        (11, 500.0), (10, 10.0)
    ]  # fmt: skip


def test_loop_timing_measures_from_when_a_tick_was_due_and_leaves_the_start_out() -> None:
    clock = FakeClock(START)
    timing = LoopTiming(10 * PERIOD, clock)
    for k in range(20):
        clock.now_ns = START + k * PERIOD + 30_000
        timing.woke(START + k * PERIOD)
        clock.now_ns += 100_000
        timing.done()
    timing.pause()  # the time until the next tick is no period
    clock.now_ns += 1000 * PERIOD
    timing.woke(clock.now_ns)
    # The warm-up ends at 10 periods; ticks 10…19 began after it, and between ten beginnings lie nine periods.
    found = timing.report()
    assert [(each.count, each.max) for each in (found.wake, found.busy, found.period) if each] == [
        (11, 30.0), (10, 100.0), (9, PERIOD / 1000)
    ]  # fmt: skip
    assert found.recent_period == found.period
