"""Several runs side by side: what differs in their configurations, and their figures.

`log compare --json` prints a `Comparison`; the terminal and the page show the same from the reports.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from aeroloop.service.logs.recording import Progress
from aeroloop.service.review.panels import MAX_POINTS
from aeroloop.service.review.report import Findings, Report, differences
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import read


class SettingDifference(BaseModel, frozen=True):
    """A key of the configuration whose value is not the same in every run."""

    key: str = Field(description="dotted, such as `law.C2`")
    values: dict[str, Any] = Field(description="by run; null where a run has no such key")


class Comparison(BaseModel, frozen=True):
    """Runs side by side."""

    runs: dict[str, Findings] = Field(description="by the run's name")
    differences: list[SettingDifference]

    @classmethod
    def of(cls, reports: Sequence[Report]) -> Comparison:
        """Comparison of runs whose names differ."""
        runs = {run.name: run.findings for run in reports}
        rows = [(key, dict(zip(runs, values, strict=True))) for key, values in differences(reports)]
        return cls(runs=runs, differences=[SettingDifference(key=key, values=values) for key, values in rows])


def read_runs(logs: Sequence[Path], limits: Sequence[Limit] = (), progress: Progress | None = None) -> list[Report]:
    """A report of every log or folder, each a run of its own, with names that differ, checked against limits.

    Logs of one name are named with their folders. Raises as `read` does.
    """

    def share(done: int) -> Progress | None:
        return None if progress is None else lambda part: progress((done + part) / len(logs))

    points = MAX_POINTS // len(logs)  # one page holds them all
    runs = [read(log, progress=share(i)).report(limits, points) for i, log in enumerate(logs)]
    names = [run.name for run in runs]
    for i, log in enumerate(logs):
        if names.count(names[i]) > 1:
            runs[i] = replace(runs[i], name=f"{log.resolve().parent.name}/{names[i]}")
    return named_apart(runs)


def named_apart(reports: Sequence[Report]) -> list[Report]:
    """Runs whose names differ: of several with one name, the second is `name (2)`."""
    apart: dict[str, Report] = {}
    for run in reports:
        name, n = run.name, 1
        while name in apart:
            n += 1
            name = f"{run.name} ({n})"
        apart[name] = replace(run, name=name)
    return list(apart.values())
