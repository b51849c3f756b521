"""Workers for independent jobs: processes, one per core, or those of a Dask cluster.

Arguments and results cross process boundaries, so both are plain data: a configuration goes as its dump, and only
figures return. A process takes no ^C, which reaches every process of a terminal: its parent ends it. It also ends if
its parent is killed.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, Final, Protocol, Self, TypeVar, TypeVarTuple

from aeroloop.protocol.errors import AeroloopError

Arguments = TypeVarTuple("Arguments")
Result = TypeVar("Result")

PROCESSES: Final = "processes"
_DASK: Final = "dask:"
_IN_FLIGHT: Final = 4096
"""Jobs that wait or run at a time: several for each of a thousand cores, and few enough for memory."""
_WATCH_S: Final = 1.0
_PR_SET_PDEATHSIG: Final = 1


class WorkersError(AeroloopError):
    """There are no workers, or none is left; one line with the reason."""


def check_engine(engine: str) -> None:
    """Raise WorkersError unless an engine is `processes` or `dask:ADDRESS`."""
    if engine != PROCESSES and not (engine.startswith(_DASK) and engine != _DASK):
        raise WorkersError(f"--engine must be {PROCESSES} or {_DASK}ADDRESS, not {engine!r}")


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


class Engine(Protocol):
    """An executor that `Workers` watches and ends."""

    def submit(self, work: Callable[..., Result], /, *arguments: Any) -> Future[Result]:
        """As of an executor."""

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As of an executor."""

    def watch(self) -> None:
        """Called every second while jobs run. Raises WorkersError if no worker is left that can do them."""

    def abandon(self) -> None:
        """End what runs: its results have no use."""


class _Processes(ProcessPoolExecutor):
    def __init__(self) -> None:
        # Spawned, not forked: a fork would inherit the locks of the caller's threads.
        super().__init__(
            os.cpu_count(),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_end_with_parent,
            initargs=(os.getpid(),),
        )

    def watch(self) -> None:
        """Do nothing: a process that ends breaks the pool, and every job with it."""

    def abandon(self) -> None:
        for worker in list(self._processes.values()):
            worker.terminate()


class Workers:
    """Workers of an engine. A context.

    Args:
        engine: `processes`, or `dask:ADDRESS` of a Dask scheduler.

    Raises:
        WorkersError: No such engine, or no scheduler or worker answers.
        ModuleNotFoundError: Dask is not installed.
    """

    def __init__(self, engine: str = PROCESSES) -> None:
        check_engine(engine)
        if engine == PROCESSES:
            self._engine: Engine = _Processes()
        else:
            from aeroloop.service.lab.dask_workers import DaskExecutor

            self._engine = DaskExecutor(engine.removeprefix(_DASK))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # a failure or ^C: what the others compute has no use
            self._engine.abandon()
        self._engine.shutdown(cancel_futures=True)

    def stream(
        self, work: Callable[[*Arguments], Result], jobs: Iterable[tuple[*Arguments]]
    ) -> Iterator[tuple[int, Result]]:
        """Number and result of a function at the top level of a module for each tuple of arguments, as they finish.

        Jobs are taken one by one while others run, so there may be millions.

        Raises:
            WorkersError: A worker process ended, or Dask has no worker left that computes as this machine does.
            Exception: The first exception that the function raised.
        """
        numbered, numbers = enumerate(jobs), dict[Future[Result], int]()
        finished = SimpleQueue[Future[Result]]()

        def submit(count: int) -> None:
            with _uninterrupted():
                for number, job in islice(numbered, count):
                    future = self._engine.submit(work, *job)
                    numbers[future] = number
                    future.add_done_callback(finished.put)

        submit(_IN_FLIGHT)
        watched = time.monotonic()
        while numbers:
            with suppress(Empty):
                future = finished.get(timeout=_WATCH_S)
                number = numbers.pop(future)
                try:
                    result = future.result()
                except BrokenExecutor:
                    raise WorkersError("a worker process ended in the middle of a job: killed, or no memory") from None
                yield number, result
                submit(1)
            if time.monotonic() - watched > _WATCH_S:
                self._engine.watch()
                watched = time.monotonic()

    def each(
        self,
        work: Callable[[*Arguments], Result],
        jobs: Iterable[tuple[*Arguments]],
        progress: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Results as of `stream`, in the order of the jobs; `progress` is called with the number done."""
        results = dict[int, Result]()
        for number, result in self.stream(work, jobs):
            results[number] = result
            if progress is not None:
                progress(len(results))
        return [results[number] for number in range(len(results))]
