"""Figures for print: a session's as PDF, SVG and PNG (roll, pitch and yaw, Figures C.4–C.14, ‖z‖), and their style.

The style has a journal's column widths and Okabe and Ito's colours. The same bytes come out for the same figure: files
have no date, and SVG ids no salt.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from aeroloop.service.config import Settings
from aeroloop.service.logs.outputs import OutputError
from aeroloop.service.logs.recording import Progress, ReviewError
from aeroloop.service.review.panels import NUMBERS, case_of
from aeroloop.service.review.report import Panel, Report

WIDTH_IN: Final[dict[int, float]] = {1: 3.5, 2: 7.16}  # width of one column, and of two, in IEEE's journals [in]

FORMATS: Final[dict[str, dict[str, Any]]] = {
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
    "png": {"dpi": 600},
}  # suffixes of every figure, with the options of each

BLUE, ORANGE, GREEN, PURPLE, BLACK = "#0072b2", "#d55e00", "#009e73", "#b0568c", "#222222"


def figure_style() -> AbstractContextManager[None]:
    """Every figure that is drawn and saved within has the style."""
    return style.context(Path(__file__).with_name("paper.mplstyle"))


def logarithmic(panel: Axes, which: Literal["x", "y"], digits: Sequence[int]) -> None:
    """Make an axis of a panel logarithmic, with plain numbers at these digits of each decade."""
    axis = panel.xaxis if which == "x" else panel.yaxis
    panel.set(**{f"{which}scale": "log"})
    axis.set_major_locator(FixedLocator([digit * 10.0**power for power in range(-3, 6) for digit in digits]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def check_path(path: Path) -> Path:
    """The path of a single figure. Raises OutputError if its suffix or folder is wrong."""
    suffixes = [f".{name}" for name in FORMATS]
    if path.suffix not in suffixes:
        raise OutputError(f"a figure ends in {', '.join(suffixes)}, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"there is no folder {path.parent} for the figure")
    return path


def save_as(figure: Figure, path: Path) -> None:
    """Save a figure in the format of the path's suffix. Raises OutputError if it cannot be written."""
    try:
        figure.savefig(check_path(path), **FORMATS[path.suffix[1:]])
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Save a figure in every format, and return the paths. Raises OSError if it cannot be written."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # laid out once, not for each format
    paths = {folder / f"{name}.{suffix}": options for suffix, options in FORMATS.items()}
    for path, options in paths.items():
        figure.savefig(path, **options)
    return list(paths)


# ── figures of a session ──

FIGURES: Final = ("angles", "attitude", "rate", "error", "rate_error", "input", "theorem")
"""Groups of panels that are drawn, a figure each."""

LETTERS: Final = {
    "η": r"\eta", "ε": r"\epsilon_{}", "ε̃": r"\tilde{{\epsilon}}_{}", "ω": r"\omega_{}", "ω_e": r"\omega_{{e,{}}}",
    "u": "u_{}",
}  # fmt: skip
"""Quantized signals, in mathematics; with the index of the axis."""

MEASURED: Final[dict[str, Any]] = {"color": BLUE, "linewidth": 0.7}
DESIRED: Final[dict[str, Any]] = {"color": ORANGE, "linewidth": 0.8, "linestyle": (0, (3.5, 2.5))}
TRUE: Final[dict[str, Any]] = {"color": GREEN, "linewidth": 0.9, "linestyle": (0, (1, 1))}

DIGITS: Final = str.maketrans("₁₂₃", "123")


def draw_figures(report: Report, settings: Settings, folder: Path, progress: Progress | None = None) -> list[Path]:
    """Draw what a report has, each figure as PDF, SVG and PNG, and return the paths.

    The settings are its controller's; `progress` is called with the share done before each figure. Raises ReviewError
    if the session has no ticks, OSError if the folder cannot be written.
    """
    if not len(report.time):
        raise ReviewError("the log has no answered measurement to draw")
    case, paths = case_of(settings), list[Path]()
    with figure_style():
        for i, name in enumerate(FIGURES):
            if progress is not None:
                progress(i / len(FIGURES))
            panels = [panel for panel in report.panels if panel.group == name]
            if not panels:
                continue
            figure = Figure(figsize=(WIDTH_IN[1], 0.45 + 0.85 * len(panels)), layout="constrained")
            axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0].tolist()
            for axis, panel in zip(axes, panels, strict=True):
                _draw(axis, panel, report)
                axis.set_ylabel(_label(panel, "^Q" if case != "continuous" else ""))
                axis.margins(x=0)
                axis.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
            axes[-1].set_xlabel("time [s]")
            figure.align_ylabels(axes)
            for fault in report.findings.faults:
                axes[0].annotate(
                    fault.fault, (fault.begin_s, 1), xycoords=("data", "axes fraction"), xytext=(2, -2),
                    textcoords="offset points", va="top", fontsize=6,
                )  # fmt: skip
            if len(panels[0].lines) > 1:
                figure.legend(handles=axes[0].get_lines(), loc="outside upper center", ncols=len(panels[0].lines))
            number = NUMBERS[case].get(name)
            paths += save(figure, folder, f"{number}-{name}" if number else name)
    return paths


def _draw(axis: Axes, panel: Panel, report: Report) -> None:
    for line in sorted(panel.lines, key=lambda line: line.label != "measured"):
        known = np.isfinite(line.values) if not line.held else slice(None)
        steps = "steps-post" if line.held and report.thinned <= 2 else "default"
        stroke = DESIRED if line.desired else MEASURED if line.held else TRUE
        axis.plot(report.time[known], line.values[known], label=line.label, drawstyle=steps, **stroke)
    for fault in report.findings.faults:
        end_s = report.time[-1] if fault.end_s is None else fault.end_s
        axis.axvspan(fault.begin_s, end_s, facecolor="0.91", edgecolor="0.75", linewidth=0.4, zorder=0)


def _label(panel: Panel, quantized: str) -> str:
    """An axis label: the panel's letter in mathematics, and the unit if it has one."""
    letter, axis = panel.label.rstrip("₁₂₃123"), panel.label[-1].translate(DIGITS)
    text = r"$\|z\|$" if panel.label == "‖z‖" else panel.label
    if letter in LETTERS:
        text = f"${LETTERS[letter].format(axis)}{quantized}$"
    return text if panel.unit == "1" else f"{text} [{panel.unit}]"
