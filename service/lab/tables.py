"""`lab tables`: Tables C.2–C.4 of the paper; an experiment predicts each cell.

The plant was fitted to two cells without quantization, calm (C.2, C.3) and windy (C.4), by `tests/benchmarks/fit.py`.
All others are predictions, and only these count in the mean absolute relative error. Beside it stand two baselines
without physics, the means of the published columns and one constant for a table, with each cell left out of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings
from aeroloop.service.lab.engine import (
    PROCESSES,
    Progress,
    Run,
    Sheets,
    Workers,
    cell,
    figures_row,
    open_workers,
    run_of,
)

# ── published: rows are bits of the input, columns bits of the output; None is the paper's "cont." ──

INPUT_BITS: Final[tuple[int | None, ...]] = (6, 7, 8, 9, 10, None)
OUTPUT_BITS: Final[tuple[int | None, ...]] = (8, 9, 10, None)
Z_TRACK: Final = (
    (49, 51, 38, 38), (43, 40, 37, 40), (45, 40, 39, 45), (45, 40, 40, 43), (47, 40, 39, 38), (43, 35, 34, 35)
)  # fmt: skip
"""Table C.2 [1e-4 s]."""
U_TOTAL: Final = (
    (8042, 8168, 7884, 7945), (7881, 7935, 7897, 8023), (8095, 7895, 7898, 8017),
    (8055, 7857, 7959, 8034), (8121, 7970, 7892, 7899), (8147, 7854, 7767, 7980),
)  # fmt: skip
"""Table C.3 [V²·s]."""
WIND: Final = {
    "continuous": {"calm": {"z_track_1e-4": 35, "u_total": 7980}, "wind": {"z_track_1e-4": 97, "u_total": 9241}},
    "quantized_8_6": {"calm": {"z_track_1e-4": 49, "u_total": 8042}, "wind": {"z_track_1e-4": 119, "u_total": 9699}},
}
"""Table C.4."""
DURATION_S: Final = 50.0  # of every experiment
CASES: Final = {"continuous": (None, None), "quantized_8_6": (8, 6)}  # bits out and in of Table C.4
_FIGURES: Final = ("z_track_1e-4", "u_total")

# ── one cell ──


class Cell(NamedTuple):
    """One experiment. Bits of None are the paper's "cont."."""

    bits_out: int | None
    bits_in: int | None
    windy: bool = False

    @property
    def overrides(self) -> list[str]:
        """The cell as overrides of the configuration."""
        out, inp = _word(self.bits_out), _word(self.bits_in)
        bits = [f"wire.attitude.bits={out}", f"wire.rate.bits={out}", f"wire.voltage.bits={inp}"]
        return [*bits, f"plant.wind.blowing={str(self.windy).lower()}"]


def _word(bits: int | None) -> str:
    return "cont" if bits is None else str(bits)


def run_cells(
    workers: Workers, runs: Sequence[Run], progress: Callable[[int], None] = lambda _: None
) -> list[tuple[float, float]]:
    """z_track [1e-4 s] and u_total [V²·s] of each run, as long as the paper's. Raises ValueError if one trips."""
    rows = workers.rows(partial(figures_row, duration_s=DURATION_S), runs, progress)
    for row in rows:
        if row["reason"] is not None:
            raise ValueError(row["reason"])
    return [(row["z_track"] * 1e4, row["u_total"]) for row in rows]


# ── the tables, predicted ──


class Table(BaseModel):
    """A predicted table and the published one."""

    model_config = ConfigDict(frozen=True)

    ours: Any
    paper: Any
    mare: float = Field(description="mean absolute relative error of the predicted cells [1]")
    column_mean_mare: float = Field(description="the same of the published columns' means, each cell left out [1]")
    constant_mare: float | None = Field(
        description="the same of one constant, the mean of all other published cells; null of calm and windy ones [1]"
    )


class Tables(BaseModel):
    """The three tables, in the paper's units."""

    model_config = ConfigDict(frozen=True)

    C2: Table = Field(description="z_track [1e-4 s]; rows: bits of the input, columns: bits of the output")
    C3: Table = Field(description="u_total [V²·s]")
    C4: Table = Field(description="both, calm and windy; mare over the quantized windy cell's two figures")


def predict(settings: Settings, progress: Progress = lambda _done, _total: None, engine: str = PROCESSES) -> Tables:
    """Run every cell, each with its own bits and wind, by an engine as of `open_workers`.

    Raises PlantError if the plant is no emulated body, so there is no wind on it, and ValueError if a cell trips.
    """
    settings.plant.mechanism()
    cells = [Cell(out, inp) for inp in INPUT_BITS for out in OUTPUT_BITS]
    cells += [Cell(*bits, windy=True) for bits in CASES.values()]
    runs = [run_of(settings, cell.overrides) for cell in cells]
    with open_workers(engine) as workers:
        found = run_cells(workers, runs, lambda done: progress(done, len(runs)))
    rounded = {cell: [round(figure, 2) for figure in figures] for cell, figures in zip(cells, found, strict=True)}

    def calm(figure: int, published: Sequence[Sequence[float]]) -> Table:
        ours = [[rounded[Cell(out, inp)][figure] for out in OUTPUT_BITS] for inp in INPUT_BITS]
        paper = [list(row) for row in published]
        predicted = slice(-1)  # the plant was calibrated on the last cell
        mine, theirs, means = (list(chain(*table))[predicted] for table in (ours, paper, column_means(paper)))
        constants = np.array(column_means([[value] for value in chain(*paper)])).ravel().tolist()[predicted]
        return Table(
            ours=ours,
            paper=paper,
            mare=_mare(mine, theirs),
            column_mean_mare=_mare(means, theirs),
            constant_mare=_mare(constants, theirs),
        )

    ours = {
        case: {
            air: dict(zip(_FIGURES, rounded[Cell(*bits, windy=air == "wind")], strict=True)) for air in ("calm", "wind")
        }
        for case, bits in CASES.items()
    }
    windy, published = (list(table["quantized_8_6"]["wind"].values()) for table in (ours, WIND))
    pairs = [[[air[name] for air in case.values()] for case in WIND.values()] for name in _FIGURES]
    means = [column_means(table)[1][1] for table in pairs]
    in_wind = Table(
        ours=ours,
        paper=WIND,
        mare=_mare(windy, published),
        column_mean_mare=_mare(means, published),
        constant_mare=None,
    )
    return Tables(C2=calm(0, Z_TRACK), C3=calm(1, U_TOTAL), C4=in_wind)


def _mare(ours: Sequence[float], theirs: Sequence[float]) -> float:
    return fmean(abs(mine - other) / other for mine, other in zip(ours, theirs, strict=True))


def column_means(table: Sequence[Sequence[float]]) -> list[list[float]]:
    """Each cell predicted by the mean of the others in its column."""
    values = np.array(table, float)
    return ((values.sum(axis=0) - values) / (len(values) - 1)).tolist()  # type: ignore[no-any-return]


def sheets(tables: Tables) -> Sheets:
    """The tables as text: ours, with the paper's in brackets; then the errors."""
    for title, table, digits in (
        ("z_track, 10⁻⁴ s (Table C.2): ours (paper's)", tables.C2, 1),
        ("u_total, V²·s (Table C.3): ours (paper's)", tables.C3, 0),
    ):
        rows = []
        for inp, *lines in zip(INPUT_BITS, table.ours, table.paper, strict=True):
            cells = (f"{ours:.{digits}f} ({theirs})" for ours, theirs in zip(*lines, strict=True))
            rows.append({"bits in ╲ out": _word(inp)} | dict(zip(map(_word, OUTPUT_BITS), cells, strict=True)))
        yield title, rows
    rows = []
    for case, label in (("continuous", "continuous"), ("quantized_8_6", "8 bits out, 6 in")):
        rows.append({"": label})
        for air in ("calm", "wind"):
            for name, digits in zip(_FIGURES, (1, 0), strict=True):
                text = f"{tables.C4.ours[case][air][name]:.{digits}f} ({tables.C4.paper[case][air][name]})"
                rows[-1][f"{name.removesuffix('_1e-4')} {air}"] = text
    yield "With and without wind (Table C.4): ours (paper's)", rows
    each, names = (tables.C2, tables.C3, tables.C4), ("z_track", "u_total", "windy cell")
    errors: dict[str, list[float | None]] = {
        "ours": [table.mare for table in each],
        "column mean": [table.column_mean_mare for table in each],
        "one constant": [table.constant_mare for table in each],
    }
    yield (
        "Mean absolute relative error of cells that are not fitted; column mean: of the paper's others in the column; "
        "one constant: of all its others",
        [
            {"prediction": name}
            | {of: cell(error, f"{{:.{n}%}}") for of, error, n in zip(names, found, (1, 2, 1), strict=True)}
            for name, found in errors.items()
        ],
    )
