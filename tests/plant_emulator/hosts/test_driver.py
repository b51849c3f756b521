"""Driver in time: the first tick of a session, and what a plant leaves behind, on doubles of front and grid."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator

import pytest

from aeroloop.plant_emulator.hosts import driver
from aeroloop.plant_emulator.hosts.driver import Driver, PlantNetwork
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Grant
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.own_laws import Node, cycle
from tests.support.own_plants import Turntable, TurntableSettings
from tests.support.plant_end import claim_of

LOOP = LoopSettings(realtime="off")
CLAIMED_AT, HELD_UP, ENDS = 3, 5, 20


class Grid:
    """Ticks one after the other, but for those that somebody holds up."""

    due_ns = 0

    def __init__(self, period_ns: int) -> None:
        assert period_ns == LOOP.period_ns
        self.tick = -1
        self.skipped = 0
        self.held_up = 0

    def wait(self) -> int:
        self.skipped += self.held_up
        self.tick += 1 + self.held_up
        self.held_up = 0
        return self.tick


class Granting(PlantNetwork):
    """Claims the plant at a tick, which holds the grid up; notes what is sent, and at which tick."""

    def __init__(self, grid: Grid, stop: threading.Event, ends: int = ENDS, wire: WireSpec | None = None) -> None:
        super().__init__()
        self._grid, self._stop, self._ends = grid, stop, ends
        self._wire = wire or WireSpec()
        self.driver: Driver
        self.sent: list[tuple[int, int | None]] = []

    @property
    def link(self) -> Link | None:
        return None

    def serve(self) -> None: ...

    def take_inbox(self) -> None:
        if self._grid.tick == CLAIMED_AT:
            assert isinstance(self.driver.endpoint.claim(claim_of(wire=self._wire)), Grant)
            self._grid.held_up = HELD_UP

    def send(self, frame: bytes) -> None:
        self.sent.append((self._grid.tick, self._wire.measurement.counter(frame)))

    def follow_session(self) -> None: ...

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        del measurement, arrival, sent_ns
        if self._grid.tick >= self._ends:
            self._stop.set()

    def publish_status(self) -> None: ...

    def leave(self) -> None: ...


def test_a_session_begins_with_a_measurement_on_the_grid_however_long_its_grant_took(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The controller derives the grid from it; one sent late would put it ticks back."""
    stop, grid = threading.Event(), Grid(LOOP.period_ns)
    monkeypatch.setattr(driver, "TickGrid", lambda *_, **__: grid)
    front = Granting(grid, stop)
    front.driver = Driver(PlantSettings().build(LOOP.period), LOOP, WireSpec(), PlantSettings(), stop)
    front.driver.run(front)
    first = CLAIMED_AT + HELD_UP + 1
    assert front.sent == [(first + i, i) for i in range(ENDS - first + 1)]
    assert front.skipped == 0  # what was held up is before the session


class Cyclic(Turntable):
    """Makes two objects a tick that refer to each other."""

    def advance(self) -> None:
        super().advance()
        cycle()


@pytest.fixture
def _collector_off() -> Iterator[None]:
    """As `prepare_process` leaves it."""
    gc.collect()
    gc.freeze()
    gc.disable()
    yield
    gc.unfreeze()
    gc.enable()


@pytest.mark.usefixtures("_collector_off")
def test_the_cycles_of_a_plant_of_ones_own_are_collected_with_a_session_and_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks, wire = 20_000, WireSpec(actuators=1)
    stop, grid = threading.Event(), Grid(LOOP.period_ns)
    monkeypatch.setattr(driver, "TickGrid", lambda *_, **__: grid)
    front = Granting(grid, stop, ticks, wire)
    settings = PlantSettings(watchdog_s=ticks / 4 * LOOP.period)
    front.driver = Driver(Cyclic(TurntableSettings(), LOOP.period), LOOP, wire, settings, stop)
    before = Node.alive
    front.driver.run(front)
    assert len(front.sent) > 400  # until no first command came
    assert Node.alive - before < 2_000  # of 40 000
