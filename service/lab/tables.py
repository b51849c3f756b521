"""Tables C.2–C.4 of the paper, predicted: one experiment per cell, in lockstep.

The plant was calibrated on two cells without quantization: calm (C.2, C.3) and windy (C.4). All others are predictions,
and only these count in the mean absolute relative error. Baselines without physics stand beside it: forms fitted to the
published table itself, so each has seen the cells that it is scored on. What compares is their error with each cell
left out of its own fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from statistics import fmean, stdev
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings
from aeroloop.service.lab import paper
from aeroloop.service.lab.sweep import Progress, Row, Sheets, figures_row
from aeroloop.service.lab.workers import PROCESSES, Run, Workers, open_workers, run_of

CASES: Final = {"continuous": (None, None), "quantized_8_6": (8, 6)}
_FIGURES: Final = ("z_track_1e-4", "u_total")
ERRORS: Final = (
    "Mean absolute relative error of cells that are not fitted (in brackets: of a fit to all cells), with the numbers "
    "fitted per figure and the cells that they are fitted to: calm; windy"
)
NOT_IDENTIFIED: Final = (
    "The tables do not identify dead zone, height of the centre of mass and Coulomb friction separately: with a dead "
    "zone of 2.5 V, and the other two fitted again, they are predicted as well."
)


class Cell(NamedTuple):
    """One experiment. Bits of None are the paper's "cont."."""

    bits_out: int | None
    bits_in: int | None
    windy: bool = False

    @property
    def overrides(self) -> list[str]:
        """The cell as overrides of the configuration."""
        signals = (("attitude", self.bits_out), ("rate", self.bits_out), ("voltage", self.bits_in))
        bits = [f"wire.{name}.bits={_word(each)}" for name, each in signals]
        return [*bits, f"plant.wind.blowing={str(self.windy).lower()}"]


def run_cells(
    workers: Workers[Row], runs: Sequence[Run], progress: Callable[[int], None] = lambda _: None
) -> list[tuple[float, float]]:
    """z_track [1e-4 s] and u_total [V²·s] of each run, as long as the paper's. Raises ValueError if one trips."""
    rows = workers.rows(partial(figures_row, duration_s=paper.DURATION_S), runs, progress)
    for row in rows:
        if row["reason"] is not None:
            raise ValueError(row["reason"])
    return [(row["z_track"] * 1e4, row["u_total"]) for row in rows]


class Baseline(BaseModel):
    """A form fitted to a published table by least squares, and its error over the cells that we predict."""

    model_config = ConfigDict(frozen=True)

    name: str
    parameters: int = Field(description="numbers fitted, for each figure")
    cells: int = Field(description="published cells that they are fitted to")
    mare: float | None = Field(description="mean absolute relative error [1]; null if fitted to none of these cells")
    mare_left_out: float = Field(description="the same, each cell predicted by a fit to all others [1]")


def baselines(
    published: Sequence[Sequence[Sequence[float]]], fitted: tuple[int, int], scored: tuple[int, int] | None = None
) -> list[Baseline]:
    """The fitted cell for all others, a constant, column means, and a sum of rows and columns.

    Args:
        published: A table for each figure, all of one shape.
        fitted: The cell that the plant is calibrated on: row and column, from 0.
        scored: The only cell that counts; all but `fitted` if None.
    """
    tables = [np.array(table, dtype=float) for table in published]
    (rows, columns), n = tables[0].shape, tables[0].size
    counts = np.full((rows, columns), scored is None)
    counts[scored or fitted] = scored is not None

    def error(forms: Sequence[np.ndarray]) -> float:
        return float(np.mean([np.abs(form / y - 1)[counts] for form, y in zip(forms, tables, strict=True)]))

    forms = (
        ("constant", 1, [np.full(y.shape, y.mean()) for y in tables]),
        ("column mean", columns, [np.tile(y.mean(axis=0), (rows, 1)) for y in tables]),
        ("row + column", rows + columns - 1, [np.add.outer(y.mean(axis=1), y.mean(axis=0)) - y.mean() for y in tables]),
    )
    alone = error([np.full(y.shape, y[fitted]) for y in tables])
    return [
        Baseline(name="fitted cell", parameters=1, cells=1, mare=None, mare_left_out=alone),
        # Every cell has the leverage p/n in these fits: left out, it is missed by 1/(1 − p/n) times as much.
        *(
            Baseline(name=name, parameters=p, cells=n, mare=error(form), mare_left_out=error(form) * n / (n - p))
            for name, p, form in forms
        ),
    ]


class Table(BaseModel):
    """A predicted table and the published one."""

    model_config = ConfigDict(frozen=True)

    ours: Any
    paper: Any
    spread: Any = Field(default=None, description="standard deviation over seeds, shaped as `ours`; null for one seed")
    mare: float = Field(description="mean absolute relative error of the predicted cells [1]")
    baselines: list[Baseline]


class Tables(BaseModel):
    """The three tables, in the paper's units."""

    model_config = ConfigDict(frozen=True)

    C2: Table = Field(description="z_track [1e-4 s]; rows: bits of the input, columns: bits of the output")
    C3: Table = Field(description="u_total [V²·s]")
    C4: Table = Field(description="both, calm and windy; mare over the quantized windy cell's two figures")


def predict(
    settings: Settings, seeds: int = 1, progress: Progress = lambda _done, _total: None, engine: str = PROCESSES
) -> Tables:
    """Run every cell, `seeds` times each with seeds from 0 up.

    Args:
        settings: The configuration; each cell sets bits and wind.
        seeds: Number of runs per cell; a figure is their mean.
        progress: Called with cells done and cells in all.
        engine: As of `open_workers`.

    Raises:
        PlantError: The plant is no emulated body, so there is no wind on it.
        ValueError: A cell trips.
    """
    settings.plant.mechanism()
    cells = [Cell(out, inp) for inp in paper.INPUT_BITS for out in paper.OUTPUT_BITS]
    cells += [Cell(*bits, windy=True) for bits in CASES.values()]
    runs = [run_of(settings, cell.overrides, seed) for cell in cells for seed in range(seeds)]
    with open_workers(engine) as workers:
        found = run_cells(workers, runs, lambda done: progress(done, len(runs)))
    of_cell = {cell: found[i * seeds : (i + 1) * seeds] for i, cell in enumerate(cells)}

    def rounded(statistic: Callable[[Sequence[float]], float], figure: int, cell: Cell) -> float:
        return round(statistic([result[figure] for result in of_cell[cell]]), 2)

    def grid(statistic: Callable[[Sequence[float]], float], figure: int) -> list[list[float]]:
        return [[rounded(statistic, figure, Cell(out, inp)) for out in paper.OUTPUT_BITS] for inp in paper.INPUT_BITS]

    def wind(statistic: Callable[[Sequence[float]], float]) -> dict[str, dict[str, dict[str, float]]]:
        return {
            case: {
                air: {name: rounded(statistic, i, Cell(*bits, windy=air == "wind")) for i, name in enumerate(_FIGURES)}
                for air in ("calm", "wind")
            }
            for case, bits in CASES.items()
        }

    grids = []
    for figure, published in enumerate((paper.Z_TRACK, paper.U_TOTAL)):
        ours = grid(fmean, figure)
        both = zip(chain(*ours), chain(*published), strict=True)
        errors = [abs(mine - theirs) / theirs for mine, theirs in both][:-1]  # the plant was calibrated on the last
        grids.append(
            Table(
                ours=ours,
                paper=[list(row) for row in published],
                spread=grid(stdev, figure) if seeds > 1 else None,
                mare=fmean(errors),
                baselines=baselines([published], fitted=(-1, -1)),
            )
        )
    predicted, measured = (part["quantized_8_6"]["wind"] for part in (wind(fmean), paper.WIND))
    windy = Table(
        ours=wind(fmean),
        paper=paper.WIND,
        spread=wind(stdev) if seeds > 1 else None,
        mare=fmean(abs(predicted[name] - measured[name]) / measured[name] for name in measured),
        baselines=baselines(
            [[[air[name] for air in case.values()] for case in paper.WIND.values()] for name in _FIGURES],
            fitted=(0, 1),
            scored=(1, 1),
        ),
    )
    return Tables(C2=grids[0], C3=grids[1], C4=windy)


def sheets(tables: Tables) -> Sheets:
    """The tables as text: ours, with the paper's in brackets; then the errors."""
    for title, table, digits in (
        ("z_track, 10⁻⁴ s (Table C.2): ours (paper's)", tables.C2, 1),
        ("u_total, V²·s (Table C.3): ours (paper's)", tables.C3, 0),
    ):
        yield (
            title,
            [
                {"bits in ╲ out": _word(inp)}
                | {
                    _word(out): _beside(
                        table.ours[i][j], table.paper[i][j], table.spread and table.spread[i][j], digits
                    )
                    for j, out in enumerate(paper.OUTPUT_BITS)
                }
                for i, inp in enumerate(paper.INPUT_BITS)
            ],
        )
    ours, theirs, spread = tables.C4.ours, tables.C4.paper, tables.C4.spread
    columns = [(air, name) for air in ("calm", "wind") for name in _FIGURES]
    yield (
        "With and without wind (Table C.4): ours (paper's)",
        [
            {"": label}
            | {
                f"{name.removesuffix('_1e-4')} {air}": _beside(
                    ours[case][air][name], theirs[case][air][name], spread and spread[case][air][name], digits
                )
                for (air, name), digits in zip(columns, (1, 0, 1, 0), strict=True)
            }
            for case, label in (("continuous", "continuous"), ("quantized_8_6", "8 bits out, 6 in"))
        ],
    )
    yield ERRORS, list(_comparison(tables))
    yield NOT_IDENTIFIED, []


def _comparison(tables: Tables) -> Iterator[dict[str, str]]:
    """Our errors and the baselines'."""
    each, header = (tables.C2, tables.C3, tables.C4), ("z_track", "u_total", "windy cell")
    digits = (1, 2, 1)
    errors = [f"{table.mare:.{n}%}" for table, n in zip(each, digits, strict=True)]
    yield {"prediction": "ours", "numbers": "1; 2", "cells": "1; 2"} | dict(zip(header, errors, strict=True))
    for baseline in zip(*(table.baselines for table in each), strict=True):
        calm, _, windy = baseline
        errors = [
            f"{b.mare_left_out:.{n}%}{'' if b.mare is None else f' ({b.mare:.{n}%})'}"
            for b, n in zip(baseline, digits, strict=True)
        ]
        counts = {
            "numbers": f"{calm.parameters}; {windy.parameters}",
            "cells": f"{calm.cells}; {windy.cells}",
        }
        yield {"prediction": calm.name, **counts} | dict(zip(header, errors, strict=True))


def _word(bits: int | None) -> str:
    return "cont" if bits is None else str(bits)


def _beside(ours: float, theirs: float, spread: float | None, digits: int) -> str:
    return f"{ours:.{digits}f}{'' if spread is None else f' ±{spread:.{digits}f}'} ({theirs})"
