"""Driver harness: a driver's loop on a scripted grid, link and network, without a clock.

A test scripts actions between ticks, answers to measurements, and skipped ticks; the trace is the one that a
ZenohNetwork would publish.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Self
from unittest.mock import patch

from aeroloop.plant_emulator.hosts.driver import Driver, PlantNetwork
from aeroloop.plant_emulator.hosts.trace import PlantTrace
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Grant, Refusal
from aeroloop.protocol.messages.trace import Batch, read_batch
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.plant_end import claim_of

RUN = 0x0123_4567_89AB_CDEF


class Wires(Link):
    """Frames on their way to the plant, each due at a tick; the newest that is due is taken."""

    def __init__(self, answer: Callable[[bytes], None] = lambda _: None) -> None:
        self.tick = -1
        self.sent: list[bytes] = []
        self.answer = answer
        self._due: list[tuple[int, bytes]] = []

    def deliver(self, frame: bytes, tick: int) -> None:
        self._due.append((tick, frame))

    def send(self, frame: bytes) -> None:
        self.sent.append(frame)
        self.answer(frame)

    @property
    def pending(self) -> bool:
        return any(tick <= self.tick for tick, _ in self._due)

    def take(self) -> Arrival | None:
        due = [frame for tick, frame in self._due if tick <= self.tick]
        self._due = [(tick, frame) for tick, frame in self._due if tick > self.tick]
        return Arrival(due[-1], time.monotonic_ns()) if due else None

    def wait(self, timeout_s: float) -> Arrival | None:
        del timeout_s
        return self.take()

    def close(self) -> None:
        self._due.clear()


class Grid:
    due_ns = 0

    def __init__(self, skip: Callable[[], int]) -> None:
        self.tick = -1
        self.skipped = 0
        self._skip = skip

    def wait(self) -> int:
        skipped = self._skip()
        self.skipped += skipped
        self.tick += 1 + skipped
        return self.tick


class Stage(PlantNetwork):
    """Runs a driver, an emulator's unless given, to a tick.

    `between` is called between ticks, `answer` with every measurement that is sent (UNCHANGED in lockstep only), and
    `skip` gives the ticks to skip before the next. `sent` are the measurements, `wires` the way of the commands.
    """

    def __init__(
        self,
        loop: LoopSettings,
        wire: WireSpec,
        plant: PlantSettings,
        *,
        between: Callable[[Stage], None] = lambda _: None,
        answer: Callable[[Stage, bytes], None] = lambda *_: None,
        skip: Callable[[], int] = lambda: 0,
        driver: Driver | None = None,
    ) -> None:
        super().__init__()
        self.stop = threading.Event()
        self.loop, self.wire = loop, wire
        self.driver = driver or Driver(plant.make(loop.period), loop, wire, plant, self.stop)
        self.endpoint = self.driver.endpoint
        self.wires = Wires(lambda frame: answer(self, frame))
        self._published: deque[bytes] = deque()
        self.trace = PlantTrace(wire, self._published.append, run=RUN)
        self._between, self._skip = between, skip
        self._claims = 0
        self._ends = 0

    def run(self, ticks: int) -> Self:
        self._ends = ticks
        with (
            patch("aeroloop.plant_emulator.hosts.driver.TickGrid", lambda *_, **__: Grid(self._skip)),
            patch("aeroloop.plant_emulator.hosts.driver.prepare_process", lambda _: []),
            patch("aeroloop.plant_emulator.hosts.driver.IDLE_WAIT_S", 0.0),
            patch("aeroloop.plant_emulator.hosts.driver.ANSWER_TIMEOUT_S", -1.0),  # nothing comes by waiting
        ):
            self.driver.run(self)
        return self

    @property
    def batches(self) -> list[Batch]:
        batches = [read_batch(payload) for payload in self._published]
        assert None not in batches
        return [batch for batch in batches if batch is not None]

    def claim(self, *, auto_arm: bool = True) -> Grant | Refusal:
        self._claims += 1
        return self.endpoint.claim(
            claim_of(
                "c",
                wire=self.wire,
                period_ns=self.loop.period_ns,
                lockstep=self.loop.lockstep,
                auto_arm=auto_arm,
                session=f"s{self._claims}",
            )
        )

    def command(self, measurement: bytes, codes: Sequence[float]) -> None:
        counter = self.wire.measurement.counter(measurement)
        assert counter is not None
        self.wires.deliver(self.wire.command.pack(counter, codes), self.endpoint.ticked)

    @property
    def link(self) -> Link | None:
        return self.wires if self.endpoint.session is not None else None

    def serve(self) -> None:
        """Nothing to declare."""

    def take_inbox(self) -> None:
        self._between(self)
        self.follow_session()

    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        self.trace.row(self.endpoint, measurement, arrival, sent_ns)
        self.wires.tick = self.endpoint.ticked
        self.follow_session()
        if self.endpoint.ticked >= self._ends:
            self.stop.set()

    def follow_session(self) -> None:
        self.trace.follow(self.endpoint)
        if self.endpoint.session is None:
            self.wires.close()

    def publish_status(self) -> None:
        """Nobody reads it."""

    def leave(self) -> None:
        self.follow_session()
        self.trace.finish()
