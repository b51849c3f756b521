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
    """A report of every log or folder, each a run of its own, checked against limits. Raises as `read` does.

    Their names differ: logs of one name are named with their folders, and if that is not enough, by number.
    """

    def share(done: int) -> Progress | None:
        return None if progress is None else lambda part: progress((done + part) / len(logs))

    points = MAX_POINTS // len(logs)  # one page holds them all
    runs = [read(log, progress=share(i)).report(limits, points) for i, log in enumerate(logs)]
    alike = [run.name for run in runs]
    names = [
        name if alike.count(name) == 1 else f"{log.resolve().parent.name}/{name}"
        for name, log in zip(alike, logs, strict=True)
    ]
    nth = [names[: i + 1].count(name) for i, name in enumerate(names)]
    return [
        replace(run, name=name if n == 1 else f"{name} ({n})") for run, name, n in zip(runs, names, nth, strict=True)
    ]
