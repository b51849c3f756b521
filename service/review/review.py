"""Review of a log: every figure, from the log alone.

The log holds the configuration (roles' descriptions) and what each end did (traces), so the review recomputes the
controller, bit for bit. Of several sessions, it judges the longest, unless one is named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.topics import Address
from aeroloop.service.config import ConfigError
from aeroloop.service.figures import Figures
from aeroloop.service.logs.files import Progress, ReviewError
from aeroloop.service.logs.runs import Run, Taker
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import SessionKey
from aeroloop.service.review.certified_bounds import certified_bounds
from aeroloop.service.review.events import EventLog
from aeroloop.service.review.findings import facts_of, findings_of, latency_of, name_of
from aeroloop.service.review.observe import WHOLE, DrawnPart
from aeroloop.service.review.report import Band, Findings, Report
from aeroloop.service.review.requirements import Limit
from aeroloop.service.review.session import Session
from aeroloop.service.review.theorem_check import TheoremCheck


class Review(NamedTuple):
    """Review of a session of the run `name`: the figures of merit alone, and with everything else the findings."""

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
        if self.session.settings.loop.lockstep:
            panels = [panel for panel in panels if panel.group not in ("latency", "period")]
        if not len(time) and part[:2] != WHOLE[:2]:
            until, lasts = "" if part.until_s == inf else f" and before {part.until_s:g} s", self.findings.duration_s
            raise ReviewError(f"nothing to draw after {max(0.0, part.since_s):g} s{until}: the session has {lasts:g} s")
        return Report(
            name=self.name,
            findings=self.findings.model_copy(
                update={"checks": [limit.check(self.findings, limits) for limit in limits]}
            ),
            time=time,
            panels=panels,
            thinned=observer.thinned,
            settings=self.session.settings.description(),
            facts=self.facts,
            part=None if part[:2] == WHOLE[:2] else part[:2],
            bands=[Band(fault.begin_s, fault.end_s, fault.fault) for fault in self.findings.faults],
        )


def review(*paths: Path) -> Figures:
    """Figures of a run's longest session. Raises as `read` does."""
    return read(*paths).figures


def report(
    paths: Sequence[Path], limits: Sequence[Limit] = (), progress: Progress | None = None, part: DrawnPart = WHOLE
) -> Report:
    """Report of a run's longest session, checked against limits; `part` of it is drawn. Raises as `read` does."""
    return read(*paths, progress=progress, part=part).report(limits)


def read(
    *paths: Path,
    session: str | None = None,
    vehicle: str | None = None,
    watch: Callable[[Ticks], None] | None = None,
    progress: Progress | None = None,
    part: DrawnPart = WHOLE,
) -> Review:
    """Read a run and judge a session. The figures list what cannot be read of a broken file.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        session: As of `Run.choose`.
        vehicle: As of `Run.choose`.
        watch: Called with every block of the session's ticks.
        progress: Called repeatedly with the share done, 0…1.
        part: What of it is drawn.

    Raises:
        ReviewError: Not a log, several unrelated runs, or no such session.
    """
    try:
        run = Run(paths, progress)
        which = run.choose(session, vehicle)
        settings, description = run.settings(which), run.described(which).get("controller")

        def check(changes: Sequence[Change]) -> TheoremCheck:
            certified = certified_bounds(settings, changes, description.certificate if description else None)
            return TheoremCheck(certified, settings)

        missing = [gap for gap in run.missing if (gap.vehicle, gap.session) == which]
        judged = Session(settings, check, missing, watch, part)
        events = EventLog(which, settings.loop.period, run.extents[which], alone=session is not None)

        def route(address: Address) -> Taker | None:
            if address.topic.name == "truth":
                return judged.truth if address.vehicle == which[0] else None
            return events.route(address)

        for block in run.read([which], route):
            events.take(block)
            judged.take(block)
        judged.finish()
    except ConfigError as error:
        raise ReviewError(f"{paths[0]} is not a log of this version: {str(error).splitlines()[0]}") from None
    latency, reason = latency_of(judged)
    unreadable = Counter(events.unreadable)
    if judged.unreadable:
        unreadable["truth"] += judged.unreadable
    damages = [f"malformed: {count} of {topic}" for topic, count in sorted(unreadable.items())]
    figures = judged.score.figures(
        latency=latency,
        log=run.files.name,
        trips=events.trips,
        reasons={} if latency else {"latency_us": reason},
        damages=[*run.files.unread, *damages],
    )
    findings = findings_of(figures, which, judged, events, run)
    return Review(figures, findings, judged, which, name_of(paths), facts_of(run, events, which))
