"""A plant that counts its periods as its sensors' truth, behind faults of its sensors, motors and frames."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isnan, sin

from aeroloop.plant_emulator.faults.injection import FaultyPlant
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.plant import Measurement
from tests.support.plant_end import RecordingPlant

PERIOD = 0.1
LIMIT = 24.0


def sample(k: int) -> Measurement:
    """What is true after k periods: no two are alike, in no component."""
    return Measurement((cos(0.01 * k), 0.0, 0.0, sin(0.01 * k)), (1.0 * k, 10.0 * k, 100.0 * k))


class Stand(RecordingPlant):
    """Measures the count of its periods."""

    def measure(self) -> Measurement:
        return sample(len(self.periods))


def faulty(
    *faults: str, seed: int = 0, actuators: int = 2, started: bool = True, period: float = PERIOD
) -> tuple[FaultyPlant, Stand]:
    """A plant with these faults, and what is behind them."""
    stand = Stand(actuators)
    plant = FaultyPlant(stand, period, voltage_limit=LIMIT, seed=seed)
    plant.inject([Fault.parse(fault) for fault in faults], "configured")
    if started:
        plant.start()
    return plant, stand


def sensed(*faults: str, ticks: int = 8, seed: int = 0) -> list[Measurement]:
    plant, _ = faulty(*faults, seed=seed)
    seen = [plant.measure()]
    for _ in range(ticks):
        plant.advance()
        seen.append(plant.measure())
    return seen


def driven(*faults: str, ticks: int = 8, seed: int = 0) -> list[tuple[float, ...]]:
    """What the motors have in the periods that begin at 0, 0.1, 0.2, …, commanded (k, −k)."""
    plant, stand = faulty(*faults, seed=seed)
    for k in range(ticks):
        plant.actuate((float(k), float(-k)))
        plant.advance()
    return stand.periods


def passed(*faults: str, frames: Sequence[bytes | None], seed: int = 0, period: float = PERIOD) -> list[list[bytes]]:
    """The commands that pass at 0 s, 0.1 s, 0.2 s and so on."""
    plant, _ = faulty(*faults, seed=seed, period=period)
    ticks = []
    for frame in frames:
        ticks.append(plant.passes("command", frame))
        plant.advance()
    return ticks


def numbered(count: int) -> list[bytes]:
    return [k.to_bytes(4, "big") for k in range(count)]


def missing(values: Sequence[float]) -> bool:
    return all(isnan(value) for value in values)
