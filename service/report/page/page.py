"""Assembly of the page: template, sections, data, scripts and plotly.js in one text that needs no network.

The page's content security policy lists every script by its hash, so that the browser runs no other script, whatever a
log contains.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from importlib.resources import files
from string import Template
from typing import Final

from aeroloop.service.report.page import setup, tables, theorem, verdict
from aeroloop.service.report.page.data import SPREADS, group_titles, page_data, period_s, spread_names
from aeroloop.service.report.page.markup import Html, joined, tag
from aeroloop.service.review.panels import MAX_POINTS
from aeroloop.service.review.report import Report

SCRIPTS: Final = ("data.js", "window.js", "panels.js", "spreads.js", "controls.js")
"""In order of dependence."""

PROVED: Final[tuple[str, ...]] = ("z_norm", "lyapunov")
"""Groups of panels in the theorem's section."""

TIME_UNITS: Final = frozenset({"s", "ms", "µs"})


def page(reports: Sequence[Report]) -> str:
    """The page of one run, or of several overlaid. Raises ValueError if there is none."""
    if not reports:
        raise ValueError("a page needs a run")
    from plotly.offline import get_plotlyjs

    library = _script(get_plotlyjs())
    ours = _script('"use strict";\n' + "\n".join(_read(name) for name in SCRIPTS))
    title, sections = " – ".join(report.name for report in reports), _sections(reports)
    return Template(_read("page.html")).substitute(
        policy=_policy([library, ours]),
        title=tag("title", f"{title} · aeroloop"),
        style=tag("style", Html("\n" + _read("page.css"))),
        masthead=verdict.masthead(reports),
        navigation=joined(tag("a", name.capitalize(), href=f"#{name}") for name, _, _ in sections),
        runs="several" if len(reports) > 1 else "one",
        verdict=tag("div", verdict.verdict(reports), class_="verdicts"),
        sections=joined(_section(*section) for section in sections),
        data=tag("script", Html(page_data(reports)), type="application/json", id="data"),
        library=library,
        scripts=ours,
    )


def _sections(reports: Sequence[Report]) -> list[tuple[str, str, Html]]:
    """Sections of the page: id, title, contents."""
    broken, promised = verdict.broken(reports), theorem.theorem(reports)
    in_time = {panel.group for report in reports for panel in report.panels if panel.unit in TIME_UNITS}
    titles = group_titles(reports)
    proved = {group: titles.pop(group) for group in PROVED if promised and group in titles}
    several = len(reports) > 1
    drawn = _groups(reports, {group: title for group, title in titles.items() if group not in in_time})
    timing = joined([
        tag("div", [_drawing("spread", name, SPREADS.get(name, name)) for name in spread_names(reports)],
            class_="drawings"),
        tables.timing(reports),
        _groups(reports, {group: title for group, title in titles.items() if group in in_time}),
    ])  # fmt: skip
    configurations = [report.settings for report in reports]
    search = tag("input", type="search", id="search", placeholder="Search keys and values", autocomplete="off",
                 aria_label="Search the configuration and the facts")  # fmt: skip
    return [
        ("figures", "Figures of merit", verdict.figures(reports)),
        *([("differences", "What differs in the configurations", setup.differing(reports))] if several else []),
        *([("missing", "What is missing from the log", broken)] if broken else []),
        ("tracking", "Tracking", joined([_drawn(reports), drawn])),
        *([("theorem", "What the theorem promises", joined([promised, _groups(reports, proved)]))] if promised else []),
        ("events", "Events", joined([tables.faults(reports), tables.events(reports)])),
        ("timing", "Timing", timing),
        ("gaps", "Gaps", tables.gaps(reports)),
        ("wire", "On the wire", tables.wire(reports)),
        ("configuration", "Configuration", joined([search, setup.sections(reports, configurations)])),
        ("facts", "Software and host", setup.sections(reports, [report.facts for report in reports])),
    ]


def _section(name: str, title: str, contents: Html) -> Html:
    return tag("section", tag("h2", title, id=f"{name}-title"), contents, id=name, aria_labelledby=f"{name}-title")


def _groups(reports: Sequence[Report], titles: dict[str, str]) -> Html:
    drawings = []
    for group, title in titles.items():
        panels = max(sum(panel.group == group for panel in report.panels) for report in reports)
        drawings.append(_drawing("group", group, title, panels))
    return tag("div", drawings, class_="drawings")


def _drawing(kind: str, name: str, title: str, panels: int = 1) -> Html:
    """Placeholder of a drawing; it has its height from the start, so that drawing moves nothing."""
    key = tag("span", class_="key")
    plot = tag("div", class_="plot", style=f"--panels: {panels}", tabindex=0, role="group", aria_label=title)
    return tag("figure", tag("figcaption", tag("span", title, class_="name"), key), plot, class_=f"drawing {kind}",
               data_name=name)  # fmt: skip


def _drawn(reports: Sequence[Report]) -> Html:
    """What is drawn, if that is not every tick of the whole session."""
    sentences = []
    if part := next((report.part for report in reports if report.part), None):
        since, until = part[0], min(part[1], float(reports[0].time[-1]))
        sentences.append(
            f"Drawn is the part from {max(0.0, since):g} s to {until:g} s; the figures are of the session."
        )
    thinned = max(reports, key=lambda report: report.thinned)
    if thinned.thinned > 2:
        period = period_s(thinned)
        span = f", {thinned.thinned * period:.3g} s" if period else ""
        sentences.append(
            f"More than {MAX_POINTS // len(reports):,} ticks are thinned out: two points, the least and the largest "
            f"value, stand for up to {thinned.thinned:,} ticks{span}. "
            "`aeroloop log review --from S --to S --html` draws every tick of a part."
        )
    return tag("p", " ".join(sentences), class_="quiet", id="drawn") if sentences else Html("")


def _script(code: str) -> Html:
    return tag("script", Html(f"\n{code}\n"))


def _policy(scripts: Sequence[Html]) -> Html:
    """Content security policy: nothing from outside of this file, and only these scripts."""
    codes = [script.removeprefix("<script>").removesuffix("</script>") for script in scripts]
    hashes = " ".join(f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'" for code in codes)
    rules = f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:"
    return tag("meta", http_equiv="Content-Security-Policy", content=rules)


def _read(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
