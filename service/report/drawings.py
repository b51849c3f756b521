"""Drawings of the page: Plotly's traces and layouts, as JSON with typed arrays.

Lines have every tick that the report has; page.js reduces them to what is in sight. A colour is one of the style
sheet's, `var(--name)`, which page.js replaces by that of the present theme. Plotly interprets tags in text, so names
and labels are escaped.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from math import ceil, floor, log2, log10, nan
from typing import Any, Final, NamedTuple

import numpy as np

from aeroloop.service.logs.session import Array
from aeroloop.service.report.rows import SPREADS, grave, micros
from aeroloop.service.review.report import Line, Panel, Report

PROVED: Final = ("z_norm", "lyapunov")
"""Groups of panels in the theorem's section."""

DURATIONS: Final = frozenset({"s", "ms", "µs"})
"""Units of panels in the section on timing."""

DASHES: Final = ("solid", "7px,2px", "2px,2px", "9px,2px,2px,2px", "14px,3px", "4px,4px", "12px,2px,2px,2px,2px,2px")
"""Dashes of the lines of runs, in turn."""

NO_COUNT: Final = 0.5
"""Stands for an empty bin on a logarithmic axis."""

INK: Final = {"color": "var(--ink)", "size": 12}
GRID: Final = {"gridcolor": "var(--grid)", "exponentformat": "power", "fixedrange": True}
LAYOUT: Final = {
    "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "font": {"size": 12, "color": "var(--quiet)"},
    "showlegend": False,
    "hoverlabel": {"bgcolor": "var(--raised)", "bordercolor": "var(--rule)", "font": INK, "namelength": -1},
}  # fmt: skip
TIME_AXIS: Final = {
    "title": {"text": "time [s]", "standoff": 4}, "zeroline": False, "gridcolor": "var(--grid)",
    "linecolor": "var(--grid)", "showspikes": True, "spikemode": "across", "spikethickness": 1, "spikedash": "solid",
    "spikecolor": "var(--quiet)", "spikesnap": "cursor", "hoverformat": ".3f",
    "unifiedhovertitle": {"text": "%{x:.3f} s"},
}  # fmt: skip

Json = dict[str, Any]
Alike = list[tuple[int, Panel]]
"""Panels with the same label, each with its run."""


class Stroke(NamedTuple):
    """How a line is drawn, and its entry in the key: that of a run (`run`) hides and shows the run's lines.

    `hover` is its name beside values, if not the same.
    """

    text: str
    colour: str
    width: float
    dash: str = "solid"
    swatch: str = ""
    run: int | None = None
    hover: str = ""

    def trace(self, shape: str) -> Json:
        """A line in this stroke; steps (`hv`) or straight from point to point (`linear`)."""
        line = {"color": self.colour, "width": self.width, "dash": self.dash, "shape": shape}
        return {"type": "scatter", "mode": "lines", "line": line}


class Drawing(NamedTuple):
    """A figure of the page: panels under each other over time, or a distribution, which has no panels."""

    name: str
    title: str
    section: str
    key: Sequence[Stroke]
    figure: Json
    panels: int = 0


def page_data(reports: Sequence[Report], drawn: Sequence[Drawing]) -> str:
    """Everything that is drawn, as JSON that may stand in a script element: no text in it can end the script."""
    from plotly.io.json import to_json_plotly

    times, figures = typed([report.time for report in reports]), {drawing.name: drawing.figure for drawing in drawn}
    data = to_json_plotly({"span": _span(reports), "times": times, "drawings": figures}, engine="json")
    return str(data).replace("\\u002f", "/")  # which numbers are full of; without a `<` it ends nothing


def drawings(reports: Sequence[Report]) -> Iterator[Drawing]:
    """Every drawing: distributions of durations, then the groups of panels in order."""
    had = {name for report in reports for name in report.findings.timing}
    yield from (_spread(name, reports) for name in SPREADS if name in had)
    over_time = list(_shapes(reports)), _band_labels(reports)
    for group in dict.fromkeys(panel.group for report in reports for panel in report.panels):
        yield _group(group, reports, *over_time)


def typed(lines: Sequence[Array]) -> list[Any]:
    """Numbers as Plotly's typed arrays."""
    from plotly.graph_objects import Figure, Scatter

    return [trace["y"] for trace in Figure([Scatter(y=values) for values in lines]).to_dict()["data"]]


# ── panels over time ──


def _group(group: str, reports: Sequence[Report], shapes: list[Json], labels: list[Json]) -> Drawing:
    """Panels of a group under each other; of several runs, those with the same label are overlaid."""
    panels: dict[str, Alike] = {}
    for run, report in enumerate(reports):
        for panel in report.panels:
            if panel.group == group:
                panels.setdefault(panel.label, []).append((run, panel))
    shared = all(_desired_agree(alike, reports) for alike in panels.values())
    rows = len(panels)
    axes = ["", *map(str, range(2, rows + 1))]
    layout: Json = LAYOUT | {
        "margin": {"l": 54, "r": 10, "t": 22 + 14 * len({label["yshift"] for label in labels}), "b": 36},
        "hovermode": "x unified",
        "hoversubplots": "axis",
        "grid": {"rows": rows, "columns": 1, "subplots": [[f"xy{axis}"] for axis in axes]},
        "xaxis": TIME_AXIS | {"anchor": f"y{axes[-1]}"},
        "shapes": shapes,
        "annotations": list(labels),
    }
    traces, values, key = list[Json](), list[Array](), dict[int | str, tuple[bool, Stroke]]()
    room = 12 / (132 * rows)  # for the label above each panel
    for row, (axis, (label, alike)) in enumerate(zip(axes, panels.items(), strict=True)):
        unit = "" if alike[0][1].unit == "1" else alike[0][1].unit
        domain = [1 - (row + 1) / rows + room * (row < rows - 1), 1 - row / rows - room * (row > 0)]
        layout[f"yaxis{axis}"] = GRID | {"domain": domain, "nticks": 5} | _scale(alike, unit)
        layout["annotations"].append({
            "text": _plain(f"{label} [{unit}]" if unit else label), "showarrow": False, "bgcolor": "var(--paper)",
            "xref": "paper", "x": 0, "xanchor": "left", "xshift": 2, "yref": f"y{axis} domain", "y": 1,
            "yanchor": "bottom", "borderpad": 0, "font": INK | {"size": 12.5},
        })  # fmt: skip
        for run, line, stroke in _strokes(alike, reports, shared):
            key[stroke.text if stroke.run is None else stroke.run] = line.desired, stroke
            name = f"{label} {stroke.hover or stroke.text}" if rows > 1 else stroke.hover or stroke.text
            values.append(line.values.astype(np.float32))
            traces.append(stroke.trace("hv" if line.held and reports[run].thinned <= 2 else "linear") | {
                "times": run, "run": None if shared and line.desired else run, "yaxis": f"y{axis}",
                "name": _plain(name), "hovertemplate": _plain(f"%{{y:.4~g}} {unit}"),
                # A line that is published less often than every tick has no gaps between its values.
                "connectgaps": bool(2 * np.isfinite(line.values).sum() < len(line.values)),
            })  # fmt: skip
    figure = {"data": [trace | {"y": y} for trace, y in zip(traces, typed(values), strict=True)], "layout": layout}
    of_group = [panel for alike in panels.values() for _, panel in alike]
    proved = group in PROVED and any(report.findings.theorem for report in reports)
    timing = any(panel.unit in DURATIONS for panel in of_group)
    section = "timing" if timing else "theorem" if proved else "tracking"
    entries = [stroke for _, stroke in sorted(key.values(), key=lambda entry: entry[0])]  # desired ones last
    title, shown = " / ".join(dict.fromkeys(panel.title for panel in of_group)), len(reports) > 1 or len(entries) > 1
    return Drawing(group, title, section, entries if shown else [], figure, rows)


def _strokes(alike: Alike, reports: Sequence[Report], shared: bool) -> Iterator[tuple[int, Line, Stroke]]:
    """Lines with their runs, desired ones first, under the others; of shared ones, the longest run's.

    Colours mean measured, desired and true in one run, and the run among several.
    """
    longest = max((run for run, _ in alike), key=lambda run: reports[run].findings.duration_s)
    for desired in (True, False):
        for run, panel in alike:
            if desired and shared and run != longest:
                continue
            for nth, line in enumerate(line for line in panel.lines if line.desired == desired):
                if len(reports) > 1:
                    stroke = _run_stroke(run, reports)
                    if desired and shared:
                        stroke = Stroke(line.label, "var(--quiet)", 2.5)
                    elif desired or nth:
                        dash, swatch = ("1px,3px", "dot") if desired else ("5px,5px", "dash")
                        hover = f"{reports[run].name}, {line.label}"
                        stroke = Stroke(line.label, stroke.colour, 1, dash, swatch, hover=hover)
                elif desired:
                    stroke = Stroke(line.label, "var(--desired)", 2.5)
                else:
                    dash, swatch = ("solid", "") if line.held else ("6px,4px", "dash")
                    stroke = Stroke(line.label, "var(--run-2)" if nth else "var(--run-0)", 1.1, dash, swatch)
                yield run, line, stroke


def _run_stroke(run: int, reports: Sequence[Report]) -> Stroke:
    """The first of several runs is the widest, and lies below, so that none hides another."""
    width = 1.1 + 1.9 * (len(reports) - 1 - run) / max(1, len(reports) - 1)
    swatch = "" if run == 0 else "dash" if run % 2 else "dot"
    return Stroke(reports[run].name, f"var(--run-{run % 8})", width, DASHES[run % len(DASHES)], swatch, run)


def _extent(alike: Alike) -> tuple[float, float]:
    values = np.concatenate([line.values[np.isfinite(line.values)] for _, panel in alike for line in panel.lines])
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)


def _scale(alike: Alike, unit: str) -> Json:
    """A value axis; durations that differ by more than a factor of 30 have a logarithmic one."""
    least, most = _extent(alike)
    is_wide = unit in DURATIONS and least > 0 and most > 30 * least
    return _logarithmic(least, most) if is_wide else {"zerolinecolor": "var(--rule)"}


def _logarithmic(least: float, most: float) -> Json:
    """A logarithmic axis of durations [µs], with ticks such as `500 µs` and `1 ms`."""
    decades = log10(most / least)
    digits = (1,) if decades > 5 else (1, 3) if decades > 2.5 else (1, 2, 5)
    values = [digit * 10.0**power for power in range(floor(log10(least)), ceil(log10(most)) + 1) for digit in digits]
    return {"type": "log", "zeroline": False, "tickvals": values, "ticktext": [micros(value) for value in values]}


def _desired_agree(alike: Alike, reports: Sequence[Report]) -> bool:
    """Whether the desired values of all runs are nowhere visibly apart, so that one line can stand for all."""
    desired = [(reports[run].time, line.values) for run, panel in alike for line in panel.lines if line.desired]
    visible = 0.02 * max(map(abs, _extent(alike)))
    for time, values in desired[1:]:
        apart = np.abs(values - np.interp(time, *desired[0], left=nan, right=nan))
        apart = apart[np.isfinite(apart)]
        if not len(apart) or apart.max() > visible:
            return False
    return not desired or len(desired) == len(alike) == len(reports)


def _span(reports: Sequence[Report]) -> tuple[float, float]:
    """Time span of the page [s], with a margin, so that events at its ends are visible."""
    times = [float(time) for report in reports for time in (*report.time[:1], *report.time[-1:])]
    if not any(report.part for report in reports):
        times += [mark.time_s for report in reports for mark in report.findings.marks if mark.time_s is not None]
    start, end = (min(times), max(times)) if times else (0.0, 1.0)
    room = 0.01 * (end - start) or 0.5
    return start - room, end + room


def _shapes(reports: Sequence[Report]) -> Iterator[Json]:
    """Bands and gaps as areas across all panels, events as lines: one shape for all of a kind, as there may be many."""
    across = {"type": "path", "yref": "paper", "layer": "below"}
    for run, report in enumerate(reports):
        own = f"var(--run-{run % 8})" if len(reports) > 1 else ""
        gaps = [(gap.time_s, gap.time_s + gap.ticks * (report.period_s or 0.0)) for gap in report.findings.gaps]
        bands = [(start, end) for start, end, _ in _bands(report)]
        for areas, colour in ((bands, own or "var(--run-4)"), (gaps, own or "var(--bad)")):
            path = " ".join(f"M{start:.10g},0 L{end:.10g},0 L{end:.10g},1 L{start:.10g},1 Z" for start, end in areas)
            if path:
                yield across | {"run": run, "path": path, "opacity": 0.15, "fillcolor": colour, "line": {"width": 0}}
        for kind, width, dash in (("mark", 1, "dot"), ("bad", 1.4, "solid")):
            marks = [mark.time_s for mark in report.findings.marks if grave(mark) == (kind == "bad")]
            times = sorted({time for time in marks if time is not None})
            line = {"color": own or f"var(--{kind})", "width": width, "dash": dash}
            if times:
                path, opacity = " ".join(f"M{time:.10g},0 L{time:.10g},1" for time in times), 1 / (1 + len(times) / 60)
                yield across | {"run": run, "path": path, "opacity": max(0.2, opacity), "line": line}


def _band_labels(reports: Sequence[Report]) -> list[Json]:
    """Labels of the bands, above the first panel in up to three rows; page.js keeps them in sight."""
    found = [
        {"run": run, "span": [start, end], "text": _plain(f"{report.name}: {label}" if len(reports) > 1 else label)}
        for run, report in enumerate(reports)
        for start, end, label in _bands(report)
    ]
    rows = min(3, len(found))
    return [
        label | {"y": 1, "yref": "y domain", "yanchor": "bottom", "yshift": 15 + 14 * (i % rows), "showarrow": False,
                 "font": INK | {"size": 11}, "borderpad": 0}
        for i, label in enumerate(found)
    ]  # fmt: skip


def _bands(report: Report) -> list[tuple[float, float, str]]:
    """Faults as shaded spans of time; one that did not end lasts to the end of its run's lines."""
    last_s = float(report.time[-1]) if len(report.time) else 0.0
    faults = report.findings.faults
    return [(fault.begin_s, last_s if fault.end_s is None else fault.end_s, fault.fault) for fault in faults]


def _plain(text: str) -> str:
    return escape(text, quote=False)


# ── distributions ──


def _spread(name: str, reports: Sequence[Report]) -> Drawing:
    """Histograms of a duration, with percentiles; bins without a count go down to the axis."""
    several, timings = len(reports) > 1, [report.findings.timing for report in reports]
    spreads = {run: timing[name] for run, timing in enumerate(timings) if name in timing}
    bins = [edge_and_count for spread in spreads.values() for edge_and_count in spread.bins]
    least, most, top = min(bins)[0], max(bins)[0] * 2 ** (1 / 16), max(count for _, count in bins)
    data, key, shapes, annotations = list[Json](), list[Stroke](), list[Json](), list[Json]()
    for run, spread in spreads.items():
        nth = np.rint([16 * log2(edge) for edge, _ in spread.bins]).astype(int)  # bins are 2^(1/16) wide
        edges = np.arange(nth.min() - 1, nth.max() + 2)
        counts = np.full(len(edges), NO_COUNT)
        counts[nth - edges[0]] = [count for _, count in spread.bins]
        stroke = _run_stroke(run, reports) if several else Stroke("", "var(--run-0)", 1)
        fill = {} if several else {"fill": "toself", "fillcolor": "var(--area)"}
        key.append(stroke)
        data.append(stroke.trace("hv") | fill | {"run": run, "x": 2 ** (edges / 16), "y": counts, "hoverinfo": "skip"})
        for row, (percentile, at) in enumerate({"p50": spread.p50, "p99": spread.p99, "p99.9": spread.p999}.items()):
            line = {"color": stroke.colour if several else "var(--ink)", "width": 1, "dash": "dot"}
            across = {"type": "line", "x0": at, "x1": at, "y0": 0, "y1": 1, "yref": "paper", "line": line}
            shapes.append({"run": run, **across})
            annotations.append({
                "text": f"{percentile} {micros(at)}", "x": log10(at), "xanchor": "left", "xshift": 3, "font": INK,
                "y": 1 - 0.1 * row, "yref": "paper", "yanchor": "top", "bgcolor": "var(--paper)", "showarrow": False,
            })  # fmt: skip
    layout = LAYOUT | {
        "margin": {"l": 54, "r": 10, "t": 8, "b": 36}, "hovermode": False, "dragmode": False,
        "xaxis": GRID | _logarithmic(least, most) | {"range": [log10(least) - 0.05, log10(most) + 0.3]},
        "yaxis": GRID | {"type": "log", "zeroline": False, "dtick": 1, "title": {"text": "count", "standoff": 6},
                         "range": [log10(NO_COUNT), log10(top) + 0.15]},
        "shapes": shapes, "annotations": [] if several else annotations,
    }  # fmt: skip
    figure = {"data": data, "layout": layout}
    return Drawing(f"spread-{name}", SPREADS[name][1], "timing", key if several else [], figure)
