"""Findings and facts: fills the models of report.py from a session's observations and events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from aeroloop.protocol.messages.models import Description, Percentiles
from aeroloop.service.figures import Figures
from aeroloop.service.logs.runs import Run
from aeroloop.service.logs.traces import SessionKey
from aeroloop.service.review.events import EventLog
from aeroloop.service.review.report import Disagreement, Findings, Recorded, flat
from aeroloop.service.review.session import Session

LOCKSTEP: Final = "in lockstep the plant waits for each command, so no duration is a loop's"
"""Why a session in lockstep has no durations."""

OWN_AFFAIRS: Final = (
    "loop.realtime", "loop.priority", "loop.cpus", "loop.trace_s", "plant.via", "plant.faults", "plant.fault_seed"
)  # fmt: skip
"""Keys that each end has for itself, or that a command sets at the plant alone."""


def findings_of(figures: Figures, which: SessionKey, session: Session, events: EventLog, run: Run) -> Findings:
    """Findings of a session; its figures of merit are copied unchanged."""
    observer, offset = session.observer, session.reader.offset
    timing, age = observer.timing, events.age_us
    reasons = dict(figures.reasons)
    lockstep = session.settings.loop.lockstep
    if lockstep:
        timing, age = {}, None
    if age is None:
        reasons["age_us"] = LOCKSTEP if lockstep else "the log has no status of the controller with an age"
    for name, why in (("period", "fewer than two measurements"), ("latency", "no measurement was answered")):
        if name not in timing:
            reasons[f"timing.{name}"] = LOCKSTEP if lockstep else why
    known = offset.first_ns == offset.first_ns and not lockstep
    if not known:
        few = "too few ticks have all four times of sending and receiving"
        reasons["clock_offset_us"] = LOCKSTEP if lockstep else few
    faults = events.faults.intervals()
    theorem, not_judged = observer.check.findings(faults=bool(faults))
    unknown = [one for one in run.unknown if (one.vehicle, one.session) == which]
    gaps = [gap for gap in run.missing if gap.vehicle == which[0]]
    return Findings(
        **{name: getattr(figures, name) for name in Figures.model_fields if name != "reasons"},
        reasons=reasons | not_judged,
        vehicle=which[0],
        session=which[1],
        sessions=len(run.sessions_of(which[0])),
        recorded=[
            Recorded(vehicle=vehicle, session=name, duration_s=round(extent.ticks * session.settings.loop.period, 9))
            for (vehicle, name), extent in run.extents.items()
        ],
        disagreements=disagreements(run.described(which)),
        started=observer.started,
        timing=timing,
        clock_offset_us=[round(ns * 1e-3, 1) for ns in (offset.first_ns, offset.last_ns)] if known else None,
        age_us=age,
        gaps=observer.gaps,
        gap_count=observer.gap_count,
        saturated=observer.saturated,
        invalid=observer.invalid,
        losses=events.losses,
        missing_ticks={end: sum(gap.rows for gap in gaps if gap.end == end) for end in ("controller", "plant")},
        missing=gaps,
        unknown=unknown,
        unseen={
            "missing_ticks": [*(str(gap) for gap in gaps if gap.session == which[1] and gap.rows), *map(str, unknown)],
            "damages": run.files.damaged,
        },
        lapses={name: count for name, count in session.lapses.items() if count},
        theorem=theorem,
        marks=events.marks(),
        faults=faults,
    )


def latency_of(session: Session) -> tuple[Percentiles | None, str]:
    """Loop latency of a session, and the reason if there is none."""
    if session.settings.loop.lockstep:
        return None, LOCKSTEP
    return session.observer.latency, "no measurement was answered"


def disagreements(described: Mapping[str, Description]) -> list[Disagreement]:
    """Keys of the loop, the wire and the plant in which the two ends' configurations differ."""
    if not {"controller", "plant"} <= described.keys():
        return []
    tables = [flat(described[role].config) for role in ("controller", "plant")]
    keys = sorted(set().union(*tables))
    return [
        Disagreement(key=key, controller=values[0], plant=values[1])
        for key in keys
        if key.startswith(("loop.", "wire.", "plant.")) and not key.startswith(OWN_AFFAIRS)
        if (values := [table.get(key) for table in tables])[0] != values[1]
    ]


def facts_of(run: Run, events: EventLog, which: SessionKey) -> dict[str, dict[str, Any]]:
    """Facts about software and host, by role: from descriptions, the log's metadata, and notes in statuses."""
    facts: dict[str, dict[str, Any]] = {}
    for role, description in run.described(which).items():
        facts[role] = {"host": description.host, **description.facts, "versions": description.versions}
    for name, values in run.files.metadata.items():
        facts.setdefault(name, {}).update(values)
    for (owner, role), status in events.statuses.items():
        if owner == which[0] and status.notes:
            facts.setdefault(role, {})["notes"] = status.notes
    return facts


def name_of(paths: Sequence[Path]) -> str:
    """Name of a run: its file or folder, without the ending."""
    first = paths[0].resolve()
    name = first.name if first.is_dir() else first.stem
    return name if len(paths) == 1 else f"{name} and {len(paths) - 1} more"
