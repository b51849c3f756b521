"""Every item of the bench, with its aim and the margin of a comparison."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final

from aeroloop.service.bench.experiments import burden, experiment, tables
from aeroloop.service.bench.item import Figure, Item, Margin, NotMeasuredError
from aeroloop.service.bench.loop import latency, lockstep
from aeroloop.service.bench.start_up import start_experiment, start_help, start_status
from aeroloop.service.bench.tick import tick
from aeroloop.service.bench.wake_up import AIM as WAKE_UP_AIM
from aeroloop.service.bench.wake_up import CYCLICTEST, WakeUp, measure

PROCESSOR: Final = Margin(1.5, "processor time in turns repeats to 10 %, between machines to 30 %")
MEDIAN: Final = Margin(2.0, "a median of waiting repeats to 30 %; other work on shared cores doubles it")
TAIL: Final = Margin(5.0, "a stolen millisecond of a shared core is in the last percent of either side")
MEMORY: Final = Margin(1.15, "resident memory repeats to 2 %; kernels and libraries differ in what they map")
FAULTS: Final = Margin(1.0, "a page that is first touched late", slack=0.01)


@cache
def _wake_ups(quick: bool) -> dict[tuple[float, bool], WakeUp]:
    return {(found.rate_hz, found.loaded): found for found in measure(quick=quick)}


def _wake_up(rate_hz: float, loaded: bool) -> Callable[[bool], Figure]:
    def measured(quick: bool) -> Figure:
        found = _wake_ups(quick)[rate_hz, loaded]
        if found.floor != CYCLICTEST:
            beside = f"beside {found.floor} the ratio is {found.ours_us / found.floor_us:.2f}"
            raise NotMeasuredError(f"no cyclictest (Debian's rt-tests) with real-time priority; {beside}")
        return Figure(found.ours_us, found.floor_us)

    return measured


ITEMS: Final = (
    Item("tick", "µs", 1.6, PROCESSOR, tick, "a tick of the controller; bitstruct and bare calls of CasADi"),
    Item("loop-tcp-p50", "µs", 1.15, MEDIAN, lambda quick: latency("tcp", quick).p50, "the loop; bare Zenoh, by TCP"),
    Item("loop-tcp-p99", "µs", 1.5, TAIL, lambda quick: latency("tcp", quick).p99, "the same"),
    Item(
        "loop-unix-p50", "µs", 1.15, MEDIAN, lambda quick: latency("unix", quick).p50, "over a Unix socket", quick=False
    ),
    Item("loop-unix-p99", "µs", 1.5, TAIL, lambda quick: latency("unix", quick).p99, "the same", quick=False),
    Item("wake-500-idle", "µs", WAKE_UP_AIM, TAIL, _wake_up(500, False), "99.9 % of wake-ups; cyclictest", quick=False),
    Item("wake-500-loaded", "µs", WAKE_UP_AIM, TAIL, _wake_up(500, True), "all cores busy", quick=False),
    Item("wake-1000-idle", "µs", WAKE_UP_AIM, TAIL, _wake_up(1000, False), "99.9 % of wake-ups; cyclictest"),
    Item("wake-1000-loaded", "µs", WAKE_UP_AIM, TAIL, _wake_up(1000, True), "all cores busy"),
    Item("lockstep", "µs", 1.3, MEDIAN, lockstep, "a tick in lockstep over Zenoh; bare round trips back to back"),
    Item("experiment", "s", 2.5, PROCESSOR, experiment, "50 s in lockstep; the same loop in C, by cc -O2"),
    Item("tables", "s", 7.0, MEDIAN, tables, "28 such cells on all cores; as many in C", quick=False),
    Item("burden", "s", 14.0, MEDIAN, burden, "the grid of `lab burden`; as many in C", quick=False),
    Item("start-help", "s", 1.2, PROCESSOR, start_help, "`--help`; Python with typer, rich, pydantic-core"),
    Item("start-experiment", "s", 1.8, PROCESSOR, start_experiment, "`lab experiment` of 1 s; Python with casadi"),
    Item("start-status", "s", 2.2, PROCESSOR, start_status, "`op status`; Python with zenoh"),
)
"""The table, in its order."""
