"""`lab tables`, `lab calibrate`: Tables C.2–C.4 of the paper, an experiment predicts each cell; the fit of the plant.

The plant was calibrated on two cells without quantization: calm (C.2, C.3) and windy (C.4). All others are predictions,
and only these count in the mean absolute relative error. Beside it stands a baseline without physics, the means of the
published columns, with each cell left out of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings
from aeroloop.service.lab.engine import PROCESSES, Progress, Run, Sheets, Workers, figures_row, open_workers, run_of

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


class Table(BaseModel):
    """A predicted table and the published one."""

    model_config = ConfigDict(frozen=True)

    ours: Any
    paper: Any
    mare: float = Field(description="mean absolute relative error of the predicted cells [1]")
    column_mean_mare: float = Field(description="the same of the published columns' means, each cell left out [1]")


class Tables(BaseModel):
    """The three tables, in the paper's units."""

    model_config = ConfigDict(frozen=True)

    C2: Table = Field(description="z_track [1e-4 s]; rows: bits of the input, columns: bits of the output")
    C3: Table = Field(description="u_total [V²·s]")
    C4: Table = Field(description="both, calm and windy; mare over the quantized windy cell's two figures")


def predict(settings: Settings, progress: Progress = lambda _done, _total: None, engine: str = PROCESSES) -> Tables:
    """Run every cell.

    Args:
        settings: The configuration; each cell sets bits and wind.
        progress: Called with cells done and cells in all.
        engine: As of `open_workers`.

    Raises:
        PlantError: The plant is no emulated body, so there is no wind on it.
        ValueError: A cell trips.
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
        return Table(
            ours=ours,
            paper=paper,
            mare=_mare(list(chain(*ours))[predicted], list(chain(*paper))[predicted]),
            column_mean_mare=_mare(list(chain(*column_means(paper)))[predicted], list(chain(*paper))[predicted]),
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
    in_wind = Table(ours=ours, paper=WIND, mare=_mare(windy, published), column_mean_mare=_mare(means, published))
    return Tables(C2=calm(0, Z_TRACK), C3=calm(1, U_TOTAL), C4=in_wind)


def _mare(ours: Sequence[float], theirs: Sequence[float]) -> float:
    return fmean(abs(mine - other) / other for mine, other in zip(ours, theirs, strict=True))


def column_means(table: Sequence[Sequence[float]]) -> list[list[float]]:
    """Each cell predicted by the mean of the others in its column."""
    values = np.array(table, float)
    means: list[list[float]] = ((values.sum(axis=0) - values) / (len(values) - 1)).tolist()
    return means


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
    errors = {"ours": [one.mare for one in each], "column mean": [one.column_mean_mare for one in each]}
    yield (
        "Mean absolute relative error of cells that are not fitted; column mean: of the paper's others in the column",
        [
            {"prediction": name} | {of: f"{error:.{n}%}" for of, error, n in zip(names, found, (1, 2, 1), strict=True)}
            for name, found in errors.items()
        ],
    )


# ── calibration ──

_MEASURED_YAW_COULOMB: Final = 0.0037
"""Coulomb friction of the yaw axis as measured from spin-downs of another Aero [N·m]."""
_TABLE_C1_HEIGHT: Final = -0.0038
"""Height of the centre of mass in the paper's Table C.1 [m]."""
_MAX_ROUNDS: Final = 8
TOLERANCE: Final = 1e-3
"""Relative tolerance of a fitted figure; the published ones have two to four digits."""


class Calibration(BaseModel):
    """Fitted parameters, and the figures they reach."""

    model_config = ConfigDict(frozen=True)

    yaw_coulomb: float = Field(description="Coulomb friction about yaw [N·m]")
    centre_of_mass_height: float = Field(description="z of the centre of mass [m]")
    wind_torque: tuple[float, float] = Field(description="steady wind torque about pitch and yaw [N·m]")
    calm: dict[str, float] = Field(description="z_track [1e-4 s] and u_total [V²·s] reached in the calm cell")
    windy: dict[str, float] = Field(description="the same in the windy cell")
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
    runs, plant = 0, settings.plant
    (pitch, yaw), (x, y, z) = plant.friction.coulomb, plant.aero.centre_of_mass

    def body(p: Sequence[float]) -> list[str]:
        return [f"plant.friction.coulomb=[{pitch}, {p[0]}]", f"plant.aero.centre_of_mass=[{x}, {y}, {p[1]}]"]

    def wind(p: Sequence[float]) -> list[str]:
        return [*body(fitted), f"plant.wind.torque={p}"]

    def fit(
        build: Callable[[Sequence[float]], list[str]], start: Sequence[float], steps: Sequence[float], air: str
    ) -> tuple[list[float], dict[str, float]]:
        nonlocal runs
        target, p = np.array(list(WIND["continuous"][air].values())), np.array(start)
        cell = Cell(None, None, windy=air == "wind").overrides
        for _ in range(_MAX_ROUNDS):
            probes = [p, *(p + np.diag(steps))]
            reached, *moved = np.array(
                run_cells(workers, [run_of(settings, [*cell, *build(probe.tolist())]) for probe in probes])
            )
            progress(runs := runs + len(probes))
            if np.all(np.abs(reached / target - 1) < TOLERANCE):
                return p.tolist(), dict(zip(("z_track", "u_total"), reached.tolist(), strict=True))
            jacobian = np.column_stack([(m - reached) / step for m, step in zip(moved, steps, strict=True)])
            p = p - np.linalg.solve(jacobian, reached - target)
        raise CalibrationError(f"the {air} cell is not reached after {_MAX_ROUNDS} rounds, last at {reached}")

    with open_workers() as workers:
        fitted, calm = fit(body, (yaw, z), (1e-4, 2e-5), "calm")
        (about_pitch, about_yaw), windy = fit(wind, plant.wind.torque[:2], (5e-4, 5e-4), "wind")
    return Calibration(
        yaw_coulomb=fitted[0],
        centre_of_mass_height=fitted[1],
        wind_torque=(about_pitch, about_yaw),
        calm=calm,
        windy=windy,
        runs=runs,
    )


def calibration_sheets(fit: Calibration) -> Sheets:
    """The fitted values as text, beside independent measurements."""
    pitch, yaw = fit.wind_torque
    rows = (
        ("plant.friction.coulomb, yaw", f"{fit.yaw_coulomb:.6f} N·m", f"{_MEASURED_YAW_COULOMB} N·m",
         "measured from spin-downs of another Aero"),
        ("plant.aero.centre_of_mass, z", f"{fit.centre_of_mass_height:.6f} m", f"{_TABLE_C1_HEIGHT} m",
         "Table C.1, the value in the controller's model"),
        ("plant.wind.torque", f"{pitch:.6f}, {yaw:.6f} N·m", "–", "the paper's fan was not measured"),
    )  # fmt: skip
    yield "", [dict(zip(("parameter", "fitted", "elsewhere", "what that is"), row, strict=True)) for row in rows]
    reached = f"calm {fit.calm['z_track']:.2f}, {fit.calm['u_total']:.0f}; windy {fit.windy['z_track']:.2f}"
    yield f"{fit.runs} experiments; z_track in 10⁻⁴ s and u_total in V²·s: {reached}, {fit.windy['u_total']:.0f}", []
