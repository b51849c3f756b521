"""Experiments in bulk beside the same closed loop as one function in C, compiled with -O2: what they cost at the least.

The floor draws nothing, scores nothing and starts no process: a C loop calls the function of a tick on inputs that are
in memory. For a table it is the loop's time, times the cells, over the cores.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import cache
from typing import Final

from aeroloop.service.bench.item import Figure, NotMeasuredError, in_turns
from aeroloop.service.config import load
from aeroloop.service.lab.bare_loop import bare_loop
from aeroloop.service.lab.burden import measure_burden
from aeroloop.service.lab.burden_grid import grid
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.tables import predict

DURATION_S: Final = 50.0
QUICK_ROUNDS: Final = 3
ROUNDS: Final = 10


def experiment(quick: bool) -> Figure:
    """Processor time of an experiment of 50 s [s]."""
    settings, floor = load(), _loop_in_c()
    run_experiment(settings, DURATION_S)  # what is made once is made now

    def ours() -> float:
        begun = time.process_time()
        run_experiment(settings, DURATION_S)
        return time.process_time() - begun

    return in_turns(ours, floor, QUICK_ROUNDS if quick else ROUNDS)


def tables(_: bool) -> Figure:
    """Processor time of the cells of the paper's tables, over the cores [s]."""
    return _on_all_cores(lambda progress: predict(load(), progress=progress))


def burden(_: bool) -> Figure:
    """Processor time of the grid of `lab burden`, over the cores [s]."""
    return _on_all_cores(lambda progress: measure_burden(load(), grid(load()), DURATION_S, progress))


def _on_all_cores(run: Callable[[Callable[[int, int], None]], object]) -> Figure:
    floor, cells = _loop_in_c(), 0

    def progress(_: int, total: int) -> None:
        nonlocal cells
        cells = total

    def ours() -> float:
        before = os.times()
        run(progress)
        return sum(os.times()[:4]) - sum(before[:4])  # with the workers, which have ended

    found, cores = in_turns(ours, floor, 1), os.cpu_count() or 1
    return Figure(found.ours / cores, found.floor * cells / cores)


@cache
def _loop_in_c() -> Callable[[], float]:
    """A function that runs the configured loop for 50 s in C and returns its processor time [s]."""
    settings = load()
    run = bare_loop(settings, settings.loop.ticks(DURATION_S))
    if run is None:
        raise NotMeasuredError("no C compiler")

    def floor() -> float:
        begun = time.process_time()
        run()
        return time.process_time() - begun

    return floor
