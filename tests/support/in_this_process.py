"""Workers that are none: jobs run in the process that submits them, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from aeroloop.service.lab.workers import Workers


class InThisProcess(Workers):
    """Does the work itself, and keeps the jobs it did."""

    jobs: list[tuple[Any, ...]]

    def __init__(self, engine: str = "processes") -> None:
        del engine
        self.jobs = []

    def __exit__(self, *exception: object) -> None:
        pass

    def stream(self, work: Callable[..., Any], jobs: Iterable[Any]) -> Iterator[tuple[int, Any]]:
        for number, job in enumerate(jobs):
            self.jobs.append(job)
            yield number, work(*job)
