"""An engine without processes: runs happen where they are submitted, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

import pytest

from aeroloop.service.lab import check, engine
from aeroloop.service.lab.engine import Workers


class InThisProcess(Executor):
    def submit(self, work: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(work(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


def workers_here(cores: int = 1) -> Workers:
    """Workers in this process; with several cores their results come in no order."""
    return Workers(InThisProcess(), cores)


@contextmanager
def _here() -> Iterator[Workers]:
    yield workers_here()


def run_here(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (engine, check):
        monkeypatch.setattr(module, "local_processes", _here)
