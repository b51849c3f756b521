"""Driver in time: the first tick of a session, on doubles of front and grid."""

from __future__ import annotations

import threading

import pytest

from aeroloop.plant_emulator.endpoint.front import Front
from aeroloop.plant_emulator.hosts import driver
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec

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


class Granting(Front):
    """Claims the plant at a tick, which holds the grid up; notes what is sent, and at which tick."""

    def __init__(self, grid: Grid, stop: threading.Event) -> None:
        super().__init__()
        self._grid, self._stop = grid, stop
        self.driver: Driver
        self.sent: list[tuple[int, int | None]] = []

    @property
    def link(self) -> Link | None:
        return None

    def serve(self) -> None: ...

    def take_inbox(self) -> None:
        if self._grid.tick == CLAIMED_AT:
            claim = Claim(
                controller="c", session="s", period_ns=LOOP.period_ns, lockstep=False, auto_arm=True, wire=WireSpec()
            )
            assert isinstance(self.driver.endpoint.claim(claim), Grant)
            self._grid.held_up = HELD_UP

    def send(self, frame: bytes) -> None:
        self.sent.append((self._grid.tick, WireSpec().measurement.counter(frame)))

    def follow_session(self) -> None: ...

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        del measurement, arrival, sent_ns
        if self._grid.tick >= ENDS:
            self._stop.set()

    def publish_when_due(self) -> None: ...

    def publish_status(self) -> None: ...

    def leave(self) -> None: ...


def test_a_session_begins_with_a_measurement_on_the_grid_however_long_its_grant_took(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The controller derives the grid from it; one sent late would put it ticks back."""
    stop, grid = threading.Event(), Grid(LOOP.period_ns)
    monkeypatch.setattr(driver, "TickGrid", lambda _period_ns: grid)
    front = Granting(grid, stop)
    front.driver = Driver(PlantSettings().build(LOOP.period), LOOP, WireSpec(), PlantSettings(), stop)
    front.driver.run(front)
    first = CLAIMED_AT + HELD_UP + 1
    assert front.sent == [(first + i, i) for i in range(ENDS - first + 1)]
    assert front.skipped == 0  # what was held up is before the session
