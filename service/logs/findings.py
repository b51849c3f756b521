"""Findings and facts: what an observer has seen and a story has told, put into the models of report.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from protocol.messages import Lapse
from protocol.verbs import Change
from service.config import Settings
from service.figures import Figures
from service.logs.files import LogFiles, Which
from service.logs.observe import Observer
from service.logs.report import Findings
from service.logs.story import AROUND_S, Story


def findings_of(
    figures: Figures,
    which: Which,
    settings: Settings,
    observer: Observer,
    story: Story,
    changes: Sequence[Change],
    lapses: Sequence[Lapse],
    sessions: int,
) -> Findings:
    """Everything that is known of a session.

    Args:
        figures: Its figures of merit; they are taken over as they are.
        which: Its vehicle and name.
        settings: The configuration of its controller.
        observer: What was seen of it.
        story: What was told in the whole log.
        changes: What its controller followed from which tick on, in order.
        lapses: Where it did not compute with the plant's levels.
        sessions: How many sessions the log has.
    """
    vehicle, session = which
    timing, age = observer.timing, story.age_us(which)
    reasons = dict(figures.reasons)
    if age is None:
        reasons["age_us"] = "the log has no status of the controller with an age"
    for name, why in (("period", "fewer than two measurements"), ("latency", "no measurement was answered")):
        if name not in timing:
            reasons[f"timing.{name}"] = why
    theorem, unknown = observer.trial.findings()
    return Findings(
        **{name: getattr(figures, name) for name in Figures.model_fields if name != "reasons"},
        reasons=reasons | unknown,
        vehicle=vehicle,
        session=session,
        sessions=sessions,
        started=observer.started,
        timing=timing,
        age_us=age,
        gaps=observer.gaps,
        gap_count=observer.gap_count,
        saturated=observer.saturated,
        invalid=observer.invalid,
        losses=story.losses(vehicle),
        lapses=Counter(lapse.kind for lapse in lapses),
        theorem=theorem,
        marks=story.marks(which, changes, settings.loop.period, observer.clock(AROUND_S)),
    )


def facts_of(files: LogFiles, story: Story, vehicle: str) -> dict[str, dict[str, Any]]:
    """About software and host, by role: what its contract says, what the log's metadata says, what was refused."""
    facts: dict[str, dict[str, Any]] = {}
    for role, contract in files.contracts.items():
        facts[role] = {"host": contract.host, **contract.facts, "versions": contract.versions}
    for name, told in files.metadata.items():
        facts.setdefault(name, {}).update(told)
    for (whose, role), status in story.statuses.items():
        if whose == vehicle and status.notes:
            facts.setdefault(role, {})["notes"] = status.notes
    return facts


def name_of(paths: Sequence[Path]) -> str:
    """What to call a run: its file or folder, without what every log has."""
    first = paths[0].resolve()
    name = first.name if first.is_dir() else first.stem
    return name if len(paths) == 1 else f"{name} and {len(paths) - 1} more"
