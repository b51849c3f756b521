"""Calibration: fits two plant parameters to one calm cell, and the wind to one windy cell.

The calm cell cont/cont has two figures and determines two parameters: Coulomb friction of the yaw axis (chiefly from
z_track) and the height of the centre of mass (chiefly from u_total). The windy cell cont/cont determines the wind's
steady torque about pitch and yaw. No other cell is used, and all other parameters keep their configured values:
published measurements and assumptions, and a dead zone of 0 where 2–3 V were measured.
Each pair of equations is solved by Newton's method with a finite-difference Jacobian.

Two equations always determine two parameters. How well the paper's figures identify them, with the dead zone beside
them, is what `tests/benchmarks/sensitivity.py` computes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings
from aeroloop.service.lab import paper
from aeroloop.service.lab.sweep import Sheets
from aeroloop.service.lab.tables import Cell, run_cells
from aeroloop.service.lab.workers import open_workers, run_of

MEASURED_YAW_COULOMB: Final = 0.0037
"""Coulomb friction of the yaw axis as measured from spin-downs of another Aero [N·m]."""
TABLE_C1_HEIGHT: Final = -0.0038
"""Height of the centre of mass in the paper's Table C.1 [m]."""
MAX_ROUNDS: Final = 8
TOLERANCE: Final = 1e-3
"""Relative tolerance of a fitted figure; the published ones have two to four digits."""


class Calibration(BaseModel):
    """Fitted parameters, the figures they reach, and independent measurements of them."""

    model_config = ConfigDict(frozen=True)

    yaw_coulomb: float = Field(description="Coulomb friction about yaw [N·m]")
    yaw_coulomb_measured: float = MEASURED_YAW_COULOMB
    centre_of_mass_height: float = Field(description="z of the centre of mass [m]")
    centre_of_mass_height_paper: float = TABLE_C1_HEIGHT
    wind_torque: tuple[float, float] = Field(description="steady wind torque about pitch and yaw [N·m]")
    calm: dict[str, float] = Field(description="z_track [1e-4 s] and u_total [V²·s] reached in the calm cell")
    windy: dict[str, float] = Field(description="the same in the windy cell")
    residuals: dict[str, float] = Field(description="relative residual of each of the four figures")
    runs: int = Field(description="number of experiments")


class CalibrationError(AeroloopError):
    """Newton's method did not converge; one line."""


def calibrate(settings: Settings, progress: Callable[[int], None] = lambda _: None) -> Calibration:
    """Fit the plant, then the wind, from the configured values on. `progress` is called with the experiments done.

    Raises:
        CalibrationError: A cell is not reached within MAX_ROUNDS.
        PlantError: The plant is no emulated body.
        ValueError: A cell trips.
    """
    settings.plant.mechanism()
    runs = 0
    published = paper.WIND["continuous"]

    def body(p: Sequence[float]) -> list[str]:
        return [f"plant.friction.coulomb=[{pitch}, {p[0]}]", f"plant.aero.centre_of_mass=[{x}, {y}, {p[1]}]"]

    def fit(
        build: Callable[[Sequence[float]], list[str]], start: Sequence[float], steps: Sequence[float], air: str
    ) -> tuple[list[float], list[float]]:
        nonlocal runs
        target = np.array([published[air]["z_track_1e-4"], published[air]["u_total"]])
        cell = Cell(None, None, windy=air == "wind")
        p = np.array(start)
        for _ in range(MAX_ROUNDS):
            probes = [p, *(p + step * axis for step, axis in zip(steps, np.eye(2), strict=True))]
            jobs = [run_of(settings, [*cell.overrides, *build(probe.tolist())]) for probe in probes]
            reached, *moved = np.array(run_cells(workers, jobs))
            progress(runs := runs + len(jobs))
            if np.all(np.abs(reached / target - 1) < TOLERANCE):
                return p.tolist(), reached.tolist()
            jacobian = np.column_stack([(m - reached) / step for m, step in zip(moved, steps, strict=True)])
            p = p - np.linalg.solve(jacobian, reached - target)
        raise CalibrationError(f"the {air} cell is not reached after {MAX_ROUNDS} rounds, last at {reached}")

    plant = settings.plant
    (pitch, yaw), (x, y, z) = plant.friction.coulomb, plant.aero.centre_of_mass
    with open_workers() as workers:
        fitted, calm = fit(body, (yaw, z), (1e-4, 2e-5), "calm")
        wind, windy = fit(
            lambda p: [*body(fitted), f"plant.wind.torque={p}"], plant.wind.torque[:2], (5e-4,) * 2, "wind"
        )
    return Calibration(
        yaw_coulomb=fitted[0],
        centre_of_mass_height=fitted[1],
        wind_torque=(wind[0], wind[1]),
        calm={"z_track": calm[0], "u_total": calm[1]},
        windy={"z_track": windy[0], "u_total": windy[1]},
        residuals={
            f"{air} {name.removesuffix('_1e-4')}": float(reached / published[air][name] - 1)
            for air, pair in (("calm", calm), ("wind", windy))
            for name, reached in zip(("z_track_1e-4", "u_total"), pair, strict=True)
        },
        runs=runs,
    )


def sheets(fit: Calibration) -> Sheets:
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
