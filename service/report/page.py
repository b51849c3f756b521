"""Page of a review: one HTML file of one or several runs that opens without a network.

The template shows findings and configuration as HTML and escapes every text; drawings.py prepares what page.js draws.
The content security policy lists the hashes of the page's scripts: a browser runs no other, whatever a log contains.
"""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Sequence
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from aeroloop.service.report.drawings import drawings, page_data
from aeroloop.service.report.rows import (
    PERCENTILES,
    count,
    durations,
    figure_rows,
    grave,
    micros,
    missing,
    percent,
    seconds,
    shown,
    theorem_sentences,
)
from aeroloop.service.review.report import Findings, Report, differences, flat

Json = dict[str, Any]


def page(reports: Sequence[Report]) -> str:
    """The page of one run, or of several overlaid. Raises ValueError if there is none."""
    if not reports:
        raise ValueError("a page needs a run")
    from plotly.offline import get_plotlyjs

    folder = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"seconds": seconds, "micros": micros, "percent": percent, "shown": shown, "count": count}
    environment.tests["grave"] = grave
    scripts = [get_plotlyjs(), (folder / "page.js").read_text(encoding="utf-8")]
    hashes = [f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts]
    runs, drawn = [report.findings for report in reports], list(drawings(reports))
    return environment.get_template("page.html").render(
        reports=reports,
        runs=list(enumerate(reports)),
        several=len(reports) > 1,
        policy=f"default-src 'none'; script-src {' '.join(hashes)}; style-src 'unsafe-inline'; img-src data: blob:",
        style=(folder / "page.css").read_text(encoding="utf-8"),
        scripts=scripts,
        data=page_data(reports, drawn),
        drawings=drawn,
        rows=figure_rows(runs),
        differences=differences(reports),
        configuration=keys_by_section([report.settings for report in reports]),
        facts=keys_by_section([report.facts for report in reports]),
        missing=[missing(run) for run in runs],
        theorem=[theorem_sentences(run) for run in runs],
        durations=durations(runs),
        percentiles=[f"{name}#" for name in PERCENTILES.values()],
        judgement=judgement,
        largest_error=largest_error,
        thinned=max(reports, key=lambda report: report.thinned),
    )


# ── what the template shows ──


class Judgement(NamedTuple):
    """Verdict on a run in a word, and whether it is good; None without limits and without a failure."""

    word: str
    good: bool | None
    because: str


def judgement(run: Findings) -> Judgement:
    """Verdict by the limits of `--require`; without any, by trips and missing figures. It says if there were faults."""
    found = _judgement(run)
    if not run.faults:
        return found
    changed: Counter[str] = Counter()
    for fault in run.faults:
        changed[fault.effect] += fault.changed
    counts = ", ".join(f"{n:,} {effect}" for effect, n in changed.items())
    because = f"{found.because} {count(len(run.faults), 'fault')} acted at the plant: {counts}."
    return Judgement(f"{found.word}, with faults", found.good, because)


def _judgement(run: Findings) -> Judgement:
    if broken := sum(not check.holds for check in run.checks):
        return Judgement("Not held", False, f"{broken} of {count(len(run.checks), 'limit')} broken.")
    if run.checks:
        return Judgement("Held", True, f"{count(len(run.checks), 'limit')} required, none broken.")
    if run.z_track is None:
        return Judgement("Nothing to judge", False, run.reasons.get("z_track", "no measurement was answered"))
    if run.trips:
        times = "once" if len(run.trips) == 1 else f"{len(run.trips)} times"
        return Judgement("Tripped", False, f"The plant went to 0 V by itself {times}.")
    return Judgement("Tracked", None, "The plant never went to 0 V by itself; no limit was required.")


def largest_error(report: Report) -> tuple[float, float] | None:
    """Time [s] and value [deg] of the largest attitude error that is drawn; None if none is."""
    for panel in report.panels:
        if panel.group == "error_angle":
            most = int(np.nanargmax(panel.lines[0].values))
            return float(report.time[most]), float(panel.lines[0].values[most])
    return None


def keys_by_section(tables: Sequence[Json]) -> dict[str, list[tuple[str, list[Any]]]]:
    """Every dotted key of each run's nested tables with its value in each run, by section."""
    flattened = [flat(table) for table in tables]
    sections: dict[str, list[tuple[str, list[Any]]]] = {}
    for key in dict.fromkeys(chain(*flattened)):
        section, dot, _ = key.partition(".")
        sections.setdefault(section if dot else "", []).append((key, [table.get(key) for table in flattened]))
    return dict(sorted(sections.items()))
