"""Figures C.4–C.14 of the paper, drawn from a log into PNG files; and one of the theorem's bounds.

All five quantities are drawn in every case; `NUMBERS` of review/panels.py has the paper's number of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aeroloop.service.config import Settings
from aeroloop.service.logs.files import ReviewError
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review.panels import NUMBERS, case_of, title_of
from aeroloop.service.review.report import Report

Array = npt.NDArray[np.float64]


def draw_figures(settings: Settings, blocks: Sequence[Ticks], folder: Path) -> list[Path]:
    """Draw every quantity of a session into PNG files and return their paths.

    Args:
        settings: The configuration of its controller.
        blocks: Its ticks.
        folder: Target folder; created if missing.

    Raises:
        ReviewError: The session has no ticks, or the folder cannot be written.
    """
    ticks = Ticks.joined(blocks) if blocks else None
    if ticks is None or not len(ticks.k):
        raise ReviewError("the log has no answered measurement to draw")
    case, wire = case_of(settings), settings.wire
    t = np.asarray(ticks.k * settings.loop.period, dtype=np.float64)
    q = "" if case == "continuous" else "^Q"
    first_motor = 3 - wire.actuators + 1

    attitude, desired = ticks.attitude, ticks.desired
    attitude = attitude * np.sign(np.sum(attitude * desired, axis=1, keepdims=True))  # of ±q, the nearer to q_d
    rate, desired_rate = ticks.rate, ticks.desired_rate
    drawings = {
        "attitude": _stack(
            "Attitude", t, attitude, desired, [rf"$\eta{q}$", *(rf"$\epsilon_{i}{q}$" for i in (1, 2, 3))], "1"
        ),
        "rate": _stack(
            "Angular velocity", t, rate, desired_rate, [rf"$\omega_{i}{q}$" for i in (1, 2, 3)], "rad/s"
        ),
        "error": _stack(
            "Attitude error", t, ticks.attitude_error, None,
            [rf"$\tilde{{\epsilon}}_{i}{q}$" for i in (1, 2, 3)], "1",
        ),
        "rate_error": _stack(
            "Angular velocity error", t, ticks.rate_error, None,
            [rf"$\omega_{{e,{i}}}{q}$" for i in (1, 2, 3)], "rad/s",
        ),
        "input": _stack(
            "Input", t, ticks.voltages, None,
            [rf"$u_{first_motor + i}{q}$" for i in range(wire.actuators)], "V",
        ),
    }  # fmt: skip
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in drawings.items():
            number = NUMBERS.get((name, case))
            figure.suptitle(title_of(name, str(figure.get_label()), case), fontsize=12)
            stem = f"{number}-{name}" if number else name
            paths.append(folder / f"{stem}.png")
            figure.savefig(paths[-1], dpi=130)
    except OSError as error:
        raise ReviewError(f"cannot write figures into {folder}: {error.strerror}") from None
    return paths


def draw_theorem(report: Report, folder: Path) -> list[Path]:
    """Draw ‖z‖ with its guaranteed radius, and V, into a PNG file, and return its path; none without ticks.

    Args:
        report: The run.
        folder: Target folder; created if missing.

    Raises:
        ReviewError: The folder cannot be written.
    """
    drawn = [panel for panel in report.panels if panel.group in ("z_norm", "lyapunov")]
    if not drawn:
        return []
    figure = Figure(figsize=(8, 1.5 + 2.0 * len(drawn)), layout="constrained")
    figure.suptitle("What the theorem bounds", fontsize=12)
    axes: list[Axes] = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0].tolist()
    for axis, panel in zip(axes, drawn, strict=True):
        for line in panel.lines:
            known = np.isfinite(line.values)  # true states are published less often than ticks
            color, style = ("#c8401e", ":") if line.desired else (None, "-")
            axis.plot(
                report.time[known], line.values[known], linewidth=0.9, label=line.label, color=color, linestyle=style
            )
        axis.set_ylabel(f"{panel.label}{f' [{panel.unit}]' if panel.unit != '1' else ''}")
        axis.grid(visible=True, color="0.9")
        axis.margins(x=0)
        axis.legend(fontsize=9)
    axes[-1].set_xlabel("time [s]")
    path = folder / "theorem.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise ReviewError(f"cannot write figures into {folder}: {error.strerror}") from None
    return [path]


def _stack(title: str, t: Array, values: Array, desired: Array | None, labels: Sequence[str], unit: str) -> Figure:
    """A panel per component, with a shared time axis; the desired value, where there is one, is dotted."""
    n = values.shape[1]
    figure = Figure(figsize=(8, 1.5 + 1.4 * n), layout="constrained", label=title)
    panels: list[Axes] = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0].tolist()
    for i, panel in enumerate(panels):
        panel.plot(t, values[:, i], color="#1f5fa8", linewidth=0.9, label="measured")
        if desired is not None:
            panel.plot(t, desired[:, i], color="#c8401e", linewidth=1.1, linestyle=":", label="desired")
        panel.set_ylabel(f"{labels[i]} [{unit}]")
        panel.grid(visible=True, color="0.9")
        panel.set_axisbelow(True)
        panel.margins(x=0)
    if desired is not None:
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower right", fontsize=9, ncols=2)
    panels[-1].set_xlabel("time [s]")
    return figure
