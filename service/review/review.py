"""Review of a log: every figure, from the log alone.

The log holds the configuration (roles' descriptions) and what each end did (traces), so the review recomputes the
controller, bit for bit. Of several sessions, it judges the longest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.topics import Address
from aeroloop.service.config import ConfigError
from aeroloop.service.figures import Figures
from aeroloop.service.logs.files import Progress, ReviewError
from aeroloop.service.logs.runs import Run, Taker
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import SessionKey
from aeroloop.service.logs.wire_check import WireCheck
from aeroloop.service.review.certified_bounds import certified_bounds, damping_of
from aeroloop.service.review.events import EventLog
from aeroloop.service.review.findings import IN_LOCKSTEP, facts_of, findings_of, name_of
from aeroloop.service.review.observe import WHOLE, DrawnPart
from aeroloop.service.review.report import Findings, Report
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.session import Session
from aeroloop.service.review.theorem_check import TheoremCheck


class Review(NamedTuple):
    """Review of a log's longest session.

    Attributes:
        figures: The figures of merit alone.
        findings: The same figures and everything else.
        session: The session.
        which: Its vehicle and name.
        name: Name of the run.
        facts: Facts about software and host, by role.
    """

    figures: Figures
    findings: Findings
    session: Session
    which: SessionKey
    name: str
    facts: dict[str, dict[str, Any]]

    def report(self, limits: Sequence[Limit] = ()) -> Report:
        """The review as data, checked against limits. Raises ReviewError if the part to draw has no tick."""
        observer, part = self.session.observer, self.session.part
        time, panels = observer.lines()
        if not len(time) and part[:2] != WHOLE[:2]:
            until, lasts = "" if part.until_s == inf else f" and before {part.until_s:g} s", self.findings.duration_s
            raise ReviewError(f"nothing to draw after {max(0.0, part.since_s):g} s{until}: the session has {lasts:g} s")
        return Report(
            name=self.name,
            findings=self.findings.model_copy(update={"checks": [limit.check(self.findings) for limit in limits]}),
            time=time,
            panels=panels,
            thinned=observer.thinned,
            settings=self.session.settings.description(),
            facts=self.facts,
            part=None if part[:2] == WHOLE[:2] else part[:2],
        )


def review(*paths: Path) -> Figures:
    """Figures of a run's longest session. Raises as `read` does."""
    return read(*paths).figures


def report(
    paths: Sequence[Path],
    limits: Sequence[Limit] = (),
    progress: Progress | None = None,
    part: DrawnPart = WHOLE,
) -> Report:
    """Report of a run's longest session. Raises as `read` does.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        limits: Limits that its figures must keep.
        progress: Called repeatedly with the share done, 0…1.
        part: What of it is drawn.
    """
    return read(*paths, progress=progress, part=part).report(limits)


def read(
    *paths: Path,
    watch: Callable[[Ticks], None] | None = None,
    progress: Progress | None = None,
    part: DrawnPart = WHOLE,
) -> Review:
    """Read a run and judge its longest session. The figures list what cannot be read of a broken file.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        watch: Called with every block of the session's ticks.
        progress: Called repeatedly with the share done, 0…1.
        part: What of it is drawn.

    Raises:
        ReviewError: Not a log, or one without a session.
    """
    try:
        run = Run(paths, progress)
        which = run.longest
        vehicle, files = which[0], run.files
        settings, plant = files.settings(vehicle), files.plant(vehicle)
        description = files.descriptions.get((vehicle, "controller"))

        def check(changes: Sequence[Change]) -> TheoremCheck:
            certified = certified_bounds(settings, changes, description.certificate if description else None)
            return TheoremCheck(certified, settings.loop.period, damping_of(plant))

        missing = [gap for gap in run.missing if (gap.vehicle, gap.session) == which]
        session = Session(settings, plant.watchdog_s, check, missing, watch, part)
        frames = WireCheck(which, settings.wire, run.reached)
        events = EventLog(which, settings.loop.period, run.reached, run.open_sessions)

        def route(address: Address) -> Taker | None:
            if address.topic.name == "truth":
                return session.truth if address.vehicle == vehicle else None
            return frames.route(address) or events.route(address)

        for block in run.read([which], route):
            events.changed(block.changes)
            frames.take(block)
            session.take(block)
        session.finish()
    except (ValidationError, ConfigError) as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None
    lockstep = settings.loop.lockstep
    latency = None if lockstep else session.observer.latency
    why = IN_LOCKSTEP if lockstep else "the plant received no answer to a measurement of this session"
    reasons = {} if latency else {"latency_us": why}
    figures = session.score.figures(
        latency=latency, log=files.name, trips=events.trips, reasons=reasons, damages=files.unread
    )
    findings = findings_of(figures, which, session, events, run, frames.findings())
    return Review(figures, findings, session, which, name_of(paths), facts_of(run, events, vehicle))
