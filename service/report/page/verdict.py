"""Top of the page: name of each run, verdict, figures, and what of the files could not be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from aeroloop.service.report.page.markup import Html, joined, tag
from aeroloop.service.report.rows import THEOREM, Row, Value, figure_rows, seconds
from aeroloop.service.review.report import Check, Findings, Report


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
        return Judgement("Held", True, f"{_count(len(run.checks), 'limit')} asked for, none broken.")
    if run.z_track is None:
        return Judgement("Nothing to judge", False, run.reasons.get("z_track", "no measurement was answered"))
    if run.trips:
        times = "once" if len(run.trips) == 1 else f"{len(run.trips)} times"
        return Judgement("Tripped", False, f"The plant went to 0 V by itself {times}.")
    return Judgement("Tracked", None, "The plant never went to 0 V by itself; no limit was asked for.")


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
    checks, facts = report.findings.checks, [*report.findings.trips, *_facts(report.findings)]
    return tag(
        "div",
        run_name(report, index, of) if of > 1 else None,
        tag("p", tag("span", sign, aria_hidden="true"), f" {found.word}", class_="word"),
        tag("p", found.because),
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


def _facts(run: Findings) -> list[str]:
    facts = []
    if run.sessions > 1:
        facts.append(f"the longest of {run.sessions} sessions is judged")
    if run.losses:
        facts.append(f"the recorder lost {_count(sum(run.losses.values()), 'message')}")
    if missing := sum(run.missing_ticks.values()):
        facts.append(f"{_count(missing, 'tick')} were not recorded")
    if run.damages:
        facts.append("not all of the log could be read")
    return facts


def figures(reports: Sequence[Report]) -> Html:
    """Figures of merit: of one run as cards and a table of the rest, of several side by side."""
    rows = [row for row in figure_rows([report.findings for report in reports]) if not row.key.startswith(THEOREM)]
    if len(reports) > 1:
        return figures_table(reports, rows)
    rest = [row for row in rows if not row.main]
    more = tag("details", tag("summary", "Every other figure"), figures_table(reports, rest)) if rest else Html("")
    return joined([tag("dl", [_card(row) for row in rows if row.main], class_="cards"), more])


def _card(row: Row) -> Html:
    value = row.values[0]
    unit = None if value.text == "–" else row.unit if row.unit == "°" else f" {row.unit}"
    return tag(
        "div", tag("dt", row.name), tag("dd", tag("b", value.text), unit, _why(value)), class_="card", title=row.key
    )


def _why(value: Value) -> Html | None:
    return tag("small", value.why) if value.why else None


def figures_table(reports: Sequence[Report], rows: Sequence[Row]) -> Html:
    """Figures of one run, or of several side by side."""
    several = len(reports) > 1
    head = [run_name(report, index, len(reports)) if several else "" for index, report in enumerate(reports)]
    return tag(
        "div",
        tag(
            "table",
            tag("thead", tag("tr", tag("th", "Figure"), [tag("th", name, class_="number") for name in head],
                tag("th", "Unit"))),
            tag("tbody", [
                tag("tr", tag("th", row.name, scope="row"),
                    [tag("td", value.text, _why(value), class_="number") for value in row.values],
                    tag("td", row.unit, class_="unit"))
                for row in rows
            ]),
        ),
        class_="scroll",
    )  # fmt: skip


def broken(reports: Sequence[Report]) -> Html:
    """Damages of the files, missing rows and losses of the recorder; empty if there are none."""
    items = []
    for index, report in enumerate(reports):
        name = run_name(report, index, len(reports)) if len(reports) > 1 else Html("")
        lost = [f"the recorder lost {_count(n, 'message')} of {topic}" for topic, n in report.findings.losses.items()]
        missing = [f"not recorded: {gap}" for gap in report.findings.missing if gap.rows]
        items += [tag("li", name, " " if name else "", text) for text in [*report.findings.damages, *missing, *lost]]
    return tag("ul", items) if items else Html("")


def _when(report: Report) -> Html:
    run = report.findings
    started = f"{run.started[:19].replace('T', ' ')} UTC" if run.started else ""
    parts = [run.vehicle, f"session {run.session}", started, f"{seconds(run.duration_s)} s"]
    return tag("span", " · ".join(part for part in parts if part), class_="quiet")


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}" + ("" if n == 1 else "s")
