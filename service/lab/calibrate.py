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
from aeroloop.service.lab.cells import Cell, Pool

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


def calibrate(settings: Settings, progress: Callable[[int], None] | None = None) -> Calibration:
    """Fit the plant, then the wind, from the configured values on. `progress` is called with the experiments done.

    Raises:
        CalibrationError: A cell is not reached within MAX_ROUNDS.
        PlantError: The plant is no emulated body.
    """
    settings.plant.mechanism()
    runs = 0
    published = paper.WIND["continuous"]
    with Pool() as pool:

        def evaluate(jobs: Sequence[tuple[Settings, Cell]]) -> np.ndarray:
            nonlocal runs
            results = pool.run(jobs, lambda done: progress(runs + done) if progress else None)
            runs += len(jobs)
            return np.array(results)

        def fit(
            build: Callable[[Sequence[float]], Settings], start: Sequence[float], steps: Sequence[float], air: str
        ) -> tuple[np.ndarray, np.ndarray]:
            target = np.array([published[air]["z_track_1e-4"], published[air]["u_total"]])
            x = np.array(start)
            for _ in range(MAX_ROUNDS):
                probes = [x, *(x + step * axis for step, axis in zip(steps, np.eye(2), strict=True))]
                cell = Cell(None, None, windy=air == "wind")
                reached, *moved = evaluate([(build(probe.tolist()), cell) for probe in probes])
                if np.all(np.abs(reached / target - 1) < TOLERANCE):
                    return x, reached
                jacobian = np.column_stack([(m - reached) / step for m, step in zip(moved, steps, strict=True)])
                x = x - np.linalg.solve(jacobian, reached - target)
            raise CalibrationError(f"the {air} cell is not reached after {MAX_ROUNDS} rounds, last at {reached}")

        plant = settings.plant
        start = plant.friction.coulomb[1], plant.aero.centre_of_mass[2]
        x, calm = fit(lambda p: _with_body(settings, p), start, (1e-4, 2e-5), "calm")
        body = _with_body(settings, x.tolist())
        w, windy = fit(lambda p: _with_wind(body, p), plant.wind.torque[:2], (5e-4, 5e-4), "wind")
    return Calibration(
        yaw_coulomb=x[0],
        centre_of_mass_height=x[1],
        wind_torque=(w[0], w[1]),
        calm={"z_track": calm[0], "u_total": calm[1]},
        windy={"z_track": windy[0], "u_total": windy[1]},
        residuals={
            f"{air} {name.removesuffix('_1e-4')}": float(reached / published[air][name] - 1)
            for air, pair in (("calm", calm), ("wind", windy))
            for name, reached in zip(("z_track_1e-4", "u_total"), pair, strict=True)
        },
        runs=runs,
    )


def _with_body(settings: Settings, p: Sequence[float]) -> Settings:
    plant = settings.plant
    friction = plant.friction.model_copy(update={"coulomb": (plant.friction.coulomb[0], p[0])})
    x, y, _ = plant.aero.centre_of_mass
    aero = plant.aero.model_copy(update={"centre_of_mass": (x, y, p[1])})
    return settings.model_copy(update={"plant": plant.model_copy(update={"friction": friction, "aero": aero})})


def _with_wind(settings: Settings, p: Sequence[float]) -> Settings:
    wind = settings.plant.wind.model_copy(update={"torque": tuple(p)})
    return settings.model_copy(update={"plant": settings.plant.model_copy(update={"wind": wind})})
