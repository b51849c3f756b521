"""An engine without processes: batches run where they are submitted, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

import pytest

from aeroloop.service.lab import workers
from aeroloop.service.lab.workers import Workers


class InThisProcess(Executor):
    """Runs what is submitted at once."""

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        """As of an executor."""
        future: Future[Any] = Future()
        try:
            future.set_result(work(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


def workers_here(count: int = 1, batch_s: float = 0.0) -> Workers[Any]:
    """Workers in this process; with a count above one their results come in no order."""
    return Workers(InThisProcess(), count, batch_s)


def run_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every engine run in this process."""

    @contextmanager
    def executor(_engine: str) -> Iterator[tuple[Executor, int]]:
        yield InThisProcess(), 1

    monkeypatch.setattr(workers, "executor_of", executor)
