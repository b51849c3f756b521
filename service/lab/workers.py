"""Worker processes, one per core, for independent experiments.

Arguments and results cross process boundaries, so both are plain data: a configuration goes as its dump, and only
figures return.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Self, TypeVar, TypeVarTuple

Arguments = TypeVarTuple("Arguments")
Result = TypeVar("Result")


class Workers:
    """A pool of processes. A context."""

    def __init__(self) -> None:
        # Spawned, not forked: a fork would inherit the locks of the caller's threads.
        self._executor = ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
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
        futures = [self._executor.submit(work, *job) for job in jobs]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            if progress is not None:
                progress(done)
        return [future.result() for future in futures]
