"""Tables of events, gaps, durations and wire traffic.

Every time is a button that moves all time axes there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from aeroloop.service.report.page.data import SPREADS, grave, period_s, spread_names
from aeroloop.service.report.page.markup import Html, joined, tag
from aeroloop.service.report.page.verdict import run_name
from aeroloop.service.report.rows import micros, percent, seconds
from aeroloop.service.review.report import Report

Column = tuple[str, bool]
"""A column's head, and whether it holds numbers."""

TEXT = "Text"
"""The column that takes the remaining width, and wraps."""


def table(columns: Sequence[Column], rows: Sequence[Sequence[Html | str]], *, tall: bool = False) -> Html:
    """A table that scrolls by itself where it does not fit."""
    kinds = ["number" if number else "text" if name == TEXT else None for name, number in columns]
    body = [tag("tr", [tag("td", cell, class_=kind) for cell, kind in zip(row, kinds, strict=True)]) for row in rows]
    head = [tag("th", name, class_=kind) for (name, _), kind in zip(columns, kinds, strict=True)]
    return tag(
        "div",
        tag("table", tag("thead", tag("tr", head)), tag("tbody", body)),
        class_="scroll tall" if tall else "scroll",
    )


def events(reports: Sequence[Report]) -> Html:
    """Events in order of time, run by run."""
    rows = []
    for index, report in enumerate(reports):
        for mark in report.findings.marks:
            where: Html | str = "–" if mark.time_s is None else jump(mark.time_s, index, f"{mark.kind} {mark.text}")
            kind = tag("span", mark.kind, class_="kind grave" if grave(mark) else "kind")
            rows.append([*run_cell(reports, index), where, kind, mark.role, mark.text])
    if not rows:
        return tag("p", "None: no event, no change, no loss.", class_="quiet")
    return table(
        [*run_column(reports), ("Time [s]", True), ("What", False), ("Role", False), (TEXT, False)], rows, tall=True
    )


def gaps(reports: Sequence[Report]) -> Html:
    """Ticks in a row that no command answered."""
    total = sum(report.findings.gap_count for report in reports)
    if not total:
        return tag("p", "None: a command answered every tick.", class_="quiet")
    rows = []
    for index, report in enumerate(reports):
        period = period_s(report)
        for gap in report.findings.gaps:
            lasts = "–" if period is None else f"{1e3 * period * gap.ticks:,.4g}"
            where = jump(gap.time_s, index, f"gap of {gap.ticks} ticks")
            rows.append([*run_cell(reports, index), where, f"{gap.tick:,}", f"{gap.ticks:,}", lasts])
    columns: list[Column] = [("Time [s]", True), ("From tick", True), ("Ticks", True), ("Length [ms]", True)]
    summary = f"{total:,} in all" + (f", the longest {len(rows):,} of them listed" if len(rows) < total else "")
    return joined([tag("p", f"{summary}.", class_="quiet"), table([*run_column(reports), *columns], rows, tall=True)])


def timing(reports: Sequence[Report]) -> Html:
    """Percentiles of every distribution."""
    rows = []
    for name in spread_names(reports):
        for index, report in enumerate(reports):
            spread = report.findings.timing.get(name)
            if spread is not None:
                points = (spread.p50, spread.p90, spread.p99, spread.p999, spread.max)
                rows.append(
                    [*run_cell(reports, index), name.replace("_", " "), *map(micros, points), f"{spread.count:,}"]
                )
    for index, report in enumerate(reports):
        age = report.findings.age_us
        if age:
            points_or_not = [micros(age[p]) if p in age else "–" for p in ("p50", "p90", "p99", "p999", "max")]
            rows.append([*run_cell(reports, index), "age when used", *points_or_not, "–"])
    if not rows:
        reasons = {report.findings.reasons.get("latency_us", "not measured") for report in reports}
        return tag("p", f"No durations: {'; '.join(sorted(reasons))}.", class_="quiet")
    heads = ("p50", "p90", "p99", "p99.9", "longest", "count")
    return table([*run_column(reports), ("Duration", False), *((head, True) for head in heads)], rows)


def spread_title(name: str) -> str:
    """Title of a distribution."""
    return SPREADS.get(name, name)


def wire(reports: Sequence[Report]) -> Html:
    """Frames and bits of each direction, and how often a value was at its quantizer's outermost level."""
    streams, values = [], []
    for name, way in (("measurement", "plant → controller"), ("command", "controller → plant")):
        for index, report in enumerate(reports):
            run = report.findings
            stream = run.measurement if name == "measurement" else run.command
            rates = ["–" if r is None else f"{r:,.{d}f}" for r, d in ((stream.frames_per_s, 1), (stream.bits_per_s, 0))]
            invalid = f"{run.invalid.get(name, 0):,}"
            streams.append([*run_cell(reports, index), name, way, *rates, invalid])
    for name, symbol in (("attitude", "ε"), ("rate", "ω"), ("voltage", "u")):
        for index, report in enumerate(reports):
            run, signal = report.findings, report.settings.get("wire", {}).get(name, {})
            share = percent(run.saturated[name]) if name in run.saturated else "–"
            values.append([*run_cell(reports, index), f"{name} {symbol}", *_quantizer(signal), share])
    first = table(
        [*run_column(reports), ("Frames", False), ("Direction", False), ("Frames/s", True), ("Bit/s", True),
         ("Without a valid value", True)],
        streams,
    )  # fmt: skip
    second = table(
        [
            *run_column(reports),
            ("Value", False),
            ("Quantizer", False),
            ("Bits", True),
            ("Limit", True),
            ("At the outermost level [%]", True),
        ],
        values,
    )
    return joined([first, second])


def _quantizer(signal: dict[str, Any]) -> tuple[str, str, str]:
    """Kind, bits, limit; an old log without a kind has the uniform one."""
    if not signal:
        return "–", "–", "–"
    bits, limit = signal.get("bits"), signal.get("limit")
    kind, bits = ("–", "cont") if bits is None else (signal.get("kind", "uniform"), str(bits))
    return kind, bits, f"±{limit:g}" if isinstance(limit, int | float) else "–"


def jump(time_s: float, run: int, what: str) -> Html:
    """A button that moves every time axis to a time of a run."""
    shown = seconds(time_s)
    return tag("button", shown, type="button", class_="jump", data_time=time_s, data_run=run,
               aria_label=f"Show {shown} s: {what}")  # fmt: skip


def run_cell(reports: Sequence[Report], index: int) -> list[Html]:
    """A row's first cell where there are several runs."""
    return [run_name(reports[index], index, len(reports))] if len(reports) > 1 else []


def run_column(reports: Sequence[Report]) -> list[Column]:
    """The head of that cell's column."""
    return [("Run", False)] if len(reports) > 1 else []
