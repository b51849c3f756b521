"""Figure of `lab burden`: error against payload bits a second, one panel for each of the sensors.

Both axes are logarithmic. Colour and shape mark the quantizer; a full marker is sent on change, a hollow one at every
tick. A line joins the Pareto front, its points labelled with bits out/in; dotted lines mark float64 at every tick.
"""

from __future__ import annotations

from math import log10
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from aeroloop.service.lab.burden import Burden, Point, short_name
from aeroloop.service.report.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, WIDTH_IN, figure_style, save_as

_STYLES: Final = {
    "uniform": (BLUE, "o"),
    "hysteresis-uniform": (ORANGE, "s"),
    "logarithmic-uniform": (GREEN, "^"),
    "hysteresis-rate": (PURPLE, "p"),
    None: (BLACK, "D"),
}
_LABEL_WIDTH: Final = 0.2
_LABEL_HEIGHT: Final = 0.055
"""Decades that a label covers."""
_TICKS: Final = [digit * 10**power for power in range(-1, 6) for digit in (1, 2, 3, 5)]


def draw_burden(burden: Burden, path: Path) -> None:
    """Draw the grid into a file. Raises OutputError if its name is wrong, or it cannot be written."""
    with figure_style():
        save_as(_figure(burden), path)


def _figure(burden: Burden) -> Figure:
    names = list(burden.sensors)
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    width = WIDTH_IN[1 if columns == 1 else 2]
    figure = Figure(figsize=(width, 0.75 + 2.5 * rows), layout="constrained")
    panels: list[Axes] = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flatten().tolist()
    for panel, name in zip(panels, names, strict=False):
        _draw(panel, [point for point in burden.under(name) if point.reason is None])
        panel.annotate(f"sensors: {name}", (1, 1), xycoords="axes fraction", xytext=(-4, -4),
                       textcoords="offset points", ha="right", va="top",
                       bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})  # fmt: skip
    errors = [_place(point)[1] for point in burden.points if point.reason is None]
    panels[0].set_ylim(0.78 * min(errors), 1.2 * max(errors))
    for i, panel in enumerate(panels):
        if i >= len(names):
            panel.set_axis_off()
        if i % columns == 0:
            panel.set_ylabel(r"$z_\mathrm{track}$ [$10^{-4}$ s]")
        if i + columns >= len(names):  # the last of its column
            panel.set_xlabel("payload of measurements and commands [kbit/s]")
            panel.tick_params(labelbottom=True)
    figure.legend(handles=_legend(burden), loc="outside lower center", ncols=3)
    return figure


def _place(point: Point) -> tuple[float, float]:
    """Payload [kbit/s] and error [1e-4 s]."""
    assert point.bits_per_s is not None
    assert point.z_track is not None
    return point.bits_per_s / 1e3, point.z_track * 1e4


def _draw(panel: Axes, points: list[Point]) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.margins(x=0.08)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(FixedLocator(_TICKS))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    front = sorted({_place(point): point for point in points if point.pareto}.items())
    panel.plot(*zip(*(place for place, _ in front), strict=True), color="0.45", linewidth=0.9, zorder=2)
    for point in points:
        color, marker = _STYLES[point.quantizer]
        panel.plot(
            *_place(point),
            marker,
            color=color,
            markersize=4,
            markerfacecolor=color if point.transmit == "on_change" else "white",
            linestyle="none",
            zorder=4 if point.pareto else 3,
        )
        if point.is_baseline:
            payload, error = _place(point)
            panel.axvline(payload, color="0.3", linewidth=0.6, linestyle=":", zorder=1)
            panel.axhline(error, color="0.3", linewidth=0.6, linestyle=":", zorder=1)
    _label(panel, [(point.label, place) for place, point in front])


def _label(panel: Axes, labels: list[tuple[str, tuple[float, float]]]) -> None:
    """Label places on a front to the lower left, where no point is; skip labels that would overlap another."""
    placed: list[tuple[float, float]] = []
    for label, (x, y) in labels:
        if any(
            abs(log10(x / other)) < _LABEL_WIDTH and abs(log10(y / above)) < _LABEL_HEIGHT for other, above in placed
        ):
            continue
        placed.append((x, y))
        panel.annotate(label, (x, y), xytext=(-4, -4), textcoords="offset points", ha="right", va="top", fontsize=6)


def _legend(burden: Burden) -> list[Line2D]:
    """Entries of the legend; three columns, filled downwards."""
    drawn = {short_name(point): _STYLES[point.quantizer] for point in burden.points if point.quantizer is not None}
    quantizers = [_key(*style, name) for name, style in drawn.items()]
    color, marker = _STYLES[None]
    return [
        *quantizers,
        _key(color, marker, "float64"),
        _key("0.4", "o", "sent on change"),
        _key("0.4", "o", "sent at every tick", full=False),
        Line2D([], [], color="0.45", linewidth=0.9, label="Pareto front, bits out/in"),
        Line2D([], [], color="0.3", linewidth=0.6, linestyle=":", label="float64 at every tick"),
    ]


def _key(color: str, marker: str, label: str, *, full: bool = True) -> Line2D:
    face = color if full else "white"
    return Line2D([], [], color=color, marker=marker, markerfacecolor=face, linestyle="none", markersize=4, label=label)
