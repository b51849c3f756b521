"""Several runs side by side: what differs in their configurations, and their figures.

`log compare --json` prints a `Comparison`; the terminal and the page show the same from the reports.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from aeroloop.service.review.downsample import MAX_POINTS
from aeroloop.service.review.observe import DrawnPart
from aeroloop.service.review.report import Findings, Report, differences
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.review import report


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
        names = [run.name for run in reports]
        return cls(
            runs={run.name: run.findings for run in reports},
            differences=[
                SettingDifference(key=key, values=dict(zip(names, values, strict=True)))
                for key, values in differences(reports)
            ],
        )


def read_runs(
    logs: Sequence[Path], limits: Sequence[Limit] = (), progress: Callable[[float], None] | None = None
) -> list[Report]:
    """A report of every log or folder, each a run of its own, with names that differ. Raises as `report` does.

    Logs of one name are named with their folders.

    Args:
        logs: A file or a folder each.
        limits: Limits that the figures of each must keep.
        progress: Called repeatedly with the share done, 0…1.
    """

    def share(done: int) -> Callable[[float], None] | None:
        return None if progress is None else lambda part: progress((done + part) / len(logs))

    part = DrawnPart(points=MAX_POINTS // len(logs))  # one page holds them all
    reports = [report([log], limits, share(i), part) for i, log in enumerate(logs)]
    names = [run.name for run in reports]
    return named_apart(
        [
            replace(run, name=f"{log.resolve().parent.name}/{run.name}") if names.count(run.name) > 1 else run
            for log, run in zip(logs, reports, strict=True)
        ]
    )


def named_apart(reports: Sequence[Report]) -> list[Report]:
    """Runs whose names differ: of several with one name, the second is `name (2)`."""
    taken: set[str] = set()
    apart = []
    for run in reports:
        name, n = run.name, 1
        while name in taken:
            n += 1
            name = f"{run.name} ({n})"
        taken.add(name)
        apart.append(replace(run, name=name))
    return apart


def broken_limits(reports: Sequence[Report]) -> list[str]:
    """Limits that do not hold, a line each."""
    return [
        f"{run.name}: {check.text} does not hold: {check.found}"
        for run in reports
        for check in run.findings.checks
        if not check.holds
    ]
