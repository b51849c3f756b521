"""Workers: run a function of many configurations on every core, or on a Dask cluster.

Configurations go to other processes as JSON with overrides, in batches, and results come back as plain data. A process
takes no ^C, which reaches every process of a terminal: its parent ends it. It also ends if its parent is killed.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import cache, lru_cache, partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, load_over

Result = TypeVar("Result")

PROCESSES: Final = "processes"
_DASK: Final = "dask:"
_BATCH_S: Final = {PROCESSES: 2.0, _DASK: 20.0}
"""Computing time of a batch: what ^C costs at most, or what one scheduler hands out to thousands of cores [s]."""
_PATIENCE_S: Final = 10.0
_RETRIES: Final = 2
_PR_SET_PDEATHSIG: Final = 1


class WorkersError(AeroloopError):
    """There are no workers, or none is left; one line with the reason."""


class Run(NamedTuple):
    """A configuration to run, as plain data: it goes to other processes."""

    config: str  # JSON of a configuration
    overrides: tuple[str, ...] = ()
    seed: int | None = None  # of wind and sensors; None as configured

    def settings(self) -> Settings:
        """The configuration."""
        settings = _loaded(self.config, self.overrides)
        return settings if self.seed is None else with_seed(settings, self.seed)


@lru_cache(maxsize=4)
def _loaded(config: str, overrides: tuple[str, ...]) -> Settings:
    base = _base(config)
    return load_over(base, overrides) if overrides else base


@lru_cache(maxsize=2)
def _base(config: str) -> Settings:
    return Settings.model_validate_json(config)


def run_of(settings: Settings, overrides: Sequence[str] = (), seed: int | None = None) -> Run:
    """The run of a configuration."""
    return Run(json.dumps(settings.description()), tuple(overrides), seed)


def with_seed(settings: Settings, seed: int) -> Settings:
    """The configuration with this seed of wind and sensors; a plant without ours stays as it is."""
    plant = settings.plant
    if not plant.emulated:
        return settings
    drawn = {name: getattr(plant, name).model_copy(update={"seed": seed}) for name in ("wind", "sensors")}
    return settings.model_copy(update={"plant": plant.model_copy(update=drawn)})


def check_engine(engine: str) -> None:
    """Raise WorkersError unless an engine is `processes` or `dask:ADDRESS`."""
    if engine != PROCESSES and not (engine.startswith(_DASK) and engine != _DASK):
        raise WorkersError(f"--engine must be {PROCESSES} or {_DASK}ADDRESS, not {engine!r}")


@cache
def code_version() -> str:
    """The version of aeroloop, and a hash of its code and of Python, NumPy and CasADi, such as `0.2.0+1f0c83a6be25`."""
    digest = sha256(repr([sys.version, version("numpy"), version("casadi")]).encode())
    for package in ("protocol", "plant_emulator", "service"):
        folder = Path(str(sys.modules[f"aeroloop.{package}"].__file__)).parent
        for file in sorted(filter(Path.is_file, folder.rglob("*.py"))):  # an editable install may have dead links
            digest.update(f"{package}/{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return f"{version('aeroloop')}+{digest.hexdigest()[:12]}"


class Batch(NamedTuple):
    """Results of some runs, and what they cost in their worker."""

    results: list[Any]
    worker: str
    began: float  # monotonic time of the worker [s]
    ended: float
    cpu: float  # [s]


_one_at_a_time = threading.Lock()


def _run_batch(expected: str, work: Callable[[Settings], Any], runs: Sequence[Run]) -> Batch:
    """Run a batch, in any process. A thread at a time, as compiled loops are shared by the threads of a process."""
    worker = f"{os.uname().nodename}:{os.getpid()}"
    if (mine := code_version()) != expected:
        raise WorkersError(f"worker {worker} runs aeroloop {mine}, this machine {expected}: install the same on both")
    with _one_at_a_time:
        began, cpu = time.monotonic(), time.process_time()
        results = [work(run.settings()) for run in runs]
        return Batch(results, worker, began, time.monotonic(), time.process_time() - cpu)


class Workers(Generic[Result]):
    """Workers that do a function of a configuration.

    Attributes:
        batches: What each batch cost so far, without its results; and how many these were.
    """

    def __init__(self, executor: Executor, count: int, batch_s: float) -> None:
        self._executor, self._count, self._batch_s = executor, count, batch_s
        self.batches: list[tuple[Batch, int]] = []

    def stream(self, work: Callable[[Settings], Result], runs: Sequence[Run]) -> Iterator[tuple[int, Result]]:
        """Number and result of each run, as they finish.

        Args:
            work: Function at the top level of a module, or a `partial` of one.
            runs: Configurations.

        Raises:
            WorkersError: A worker ended, or has another version of aeroloop, or Dask's scheduler is gone.
            Exception: The first exception that the function raised.
        """
        pending, sent = dict[Future[Batch], int](), 0
        while pending or sent < len(runs):
            while sent < len(runs) and len(pending) < 2 * self._count:
                batch = runs[sent : sent + self._size(len(runs) - sent)]
                with _uninterrupted():
                    pending[self._executor.submit(_run_batch, code_version(), work, batch)] = sent
                sent += len(batch)
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                first, found = pending.pop(future), _result_of(future)
                self.batches.append((found._replace(results=[]), len(found.results)))
                yield from enumerate(found.results, first)

    def rows(
        self, work: Callable[[Settings], Result], runs: Sequence[Run], progress: Callable[[int], None] = lambda _: None
    ) -> list[Result]:
        """Results as of `stream`, in the order of the runs; `progress` is called with the number done."""
        results = dict[int, Result]()
        for number, result in self.stream(work, runs):
            results[number] = result
            progress(len(results))
        return [results[number] for number in range(len(runs))]

    def _size(self, left: int) -> int:
        """Runs of the next batch: one until the cost is known; few enough that all workers end at about one time."""
        cpu, count = sum(batch.cpu for batch, _ in self.batches[-100:]), sum(n for _, n in self.batches[-100:])
        return max(1, min(int(self._batch_s * count / cpu) if cpu else 1, left // (4 * self._count)))


def _result_of(future: Future[Batch]) -> Batch:
    try:
        return future.result()
    except BrokenExecutor:
        raise WorkersError("a worker process ended in the middle of a job: killed, or no memory") from None
    except CancelledError:
        raise WorkersError("the Dask scheduler is gone, or has dropped the jobs") from None
    except Exception as error:
        if type(error).__module__.startswith("distributed"):  # such as KilledWorker, after several workers
            raise WorkersError(f"a job failed on the Dask cluster: {str(error).splitlines()[0]}") from None
        raise


@contextmanager
def open_workers(engine: str = PROCESSES) -> Iterator[Workers[Any]]:
    """Workers of an engine, ended with the context.

    Raises:
        WorkersError: No such engine, or no scheduler or worker answers.
        ModuleNotFoundError: Dask is not installed.
    """
    check_engine(engine)
    with executor_of(engine) as (executor, count):
        yield Workers(executor, count, _BATCH_S[PROCESSES if engine == PROCESSES else _DASK])


@contextmanager
def executor_of(engine: str) -> Iterator[tuple[Executor, int]]:
    """The executor of an engine, and how many workers it has."""
    if engine != PROCESSES:
        with _dask(engine.removeprefix(_DASK)) as found:
            yield found
        return
    count = os.cpu_count() or 1
    context = multiprocessing.get_context("spawn")  # a fork would inherit the locks of the caller's threads
    ending = partial(_end_with_parent, os.getpid())
    with ProcessPoolExecutor(count, mp_context=context, initializer=ending) as executor:
        try:
            yield executor, count
        except BaseException:  # a failure or ^C: what the others compute has no use
            for process in multiprocessing.active_children():
                process.terminate()
            raise


@contextmanager
def _dask(address: str) -> Iterator[tuple[Executor, int]]:
    """Executor of a Dask cluster, such as at `tcp://10.0.0.1:8786`; TLS as Dask's own configuration says."""
    from distributed import Client, Security
    from distributed.comm.core import connect

    for name in ("distributed", "distributed.client"):  # what matters is raised here
        logging.getLogger(name).setLevel(logging.CRITICAL)

    async def connect_once() -> None:  # a client that fails but for want of an answer, such as for TLS, never ends
        comm = await connect(address, timeout=_PATIENCE_S, **Security().get_connection_args("client"))
        await comm.close()

    try:
        asyncio.run(connect_once())
        client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except Exception as error:  # whatever the transport raises
        raise WorkersError(f"no Dask scheduler answers at {address}: {str(error).splitlines()[0]}") from None
    with client:
        if not (cores := sum(client.ncores().values())):
            raise WorkersError(f"no worker at {address}: `dask worker {address} --nthreads 1` starts one")
        yield client.get_executor(retries=_RETRIES, pure=False), cores


def _end_with_parent(parent: int) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before prctl took effect
        os._exit(1)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Put ^C off while processes start: one that starts half prints a traceback. They inherit the mask of signals.

    Why not a mask alone: another thread would take the signal, and Python handles it in the main thread all the same.
    """
    arrived: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, lambda number, _: arrived.append(number)) if main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if main:
            signal.signal(signal.SIGINT, before)
    if arrived:
        signal.raise_signal(signal.SIGINT)
