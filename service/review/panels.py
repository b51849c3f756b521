"""Panels of a session: quantities in the order of the paper's figures, with the numbers of these figures.

A log is one run, and a run is one of the paper's three cases: without quantization (C.4–C.6), with it (C.7–C.11), with
it and wind (C.12–C.14). Every quantity is drawn in every case; a title has the paper's number where the paper has
that figure. Roll, pitch and yaw come before them; timing, estimates, and the theorem's norms follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

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


def columns_of(settings: Settings, *, theta: bool = False) -> list[PanelColumn]:
    """Columns kept of every tick, in the order of drawing, as `Observer` fills them.

    `theta` is whether the plant's damping is known, so that V has all its terms.
    """
    case, beside = case_of(settings), ("measured", "desired")
    true_V = "true, with θ̃" if theta else "true, without θ̃"
    rate_errors, inputs = ("ω_e1", "ω_e2", "ω_e3"), ["u" + "₁₂₃₄₅₆₇₈"[i - 1] for i in settings.wire.motors]
    panels: list[tuple[str, str, Sequence[str], str, Sequence[str]]] = [
        ("angles", "Roll, pitch and yaw", ("roll", "pitch", "yaw"), "°", (*beside, "true")),
        ("attitude", title_of("attitude", "Attitude", case), ("η", "ε₁", "ε₂", "ε₃"), "1", beside),
        ("rate", title_of("rate", "Angular velocity", case), ("ω₁", "ω₂", "ω₃"), "rad/s", beside),
        ("attitude_error", title_of("error", "Attitude error", case), ("ε̃₁", "ε̃₂", "ε̃₃"), "1", ["measured"]),
        ("rate_error", title_of("rate_error", "Angular velocity error", case), rate_errors, "rad/s", ["measured"]),
        ("input", title_of("input", "Input", case), inputs, "V", ["commanded"]),
        ("error_angle", "Attitude error, as an angle", ["angle"], "°", ("measured", "true")),
        ("latency", "Loop latency", ["latency"], "µs", ["latency"]),
        ("period", "Period between measurements", ["period"], "µs", ["period"]),
        ("damping_estimate", "Damping estimate", ("θ̂₁", "θ̂₂", "θ̂₃"), "N·m·s/rad", ["estimated"]),
        ("z_norm", "Error of Theorem 1", ["‖z‖"], "1", ("measured", "true")),
        ("lyapunov", "Lyapunov function", ["V"], "N·m", ("measured, without θ̃", true_V)),
    ]
    return [
        PanelColumn(group, title, label, unit, line)
        for group, title, labels, unit, lines in panels
        for label in labels
        for line in lines
    ]


def panels_of(columns: list[PanelColumn], values: Array) -> list[Panel]:
    """Panels of columns; lines that share an axis share a panel, and a line without any value is left out.

    The values have shape (n, columns).
    """
    drawn = [(column, values[:, i]) for i, column in enumerate(columns) if not np.isnan(values[:, i]).all()]
    return [
        Panel(group, title, label, unit, [Line(kept.line, found, kept.line == "desired") for kept, found in lines])
        for (group, title, label, unit), lines in groupby(drawn, key=lambda pair: pair[0][:4])
    ]


def with_level(
    panels: list[Panel], group: str, label: str, level: float | None, where: npt.NDArray[np.bool_]
) -> list[Panel]:
    """Panels, with a horizontal line at a level in those of a group, at the times `where` it holds. Shape (n,).

    Unchanged if there is no level, or nowhere to draw it.
    """
    if level is None or not where.any():
        return panels
    line = Line(label, np.where(where, level, np.nan), desired=True)
    return [replace(panel, lines=[*panel.lines, line]) if panel.group == group else panel for panel in panels]
