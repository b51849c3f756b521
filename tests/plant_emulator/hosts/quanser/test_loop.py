"""The closed loop on Quanser's board: that of the emulator to the last bit, and safe when the board fails."""

from __future__ import annotations

from threading import Event

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.quanser_board import BoardDriver
from aeroloop.plant_emulator.model.wind import WindSettings
from aeroloop.plant_emulator.plant import Plant
from aeroloop.protocol.messages.models import Grant
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.config import Settings, with_bits
from aeroloop.service.control.controller import Controller
from tests.support.plant_end import claim_of
from tests.support.plant_stage import Stage
from tests.support.quanser_board import AERO, PERIOD, emulated_aero, plant_on_board


class Loop:
    """A controller and an endpoint in lockstep, granted at tick 0."""

    def __init__(self, plant: Plant, settings: Settings) -> None:
        wire, period_ns = settings.wire, settings.loop.period_ns
        guard = settings.plant.limit_monitor(period_ns, wire.voltage.quantizer().outermost)
        self.endpoint = Endpoint(plant, wire, period_ns, lockstep=True, limits=guard)
        assert isinstance(self.endpoint.claim(claim_of(wire=wire, period_ns=period_ns, lockstep=True)), Grant)
        self.controller = Controller(wire, settings.law, settings.reference, PERIOD)
        self.measurement = self.endpoint.tick(None, 0)
        self.k = 0

    def tick(self) -> tuple[bytes | None, bytes | None]:
        assert self.measurement is not None
        command = self.controller.tick(self.measurement, self.k)
        self.k += 1
        self.measurement = self.endpoint.tick(command, self.k)
        return command, self.measurement


@pytest.mark.parametrize(("bits", "wind"), [(("8", "6"), True), (("cont", "cont"), False)])
def test_the_loop_on_the_board_is_the_loop_on_the_emulator_to_the_last_bit(bits: tuple[str, str], wind: bool) -> None:
    aero = AERO.model_copy(update={"wind": WindSettings(blowing=wind)})
    settings = with_bits(Settings(plant=aero), "/".join(bits))
    plant, board = plant_on_board(aero)
    on_board, emulated = Loop(plant, settings), Loop(emulated_aero(aero), settings)
    for _ in range(1000):
        assert on_board.tick() == emulated.tick()
    assert on_board.endpoint.state is PlantState.DRIVEN
    assert (plant.failures, board.time) == (0, 1000)


def test_one_lost_sample_does_not_end_the_session_and_a_board_that_is_unplugged_trips_in_the_time_of_its_guard() -> (
    None
):
    plant, board = plant_on_board()
    loop = Loop(plant, Settings())
    for k in range(200):
        if k == 100:
            board.fail_next("task_read")
        loop.tick()
    assert loop.endpoint.state is PlantState.DRIVEN
    assert (loop.controller.invalid, plant.failures) == (1, 1)
    board.unplug()
    ticks = 0
    while loop.endpoint.session is not None and ticks < 1000:
        loop.tick()
        ticks += 1
    assert ticks == 51  # limits.max_invalid_s = 0.1 s of samples without a value, and the one that makes it more
    assert "no valid value" in loop.endpoint.notices[-1].text
    assert board.analog == [0.0, 0.0]  # no write reaches it any more: the board's watchdog did
    assert board.expired


def test_failed_calls_of_the_board_are_notes_of_the_status() -> None:
    plant, board = plant_on_board(session=False)
    plant.close()  # the driver opens it again
    loop, wire, stop = LoopSettings(realtime="off"), Settings().wire, Event()

    def fail(stage: Stage) -> None:
        if stage.endpoint.ticked in (20, 30):
            board.fail_next("task_read")

    stage = Stage(loop, wire, AERO, driver=BoardDriver(loop, wire, AERO, stop), between=fail)
    stage.stop = stop
    stage.run(50)
    assert stage.notes == ["the board: 2 failed calls, the last: task_read was made to fail"]
