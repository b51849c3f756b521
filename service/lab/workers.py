"""Worker processes, one per core, for independent experiments.

Arguments and results cross process boundaries, so both are plain data: a configuration goes as its dump, and only
figures return. A worker takes no ^C, which reaches every process of a terminal: its parent ends it. It also ends if its
parent is killed.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Final, Self, TypeVar, TypeVarTuple

Arguments = TypeVarTuple("Arguments")
Result = TypeVar("Result")


_PR_SET_PDEATHSIG: Final = 1


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


class Workers:
    """A pool of processes. A context."""

    def __init__(self) -> None:
        # Spawned, not forked: a fork would inherit the locks of the caller's threads.
        self._executor = ProcessPoolExecutor(
            os.cpu_count(),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_end_with_parent,
            initargs=(os.getpid(),),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # a failure or ^C: what the others compute has no use
            for worker in list(self._executor._processes.values()):
                worker.terminate()
        self._executor.shutdown(cancel_futures=True)

    def each(
        self,
        work: Callable[[*Arguments], Result],
        jobs: Iterable[tuple[*Arguments]],
        progress: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Results of a function at the top level of a module for each tuple of arguments, in their order.

        Raises:
            Exception: The first exception that the function raised.
        """
        with _uninterrupted():
            futures = [self._executor.submit(work, *job) for job in jobs]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            if progress is not None:
                progress(done)
        return [future.result() for future in futures]
