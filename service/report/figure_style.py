"""Style of figures for print: a journal's column widths, one colour scheme, PDF, SVG and PNG, no titles.

Colours are those of Okabe and Ito, which differ for the colour-blind, too; in grey, line styles and markers differ.
The same bytes come out for the same figure: files have no date, and SVG ids no salt.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from aeroloop.service.logs.outputs import OutputError

WIDTH_IN: Final[dict[int, float]] = {1: 3.5, 2: 7.16}
"""Width of one column, and of two, in IEEE's journals [in]."""

FORMATS: Final[dict[str, dict[str, Any]]] = {
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
    "png": {"dpi": 600},
}
"""Suffixes of every figure, with the options of each."""

BLUE, ORANGE, GREEN, PURPLE, BLACK = "#0072b2", "#d55e00", "#009e73", "#b0568c", "#222222"

MEASURED: Final[dict[str, Any]] = {"color": BLUE, "linewidth": 0.7}
DESIRED: Final[dict[str, Any]] = {"color": ORANGE, "linewidth": 0.8, "linestyle": (0, (3.5, 2.5))}
TRUE: Final[dict[str, Any]] = {"color": GREEN, "linewidth": 0.9, "linestyle": (0, (1, 1))}

_STYLE: Final[dict[str, Any]] = {
    "font.family": "STIXGeneral",  # a Times that comes with matplotlib
    "mathtext.fontset": "stix",
    "font.size": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.2,
    "legend.borderpad": 0.2,
    "axes.linewidth": 0.5,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.4,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "pdf.fonttype": 42,  # TrueType, which journals ask for
    "svg.hashsalt": "aeroloop",
}


def figure_style() -> AbstractContextManager[None]:
    """Every figure that is drawn and saved within has the style."""
    return matplotlib.rc_context(_STYLE)  # type: ignore[arg-type]  # its keys are literals in the stubs


def stacked(panels: int, height: float = 0.85) -> tuple[Figure, list[Axes]]:
    """A figure, one column wide, with panels of this height [in] over one time axis [s]."""
    figure = Figure(figsize=(WIDTH_IN[1], 0.45 + height * panels), layout="constrained")
    axes: list[Axes] = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0].tolist()
    for axis in axes:
        axis.margins(x=0)
        axis.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    return figure, axes


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
