"""Figure of margins: proven and simulated limits against the rate, one panel for delay and one for lost frames.

Both axes are logarithmic, and both limits are in ms: lost frames count with their periods. Colour and marker are the
bits; a full marker is proven, a hollow one is where simulation begins to diverge, grey where it does at some bits. A
dotted line is the watchdog of a real plant.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from aeroloop.service.lab.margins import FLOAT64, OLDEST_S, Margin, Margins
from aeroloop.service.report.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, WIDTH_IN, figure_style, save_as

_STYLES: Final = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "p"), (BLACK, "D"))
_TICKS: Final = [digit * 10**power for power in range(4) for digit in (1, 2, 5)]


def draw_margins(margins: Margins, path: Path) -> None:
    """Draw the margins into a file. Raises OutputError if its name is wrong, or it cannot be written."""
    with figure_style():
        save_as(_figure(margins), path)


def _figure(margins: Margins) -> Figure:
    figure = Figure(figsize=(WIDTH_IN[2], 3.2), layout="constrained")
    delay, lost = figure.subplots(1, 2, sharex=True, sharey=True)
    _draw(delay, margins, lambda m: m.delay_ms, lambda m: m.diverges_delay_ms)
    _draw(lost, margins, lambda m: _ms(m.lost_frames, m), lambda m: _ms(m.diverges_lost_frames, m))
    delay.set_ylabel("beyond the hold of a period [ms]")
    delay.set_ylim(top=OLDEST_S * 1e3)
    for panel, name in ((delay, "delay, no frame lost"), (lost, "frames lost in a row · period, no delay")):
        panel.set_xlabel("rate [Hz]")
        panel.annotate(name, (0, 1), xycoords="axes fraction", xytext=(4, -4), textcoords="offset points", va="top")
    figure.legend(handles=_legend(margins), loc="outside lower center", ncols=4)
    return figure


def _ms(frames: int | None, margin: Margin) -> float | None:
    return None if frames is None else frames * 1e3 / margin.rate_hz


def _draw(
    panel: Axes, margins: Margins, proven: Callable[[Margin], float | None], diverges: Callable[[Margin], float | None]
) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.axhline(margins.watchdog_ms, color="0.3", linewidth=0.6, linestyle=":")
    rates = sorted({margin.rate_hz for margin in margins.margins})
    panel.xaxis.set_major_locator(FixedLocator(rates))
    panel.yaxis.set_major_locator(FixedLocator(_TICKS))
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for bits, (color, marker) in _styles(margins):
        mine = [margin for margin in margins.margins if margin.bits == bits]
        for of, face, line in ((proven, color, "-"), (diverges, "white", "--")):
            points = [(margin.rate_hz, y) for margin in mine if (y := of(margin))]  # 0 has no place on the axis
            places = [x for x, _ in points], [y for _, y in points]
            panel.plot(*places, line, color=color, marker=marker, markerfacecolor=face, markersize=4, linewidth=0.9)
    from_here = [[y for m in margins.margins if m.rate_hz == rate and (y := diverges(m))] for rate in rates]
    if all(from_here):
        panel.fill_between(rates, [min(ys) for ys in from_here], OLDEST_S * 1e3, color="0.92", linewidth=0, zorder=0)


def _styles(margins: Margins) -> list[tuple[str, tuple[str, str]]]:
    bits = dict.fromkeys(margin.bits for margin in margins.margins)
    return list(zip(bits, _STYLES, strict=False))


def _legend(margins: Margins) -> list[Line2D]:
    return [
        *(
            Line2D([], [], color=color, marker=marker, linestyle="none", markersize=4, label=_name(margins, bits))
            for bits, (color, marker) in _styles(margins)
        ),
        Line2D([], [], color="0.4", marker="o", markersize=4, label="proven up to here"),
        Line2D([], [], color="0.4", marker="o", markerfacecolor="white", linestyle="--", markersize=4,
               label="simulation diverges from here"),
        Line2D([], [], color="0.3", linewidth=0.6, linestyle=":", label="watchdog"),
    ]  # fmt: skip


def _name(margins: Margins, bits: str) -> str:
    proven = any(margin.bits == bits and margin.delay_ms is not None for margin in margins.margins)
    name = bits if bits == FLOAT64 else f"{bits} bits"
    return name if proven else f"{name}, nothing proven"
