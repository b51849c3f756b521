"""Cells of the paper's tables, run in parallel on every core.

A cell is one lockstep experiment: bits out, bits in, wind or calm, a seed. Cells are independent of each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from aeroloop.service.config import Settings
from aeroloop.service.lab.experiment import experiment
from aeroloop.service.lab.paper import DURATION_S
from aeroloop.service.lab.workers import Workers


class Cell(NamedTuple):
    """One experiment. Bits of None are the paper's "cont."."""

    bits_out: int | None
    bits_in: int | None
    windy: bool = False
    seed: int = 0


class Result(NamedTuple):
    """Figures of a cell, in the units of the paper's tables."""

    z_track: float  # [1e-4 s]
    u_total: float  # [V²·s]


def with_seed(settings: Settings, seed: int) -> Settings:
    """The settings with this seed of wind and sensors; a plant without ours stays as it is."""
    plant = settings.plant
    if not plant.emulated:
        return settings
    drawn = {name: getattr(plant, name).model_copy(update={"seed": seed}) for name in ("wind", "sensors")}
    return settings.model_copy(update={"plant": plant.model_copy(update=drawn)})


def run_cell(config: dict[str, Any], cell: Cell) -> Result:
    """Run one cell of a configuration's dump."""
    settings = with_seed(Settings.model_validate(config), cell.seed)
    wind = settings.plant.wind.model_copy(update={"blowing": cell.windy})
    plant = settings.plant.model_copy(update={"wind": wind})
    wire = settings.wire.with_bits(cell.bits_out, cell.bits_in)
    figures = experiment(settings.model_copy(update={"wire": wire, "plant": plant}), DURATION_S).figures
    assert figures.z_track is not None
    assert figures.u_total is not None
    return Result(figures.z_track * 1e4, figures.u_total)


class Pool(Workers):
    """Processes that run cells, one a core. A context."""

    def run(self, jobs: Iterable[tuple[Settings, Cell]], progress: Callable[[int], None] | None = None) -> list[Result]:
        """Results of cells in their order; `progress` is called with the number done."""
        return self.each(run_cell, ((settings.description(), cell) for settings, cell in jobs), progress)
