"""Work spread over processes, one a core: experiments that know nothing of each other, run side by side.

What is asked and what is answered travels between processes, so both are plain data: a configuration goes as its dump,
and only figures come back.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Self, TypeVar, TypeVarTuple

Asked = TypeVarTuple("Asked")
Answered = TypeVar("Answered")


class Workers:
    """Processes that wait for work. A context."""

    def __init__(self) -> None:
        # Spawned, not forked: a fork would inherit threads of whatever the caller has open.
        self._executor = ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._executor.shutdown(cancel_futures=True)

    def each(
        self,
        work: Callable[[*Asked], Answered],
        jobs: Iterable[tuple[*Asked]],
        progress: Callable[[int], None] | None = None,
    ) -> list[Answered]:
        """What a function of a module answers to each of these arguments, in their order.

        Args:
            work: The function.
            jobs: Its arguments, one tuple a call.
            progress: Hears how many are done.

        Raises:
            Exception: Whatever the function raised first.
        """
        futures = [self._executor.submit(work, *job) for job in jobs]
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            if progress is not None:
                progress(done)
        return [future.result() for future in futures]
