"""Drawings of the page: panels over time as Plotly's traces and layouts, as JSON with compressed numbers.

page.js reduces lines to what is in sight. Plotly interprets tags in text, so names and labels are escaped.
"""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from typing import Any, Final, NamedTuple

import numpy as np

from aeroloop.service.report.rows import grave
from aeroloop.service.review.report import Line, Report

# Of runs, in turn: Okabe and Ito's colours, darkened until they can be read on white; dashes for print.
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#b0568c", "#8a6d00", "#5b4bb5", "#3f4a56", "#8b2e16")
DASHES: Final = ("solid", "7px,2px", "2px,2px", "9px,2px,2px,2px", "14px,3px", "4px,4px")
QUIET, BAND, GRAVE, MARK = "#58616d", "#8a6d00", "#b03a00", "#8b95a3"
MEASURED, DESIRED, TRUE = "#0072b2", "#d55e00", "#009e73"

WIDE: Final = 30.0  # durations that differ by more than this factor have a logarithmic axis

Json = dict[str, Any]


class Drawing(NamedTuple):
    """A figure of the page: panels under each other over time."""

    name: str
    title: str
    section: str
    panels: int
    figure: Json


def drawings(reports: Sequence[Report]) -> list[Drawing]:
    """A drawing for each group of panels, in the order of the reports."""
    groups = dict.fromkeys(panel.group for report in reports for panel in report.panels)
    shapes, labels = list(_shapes(reports)), _fault_labels(reports)
    return [_drawing(group, reports, shapes, labels) for group in groups]


def page_data(reports: Sequence[Report], drawn: Sequence[Drawing], *, live: bool = False) -> str:
    """Everything that is drawn, as JSON that may stand in a script element: no text in it can end the script.

    `numbers` are times, then lines, one after the other as little-endian doubles and floats, compressed by gzip: levels
    of quantizers take a tenth.
    """
    figures = {drawing.name: drawing.figure for drawing in drawn}
    times = [report.time.astype("<f8") for report in reports]
    lines = [trace.pop("y") for figure in figures.values() for trace in figure["data"]]
    octets = gzip.compress(b"".join(each.tobytes() for each in (*times, *lines)), 6, mtime=0)
    period = max((report.period_s or 0.0 for report in reports), default=0.0)
    data = {
        "span": span_of(reports), "drawings": figures, "period": period, "live": live,
        "numbers": b64encode(octets).decode(), "times": [len(each) for each in times],
    }  # fmt: skip
    return json.dumps(data).replace("<", "\\u003c").replace(">", "\\u003e")


def _drawing(group: str, reports: Sequence[Report], shapes: list[Json], labels: list[Json]) -> Drawing:
    """Panels of a group under each other; those of several runs with the same label are overlaid."""
    found = [(run, panel) for run, report in enumerate(reports) for panel in report.panels if panel.group == group]
    rows = {label: i for i, label in enumerate(dict.fromkeys(panel.label for _, panel in found))}
    axes = ["y", *(f"y{row}" for row in range(2, len(rows) + 1))]
    layout: Json = {  # the page's style sheet has the colours of paper, text and grid
        "font": {"size": 12},
        "margin": {"l": 78, "r": 10, "t": 24, "b": 36},
        "legend": {"orientation": "h", "x": 1, "xanchor": "right", "y": 1, "yanchor": "bottom", "uirevision": "kept"},
        "hovermode": "x unified", "hoversubplots": "axis", "hoverlabel": {"namelength": -1},
        "grid": {"rows": len(rows), "columns": 1, "ygap": 0.12, "subplots": [[f"x{axis}"] for axis in axes]},
        "xaxis": {
            "title": {"text": "time [s]", "standoff": 4}, "anchor": axes[-1], "zeroline": False,
            "hoverformat": ".3f", "unifiedhovertitle": {"text": "%{x:.3f} s"},
        },
        "shapes": shapes, "annotations": labels,
    }  # fmt: skip
    for label, row in rows.items():
        unit = next(panel.unit for _, panel in found if panel.label == label)
        drawn = np.concatenate([line.values for _, panel in found if panel.label == label for line in panel.lines])
        text = _plain(label) + ("" if unit == "1" else f"<br>[{_plain(unit)}]")
        is_wide = unit == "ms" and len(drawn) and np.nanmin(drawn) > 0 and np.nanmax(drawn) > WIDE * np.nanmin(drawn)
        layout[axes[row].replace("y", "yaxis")] = {
            "title": {"text": text, "standoff": 4}, "fixedrange": True, "nticks": 5, "exponentformat": "power",
            "rangemode": "tozero" if unit == "ms" else "normal", "type": "log" if is_wide else "linear",
        }  # fmt: skip
    traces, known = list[Json](), set[str]()
    for desired in (True, False):  # which lie below the others
        for run, panel in found:
            for line in panel.lines:
                if line.desired == desired:
                    entry, stroke = _stroke(line, run, reports)
                    name = " ".join([panel.label] * (len(rows) > 1) + [entry] * (len(reports) > 1) + [line.label])
                    stroke["shape"] = "hv" if line.held and reports[run].thinned <= 2 else "linear"
                    traces.append({
                        "type": "scatter", "mode": "lines", "times": run, "yaxis": axes[rows[panel.label]],
                        "y": line.values.astype("<f4"),
                        "panel": panel.label, "quantity": line.label, "unit": panel.unit.removeprefix("1"),
                        "line": stroke, "name": _plain(entry), "legendgroup": entry, "showlegend": entry not in known,
                        "hovertemplate": _plain(f"{name}: %{{y:.4~g}} {panel.unit.strip('1')}") + "<extra></extra>",
                        # A line that is published less often than every tick has no gaps between its values.
                        "connectgaps": bool(2 * np.isfinite(line.values).sum() < len(line.values)),
                    })  # fmt: skip
                    known.add(entry)
    layout["showlegend"] = len(known) > 1
    title = " / ".join(dict.fromkeys(panel.title for _, panel in found))
    is_timing = any(panel.unit == "ms" for _, panel in found)
    section = "timing" if is_timing else group if group == "theorem" else "tracking"
    return Drawing(group, title, section, len(rows), {"data": traces, "layout": layout})


def _stroke(line: Line, run: int, reports: Sequence[Report]) -> tuple[str, Json]:
    """A line's entry in the legend, and how it is drawn. Colours mean the quantity in one run, the run in several."""
    is_true = not line.held and not line.desired
    if line.desired:
        entry, colour, width, dash = line.label, QUIET if len(reports) > 1 else DESIRED, 2.5, "solid"
    elif len(reports) > 1:
        entry, colour = reports[run].name, COLOURS[run % len(COLOURS)]
        width, dash = (1.8, "1px,3px") if is_true else (1.1, DASHES[run % len(DASHES)])
    else:
        entry, colour, width = line.label, TRUE if is_true else MEASURED, 1.1
        dash = "6px,4px" if is_true else "solid"
    return entry, {"color": colour, "width": width, "dash": dash}


def span_of(reports: Sequence[Report]) -> tuple[float, float]:
    """Time span of the page [s], with a margin, so that events at its ends are visible."""
    times = [float(time) for report in reports for time in (*report.time[:1], *report.time[-1:])]
    if not any(report.part for report in reports):
        times += [mark.time_s for report in reports for mark in report.findings.marks if mark.time_s is not None]
    start, end = (min(times), max(times)) if times else (0.0, 1.0)
    room = 0.01 * (end - start) or 0.5
    return start - room, end + room


def _shapes(reports: Sequence[Report]) -> Iterator[Json]:
    """Faults and gaps as areas across all panels, events as lines: one shape for all of a kind, as many may be."""
    across = {"type": "path", "yref": "paper", "layer": "below"}
    for run, report in enumerate(reports):
        own = COLOURS[run % len(COLOURS)] if len(reports) > 1 else None
        gaps = [(gap.time_s, gap.time_s + gap.ticks * (report.period_s or 0.0)) for gap in report.findings.gaps]
        for areas, colour in (([(start, end) for start, end, _ in _faults(report)], BAND), (gaps, GRAVE)):
            path = " ".join(f"M{start:.10g},0 L{end:.10g},0 L{end:.10g},1 L{start:.10g},1 Z" for start, end in areas)
            if path:
                yield across | {"path": path, "opacity": 0.15, "fillcolor": own or colour, "line": {"width": 0}}
        for is_grave, width, dash in ((False, 1, "dot"), (True, 1.4, "solid")):
            marks = [mark.time_s for mark in report.findings.marks if grave(mark) == is_grave]
            if times := sorted({time for time in marks if time is not None}):
                line = {"color": own or (GRAVE if is_grave else MARK), "width": width, "dash": dash}
                path, opacity = " ".join(f"M{time:.10g},0 L{time:.10g},1" for time in times), 1 / (1 + len(times) / 60)
                yield across | {"path": path, "opacity": max(0.2, opacity), "line": line}


def _fault_labels(reports: Sequence[Report]) -> list[Json]:
    """Names of the faults, where they begin, in three rows at the top of the first panel."""
    alike = {
        "xanchor": "left", "y": 1, "yref": "paper", "yanchor": "top", "showarrow": False, "borderpad": 0,
        "font": {"size": 11},
    }  # fmt: skip
    found = [(start, label) for report in reports for start, _, label in _faults(report)]
    return [alike | {"text": _plain(label), "x": x, "yshift": -12 * (i % 3)} for i, (x, label) in enumerate(found)]


def _faults(report: Report) -> list[tuple[float, float, str]]:
    """Begin, end and name of each fault; one that did not end lasts to the end of its run's lines."""
    last_s = float(report.time[-1]) if len(report.time) else 0.0
    faults = report.findings.faults
    return [(fault.begin_s, last_s if fault.end_s is None else fault.end_s, fault.fault) for fault in faults]


def _plain(text: str) -> str:
    return escape(text, quote=False)
