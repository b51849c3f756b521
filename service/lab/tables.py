"""Tables C.2–C.4 of the paper: published, predicted by one lockstep experiment per cell, and the fit of the plant.

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
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings
from aeroloop.service.lab.sweep import PROCESSES, Progress, Run, Sheets, Workers, figures_row, open_workers, run_of

# ── published: rows are bits of the input, columns bits of the output; None is the paper's "cont." ──

INPUT_BITS: Final[tuple[int | None, ...]] = (6, 7, 8, 9, 10, None)
OUTPUT_BITS: Final[tuple[int | None, ...]] = (8, 9, 10, None)
Z_TRACK: Final = (
    (49, 51, 38, 38),
    (43, 40, 37, 40),
    (45, 40, 39, 45),
    (45, 40, 40, 43),
    (47, 40, 39, 38),
    (43, 35, 34, 35),
)
"""Table C.2 [1e-4 s]."""
U_TOTAL: Final = (
    (8042, 8168, 7884, 7945),
    (7881, 7935, 7897, 8023),
    (8095, 7895, 7898, 8017),
    (8055, 7857, 7959, 8034),
    (8121, 7970, 7892, 7899),
    (8147, 7854, 7767, 7980),
)
"""Table C.3 [V²·s]."""
WIND: Final = {
    "continuous": {"calm": {"z_track_1e-4": 35, "u_total": 7980}, "wind": {"z_track_1e-4": 97, "u_total": 9241}},
    "quantized_8_6": {"calm": {"z_track_1e-4": 49, "u_total": 8042}, "wind": {"z_track_1e-4": 119, "u_total": 9699}},
}
"""Table C.4."""
DURATION_S: Final = 50.0
"""Length of every experiment [s]."""
CASES: Final = {"continuous": (None, None), "quantized_8_6": (8, 6)}
"""Bits out and in of Table C.4."""
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
        signals = (("attitude", self.bits_out), ("rate", self.bits_out), ("voltage", self.bits_in))
        bits = [f"wire.{name}.bits={_word(each)}" for name, each in signals]
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


class Baseline(BaseModel):
    """A form fitted to a published table by least squares, and its error over the cells that we predict."""

    model_config = ConfigDict(frozen=True)

    name: str
    parameters: int = Field(description="numbers fitted, for each figure")
    cells: int = Field(description="published cells that they are fitted to")
    mare: float | None = Field(description="mean absolute relative error [1]; null if fitted to none of these cells")
    mare_left_out: float = Field(description="the same, each cell predicted by a fit to all others [1]")


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
    cells = [Cell(out, inp) for inp in INPUT_BITS for out in OUTPUT_BITS]
    cells += [Cell(*bits, windy=True) for bits in CASES.values()]
    runs = [run_of(settings, cell.overrides, seed) for cell in cells for seed in range(seeds)]
    with open_workers(engine) as workers:
        found = run_cells(workers, runs, lambda done: progress(done, len(runs)))
    of_cell = {cell: found[i * seeds : (i + 1) * seeds] for i, cell in enumerate(cells)}

    def grid(statistic: _Statistic, figure: int) -> list[list[float]]:
        return [[rounded(statistic, figure, Cell(out, inp)) for out in OUTPUT_BITS] for inp in INPUT_BITS]

    def wind(statistic: _Statistic) -> dict[str, dict[str, dict[str, float]]]:
        return {
            case: {
                air: {name: rounded(statistic, i, Cell(*bits, air == "wind")) for i, name in enumerate(_FIGURES)}
                for air in ("calm", "wind")
            }
            for case, bits in CASES.items()
        }

    def rounded(statistic: _Statistic, figure: int, cell: Cell) -> float:
        return round(statistic([result[figure] for result in of_cell[cell]]), 2)

    def calm(figure: int, published: Sequence[Sequence[float]]) -> Table:
        ours = grid(fmean, figure)
        predicted = list(zip(chain(*ours), chain(*published), strict=True))[:-1]  # the plant was calibrated on the last
        return Table(
            ours=ours,
            paper=[list(row) for row in published],
            spread=grid(stdev, figure) if seeds > 1 else None,
            mare=_mare(predicted),
            baselines=baselines([published], fitted=(-1, -1)),
        )

    ours = wind(fmean)
    predicted, measured = (part["quantized_8_6"]["wind"] for part in (ours, WIND))
    in_wind = Table(
        ours=ours,
        paper=WIND,
        spread=wind(stdev) if seeds > 1 else None,
        mare=_mare([(predicted[name], measured[name]) for name in _FIGURES]),
        baselines=baselines(
            [[[air[name] for air in case.values()] for case in WIND.values()] for name in _FIGURES],
            fitted=(0, 1),
            scored=(1, 1),
        ),
    )
    return Tables(C2=calm(0, Z_TRACK), C3=calm(1, U_TOTAL), C4=in_wind)


_Statistic: TypeAlias = Callable[[Sequence[float]], float]


def _mare(pairs: Sequence[tuple[float, float]]) -> float:
    return fmean(abs(mine - theirs) / theirs for mine, theirs in pairs)


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


def sheets(tables: Tables) -> Sheets:
    """The tables as text: ours, with the paper's in brackets; then the errors."""
    for title, table, digits in (
        ("z_track, 10⁻⁴ s (Table C.2): ours (paper's)", tables.C2, 1),
        ("u_total, V²·s (Table C.3): ours (paper's)", tables.C3, 0),
    ):
        spreads = table.spread or [[None] * len(OUTPUT_BITS)] * len(INPUT_BITS)
        rows = []
        for inp, *lines in zip(INPUT_BITS, table.ours, table.paper, spreads, strict=True):
            cells = (_text(*each, digits=digits) for each in zip(*lines, strict=True))
            rows.append({"bits in ╲ out": _word(inp)} | dict(zip(map(_word, OUTPUT_BITS), cells, strict=True)))
        yield title, rows
    ours, theirs, spread = tables.C4.ours, tables.C4.paper, tables.C4.spread
    rows = []
    for case, label in (("continuous", "continuous"), ("quantized_8_6", "8 bits out, 6 in")):
        rows.append({"": label})
        for air in ("calm", "wind"):
            for name, digits in zip(_FIGURES, (1, 0), strict=True):
                each = ours[case][air][name], theirs[case][air][name], spread and spread[case][air][name]
                rows[-1][f"{name.removesuffix('_1e-4')} {air}"] = _text(*each, digits=digits)
    yield "With and without wind (Table C.4): ours (paper's)", rows
    yield (
        "Mean absolute relative error of cells that are not fitted (in brackets: of a fit to all cells), with the "
        "numbers fitted per figure and the cells that they are fitted to: calm; windy",
        list(_comparison(tables)),
    )
    yield (
        "The tables do not identify dead zone, height of the centre of mass and Coulomb friction separately: with a "
        "dead zone of 2.5 V, and the other two fitted again, they are predicted as well.",
        [],
    )


def _text(ours: float, theirs: float, spread: float | None, *, digits: int) -> str:
    return f"{ours:.{digits}f}{'' if spread is None else f' ±{spread:.{digits}f}'} ({theirs})"


def _comparison(tables: Tables) -> Iterator[dict[str, str]]:
    """Our errors and the baselines'."""
    each, header, digits = (tables.C2, tables.C3, tables.C4), ("z_track", "u_total", "windy cell"), (1, 2, 1)
    errors = [f"{table.mare:.{n}%}" for table, n in zip(each, digits, strict=True)]
    yield {"prediction": "ours", "numbers": "1; 2", "cells": "1; 2"} | dict(zip(header, errors, strict=True))
    for baseline in zip(*(table.baselines for table in each), strict=True):
        calm, _, windy = baseline
        errors = [
            f"{b.mare_left_out:.{n}%}{'' if b.mare is None else f' ({b.mare:.{n}%})'}"
            for b, n in zip(baseline, digits, strict=True)
        ]
        counts = {"numbers": f"{calm.parameters}; {windy.parameters}", "cells": f"{calm.cells}; {windy.cells}"}
        yield {"prediction": calm.name, **counts} | dict(zip(header, errors, strict=True))


# ── calibration ──

_MEASURED_YAW_COULOMB: Final = 0.0037
"""Coulomb friction of the yaw axis as measured from spin-downs of another Aero [N·m]."""
_TABLE_C1_HEIGHT: Final = -0.0038
"""Height of the centre of mass in the paper's Table C.1 [m]."""
_MAX_ROUNDS: Final = 8
TOLERANCE: Final = 1e-3
"""Relative tolerance of a fitted figure; the published ones have two to four digits."""


class Calibration(BaseModel):
    """Fitted parameters, the figures they reach, and independent measurements of them."""

    model_config = ConfigDict(frozen=True)

    yaw_coulomb: float = Field(description="Coulomb friction about yaw [N·m]")
    yaw_coulomb_measured: float = _MEASURED_YAW_COULOMB
    centre_of_mass_height: float = Field(description="z of the centre of mass [m]")
    centre_of_mass_height_paper: float = _TABLE_C1_HEIGHT
    wind_torque: tuple[float, float] = Field(description="steady wind torque about pitch and yaw [N·m]")
    calm: dict[str, float] = Field(description="z_track [1e-4 s] and u_total [V²·s] reached in the calm cell")
    windy: dict[str, float] = Field(description="the same in the windy cell")
    residuals: dict[str, float] = Field(description="relative residual of each of the four figures")
    runs: int = Field(description="number of experiments")


class CalibrationError(AeroloopError):
    """Newton's method did not converge; one line."""


def calibrate(settings: Settings, progress: Callable[[int], None] = lambda _: None) -> Calibration:
    """Fit the plant to the calm cell cont/cont, then the wind to the windy one, by Newton's method on differences.

    The calm cell's two figures determine Coulomb friction about yaw (chiefly z_track) and the height of the centre of
    mass (chiefly u_total); the windy cell's the steady torque about pitch and yaw. All else keeps its configured value:
    published measurements and assumptions, and a dead zone of 0 where 2–3 V were measured. How well the figures
    identify these is what `tests/benchmarks/sensitivity.py` computes.

    Args:
        settings: The configuration, from whose values the fit begins.
        progress: Called with the experiments done.

    Raises:
        CalibrationError: A cell is not reached within eight rounds.
        PlantError: The plant is no emulated body.
        ValueError: A cell trips.
    """
    settings.plant.mechanism()
    runs, published, plant = 0, WIND["continuous"], settings.plant
    (pitch, yaw), (x, y, z) = plant.friction.coulomb, plant.aero.centre_of_mass

    def body(p: Sequence[float]) -> list[str]:
        return [f"plant.friction.coulomb=[{pitch}, {p[0]}]", f"plant.aero.centre_of_mass=[{x}, {y}, {p[1]}]"]

    def wind(p: Sequence[float]) -> list[str]:
        return [*body(fitted), f"plant.wind.torque={p}"]

    def fit(
        build: Callable[[Sequence[float]], list[str]], start: Sequence[float], steps: Sequence[float], air: str
    ) -> tuple[list[float], list[float]]:
        nonlocal runs
        target, p = np.array(list(published[air].values())), np.array(start)
        for _ in range(_MAX_ROUNDS):
            probes = [p, *(p + step * axis for step, axis in zip(steps, np.eye(2), strict=True))]
            cell = Cell(None, None, windy=air == "wind").overrides
            jobs = [run_of(settings, [*cell, *build(probe.tolist())]) for probe in probes]
            reached, *moved = np.array(run_cells(workers, jobs))
            progress(runs := runs + len(jobs))
            if np.all(np.abs(reached / target - 1) < TOLERANCE):
                return p.tolist(), reached.tolist()
            jacobian = np.column_stack([(m - reached) / step for m, step in zip(moved, steps, strict=True)])
            p = p - np.linalg.solve(jacobian, reached - target)
        raise CalibrationError(f"the {air} cell is not reached after {_MAX_ROUNDS} rounds, last at {reached}")

    with open_workers() as workers:
        fitted, calm = fit(body, (yaw, z), (1e-4, 2e-5), "calm")
        (about_pitch, about_yaw), windy = fit(wind, plant.wind.torque[:2], (5e-4, 5e-4), "wind")
    names = [name.removesuffix("_1e-4") for name in _FIGURES]
    return Calibration(
        yaw_coulomb=fitted[0],
        centre_of_mass_height=fitted[1],
        wind_torque=(about_pitch, about_yaw),
        calm=dict(zip(names, calm, strict=True)),
        windy=dict(zip(names, windy, strict=True)),
        residuals={
            f"{air} {name}": float(reached / target - 1)
            for air, pair in (("calm", calm), ("wind", windy))
            for name, reached, target in zip(names, pair, published[air].values(), strict=True)
        },
        runs=runs,
    )


def calibration_sheets(fit: Calibration) -> Sheets:
    """The fitted values as text, beside independent measurements."""
    pitch, yaw = fit.wind_torque
    rows = (
        ("plant.friction.coulomb, yaw", f"{fit.yaw_coulomb:.6f} N·m", f"{fit.yaw_coulomb_measured} N·m",
         "measured from spin-downs of another Aero"),
        ("plant.aero.centre_of_mass, z", f"{fit.centre_of_mass_height:.6f} m", f"{fit.centre_of_mass_height_paper} m",
         "Table C.1, the value in the controller's model"),
        ("plant.wind.torque", f"{pitch:.6f}, {yaw:.6f} N·m", "–", "the paper's fan was not measured"),
    )  # fmt: skip
    yield "", [dict(zip(("parameter", "fitted", "elsewhere", "what that is"), row, strict=True)) for row in rows]
    yield "", [{"figure": name, "residual": f"{residual:+.2%}"} for name, residual in fit.residuals.items()]
    yield f"{fit.runs} experiments", []
