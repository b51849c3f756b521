"""Figure of compared laws: a row of panels for each plant and its sensors, a line of marks for each law.

Colour is calm or wind, a shape the bits. A full bar is the delay that a law survives, a hollow one the frames lost in a
row, with their periods. A law without figures has a cross.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Final

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from aeroloop.service.lab.laws import LawMargin, LawRow, Laws
from aeroloop.service.report.figure_style import BLACK, BLUE, ORANGE, WIDTH_IN, figure_style, save_as

_COLOURS: Final = {"calm": BLUE, "wind": ORANGE}
_SHAPES: Final = "osD^vP"
_PANELS: Final[tuple[tuple[str, Callable[[LawRow], float]], ...]] = (
    (r"$z_\mathrm{track}$ [$10^{-4}$ s]", lambda row: 1e4 * (row.z_track or 0)),
    ("settled error [°]", lambda row: row.second_half_error_deg or 0),
    (r"$u_\mathrm{total}$ [V²·s]", lambda row: row.u_total or 0),
    ("changes of commands [1/s]", lambda row: row.command_changes_per_s or 0),
)
_LOGARITHMIC: Final = (0, 1, 3)
_TICKS: Final = [digit * 10.0**power for power in range(-3, 6) for digit in (1, 2, 5)]


def draw_laws(laws: Laws, path: Path) -> None:
    """Draw the comparison into a file. Raises OutputError if its name is wrong, or it cannot be written."""
    with figure_style():
        save_as(_figure(laws), path)


def _figure(laws: Laws) -> Figure:
    rows = sorted(laws.rows, key=lambda row: (row.plant, row.sensors))
    groups = {place: list(each) for place, each in groupby(rows, lambda row: (row.plant, row.sensors))}
    kinds = list(dict.fromkeys(row.law for row in laws.rows))
    bits = list(dict.fromkeys(row.bits for row in laws.rows))
    height = 0.7 + len(groups) * (0.75 + 0.17 * len(kinds))
    figure = Figure(figsize=(WIDTH_IN[2], height), layout="constrained")
    panels = figure.subplots(len(groups), len(_PANELS) + 1, sharey=True, squeeze=False)
    for line, ((plant, sensors), found) in zip(panels, groups.items(), strict=True):
        for i, (panel, (name, value)) in enumerate(zip(line, _PANELS, strict=False)):
            if i in _LOGARITHMIC and any(value(row) > 0 for row in found):
                panel.set_xscale("log")
                panel.xaxis.set_major_locator(FixedLocator(_TICKS))
                panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                panel.xaxis.set_minor_locator(NullLocator())
            _marks(panel, found, kinds, bits, value)
            panel.set_xlabel(name)
        _survived(line[-1], [margin for margin in laws.margins if margin.plant == plant], kinds, laws.period_ms)
        line[0].set_yticks(range(len(kinds)), kinds)
        line[0].set_ylim(len(kinds) - 0.4, -0.6)
        line[0].set_ylabel(f"{plant}, {sensors}")
    figure.legend(handles=_legend(laws, bits), loc="outside lower center", ncols=6)
    return figure


def _marks(
    panel: Axes, rows: list[LawRow], kinds: list[str], bits: list[str], value: Callable[[LawRow], float]
) -> None:
    for row in rows:
        colour, shape = _COLOURS.get(row.wind, BLACK), _SHAPES[bits.index(row.bits) % len(_SHAPES)]
        offset = 0.13 * (1 if row.wind == "wind" else -1)  # marks of one law that would cover each other
        y = kinds.index(row.law) + offset
        if row.reason is not None:
            panel.plot(0.97, y, "x", color=colour, markersize=4, transform=panel.get_yaxis_transform())
        else:
            panel.plot(value(row), y, shape, color=colour, markersize=4, markerfacecolor="none", markeredgewidth=0.9)


def _survived(panel: Axes, margins: list[LawMargin], kinds: list[str], period_ms: float) -> None:
    for margin in margins:
        y = kinds.index(margin.law)
        panel.barh(y - 0.14, margin.delay_ms or 0, height=0.24, color="0.75", edgecolor="0.4", linewidth=0.5)
        lost_ms = (margin.lost_frames or 0) * period_ms
        panel.barh(y + 0.14, lost_ms, height=0.24, color="white", edgecolor="0.4", linewidth=0.5)
    panel.set_xlabel("survived [ms]")


def _legend(laws: Laws, bits: list[str]) -> list[Artist]:
    winds = [name for name in _COLOURS if any(row.wind == name for row in laws.rows)]
    shapes = zip(bits, _SHAPES * len(bits), strict=False)
    bars = [Patch(facecolor=face, edgecolor="0.4", linewidth=0.5, label=label)
            for face, label in (("0.75", "delay"), ("white", "frames lost in a row"))]  # fmt: skip
    failed = [Line2D([], [], marker="x", color="0.4", linestyle="none", markersize=4, label="did not last")]
    return [
        *(Line2D([], [], color=_COLOURS[name], linewidth=4, label=name) for name in winds),
        *(Line2D([], [], marker=shape, color="0.4", markerfacecolor="none", linestyle="none", markersize=4,
                 label=f"{pair} bits") for pair, shape in shapes),
        *bars,
        *(failed if any(row.reason for row in laws.rows) else []),
    ]  # fmt: skip
