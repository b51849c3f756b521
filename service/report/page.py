"""Page of a review: one HTML file of one or several runs that opens without a network.

The template shows findings and configuration as HTML and escapes every text; drawings.py prepares what page.js draws.
The content security policy lists the hashes of the page's scripts: a browser runs no other, whatever a log contains.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from aeroloop.service.report import rows
from aeroloop.service.report.drawings import COLOURS, drawings, page_data, span_of
from aeroloop.service.review.report import Findings, Report, differences, flat
from aeroloop.service.review.requirements import percent, seconds

Json = dict[str, Any]
HERE = Path(__file__).parent
SCRIPTS = ("page.js", "attitude.js")


def page(reports: Sequence[Report]) -> str:
    """The page of one run, or of several overlaid. Raises ValueError if there is none."""
    if not reports:
        raise ValueError("a page needs a run")
    runs = [report.findings for report in reports]
    return rendered(
        "page.html", reports,
        rows=rows.figure_rows(runs), differences=differences(reports),
        configuration=keys_by_section([report.settings for report in reports]),
        facts=keys_by_section([report.facts for report in reports]),
        missing=[rows.missing(run) for run in runs], theorem=[rows.theorem_sentences(run) for run in runs],
        durations=rows.durations(runs), percentiles=[f"{name}#" for name in rows.PERCENTILES.values()],
        verdict=verdict, largest_error=largest_error, thinned=max(reports, key=lambda report: report.thinned),
    )  # fmt: skip


def rendered(template: str, reports: Sequence[Report], *more: str, live: bool = False, **names: Any) -> str:
    """A template with the drawings of some runs and `more` scripts; of a live page the lines are empty."""
    from plotly.offline import get_plotlyjs

    blocks: Json = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, **blocks)
    environment.filters |= {each.__name__: each for each in (seconds, percent, rows.shown, rows.count, rows.micros)}
    environment.tests["grave"] = rows.grave
    scripts = [get_plotlyjs(), *((HERE / name).read_text(encoding="utf-8") for name in (*SCRIPTS, *more))]
    hashes = [f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts]
    policy = f"default-src 'none'; script-src {' '.join(hashes)}; style-src 'unsafe-inline'; img-src data: blob:"
    drawn = drawings(reports)
    return environment.get_template(template).render(
        reports=reports, runs=list(enumerate(reports)), several=len(reports) > 1, colours=COLOURS,
        policy=policy + ("; connect-src 'self'" if live else ""), scripts=scripts,
        style=(HERE / "page.css").read_text(encoding="utf-8"), data=page_data(reports, drawn, live=live),
        drawings=drawn, span=span_of(reports), **names,
    )  # fmt: skip


def verdict(run: Findings) -> tuple[str, bool | None, str]:
    """Verdict on a run in a word, whether it is good (None: nothing was required), and because of what."""
    found: tuple[str, bool | None, str]
    troubles, limits = sum(map(rows.grave, run.marks)), rows.count(len(run.checks), "limit")
    if broken := sum(not check.holds for check in run.checks):
        found = "Not held", False, f"{broken} of {limits} broken."
    elif run.checks:
        found = "Held", True, f"{limits} required, none broken."
    elif run.z_track is None:
        found = "Nothing to judge", False, run.reasons.get("z_track", "no measurement was answered")
    elif run.trips:
        times = "once" if len(run.trips) == 1 else f"{len(run.trips)} times"
        found = "Tripped", False, f"The plant tripped to 0 V {times}."
    elif troubles or run.faults:
        found = "Faults", None, "No trip; faults, losses and refusals are listed below."
    else:
        found = "No trip, no fault", None, "No limit was required."
    if not run.faults:
        return found
    changed = ", ".join(f"{fault.changed:,} {fault.effect}" for fault in run.faults)
    return *found[:2], f"{found[2]} {rows.count(len(run.faults), 'fault')} acted at the plant: {changed}."


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
