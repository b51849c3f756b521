"""Panels of a session: quantities in the order of the paper's figures, with the numbers of these figures.

A log is one run, and a run is one of the paper's three cases: without quantization (C.4–C.6), with it (C.7–C.11), with
it and wind (C.12–C.14). Every quantity is drawn in every case; a title has the paper's number where the paper has
that figure. Quantities without a figure in the paper follow: timing, estimates, and the theorem's norms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from typing import Final, Literal, NamedTuple

import numpy as np

from aeroloop.service.config import Settings
from aeroloop.service.logs.traces import Array
from aeroloop.service.review.report import Line, Panel

Case = Literal["continuous", "quantized", "wind"]

CASES: Final[dict[Case, str]] = {
    "continuous": "without quantization",
    "quantized": "with quantization",
    "wind": "with wind",
}

NUMBERS: Final[dict[tuple[str, Case], str]] = {
    ("error", "continuous"): "C.4",
    ("rate_error", "continuous"): "C.5",
    ("input", "continuous"): "C.6",
    ("attitude", "quantized"): "C.7",
    ("rate", "quantized"): "C.8",
    ("error", "quantized"): "C.9",
    ("rate_error", "quantized"): "C.10",
    ("input", "quantized"): "C.11",
    ("error", "wind"): "C.12",
    ("rate_error", "wind"): "C.13",
    ("input", "wind"): "C.14",
}
"""Number of the paper's figure of a quantity in a case."""


def case_of(settings: Settings) -> Case:
    """The paper's case that a session belongs to."""
    if settings.plant.wind.blowing and not settings.plant.ideal:
        return "wind"
    bits = (settings.wire.attitude.bits, settings.wire.rate.bits, settings.wire.voltage.bits)
    return "continuous" if bits == (None, None, None) else "quantized"


def title_of(name: str, quantity: str, case: Case) -> str:
    """A figure's title: the paper's number where it has that figure, the quantity in words, the case."""
    number = NUMBERS.get((name, case))
    return f"{f'Figure {number}: ' if number else ''}{quantity} {CASES[case]}"


class PanelColumn(NamedTuple):
    """One line and the panel that it is drawn in."""

    group: str
    title: str
    label: str
    unit: str
    line: str
    desired: bool = False


def columns_of(settings: Settings, *, theta: bool = False) -> list[PanelColumn]:
    """Columns kept of every tick, in the order of drawing, as `Observer` fills them.

    Args:
        settings: The configuration of the controller.
        theta: Whether the plant's damping is known, so that V has all its terms.
    """
    return list(_columns(case_of(settings), settings.wire.actuators, theta=theta))


def panels_of(columns: list[PanelColumn], values: Array) -> list[Panel]:
    """Panels of columns; lines that share an axis share a panel, and a line without any value is left out.

    Args:
        columns: Their descriptions.
        values: Shape (n, columns).
    """
    panels = []
    drawn = [(column, values[:, i]) for i, column in enumerate(columns) if (values[:, i] == values[:, i]).any()]
    for (group, title, label, unit), lines in groupby(drawn, key=lambda pair: pair[0][:4]):
        panels.append(
            Panel(group, title, label, unit, [Line(column.line, found, column.desired) for column, found in lines])
        )
    return panels


def with_level(panels: list[Panel], group: str, label: str, level: float | None) -> list[Panel]:
    """Panels, with a horizontal line at a level in those of a group; unchanged if the level is None."""
    if level is None:
        return panels
    return [
        replace(panel, lines=[*panel.lines, Line(label, np.full(len(panel.lines[0].values), level), desired=True)])
        if panel.group == group
        else panel
        for panel in panels
    ]


def _columns(case: Case, actuators: int, *, theta: bool) -> Iterator[PanelColumn]:
    def titled(name: str, quantity: str) -> str:
        return title_of(name, quantity, case)

    for label in ("η", "ε₁", "ε₂", "ε₃"):
        yield PanelColumn("attitude", titled("attitude", "Attitude"), label, "1", "measured")
        yield PanelColumn("attitude", titled("attitude", "Attitude"), label, "1", "desired", desired=True)
    for label in ("ω₁", "ω₂", "ω₃"):
        yield PanelColumn("rate", titled("rate", "Angular velocity"), label, "rad/s", "measured")
        yield PanelColumn("rate", titled("rate", "Angular velocity"), label, "rad/s", "desired", desired=True)
    for label in ("ε̃₁", "ε̃₂", "ε̃₃"):
        yield PanelColumn("attitude_error", titled("error", "Attitude error"), label, "1", "measured")
    for label in ("ω_e1", "ω_e2", "ω_e3"):
        yield PanelColumn("rate_error", titled("rate_error", "Angular velocity error"), label, "rad/s", "measured")
    for label in ("u₁", "u₂", "u₃")[3 - actuators :]:
        yield PanelColumn("input", titled("input", "Input"), label, "V", "commanded")
    yield PanelColumn("error_angle", "Attitude error, as an angle", "angle", "deg", "measured")
    yield PanelColumn("error_angle", "Attitude error, as an angle", "angle", "deg", "true")
    yield PanelColumn("latency", "Loop latency", "latency", "µs", "latency")
    yield PanelColumn("period", "Period between measurements", "period", "µs", "period")
    for label in ("θ̂₁", "θ̂₂", "θ̂₃"):
        yield PanelColumn("damping_estimate", "Damping estimate", label, "N·m·s/rad", "estimated")
    yield PanelColumn("z_norm", "Error of Theorem 1", "‖z‖", "1", "measured")
    yield PanelColumn("z_norm", "Error of Theorem 1", "‖z‖", "1", "true")
    yield PanelColumn("lyapunov", "Lyapunov function", "V", "N·m", "measured, without θ̃")
    yield PanelColumn("lyapunov", "Lyapunov function", "V", "N·m", "true, with θ̃" if theta else "true, without θ̃")
