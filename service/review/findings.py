"""Findings and facts: fills the models of report.py from a session's observations and events."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from aeroloop.service.figures import Figures
from aeroloop.service.logs.runs import Run
from aeroloop.service.logs.traces import SessionKey
from aeroloop.service.review.events import EventLog
from aeroloop.service.review.report import Findings
from aeroloop.service.review.session import Session

IN_LOCKSTEP: Final = "in lockstep nothing is in real time"

FrameCounts = dict[str, dict[str, int]] | None
"""Of `WireCheck`."""


def findings_of(
    figures: Figures, which: SessionKey, session: Session, events: EventLog, run: Run, frames: FrameCounts
) -> Findings:
    """Findings of a session; its figures of merit are copied unchanged."""
    observer, offset = session.observer, session.reader.offset
    timing, age = observer.timing, events.age_us
    reasons = dict(figures.reasons)
    if session.settings.loop.lockstep:
        age, reasons["age_us"] = None, IN_LOCKSTEP
    elif age is None:
        reasons["age_us"] = "the log has no status of the controller with an age"
    for name, why in (("period", "fewer than two measurements"), ("latency", "no measurement was answered")):
        if name not in timing:
            reasons[f"timing.{name}"] = why
    known = offset.first_ns == offset.first_ns
    if not known:
        reasons["clock_offset_us"] = "too few ticks have all four times of sending and receiving"
    theorem, unknown = observer.trial.findings()
    return Findings(
        **{name: getattr(figures, name) for name in Figures.model_fields if name != "reasons"},
        reasons=reasons | unknown,
        vehicle=which[0],
        session=which[1],
        sessions=len(run.extents),
        started=observer.started,
        timing=timing,
        clock_offset_us=[round(ns * 1e-3, 1) for ns in (offset.first_ns, offset.last_ns)] if known else None,
        age_us=age,
        gaps=observer.gaps,
        gap_count=observer.gap_count,
        saturated=observer.saturated,
        invalid=observer.invalid,
        losses=events.losses,
        missing_ticks={end: sum(gap.rows for gap in run.missing if gap.end == end) for end in ("controller", "plant")},
        missing=run.missing,
        lapses={name: count for name, count in session.lapses.items() if count},
        frames=frames,
        theorem=theorem,
        marks=events.marks(),
    )


def facts_of(run: Run, events: EventLog, vehicle: str) -> dict[str, dict[str, Any]]:
    """Facts about software and host, by role: from descriptions, the log's metadata, and notes in statuses."""
    facts: dict[str, dict[str, Any]] = {}
    for (owner, role), description in run.files.descriptions.items():
        if owner == vehicle:
            facts[role] = {"host": description.host, **description.facts, "versions": description.versions}
    for name, values in run.files.metadata.items():
        facts.setdefault(name, {}).update(values)
    for (owner, role), status in events.statuses.items():
        if owner == vehicle and status.notes:
            facts.setdefault(role, {})["notes"] = status.notes
    return facts


def name_of(paths: Sequence[Path]) -> str:
    """Name of a run: its file or folder, without the ending."""
    first = paths[0].resolve()
    name = first.name if first.is_dir() else first.stem
    return name if len(paths) == 1 else f"{name} and {len(paths) - 1} more"
