"""Quanser's board as a process: a driver that the board's clock paces, and that shows its state on the lights.

The amplifier is on while there is a session, and off otherwise, whatever the outputs say.
"""

from __future__ import annotations

import threading

from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.hosts.quanser.usb import QuanserPlant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec


class BoardDriver(Driver):
    """Drives the Aero on Quanser's board, or on the fake of it with `via = "quanser-fake"`.

    Args:
        loop: The grid; the board keeps it.
        wire: How frames are read and written.
        settings: The board, and how the plant end looks after itself.
        stop: Set when it is to end.

    Raises:
        QuanserError: The interface is missing, or the board cannot be opened.
        ValueError: The wire does not command two motors.
    """

    def __init__(self, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, stop: threading.Event) -> None:
        hardware = None
        if settings.via == "quanser-fake":
            from aeroloop.plant_emulator.hosts.quanser.fake import FakeQuanser

            hardware = FakeQuanser(
                settings, loop.period, card_type=settings.quanser.card_type, realtime=not loop.lockstep
            )
        self._board = QuanserPlant(settings.quanser, loop.period, hardware=hardware)
        self._shown: PlantState | None = None
        super().__init__(self._board, loop, wire, settings, stop)

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        self._show()  # a claim or a release that came since the last tick
        echo = super()._tick(arrival, k)
        self._show()  # what the tick itself has changed, a trip first of all
        return echo

    def _show(self) -> None:
        state = self.endpoint.state
        if state is not self._shown:
            self._shown = state
            self._board.enable(state in (PlantState.GRANTED, PlantState.DRIVEN))
            self._board.show(state)
