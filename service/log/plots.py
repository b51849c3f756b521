"""The paper's Figures C.4–C.14, drawn from a log.

A log is one run, and a run is one of the paper's three cases: without quantization (C.4–C.6), with it (C.7–C.11), with
it and wind (C.12–C.14). All five quantities are drawn whatever the case; a title carries the paper's number where the
paper has that figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from service.config import Settings
from service.log.files import ReviewError
from service.log.review import Tick

Case = Literal["continuous", "quantized", "wind"]
Array = npt.NDArray[np.float64]

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
"""Which figure of the paper shows a quantity in a case."""


def case_of(settings: Settings) -> Case:
    """Which of the paper's cases a session was."""
    if settings.plant.wind.blowing and not settings.plant.ideal:
        return "wind"
    bits = (settings.wire.attitude.bits, settings.wire.rate.bits, settings.wire.voltage.bits)
    return "continuous" if bits == (None, None, None) else "quantized"


def draw_figures(settings: Settings, ticks: Sequence[Tick], folder: Path) -> list[Path]:
    """Draw every quantity of a session into PNG files and return their paths.

    Args:
        settings: The configuration of its controller.
        ticks: Its ticks.
        folder: Where; made if need be.

    Raises:
        ReviewError: The session has no ticks, or the folder cannot be written.
    """
    if not ticks:
        raise ReviewError("the log has no answered measurement to draw")
    case, wire = case_of(settings), settings.wire
    t = np.array([tick.k for tick in ticks]) * settings.loop.period
    q = "" if case == "continuous" else "^Q"
    first_motor = 3 - wire.actuators + 1

    attitude, desired = _column(ticks, "attitude"), _column(ticks, "desired")
    attitude = attitude * np.sign(np.sum(attitude * desired, axis=1, keepdims=True))  # of ±q, the one beside q_d
    rate, desired_rate = _column(ticks, "rate"), _column(ticks, "desired_rate")
    drawings = {
        "attitude": _stack(
            "Attitude", t, attitude, desired, [rf"$\eta{q}$", *(rf"$\epsilon_{i}{q}$" for i in (1, 2, 3))], "1"
        ),
        "rate": _stack(
            "Angular velocity", t, rate, desired_rate, [rf"$\omega_{i}{q}$" for i in (1, 2, 3)], "rad/s"
        ),
        "error": _stack(
            "Attitude error", t, _column(ticks, "attitude_error"), None,
            [rf"$\tilde{{\epsilon}}_{i}{q}$" for i in (1, 2, 3)], "1",
        ),
        "rate_error": _stack(
            "Angular velocity error", t, _column(ticks, "rate_error"), None,
            [rf"$\omega_{{e,{i}}}{q}$" for i in (1, 2, 3)], "rad/s",
        ),
        "input": _stack(
            "Input", t, _column(ticks, "voltages"), None,
            [rf"$u_{first_motor + i}{q}$" for i in range(wire.actuators)], "V",
        ),
    }  # fmt: skip
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in drawings.items():
            number = NUMBERS.get((name, case))
            label = f"Figure {number}: " if number else ""
            figure.suptitle(f"{label}{figure.get_label()} {CASES[case]}", fontsize=12)
            stem = f"{number}-{name}" if number else name
            paths.append(folder / f"{stem}.png")
            figure.savefig(paths[-1], dpi=130)
    except OSError as error:
        raise ReviewError(f"cannot write figures into {folder}: {error.strerror}") from None
    return paths


def _column(ticks: Sequence[Tick], name: str) -> Array:
    return np.array([getattr(tick, name) for tick in ticks], dtype=np.float64)


def _stack(title: str, t: Array, values: Array, desired: Array | None, labels: Sequence[str], unit: str) -> Figure:
    """One panel a component, with a shared time axis; the desired value, where there is one, is dotted."""
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
