"""Tables of events, gaps, durations and wire traffic.

Every time is a button that moves all time axes there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from aeroloop.service.report.page.data import grave, period_s, spread_names
from aeroloop.service.report.page.markup import Html, joined, jump, tag
from aeroloop.service.report.page.verdict import run_name
from aeroloop.service.report.rows import micros, percent
from aeroloop.service.review.report import Report

Column = tuple[str, bool]
"""A column's head, and whether it holds numbers."""

TEXT = "Text"
"""The column that takes the remaining width, and wraps."""


Rows = Sequence[tuple[int, Sequence[Html | str]]]
"""Cells of rows, each with the index of its run."""


def table(reports: Sequence[Report], columns: Sequence[Column], rows: Rows, *, tall: bool = False) -> Html:
    """A table that scrolls by itself where it does not fit; of several runs, its first column is the run."""
    several = len(reports) > 1
    columns = [("Run", False), *columns] if several else columns
    lines = [[run_name(reports[run], run, len(reports)), *cells] if several else cells for run, cells in rows]
    kinds = ["number" if number else "text" if name == TEXT else None for name, number in columns]
    body = [tag("tr", [tag("td", cell, class_=kind) for cell, kind in zip(line, kinds, strict=True)]) for line in lines]
    head = [tag("th", name, class_=kind) for (name, _), kind in zip(columns, kinds, strict=True)]
    return tag(
        "div",
        tag("table", tag("thead", tag("tr", head)), tag("tbody", body)),
        class_="scroll tall" if tall else "scroll",
        tabindex=0 if tall else None,
    )


def events(reports: Sequence[Report]) -> Html:
    """Events in order of time, run by run."""
    rows = []
    for index, report in enumerate(reports):
        for mark in report.findings.marks:
            where: Html | str = "–" if mark.time_s is None else jump(mark.time_s, index, f"{mark.kind} {mark.text}")
            kind = tag("span", mark.kind, class_="kind grave" if grave(mark) else "kind")
            rows.append((index, [where, kind, mark.role, mark.text]))
    if not rows:
        return tag("p", "None: no event, no change, no loss.", class_="quiet")
    columns = [("Time [s]", True), ("What", False), ("Role", False), (TEXT, False)]
    return joined(
        [tag("p", f"{len(rows):,} in order of time.", class_="quiet"), table(reports, columns, rows, tall=True)]
    )


def faults(reports: Sequence[Report]) -> Html:
    """Faults of the plant: when each acted, and how much it changed; empty if there were none."""
    rows = []
    for index, report in enumerate(reports):
        for fault in report.findings.faults:
            end = "–" if fault.end_s is None else jump(fault.end_s, index, f"{fault.fault} ends")
            when = [jump(fault.begin_s, index, f"{fault.fault} begins"), end]
            rows.append((index, [*when, fault.fault, fault.source, f"{fault.changed:,} {fault.effect}"]))
    columns = [("From [s]", True), ("To [s]", True), ("Fault", False), ("Source", False), (TEXT, False)]
    return table(reports, columns, rows) if rows else Html("")


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
            rows.append((index, [where, f"{gap.tick:,}", f"{gap.ticks:,}", lasts]))
    columns = [("Time [s]", True), ("From tick", True), ("Ticks", True), ("Length [ms]", True)]
    summary = f"{total:,} in all" + (f", the longest {len(rows):,} of them listed" if len(rows) < total else "")
    return joined([tag("p", f"{summary}.", class_="quiet"), table(reports, columns, rows, tall=True)])


def timing(reports: Sequence[Report]) -> Html:
    """Percentiles of every distribution."""
    points, rows = ("p50", "p90", "p99", "p999", "max"), []
    for name in spread_names(reports):
        for index, report in enumerate(reports):
            if (spread := report.findings.timing.get(name)) is not None:
                found = [micros(getattr(spread, point)) for point in points]
                rows.append((index, [name.replace("_", " "), *found, f"{spread.count:,}"]))
    for index, report in enumerate(reports):
        if age := report.findings.age_us:
            found = [micros(age[point]) if point in age else "–" for point in points]
            rows.append((index, ["age at the controller", *found, "–"]))
    if not rows:
        reasons = {report.findings.reasons.get("latency_us", "not measured") for report in reports}
        return tag("p", f"No durations: {'; '.join(sorted(reasons))}.", class_="quiet")
    heads = ("p50", "p90", "p99", "p99.9", "longest", "count")
    return table(reports, [("Duration", False), *((head, True) for head in heads)], rows)


def wire(reports: Sequence[Report]) -> Html:
    """Frames and bits of each direction, and how often a value was at its quantizer's outermost level."""
    streams, values = [], []
    for name, way in (("measurement", "plant → controller"), ("command", "controller → plant")):
        for index, report in enumerate(reports):
            run = report.findings
            stream = run.measurement if name == "measurement" else run.command
            rates = ["–" if r is None else f"{r:,.{d}f}" for r, d in ((stream.frames_per_s, 1), (stream.bits_per_s, 0))]
            streams.append((index, [name, way, *rates, f"{run.invalid.get(name, 0):,}"]))
    for name, symbol in (("attitude", "ε"), ("rate", "ω"), ("voltage", "u")):
        for index, report in enumerate(reports):
            run, signal = report.findings, report.settings.get("wire", {}).get(name, {})
            share = percent(run.saturated[name]) if name in run.saturated else "–"
            values.append((index, [f"{name} {symbol}", *_quantizer(signal), share]))
    rates_of = [("Frames", False), ("Direction", False), ("Frames/s", True), ("Bit/s", True)]
    quantizers = [("Value", False), ("Quantizer", False), ("Bits", True), ("Limit", True)]
    first = table(reports, [*rates_of, ("Without a valid value", True)], streams)
    return joined([first, table(reports, [*quantizers, ("At the limit [%]", True)], values)])


def _quantizer(signal: dict[str, Any]) -> tuple[str, str, str]:
    """Kind, bits, limit; an old log without a kind has the uniform one."""
    if not signal:
        return "–", "–", "–"
    bits, limit = signal.get("bits"), signal.get("limit")
    kind, bits = ("–", "cont") if bits is None else (signal.get("kind", "uniform"), str(bits))
    return kind, bits, f"±{limit:g}" if isinstance(limit, int | float) else "–"
