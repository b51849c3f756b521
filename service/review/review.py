"""Review of a log: every figure and finding, from the log alone.

The log holds the configuration and what each end did, so the review recomputes the controller, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from math import inf, isnan
from pathlib import Path
from typing import Any, Final

from aeroloop.protocol.messages.models import Description, Percentiles, Status
from aeroloop.protocol.messages.trace import ENDS
from aeroloop.service.config import ConfigError, Settings
from aeroloop.service.figures import Figures, figures
from aeroloop.service.logs.recording import INDEXING, Progress, Recording, ReviewError
from aeroloop.service.logs.session import Missing, Session, Truths, Unknown
from aeroloop.service.logs.ticks import Ticks, recompute, with_known_law
from aeroloop.service.review import events
from aeroloop.service.review.panels import MAX_POINTS, panels_of
from aeroloop.service.review.report import Disagreement, Findings, Recorded, Report, differences, flat
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.theorem import TheoremCheck, check_theorem

LOCKSTEP: Final = "in lockstep the plant waits for each command, so no duration is a loop's"

OWN_AFFAIRS: Final = (
    "loop.realtime", "loop.cpus", "plant.via", "plant.faults", "plant.fault_seed", "plant.armed_at_start",
    "plant.state_directory",
)  # fmt: skip
"""Keys that each end has for itself, or that a command sets at the plant alone."""


@dataclass(frozen=True)
class Review:
    """Review of a session. The ticks are those that are judged; `part` is from when to when it was read [s]."""

    figures: Figures
    findings: Findings
    settings: Settings
    ticks: Ticks
    theorem: TheoremCheck
    truths: Truths
    name: str
    facts: dict[str, dict[str, Any]]
    part: tuple[float, float] | None

    def checked(self, limits: Sequence[Limit] = ()) -> Findings:
        """The findings, checked against limits."""
        return self.findings.model_copy(update={"checks": [limit.check(self.findings, limits) for limit in limits]})

    def report(self, limits: Sequence[Limit] = (), points: int = MAX_POINTS) -> Report:
        """The review as data, checked against limits, with lines of at most so many points."""
        drawn = panels_of(self.settings, self.ticks, self.theorem, points, self.truths)
        return Report(
            self.name, self.checked(limits), *drawn, self.settings.description(), facts=self.facts, part=self.part
        )


def review(*paths: Path) -> Figures:
    """Figures of a run's longest session. Raises as `read` does."""
    return read(*paths).figures


def read(
    *paths: Path,
    session: str | None = None,
    vehicle: str | None = None,
    progress: Progress | None = None,
    since_s: float = -inf,
    until_s: float = inf,
) -> Review:
    """Read a run (logs, folders, or the files of a rotated run) and judge a session, or of it what is in this time [s].

    Session and vehicle are as of `Recording.choose`, the time is the law's. Raises ReviewError.
    """
    try:
        recording = Recording(paths, progress)
        which = recording.choose(session, vehicle)
        its = recording.session(which, since_s, until_s)
    except ConfigError as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None
    its, law_unknown = with_known_law(its)
    settings, loop, last = its.settings, its.settings.loop, max(its.extent.last.values())
    part, span = None, (0, last)
    unseen: list[Missing | Unknown] = [*(gap for gap in its.missing if gap.rows), *its.unknown]
    if (since_s, until_s) != (-inf, inf):
        part = since_s, until_s
        if not len(its.k):
            lasts = its.extent.ticks * loop.period
            raise ReviewError(f"there is nothing {_in_words(part)}: the session has {lasts:g} s")
        span = int(its.k[0]), int(its.k[-1])
        since, until = since_s / loop.period, until_s / loop.period
        unseen = [gap for gap in unseen if gap.first_tick <= until and _last_tick(gap) >= since]
    messages = events.read_messages(recording, which, settings.wire.actuators)
    whole = recording.judged(which)
    recording.release()
    marks, trips, losses = events.happened(messages, its, span, session is not None)
    faults = events.fault_intervals(messages, its)
    judged = recompute(its, progress and (lambda share: progress(INDEXING + (1 - INDEXING) * share)))
    ticks, went = judged.ticks, events.lapses(its, judged.missed)
    its = replace(its, controller=its.controller[:0].copy(), plant=its.plant[:0].copy())  # 200 MB of an hour

    spreads = {} if loop.lockstep else events.timing(ticks)
    latency, offset = spreads.get("latency"), None if isnan(judged.offset_ns[0]) else judged.offset_ns
    unavailable = {
        "latency_us": None if latency else "no measurement was answered",
        "timing.period": None if "period" in spreads else "fewer than two measurements",
        "timing.latency": None if latency else "no measurement was answered",
        "clock_offset_us": None if offset else "too few ticks have all four times of sending and receiving",
    }
    reasons = {key: LOCKSTEP if loop.lockstep else why for key, why in unavailable.items() if why}
    if part is not None:
        reasons["duration_s"] = f"of the session only what is {_in_words(part)} was read"
    merits = figures(
        settings.wire, loop.period, (ticks.k, ticks.attitude_error), (judged.answered, judged.voltages),
        watchdog_s=settings.plant.watchdog_s, unsent=judged.unsent, log=recording.name, trips=trips,
        latency=Percentiles(**latency.model_dump(include=set(Percentiles.model_fields))) if latency else None,
        reasons={key: why for key, why in reasons.items() if key in Figures.model_fields},
        damages=recording.unread,
    )  # fmt: skip
    controller = its.descriptions.get("controller")
    certificate = controller.certificate if controller else None
    theorem = check_theorem(settings, ticks, messages.truths, its.changes, certificate, faults=bool(faults))
    gap_count, longest = events.gaps(judged.answered, loop.period)
    saturated, invalid = events.saturation(settings.wire, judged.measurements, judged.commands)
    missing = whole.missing
    started_s = ticks.wall_ns[:1] * 1e-9
    recorded = [
        Recorded(vehicle=owner, session=one, duration_s=round(extent.ticks * loop.period, 9))
        for (owner, one), extent in recording.extents.items()
    ]
    findings = Findings(
        **{key: value for key, value in merits if key != "reasons"},
        reasons=merits.reasons | reasons | theorem.reasons,
        vehicle=which[0], session=which[1], sessions=len(recording.sessions_of(which[0])), recorded=recorded,
        started="".join(datetime.fromtimestamp(at_s, UTC).isoformat(timespec="milliseconds") for at_s in started_s),
        disagreements=disagreements(its.descriptions), theorem=theorem.findings, marks=marks, faults=faults,
        timing=spreads, clock_offset_us=[round(ns * 1e-3, 1) for ns in offset] if offset else None,
        gaps=longest, gap_count=gap_count, saturated=saturated, invalid=invalid, losses=losses, lapses=went,
        missing_ticks={role: sum(gap.rows for gap in missing if gap.end == role) for role in ENDS}, missing=missing,
        unknown=its.unknown, law_unknown=law_unknown,
        unseen={"missing_ticks": [str(one) for one in unseen], "damages": whole.damages},
    )  # fmt: skip
    path = paths[0].resolve()
    name = path.name if path.is_dir() else path.stem
    name = name if len(paths) == 1 else f"{name} and {len(paths) - 1} more"
    facts = _facts(recording, its, messages)
    return Review(merits, findings, settings, ticks, theorem, messages.truths, name, facts, part)


def _facts(recording: Recording, session: Session, messages: events.Messages) -> dict[str, dict[str, Any]]:
    """Facts about software and host by role."""
    described = session.descriptions.items()
    facts = {role: {"host": one.host, **one.facts, "versions": one.versions} for role, one in described}
    for kind, values in recording.metadata.items():
        facts.setdefault(kind, {}).update(values)
    for _, role, status in messages.published:
        if isinstance(status, Status) and status.notes:
            facts.setdefault(role, {})["notes"] = status.notes
    return facts


def _last_tick(gap: Missing | Unknown) -> float:
    return inf if gap.last_tick is None else gap.last_tick


def _in_words(part: tuple[float, float]) -> str:
    since, until = max(0.0, part[0]), part[1]
    return f"from {since:g} s on" if until == inf else f"from {since:g} s to {until:g} s"


def disagreements(described: Mapping[str, Description]) -> list[Disagreement]:
    """Keys of the loop, the wire and the plant in which the two ends' configurations differ."""
    if not {"controller", "plant"} <= described.keys():
        return []
    controller, plant = (flat(described[role].config) for role in ("controller", "plant"))
    return [
        Disagreement(key=key, controller=controller.get(key), plant=plant.get(key))
        for key in sorted(controller.keys() | plant.keys())
        if key.startswith(("loop.", "wire.", "plant.")) and not key.startswith(OWN_AFFAIRS)
        if controller.get(key) != plant.get(key)
    ]


# ── several runs side by side ──


def compared(reports: Sequence[Report]) -> dict[str, Any]:
    """Findings of runs by their names, which differ, and what differs in their configurations, as `--json` prints it.

    A dotted key whose value is not the same in every run has a value by run, null where a run has no such key.
    """
    runs = {run.name: run.findings for run in reports}
    rows = [{"key": key, "values": dict(zip(runs, values, strict=True))} for key, values in differences(reports)]
    return {"runs": runs, "differences": rows}


def read_runs(logs: Sequence[Path], limits: Sequence[Limit] = (), progress: Progress | None = None) -> list[Report]:
    """A report of every log or folder, each a run of its own, checked against limits. Raises as `read` does.

    Logs of one name are named with their folders, and if that is not enough, by number.
    """

    def share(done: int) -> Progress | None:
        return None if progress is None else lambda part: progress((done + part) / len(logs))

    points = MAX_POINTS // len(logs)  # one page holds them all
    runs = [read(log, progress=share(i)).report(limits, points) for i, log in enumerate(logs)]
    alike, names = [run.name for run in runs], list[str]()
    for name, log in zip(alike, logs, strict=True):
        long = name if alike.count(name) == 1 else f"{log.resolve().parent.name}/{name}"
        names.append(long if long not in names else f"{long} ({sum(one.startswith(long) for one in names) + 1})")
    return [replace(run, name=name) for run, name in zip(runs, names, strict=True)]
