"""Experiments in bulk beside the same closed loop as one function in C, compiled with -O2: what they cost at the least.

The floor draws nothing, scores nothing and starts no process: a C loop calls the function of a tick on inputs that are
in memory. For a table it is the loop's time, times the cells, over the cores.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final

import casadi as ca
import numpy as np
from numpy.ctypeslib import ndpointer

from aeroloop.service.bench.item import Figure, NotMeasuredError, in_turns
from aeroloop.service.config import Settings, load
from aeroloop.service.control.reference import Floats
from aeroloop.service.lab.burden import measure_burden
from aeroloop.service.lab.burden_grid import grid
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.loop_function import loop_of
from aeroloop.service.lab.tables import predict

DURATION_S: Final = 50.0
QUICK_ROUNDS: Final = 3
ROUNDS: Final = 10

_LOOP: Final = """
void loop(long ticks, double *state, const double *desired, const double *wind, const double *error, double *out) {{
    static double w[{w} + 1], after[{state}];
    static casadi_int iw[{iw} + 1];
    for (long k = 0; k < ticks; k++) {{
        const double *arg[{arg}] = {{state, desired + {desired} * k, wind + {wind} * k, error + {error} * k}};
        double *res[{res}] = {{after, out}};
        tick(arg, res, iw, w, 0);
        for (int i = 0; i < {state}; i++) state[i] = after[i];
    }}
}}
"""
"""The loop around CasADi's C function of a tick."""


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
    """Time of the 28 cells of the paper's tables, on all cores [s]."""
    return _on_all_cores(lambda progress: predict(load(), progress=progress))


def burden(_: bool) -> Figure:
    """Time of the grid of `lab burden`, on all cores [s]."""
    return _on_all_cores(lambda progress: measure_burden(load(), grid(load()), DURATION_S, progress))


def _on_all_cores(run: Callable[[Callable[[int, int], None]], object]) -> Figure:
    floor, cells = _loop_in_c(), 0

    def progress(_: int, total: int) -> None:
        nonlocal cells
        cells = total

    def ours() -> float:
        begun = time.monotonic()
        run(progress)
        return time.monotonic() - begun

    found = in_turns(ours, floor, 1)
    return found._replace(floor=found.floor * cells / (os.cpu_count() or 1))


@cache
def _loop_in_c() -> Callable[[], float]:
    """A function that runs the configured loop for 50 s in C and returns its processor time [s]."""
    settings = load()
    ticks = settings.loop.ticks(DURATION_S)
    state, *rows = loop_inputs(settings, ticks)
    run = compiled_loop(loop_of(settings).tick)

    def floor() -> float:
        first = state.copy()
        begun = time.thread_time()
        run(ticks, first, *rows)
        return time.thread_time() - begun

    return floor


def loop_inputs(settings: Settings, ticks: int) -> list[Floats]:
    """Arguments of a compiled loop after its first: state, desired, wind, error, and memory for the output."""
    loop = loop_of(settings)
    state, wind, error = loop._begin(settings, ticks)
    arrays = state, loop._wanted(settings, ticks), wind, error, np.empty(loop.tick.numel_out("out"))
    return [np.ascontiguousarray(array) for array in arrays]


def compiled_loop(tick: ca.Function) -> Callable[..., None]:
    """The loop of a tick's function in C, of ticks, and contiguous arrays: state, desired, wind, error, out.

    It leaves the state after the last tick in `state`, and that tick's output in `out`.

    Raises:
        NotMeasuredError: There is no C compiler, or it fails.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise NotMeasuredError("no C compiler")
    generator = ca.CodeGenerator("tick")
    generator.add(tick)
    sizes = {name: tick.numel_in(name) for name in tick.name_in()}
    work = {"arg": tick.sz_arg(), "res": tick.sz_res(), "iw": tick.sz_iw(), "w": tick.sz_w()}
    with tempfile.TemporaryDirectory(prefix="aeroloop-") as folder:
        source, library = Path(folder, "loop.c"), Path(folder, "loop.so")
        source.write_text(generator.dump() + _LOOP.format(**sizes, **work))
        words = [compiler, "-O2", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            raise NotMeasuredError(f"the C compiler fails: {[*done.stderr.splitlines(), ''][0]}")
        loop = ctypes.CDLL(str(library)).loop
    loop.restype, loop.argtypes = None, [ctypes.c_long, *[ndpointer(np.float64, flags="C")] * 5]
    run: Callable[..., None] = loop
    return run
