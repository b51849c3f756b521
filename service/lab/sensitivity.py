"""Sensitivity of the predicted tables to what was not fitted: each is changed alone, and nothing is refitted.

A change is an override, as `--set` takes it, so any row can be looked into with `aeroloop lab tables --set …`. The bits
of the input hardly matter to the prediction (0.6 % of a figure at the most), so the cells with ROW bits stand for every
row of Tables C.2 and C.3: five experiments a change, where the tables take 26. Errors then differ by 0.1 percentage
point, and by 0.3 where a change lets the command chatter (the filter at 25 rad/s).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings, as_overrides, load_over
from aeroloop.service.lab import paper
from aeroloop.service.lab.calibrate import MEASURED_YAW_COULOMB, TABLE_C1_HEIGHT
from aeroloop.service.lab.cells import Cell, Pool
from aeroloop.service.lab.experiment import PATH
from aeroloop.service.lab.tables import CASES

ROW: Final = 7
"""Bits of the input in all calm cells."""


class Change(BaseModel):
    """One change and the mean absolute relative errors that the tables then have."""

    model_config = ConfigDict(frozen=True)

    name: str
    overrides: list[str] = Field(description="the change as `--set` takes it")
    z_track: float = Field(description="of Table C.2, 23 cells [1]")
    u_total: float = Field(description="of Table C.3, 23 cells [1]")
    windy: float = Field(description="of the quantized windy cell of Table C.4 [1]")


class Sensitivity(BaseModel):
    """All changes, the first of them none."""

    model_config = ConfigDict(frozen=True)

    changes: list[Change]
    path: str = Field(description=PATH)


def measure_sensitivity(
    settings: Settings, seeds: int = 1, progress: Callable[[int, int], None] | None = None
) -> Sensitivity:
    """Predict the tables as configured and after each change. Arguments as of `predict`."""
    changes = {"as configured": list[str](), **_changes(settings)}
    cells = [Cell(out, ROW) for out in paper.OUTPUT_BITS] + [Cell(*CASES["quantized_8_6"], windy=True)]
    jobs = [
        (changed, cell._replace(seed=seed))
        for changed in [load_over(settings, overrides) for overrides in changes.values()]
        for cell in cells
        for seed in range(seeds)
    ]
    with Pool() as pool:
        results = pool.run(jobs, lambda done: progress(done, len(jobs)) if progress else None)
    figures = np.array(results).reshape(len(changes), len(cells), seeds, 2).mean(axis=2)
    return Sensitivity(
        path=pool.path,
        changes=[
            Change(name=name, overrides=overrides, **_errors(found))
            for (name, overrides), found in zip(changes.items(), figures, strict=True)
        ],
    )


def _errors(figures: np.ndarray) -> dict[str, float]:
    """Errors of both figures of the five cells. Shape (5, 2)."""
    windy = np.array(list(paper.WIND["quantized_8_6"]["wind"].values()))
    z_track, u_total = (
        np.abs(calm / np.array(published) - 1).ravel()[:-1].mean()  # the last is the fitted cell
        for calm, published in zip(figures[:-1].T, (paper.Z_TRACK, paper.U_TOTAL), strict=True)
    )
    return {"z_track": z_track, "u_total": u_total, "windy": np.abs(figures[-1] / windy - 1).mean()}


def _changes(settings: Settings) -> dict[str, list[str]]:
    plant = settings.plant
    x, y, _ = plant.aero.centre_of_mass
    viscous, coulomb = plant.friction.viscous[:1], plant.friction.coulomb[:1]
    changes: dict[str, dict[str, Any]] = {
        "rate from a gyro": {"sensors.rate": "gyro"},
        "perfect sensors": {"sensors.rate": "perfect", "sensors.attitude": "perfect"},
        "rate filter at 25 rad/s": {"sensors.bandwidth": 25.0},
        "rotor lag 0.08 s up, 0.091 s down": {"rotor.lag_up_s": 0.08, "rotor.lag_down_s": 0.0914},
        "dead zone 2.5 V": {"rotor.dead_zone_v": 2.5},
        "thrust 5 % weaker": {"aero.thrust": [[0.95 * gain for gain in row] for row in plant.aero.thrust]},
        "yaw viscous 0.0095 N·m·s/rad": {"friction.viscous": [*viscous, 0.0095]},
        "no Coulomb friction about pitch": {"friction.coulomb": [0.0, *plant.friction.coulomb[1:]]},
        "Coulomb friction and height as published": {
            "friction.coulomb": [*coulomb, MEASURED_YAW_COULOMB],
            "aero.centre_of_mass": [x, y, TABLE_C1_HEIGHT],
        },
        "wind without gusts": {"wind.gust": 0.0},
    }
    overrides = {name: as_overrides(values, "plant.") for name, values in changes.items()}
    return {**overrides, "loop at 1 kHz (and other gusts)": ["loop.rate_hz=1000"]}


def rows(found: Sensitivity) -> list[list[str]]:
    """The errors as rows of text, a header first."""
    header = ["changed alone, nothing refitted", "z_track", "u_total", "windy cell"]
    return [header, *([c.name, f"{c.z_track:.1%}", f"{c.u_total:.2%}", f"{c.windy:.1%}"] for c in found.changes)]
