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
    case, actuators = case_of(settings), settings.wire.actuators
    t = np.asarray(ticks.k * settings.loop.period, dtype=np.float64)
    q, axes = "" if case == "continuous" else "^Q", (1, 2, 3)
    desired = ticks.desired
    attitude = ticks.attitude * np.sign(np.sum(ticks.attitude * desired, axis=1, keepdims=True))  # of ±q, the nearer
    euler = [rf"$\eta{q}$", *(rf"$\epsilon_{i}{q}$" for i in axes)]
    errors, rates = [rf"$\tilde{{\epsilon}}_{i}{q}$" for i in axes], [rf"$\omega_{i}{q}$" for i in axes]
    rate_errors, motors = [rf"$\omega_{{e,{i}}}{q}$" for i in axes], [rf"$u_{i}{q}$" for i in axes[3 - actuators :]]
    drawings: list[tuple[str, str, Array, Array | None, list[str], str]] = [
        ("attitude", "Attitude", attitude, desired, euler, "1"),
        ("rate", "Angular velocity", ticks.rate, ticks.desired_rate, rates, "rad/s"),
        ("error", "Attitude error", ticks.attitude_error, None, errors, "1"),
        ("rate_error", "Angular velocity error", ticks.rate_error, None, rate_errors, "rad/s"),
        ("input", "Input", ticks.voltages, None, motors, "V"),
    ]
    paths = []
    for name, quantity, values, wanted, labels, unit in drawings:
        figure = _stack(title_of(name, quantity, case), t, values, wanted, [f"{label} [{unit}]" for label in labels])
        number = NUMBERS.get((name, case))
        paths.append(_save(figure, folder / f"{f'{number}-' if number else ''}{name}.png"))
    return paths


def draw_theorem(report: Report, folder: Path) -> list[Path]:
    """Draw ‖z‖ with its guaranteed radius, and V, into a PNG file, and return its path; none without ticks.

    The folder is created if missing. Raises ReviewError if it cannot be written.
    """
    drawn = [panel for panel in report.panels if panel.group in ("z_norm", "lyapunov")]
    if not drawn:
        return []
    figure, axes = _figure("What the theorem bounds", len(drawn), 2.0)
    for axis, panel in zip(axes, drawn, strict=True):
        for line in panel.lines:
            known = np.isfinite(line.values)  # true states are published less often than ticks
            color, style = ("#c8401e", ":") if line.desired else (None, "-")
            axis.plot(
                report.time[known], line.values[known], linewidth=0.9, label=line.label, color=color, linestyle=style
            )
        axis.set_ylabel(f"{panel.label}{f' [{panel.unit}]' if panel.unit != '1' else ''}")
        axis.legend(fontsize=9)
    return [_save(figure, folder / "theorem.png")]


def _stack(title: str, t: Array, values: Array, desired: Array | None, labels: Sequence[str]) -> Figure:
    """A panel per component, with a shared time axis; the desired value, where there is one, is dotted."""
    figure, panels = _figure(title, len(labels), 1.4)
    for i, panel in enumerate(panels):
        panel.plot(t, values[:, i], color="#1f5fa8", linewidth=0.9, label="measured")
        if desired is not None:
            panel.plot(t, desired[:, i], color="#c8401e", linewidth=1.1, linestyle=":", label="desired")
        panel.set_ylabel(labels[i])
        panel.set_axisbelow(True)
    if desired is not None:
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower right", fontsize=9, ncols=2)
    return figure


def _figure(title: str, panels: int, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with panels of this height [in] over one time axis."""
    figure = Figure(figsize=(8, 1.5 + height * panels), layout="constrained")
    figure.suptitle(title, fontsize=12)
    axes: list[Axes] = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0].tolist()
    for axis in axes:
        axis.grid(visible=True, color="0.9")
        axis.margins(x=0)
    axes[-1].set_xlabel("time [s]")
    return figure, axes


def _save(figure: Figure, path: Path) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise ReviewError(f"cannot write figures into {path.parent}: {error.strerror}") from None
    return path
