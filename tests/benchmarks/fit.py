"""The fit of the emulated Aero to two of the paper's cells, and what the predicted tables depend on.

uv run python -m tests.benchmarks.fit            # or with names of `CHANGES`, for these alone

Newton's method fits yaw friction and height to the calm cell without quantization, the wind to the windy one, from what
others measured. Then come the tables' errors after each change of what was not fitted, and how open a fit leaves it: 7
bits of the input stand for every row of Tables C.2 and C.3. ± are standard deviations of a least-squares fit to the
eight figures of Table C.4, which scatter as the published cells do about their column means.
"""

import sys

import numpy as np

from aeroloop.service.config import load
from aeroloop.service.lab.engine import Workers, open_workers, run_of
from aeroloop.service.lab.tables import CASES, OUTPUT_BITS, U_TOTAL, WIND, Z_TRACK, Cell, run_cells

PLANT = load().plant
PITCH, YAW = PLANT.friction.coulomb
CHANGES = {
    "as configured": [],
    "rate from a gyro": ["plant.sensors.rate=gyro"],
    "perfect sensors": ["plant.sensors.rate=perfect", "plant.sensors.attitude=perfect"],
    "rate filter at 25 rad/s": ["plant.sensors.bandwidth=25"],
    "rotor lag 0.08 s up, 0.091 s down": ["plant.rotor.lag_up_s=0.08", "plant.rotor.lag_down_s=0.0914"],
    "dead zone 2.5 V": ["plant.rotor.dead_zone_v=2.5"],
    "thrust 5 % weaker": [f"plant.aero.thrust={(0.95 * np.array(PLANT.aero.thrust)).tolist()}"],
    "yaw viscous 0.0095 N·m·s/rad": [f"plant.friction.viscous=[{PLANT.friction.viscous[0]}, 0.0095]"],
    "no Coulomb friction about pitch": [f"plant.friction.coulomb=[0, {YAW}]"],
    "both as published": [f"plant.friction.coulomb=[{PITCH}, 0.0037]", "plant.aero.centre_of_mass=[0, 0, -0.0038]"],
    "wind without gusts": ["plant.wind.gust=0"],
    "loop at 1 kHz (and other gusts)": ["loop.rate_hz=1000"],
}
FITTED = "yaw Coulomb friction, N·m", "height, m", "wind about pitch, N·m", "wind about yaw, N·m", "dead zone, V"
START = np.array([0.0037, -0.0038, 0.0, 0.01])
SCALE = np.array([0.0037, 0.0038, 0.01, 0.01, 2.5])
KEYS = "friction.coulomb=[{p}, {}]|aero.centre_of_mass=[0, 0, {}]|wind.torque=[{}, {}]|rotor.dead_zone_v={}"
SCATTER = 0.088, 0.011
"""Standard deviation of the cells of C.2 and C.3 about their column means, as a part of these [1]."""
TABLE_C4 = np.array([list(WIND[case][air].values()) for case in CASES for air in ("calm", "wind")])


def overrides(x: np.ndarray) -> list[str]:
    """Values of `FITTED`, of which the dead zone may be left out."""
    return [f"plant.{key}" for key in KEYS.format(*x, *[0.0] * (5 - len(x)), p=PITCH).split("|")]


def fit(workers: Workers) -> np.ndarray:
    """The first four of `FITTED` with which both cells without quantization are within 0.1 % of the paper's."""
    x, steps, target = START, np.array([1e-4, 2e-5, 5e-4, 5e-4]), TABLE_C4[:2].ravel()
    cells = [Cell(None, None, windy) for windy in (False, True)]
    while True:
        runs = [
            run_of(load(overrides=overrides(p)), cell.overrides) for p in (x, *(x + np.diag(steps))) for cell in cells
        ]
        reached, *moved = np.array(run_cells(workers, runs)).reshape(len(x) + 1, -1)
        print("  ".join(f"{value:.6f}" for value in x), " z_track, u_total:", reached.round(2))
        if np.all(np.abs(reached / target - 1) < 1e-3):
            return x
        x = x - np.linalg.solve(((np.array(moved) - reached) / steps[:, None]).T, reached - target)


def main() -> None:
    """Print the fit's rounds, then the figures of 60 cells of the tables and 24 of the fit."""
    x = np.array([YAW, PLANT.aero.centre_of_mass[2], *PLANT.wind.torque, 0.0])
    row = [Cell(out, 7) for out in OUTPUT_BITS] + [Cell(8, 6, windy=True)]
    corners = [Cell(*bits, windy) for bits in CASES.values() for windy in (False, True)]
    probes = [overrides(p) for p in (x, *(x + np.diag(0.1 * SCALE)))]
    names = sys.argv[1:] or list(CHANGES)
    with open_workers() as workers:
        print(f"fitted: {fit(workers)}; configured: {x[:4]}")
        changed = [run_of(load(overrides=CHANGES[name]), cell.overrides) for name in names for cell in row]
        fitted = [run_of(load(overrides=o), cell.overrides) for o in probes for cell in corners]
        tables, fits = np.array(run_cells(workers, changed)), np.array(run_cells(workers, fitted))
    fits = fits.reshape(len(probes), len(corners), 2)
    for name, (*calm, windy) in zip(names, tables.reshape(-1, len(row), 2), strict=True):
        published = np.array([Z_TRACK, U_TOTAL])  # the last of each is fitted
        errors = np.abs(np.array(calm).T[:, None] / published - 1).reshape(2, -1)[:, :-1].mean(axis=1)
        print(f"{name:34s} {errors[0]:6.1%} {errors[1]:7.2%} {np.abs(windy / TABLE_C4[3] - 1).mean():6.1%}")
    J = ((fits[1:] - fits[0]) / TABLE_C4 / SCATTER / 0.1).reshape(len(x), -1).T
    alone, jointly = SCALE / np.linalg.norm(J, axis=0), SCALE * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    for name, value, one, both in zip(FITTED, x, alone, jointly, strict=True):
        print(f"{name:34s} {value:.3g} ± {one:.2g} if the others are known, ± {both:.2g} jointly")


if __name__ == "__main__":
    main()
