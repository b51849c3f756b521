"""The plant on Quanser's fake board, with an emulated Aero behind it, as several tests drive it.

The fake refuses every call that a board would refuse, so every test also checks types, channels and order. Its time is
a count of samples of 2 ms: the board's watchdog of 0.1 s expires after 50 of them.
"""

from __future__ import annotations

import sys
from math import isnan
from types import ModuleType
from typing import Any

from aeroloop.plant_emulator.hosts.quanser_board import QuanserPlant
from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.plant_emulator.model.sensors import SensorSettings
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.plant_emulator.settings import PlantSettings, QuanserSettings
from aeroloop.protocol.messages.states import PlantState
from tests.support.fake_quanser import FakeQuanser

PERIOD = 0.002
WATCHDOG = 50
"""Samples in 0.1 s."""
AERO = PlantSettings(voltage_limit=18.0)
OFF = (0.0, 0.0)
VOLTS = (9.0, -12.0)


def plant_on_board(
    settings: PlantSettings = AERO, *, realtime: bool = False, session: bool = True, **changed: Any
) -> tuple[QuanserPlant, FakeQuanser]:
    """A plant that was just opened, and its board; `changed` are fields of QuanserSettings."""
    quanser = QuanserSettings(**changed)
    board = FakeQuanser(settings, PERIOD, card_type=quanser.card_type, realtime=realtime)
    plant = plant_of(board, quanser)
    if session:
        plant.follow(PlantState.DRIVEN)
    return plant, board


def plant_of(board: FakeQuanser, settings: QuanserSettings = AERO.quanser) -> QuanserPlant:
    """A plant on this board, which is what `import quanser.hardware` finds."""
    names = {"HIL": board.HIL, "HILError": board.HILError, "Clock": board.Clock}
    for module, of in (
        ("quanser", {}),
        ("quanser.hardware", names),
        ("quanser.hardware.enumerations", {"BufferOverflowMode": board.BufferOverflowMode}),
    ):
        sys.modules[module] = ModuleType(module)
        sys.modules[module].__dict__.update(of)
    return QuanserPlant(settings, PERIOD)


def drive(plant: Plant, periods: int, voltages: tuple[float, float] = VOLTS) -> None:
    for _ in range(periods):
        plant.actuate(voltages)
        plant.advance()


def driven_plant(**changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    """A plant that has been driven for long enough to be in motion."""
    plant, board = plant_on_board(**changed)
    drive(plant, 100)
    return plant, board


def expired_plant() -> tuple[QuanserPlant, FakeQuanser]:
    """A plant whose board's watchdog expired while it was driven, and that has noticed; no periods are owed."""
    plant, board = driven_plant()
    board.let_pass(WATCHDOG + 1)
    for _ in range(WATCHDOG + 1):
        plant.advance()
    assert board.expired
    assert is_nothing(plant.measure())
    return plant, board


def emulated_aero(settings: PlantSettings = AERO, counts: tuple[int, int] = (2880, 4096)) -> EmulatedPlant:
    """The same Aero without a board: an Aero 2's encoders unless given."""
    return settings.model_copy(update={"sensors": SensorSettings(counts=counts)}).build(PERIOD)


def is_nothing(seen: Measurement) -> bool:
    return all(isnan(value) for value in (*seen.attitude, *seen.rate))


class Calls:
    """Names of the calls to a board since this was made."""

    def __init__(self, board: FakeQuanser) -> None:
        self._board, self._before = board, len(board.calls)

    def names(self) -> list[str]:
        return list(self._board.calls)[self._before :]
