"""Style of figures for print: a journal's column widths, one colour scheme, PDF, SVG and PNG, no titles.

Colours are those of Okabe and Ito, which differ for the colour-blind, too; in grey, line styles and markers differ.
The same bytes come out for the same figure: files have no date, and SVG ids no salt.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Literal

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from aeroloop.service.logs.outputs import OutputError

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
