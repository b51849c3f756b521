"""Top of the page: name of each run, verdict, figures, and what of the files could not be read.

What a verdict rests on has its time, as a button that shows the drawings there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from aeroloop.service.report.page.data import grave
from aeroloop.service.report.page.markup import Html, joined, jump, tag
from aeroloop.service.report.rows import THEOREM, Row, Value, figure_rows, micros, seconds
from aeroloop.service.review.report import Check, Findings, Report

MOMENTS = 5
"""Trips, faults and losses that a verdict lists."""


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
    counts = ", ".join(f"{count:,} {effect}" for effect, count in changed.items())
    because = f"{found.because} {_count(len(run.faults), 'fault')} acted at the plant: {counts}."
    return Judgement(f"{found.word}, with faults", found.good, because)


def _judgement(run: Findings) -> Judgement:
    broken = [check for check in run.checks if not check.holds]
    if broken:
        return Judgement("Not held", False, f"{len(broken)} of {_count(len(run.checks), 'limit')} broken.")
    if run.checks:
        return Judgement("Held", True, f"{_count(len(run.checks), 'limit')} required, none broken.")
    if run.z_track is None:
        return Judgement("Nothing to judge", False, run.reasons.get("z_track", "no measurement was answered"))
    if run.trips:
        times = "once" if len(run.trips) == 1 else f"{len(run.trips)} times"
        return Judgement("Tripped", False, f"The plant went to 0 V by itself {times}.")
    return Judgement("Tracked", None, "The plant never went to 0 V by itself; no limit was required.")


def run_name(report: Report, index: int, of: int) -> Html:
    """A run's name; beside others, with its colour."""
    swatch = tag("i", class_="swatch", style=f"--line: var(--run-{index % 8})") if of > 1 else Html("")
    return tag("span", swatch, report.name, class_="run")


def masthead(reports: Sequence[Report]) -> Html:
    """Heading: the names of the runs."""
    if len(reports) > 1:
        names = joined(tag("li", run_name(r, i, len(reports)), " ", _when(r)) for i, r in enumerate(reports))
        return joined([tag("h1", f"{len(reports)} runs compared"), tag("ul", names, class_="runs")])
    return joined([tag("h1", reports[0].name), tag("p", _when(reports[0]), class_="quiet")])


def verdict(reports: Sequence[Report]) -> Html:
    """Whether each run held, check by check."""
    return joined(_verdict(report, index, len(reports)) for index, report in enumerate(reports))


def _verdict(report: Report, index: int, of: int) -> Html:
    found = judgement(report.findings)
    mood, sign = {True: ("good", "✓"), False: ("bad", "✗"), None: ("neutral", "●")}[found.good]
    checks, facts = report.findings.checks, [*_moments(report, index), *_facts(report)]
    return tag(
        "div",
        run_name(report, index, of) if of > 1 else None,
        tag("p", tag("span", sign, aria_hidden="true"), f" {found.word}", class_="word"),
        tag("p", found.because, class_="because"),
        tag("ul", [_check(check) for check in checks], class_="checks") if checks else None,
        tag("ul", [tag("li", fact) for fact in facts], class_="facts") if facts else None,
        class_=f"verdict {mood}",
    )


def _check(check: Check) -> Html:
    return tag(
        "li",
        tag("span", "✓" if check.holds else "✗", class_="sign", aria_hidden="true"),
        tag("span", check.text, class_="asked"),
        tag("span", ("holds: " if check.holds else "does not hold: ") + check.found, class_="found"),
        class_="good" if check.holds else "bad",
    )


def _moments(report: Report, index: int) -> list[Html]:
    """Trips, faults and losses with their times, and the time of the largest error that is drawn."""
    grave_marks = sorted(filter(grave, report.findings.marks), key=lambda mark: mark.time_s is None)
    moments = []
    for mark in grave_marks[:MOMENTS]:
        at = Html(" outside of the session that is judged")
        if mark.time_s is not None:
            at = joined([" at ", jump(mark.time_s, index, f"{mark.kind}, {mark.role}: {mark.text}"), " s"])
        moments.append(joined([tag("b", mark.kind), at, f" ({mark.role}): {mark.text}"]))
    if len(grave_marks) > MOMENTS:
        more = tag("a", "all events", href="#events")
        moments.append(joined([f"{len(grave_marks) - MOMENTS:,} more trips, faults and losses: see ", more]))
    for panel in report.panels:
        if panel.group == "error_angle":
            values = panel.lines[0].values
            time_s = float(report.time[int(np.nanargmax(values))])
            text = f"Largest attitude error{' of the part that is drawn' if report.part else ''}: "
            most = f"{float(np.nanmax(values)):.2f}°"
            moments.append(joined([text, most, " at ", jump(time_s, index, f"largest attitude error, {most}"), " s"]))
    return moments


def _facts(report: Report) -> list[str]:
    run, facts = report.findings, []
    if run.sessions > 1:
        facts.append(f"The longest of {run.sessions} sessions is judged.")
    if report.settings.get("loop", {}).get("lockstep"):
        facts.append("The loop ran in lockstep: its durations are not those of real time.")
    if run.losses:
        facts.append(f"The recorder lost {_count(sum(run.losses.values()), 'message')}.")
    if missing := sum(run.missing_ticks.values()):
        facts.append(f"{_count(missing, 'tick')} were not recorded.")
    if run.damages:
        facts.append("Not all of the log could be read.")
    return facts


def figures(reports: Sequence[Report]) -> Html:
    """Figures of merit: of one run as cards and a table of the rest, of several side by side."""
    rows = [row for row in figure_rows([report.findings for report in reports]) if not row.key.startswith(THEOREM)]
    if len(reports) > 1:
        return figures_table(reports, rows)
    rest = [row for row in rows if not row.figure.main]
    more = tag("details", tag("summary", "Every other figure"), figures_table(reports, rest)) if rest else Html("")
    cards = [_card(row, _beside(row, reports[0].findings)) for row in rows if row.figure.main]
    return joined([tag("dl", cards, class_="cards"), more])


def _beside(row: Row, run: Findings) -> str:
    """What a figure is; beside the median latency, the 99th percentile."""
    tail = run.latency_us if row.key == "latency_us" else None
    return row.figure.what + (f"; p99 {micros(tail.p99)}" if tail else "")


def _card(row: Row, what: str) -> Html:
    value = row.values[0]
    unit = None if value.text == "–" else row.unit if row.unit == "°" else f" {row.unit}"
    return tag("div", tag("dt", row.name), tag("dd", tag("b", value.text), unit), _why(value) or tag("small", what),
               class_="card", title=row.key)  # fmt: skip


def _why(value: Value) -> Html | None:
    return tag("small", value.why) if value.why else None


def figures_table(reports: Sequence[Report], rows: Sequence[Row]) -> Html:
    """Figures of one run, or of several side by side, each with its difference to the first."""
    several, runs = len(reports) > 1, range(len(reports))
    head = [tag("th", "Figure"), *_each(
        [tag("th", run_name(reports[i], i, len(reports)) if several else "", class_="number") for i in runs],
        [tag("th", f"Δ to {reports[0].name}", class_="number") for _ in runs],
    ), tag("th", "Unit")]  # fmt: skip
    body = [
        tag("tr", tag("th", row.name, scope="row", title=row.figure.what or None), _each(
            [tag("td", value.text, _why(value), class_="number") for value in row.values],
            [_delta(row, run) for run in runs],
        ), tag("td", row.unit, class_="unit"))
        for row in rows
    ]  # fmt: skip
    return tag("div", tag("table", tag("thead", tag("tr", head)), tag("tbody", body)), class_="scroll")


def _each(values: Sequence[Html], deltas: Sequence[Html]) -> list[Html]:
    """Each run's value, and from the second run on its difference to the first."""
    return [cell for i, value in enumerate(values) for cell in ((value, deltas[i]) if i else (value,))]


def _delta(row: Row, run: int) -> Html:
    delta = row.delta(run)
    if delta is None:
        return tag("td", "–", class_="number delta")
    sign = {"better": "▼ ", "worse": "▲ "}.get(delta.word or "", "")
    word = tag("span", f"{sign}{delta.word or ''}", class_=f"word {delta.word or ''}")
    return tag("td", delta.text, " ", word, class_="number delta")


def broken(reports: Sequence[Report]) -> Html:
    """Damages of the files, missing rows and losses of the recorder; empty if there are none."""
    items = []
    for index, report in enumerate(reports):
        name = run_name(report, index, len(reports)) if len(reports) > 1 else Html("")
        lost = [f"the recorder lost {_count(n, 'message')} of {topic}" for topic, n in report.findings.losses.items()]
        missing = [f"not recorded: {gap}" for gap in report.findings.missing if gap.rows]
        missing += [str(one) for one in report.findings.unknown]
        items += [tag("li", name, " " if name else "", text) for text in [*report.findings.damages, *missing, *lost]]
    return tag("ul", items) if items else Html("")


def _when(report: Report) -> Html:
    run = report.findings
    started = f"{run.started[:19].replace('T', ' ')} UTC" if run.started else ""
    parts = [run.vehicle, f"session {run.session}", started, f"{seconds(run.duration_s)} s"]
    return tag("span", " · ".join(part for part in parts if part), class_="quiet")


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}" + ("" if n == 1 else "s")
