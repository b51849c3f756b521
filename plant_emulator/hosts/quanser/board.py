"""Driver of Quanser's board: the board's clock paces it, the board's lights show its state.

The amplifier is on during a session only, whatever the analog outputs are.
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
    """Drives the Aero on Quanser's board, or on the fake board with `via = "quanser-fake"`, by the board's clock.

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
        self._show()  # after a claim or a release since the last tick
        echo = super()._tick(arrival, k)
        self._show()  # after a trip or a first command in the tick
        return echo

    def _show(self) -> None:
        state = self.endpoint.state
        if state is not self._shown:
            self._shown = state
            self._board.enable(state in (PlantState.GRANTED, PlantState.DRIVEN))
            self._board.show(state)
