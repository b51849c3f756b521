"""Data of the page's drawings, as JSON: every tick of every line, packed small enough that minutes open at once.

A line is whole numbers of a step that is 2⁻²² of the line's extent, far finer than a pixel at any zoom; of them the
differences are kept, zigzag-coded (0, −1, 1, −2… as 0, 1, 2, 3…), the least significant bytes of all first, deflated,
in base64. Values of a quantizer repeat, so they take next to nothing. data.js reads it back. The panels of several runs
are overlaid by group and label.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from json import dumps
from math import floor, isfinite, log10
from typing import Any, Final
from zlib import compress

import numpy as np

from aeroloop.service.logs.session import Array
from aeroloop.service.review.report import Line, Mark, Panel, Report

SPREADS: Final = {
    "latency": "Latency: from a measurement to the command that answers it",
    "measurement_delay": "From the plant to the controller",
    "command_delay": "From the controller to the plant",
    "period": "Period between measurements",
}
"""Distributions in the order of drawing, with their titles."""

LEVELS: Final = 1 << 22
"""Steps of a line."""

TIME_LEVELS: Final = 1 << 30
"""Steps of the time axis: of a day, 80 µs."""

GRAVE: Final = frozenset({"tripped", "fault", "lost", "refused"})
"""Kinds of events that are highlighted."""

Json = dict[str, Any]


def page_data(reports: Sequence[Report]) -> str:
    """Everything that is drawn, as JSON that may stand in a script element."""
    kept = {"p50", "p99", "p999", "max", "bins"}
    timings = [{name: spread.model_dump(include=kept) for name, spread in r.findings.timing.items()} for r in reports]
    spreads = [{"id": name, "runs": [timing.get(name) for timing in timings]} for name in spread_names(reports)]
    runs, groups = [_run(report) for report in reports], list(_groups(reports))
    data = {"span": _span(reports), "runs": runs, "groups": groups, "spreads": spreads, "bands": _bands(reports)}
    # These occur inside JSON strings only; without them, no text can end the script or start a comment.
    return dumps(data, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def group_titles(reports: Sequence[Report]) -> dict[str, str]:
    """Groups of panels in order, with the title of each; if titles differ between runs, all of them."""
    titles: dict[str, dict[str, None]] = {}
    for report in reports:
        for panel in report.panels:
            titles.setdefault(panel.group, {})[panel.title] = None
    return {group: " / ".join(names) for group, names in titles.items()}


def spread_names(reports: Sequence[Report]) -> list[str]:
    """Distributions that at least one run has."""
    had = [name for report in reports for name in report.findings.timing]
    return sorted(set(had), key=lambda name: (list(SPREADS).index(name) if name in SPREADS else len(SPREADS), name))


def grave(mark: Mark) -> bool:
    """Whether an event is highlighted."""
    return mark.kind in GRAVE


def period_s(report: Report) -> float | None:
    """The loop's period [s], as configured; None if the log does not have it."""
    rate = report.settings.get("loop", {}).get("rate_hz")
    return 1 / rate if isinstance(rate, int | float) and rate > 0 else None


def _span(reports: Sequence[Report]) -> tuple[float, float]:
    """Time span of the page, with a margin, so that events at its ends are visible."""
    times = [float(time) for report in reports for time in (*report.time[:1], *report.time[-1:])]
    if not any(report.part for report in reports):
        times += [mark.time_s for report in reports for mark in report.findings.marks if mark.time_s is not None]
    start, end = (min(times), max(times)) if times else (0.0, 1.0)
    room = 0.01 * (end - start) or 0.5
    return start - room, end + room


def _bands(reports: Sequence[Report]) -> list[Json]:
    """Shaded spans of time, of all runs; one that did not end lasts to the end of its run's lines."""
    return [
        {"run": run, "from": band.start_s, "to": float(report.time[-1]) if band.end_s is None else band.end_s,
         "label": band.label}
        for run, report in enumerate(reports)
        for band in report.bands
        if band.end_s is not None or len(report.time)
    ]  # fmt: skip


def _run(report: Report) -> Json:
    period = period_s(report) or 0.0
    return {
        "name": report.name,
        "time": packed(report.time, TIME_LEVELS),
        "exact": report.thinned <= 2,
        "marks": sorted([m.time_s, grave(m)] for m in report.findings.marks if m.time_s is not None),
        "gaps": [[gap.time_s, gap.time_s + gap.ticks * period] for gap in report.findings.gaps],
    }


def _groups(reports: Sequence[Report]) -> Iterator[Json]:
    for group in group_titles(reports):
        panels: dict[str, list[tuple[int, Panel]]] = {}
        for run, report in enumerate(reports):
            for panel in report.panels:
                if panel.group == group:
                    panels.setdefault(panel.label, []).append((run, panel))
        shared = all(_desired_agree(alike, reports) for alike in panels.values())
        yield {"id": group, "panels": [_panel(label, alike, reports, shared) for label, alike in panels.items()]}


def _panel(label: str, alike: Sequence[tuple[int, Panel]], reports: Sequence[Report], shared: bool) -> Json:
    least, most = _extent([line.values for _, panel in alike for line in panel.lines])
    unit = alike[0][1].unit
    return {
        "label": label,
        "unit": "" if unit == "1" else unit,
        "decimals": _decimals(max(abs(least), abs(most))),
        "log": unit in {"µs", "ms", "s"} and least > 0 and most > 30 * least,
        "lines": [
            {"run": run, "label": line.label, "desired": line.desired, "shared": shared and line.desired, "nth": nth,
             "held": line.held, "sparse": _sparse(line.values), "values": packed(line.values)}
            for run, nth, line in _lines(alike, reports, shared)
        ],
    }  # fmt: skip


def _lines(
    alike: Sequence[tuple[int, Panel]], reports: Sequence[Report], shared: bool
) -> Iterator[tuple[int, int, Line]]:
    """Run, index within its kind, and line; of shared desired lines, the longest run's only."""
    longest = max((run for run, _ in alike), key=lambda run: reports[run].findings.duration_s)
    for run, panel in alike:
        count = {True: 0, False: 0}
        for line in panel.lines:
            if not (line.desired and shared) or run == longest:
                yield run, count[line.desired], line
            count[line.desired] += 1


def _desired_agree(alike: Sequence[tuple[int, Panel]], reports: Sequence[Report]) -> bool:
    """Whether the desired values of all runs agree, so that one line can stand for all."""
    desired = [(reports[run].time, line.values) for run, panel in alike for line in panel.lines if line.desired]
    one_each = len(desired) in (0, len(alike)) and len(alike) == len(reports)
    least, most = _extent([line.values for _, panel in alike for line in panel.lines])
    visible = 0.02 * max(abs(least), abs(most))
    return one_each and all(_agree(visible, *desired[0], *other) for other in desired[1:])


def _agree(visible: float, time: Array, values: Array, other_time: Array, other_values: Array) -> bool:
    """Whether two lines, each sampled in its own way, are nowhere visibly apart, for as long as both last."""
    if not (len(time) and len(other_time)):
        return False
    both = (time >= other_time[0]) & (time <= other_time[-1]) & np.isfinite(values)
    apart = np.abs(np.interp(time[both], other_time, other_values) - values[both])
    apart = apart[np.isfinite(apart)]
    return bool(len(apart) and apart.max() <= visible)


def _sparse(values: Array) -> bool:
    """Whether most times have no value: the line is published less often than every tick, and has no gaps there."""
    return bool(2 * np.isfinite(values).sum() < len(values))


def _extent(values: Sequence[Array]) -> tuple[float, float]:
    finite = np.concatenate([v[np.isfinite(v)] for v in values])
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)


def _decimals(largest: float) -> int:
    """Digits behind the point that show a ten-thousandth of the largest value."""
    return min(9, max(0, 3 - floor(log10(largest)))) if largest > 0 and isfinite(largest) else 3


def packed(values: Array, levels: int = LEVELS) -> Json:
    """Values as data.js unpacks them: `least` + `step` · the sum of all `deltas` so far, NaN where the sum is negative.

    What is not finite becomes NaN. Their extent has so many levels. Shape (n,).
    """
    known = np.isfinite(values)
    least, most = _extent([values])
    step = (most - least) / levels or 1.0
    codes = np.full(len(values), -1, dtype=np.int64)
    codes[known] = np.rint((values[known] - least) / step)
    deltas = np.diff(codes, prepend=0)
    zigzag = np.where(deltas < 0, -2 * deltas - 1, 2 * deltas).astype("<u4")
    planes = zigzag.view(np.uint8).reshape(-1, 4).T
    return {"least": least, "step": step, "deltas": b64encode(compress(planes.tobytes())).decode()}
