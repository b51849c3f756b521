"""The engine of every study: a function of many configurations, on every core or on a Dask cluster.

Configurations go to other processes as JSON with overrides, and results come back as plain data: mostly as rows of
figures, one an experiment.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import cache, lru_cache
from hashlib import sha256
from importlib.metadata import version
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, load_over, vouched
from aeroloop.service.lab.experiment import run_experiment

Result = TypeVar("Result")
Row: TypeAlias = dict[str, Any]
Sheets: TypeAlias = Iterator[tuple[str, list[dict[str, str]]]]
"""A result as text: tables, each a title and rows, column to text; without rows a paragraph."""
Progress: TypeAlias = Callable[[int, int], None]
"""Called with the number done and the number in all."""


def cell(value: float | None, form: str, scale: float = 1, missing: str = "–") -> str:
    """A figure as text, by a format as of `str.format`."""
    return missing if value is None else form.format(value * scale)


class SweepError(AeroloopError):
    """Runs cannot begin or go on: no worker, another version, a file of rows in use; one line with the reason."""


PROCESSES: Final = "processes"
_DASK: Final = "dask:"
_PATIENCE_S: Final = 10.0


class Run(NamedTuple):
    """A configuration to run, as plain data: it goes to other processes."""

    config: str  # JSON of a configuration
    overrides: tuple[str, ...] = ()
    seed: int | None = None  # of wind and sensors; None as configured

    def settings(self) -> Settings:
        """The configuration; a plant that is not emulated has no seed."""
        settings = load_over(_base(self.config), self.overrides) if self.overrides else _base(self.config)
        plant = settings.plant
        if self.seed is None or not plant.emulated:
            return settings
        drawn = {name: getattr(plant, name).model_copy(update={"seed": self.seed}) for name in ("wind", "sensors")}
        return settings.model_copy(update={"plant": plant.model_copy(update=drawn)})


@lru_cache(maxsize=2)
def _base(config: str) -> Settings:
    return vouched(Settings.model_validate_json(config))  # of the user who runs the study, in another process


def run_of(settings: Settings, overrides: Sequence[str] = (), seed: int | None = None) -> Run:
    """The run of a configuration."""
    return Run(json.dumps(settings.description()), tuple(overrides), seed)


@cache
def code_version() -> str:
    """The version of aeroloop, and a hash of its code and of Python, NumPy and CasADi, such as `0.2.0+1f0c83a6be25`."""
    digest = sha256(repr([sys.version, version("numpy"), version("casadi")]).encode())
    for package in ("protocol", "plant_emulator", "service"):
        folder = Path(str(sys.modules[f"aeroloop.{package}"].__file__)).parent
        for file in sorted(filter(Path.is_file, folder.rglob("*.py"))):  # an editable install may have dead links
            digest.update(f"{package}/{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return f"{version('aeroloop')}+{digest.hexdigest()[:12]}"


_one_at_a_time = threading.Lock()


def _done(expected: str, work: Callable[[Settings], Result], run: Run) -> Result:
    """Do one run, in any process. A thread at a time, as compiled loops are shared by the threads of a process."""
    if (mine := code_version()) != expected:
        worker = f"{os.uname().nodename}:{os.getpid()}"
        raise SweepError(f"worker {worker} runs aeroloop {mine}, this machine {expected}: install the same on both")
    with _one_at_a_time:
        return work(run.settings())


class Workers(NamedTuple):
    """Workers that do a function of a configuration."""

    executor: Executor
    cores: int

    def stream(self, work: Callable[[Settings], Result], runs: Sequence[Run]) -> Iterator[tuple[int, Result]]:
        """Number and result of each run, as they finish.

        `work` is a function at the top level of a module, or a `partial` of one; its first exception is raised. Raises
        SweepError if a worker ended, or has another version of aeroloop, or Dask's scheduler is gone.
        """
        pending, sent = dict[Future[Result], int](), 0
        while pending or sent < len(runs):
            while sent < len(runs) and len(pending) < 2 * self.cores:  # none waits for its next, few are in memory
                pending[self.executor.submit(_done, code_version(), work, runs[sent])] = sent
                sent += 1
            for future in futures.wait(pending, return_when=futures.FIRST_COMPLETED).done:
                yield pending.pop(future), _result_of(future)

    def rows(
        self, work: Callable[[Settings], Result], runs: Sequence[Run], progress: Callable[[int], None] = lambda _: None
    ) -> list[Result]:
        """Results as of `stream`, in the order of the runs; `progress` is called with the number done."""
        results = dict[int, Result]()
        for number, result in self.stream(work, runs):
            results[number] = result
            progress(len(results))
        return [results[number] for number in range(len(runs))]


def _result_of(future: Future[Result]) -> Result:
    try:
        return future.result()
    except futures.BrokenExecutor:
        raise SweepError("a worker process ended in the middle of an experiment: killed, or no memory") from None
    except futures.CancelledError:
        raise SweepError("the Dask scheduler is gone, or has dropped the experiments") from None
    except Exception as error:
        if type(error).__module__.startswith("distributed"):  # such as KilledWorker, after several workers
            raise SweepError(f"an experiment failed on the Dask cluster: {str(error).splitlines()[0]}") from None
        raise


def check_engine(engine: str) -> None:
    """Raise SweepError unless an engine is `processes` or `dask:ADDRESS`."""
    if engine != PROCESSES and not (engine.startswith(_DASK) and engine != _DASK):
        raise SweepError(f"--engine must be {PROCESSES} or {_DASK}ADDRESS, not {engine!r}")


@contextmanager
def open_workers(engine: str = PROCESSES) -> Iterator[Workers]:
    """Workers of an engine, `processes` or `dask:ADDRESS`, ended with the context.

    Raises SweepError if there is no such engine, scheduler or worker, ModuleNotFoundError if Dask is not installed.
    """
    check_engine(engine)
    with local_processes() if engine == PROCESSES else _dask(engine.removeprefix(_DASK)) as workers:
        yield workers


@contextmanager
def local_processes() -> Iterator[Workers]:
    """A process a core, forked from a server that has imported what they need and has no threads."""
    count, context = os.cpu_count() or 1, multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    resource_tracker.ensure_running()  # it ends with SIGINT unblocked
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the server and its workers inherit it
    with futures.ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent) as executor:
        try:
            futures.wait(
                [executor.submit(time.sleep, 0.05) for _ in range(count)]
            )  # ^C must not meet a worker that starts
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        try:
            yield Workers(executor, count)
        except BaseException:  # a failure or ^C: what the others compute has no use
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _end_with_parent() -> None:
    """End this worker when its parent is killed, which would leave it waiting for runs."""

    def wait_for_end() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_end, daemon=True).start()


@contextmanager
def _dask(address: str) -> Iterator[Workers]:
    """Workers of a Dask cluster, such as at `tcp://10.0.0.1:8786`; TLS as Dask's own configuration says."""
    from distributed import Client

    for name in ("distributed", "distributed.client"):  # what matters is raised here
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except Exception as error:  # whatever the transport raises
        raise SweepError(f"no Dask scheduler answers at {address}: {str(error).splitlines()[0]}") from None
    with client:
        if not (cores := sum(client.ncores().values())):
            raise SweepError(f"no worker at {address}: `dask worker {address} --nthreads 1` starts one")
        yield Workers(client.get_executor(retries=2, pure=False), cores)


# ── a row an experiment ──

_STREAMS: Final = ("measurement_frames_per_s", "measurement_bits_per_s", "command_frames_per_s", "command_bits_per_s")
_FIGURES: Final = (
    "z_track", "u_total", "max_error_deg", "final_error_deg", "second_half_error_deg", "command_changes_per_s",
    "skipped_ticks",
)  # fmt: skip
COLUMNS: Final = (*_FIGURES, *_STREAMS, "reason")
"""Figures in a row of an experiment, by the names and units of `Figures`; `reason` is why there are none."""


def figures_row(settings: Settings, duration_s: float) -> Row:
    """Figures of an experiment, or the reason why it has none, such as a trip."""
    try:
        found = run_experiment(settings, duration_s)
    except (AeroloopError, ValueError) as error:  # the plant tripped, a law or plant failed, the ends do not fit
        return {**dict.fromkeys(COLUMNS), "reason": str(error).splitlines()[0]}
    streams = {name: getattr(getattr(found, name.partition("_")[0]), name.partition("_")[2]) for name in _STREAMS}
    return {**{name: getattr(found, name) for name in _FIGURES}, **streams, "reason": None}
