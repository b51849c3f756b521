"""Every item of the bench, with its aim and the margin of a comparison."""

from __future__ import annotations

from typing import Final

from aeroloop.service.bench.experiments import burden, experiment, tables
from aeroloop.service.bench.item import Item, Margin
from aeroloop.service.bench.loop import latency, lockstep
from aeroloop.service.bench.readings import lateness, page_faults, resident, shortest_period
from aeroloop.service.bench.start_up import start_experiment, start_help, start_status
from aeroloop.service.bench.tick import tick

PROCESSOR: Final = Margin(1.5, "processor time in turns repeats to 10 %, between machines to 30 %")
MEDIAN: Final = Margin(3.0, "one turn of waiting on shared cores gave ratios from 1.1 to 2.7 for the same program")
TAIL: Final = Margin(5.0, "a stolen millisecond of a shared core is in the last percent of either side")
MEMORY: Final = Margin(1.15, "resident memory repeats to 2 %; kernels and libraries differ in what they map")
FAULTS: Final = Margin(1.0, "some pages are first touched late", slack=0.01)

ITEMS: Final = (
    Item("tick", "µs", 1.6, PROCESSOR, tick, "a tick of the controller; bitstruct and bare calls of CasADi"),
    Item("loop-tcp-p50", "µs", 1.15, MEDIAN, lambda quick: latency("tcp", quick).p50, "the loop; bare Zenoh, by TCP"),
    Item("loop-tcp-p99", "µs", 1.5, TAIL, lambda quick: latency("tcp", quick).p99, "the same"),
    Item(
        "loop-unix-p50", "µs", 1.15, MEDIAN, lambda quick: latency("unix", quick).p50, "over a Unix socket", quick=False
    ),
    Item("loop-unix-p99", "µs", 1.5, TAIL, lambda quick: latency("unix", quick).p99, "the same", quick=False),
    Item("wake-500-idle", "µs", 1.5, TAIL, lateness(500, False), "99.9 % of wake-ups; cyclictest", quick=False),
    Item("wake-500-loaded", "µs", 1.5, TAIL, lateness(500, True), "all cores busy", quick=False),
    Item("wake-1000-idle", "µs", 1.5, TAIL, lateness(1000, False), "99.9 % of wake-ups; cyclictest"),
    Item("wake-1000-loaded", "µs", 1.5, TAIL, lateness(1000, True), "all cores busy"),
    Item("lockstep", "µs", 1.3, MEDIAN, lockstep, "a tick in lockstep over Zenoh; bare round trips back to back"),
    Item("memory-controller", "MB", 2.3, MEMORY, resident("controller", True), "locked; Python and the libraries"),
    Item("memory-plant", "MB", 2.3, MEMORY, resident("plant", True), "the same"),
    Item("memory-recorder", "MB", 2.3, MEMORY, resident("recorder", False), "never locked"),
    Item("memory-unlocked-controller", "MB", 2.3, MEMORY, resident("controller", False), "not locked", quick=False),
    Item("memory-unlocked-plant", "MB", 2.3, MEMORY, resident("plant", False), "not locked", quick=False),
    Item("faults-controller", "", 0.0, FAULTS, page_faults("controller"), "page faults after warm-up; ticks"),
    Item("faults-plant", "", 0.0, FAULTS, page_faults("plant"), "the same"),
    Item("highest-rate", "µs", None, MEDIAN, shortest_period, "shortest period held; a bare round trip", quick=False),
    Item("experiment", "s", 2.5, PROCESSOR, experiment, "50 s in lockstep; the same loop in C, by cc -O2"),
    Item(
        "tables",
        "s",
        7.0,
        PROCESSOR,
        tables,
        "the paper's tables, over the cores; as many in C",
        quick=False,
    ),
    Item("burden", "s", 14.0, PROCESSOR, burden, "the grid of `lab burden`; as many in C", quick=False),
    Item("start-help", "s", 2.0, PROCESSOR, start_help, "`--help`; Python with typer and rich"),
    Item("start-experiment", "s", 2.2, PROCESSOR, start_experiment, "`lab experiment` of 1 s; Python with casadi"),
    Item("start-status", "s", 2.5, PROCESSOR, start_status, "`op status`; Python with zenoh"),
)
"""The table, in its order."""
