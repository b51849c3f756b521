"""Loop of the plant end, for any plant and any network.

The loop is wait → receive → tick → send → account. An emulated plant waits for the tick grid; with hardware `advance`
blocks until the next sample; in lockstep the loop waits for the answer to its last measurement, so that a run repeats
bit for bit.
"""

from __future__ import annotations

import threading
import time
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.front import Front
from aeroloop.plant_emulator.own_plant import PlantError
from aeroloop.plant_emulator.plant import Plant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.runtime.realtime import prepare_process
from aeroloop.protocol.runtime.tick_grid import TickGrid
from aeroloop.protocol.runtime.timing import LoopTiming
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import SILENCE

IDLE_WAIT_S: Final = 0.02
ANSWER_SHARE: Final = 0.6
"""With hardware, the loop waits for the answer to a sample for this share of the period."""


class Driver:
    """Runs the plant end's loop until `stop` is set; `settings` give watchdog, limits and arming.

    Raises:
        ValueError: The wire commands another number of actuators than the plant has.

    Attributes:
        endpoint: The plant's endpoint.
    """

    def __init__(
        self, plant: Plant, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, stop: threading.Event
    ) -> None:
        self._plant = plant
        self._loop = loop
        self._settings = settings
        self._stop = stop
        self._counter = 0  # of the measurement sent last
        self._command_bytes = wire.command.size
        self._malformed = bytes(wire.command.size + 1)  # stands for every command of a wrong length
        self.endpoint = Endpoint(
            plant,
            wire,
            loop.period_ns,
            lockstep=loop.lockstep,
            watchdog_s=settings.watchdog_s,
            guard=settings.guard(loop.period_ns, wire.voltage.quantizer().outermost),
            armed=settings.armed_at_start,
        )

    def run(self, front: Front) -> None:
        """Run until `stop` is set or the plant fails; then close the plant at 0 V and leave the network.

        Raises:
            PlantError: A plant of one's own failed; the loop has tripped and says so.
        """
        self._front = front
        front.serve()
        try:
            if self._loop.lockstep:
                self._run_lockstep()
            else:
                self._run_real_time()
        except PlantError as error:
            self.endpoint.stop(TripCause.PLANT, str(error))
            raise
        finally:
            try:
                self._plant.close()
            finally:
                front.leave()

    def reconfigure(self, settings: PlantSettings) -> None:
        """Apply the settings that can change between two ticks: limits and watchdog."""
        self._settings = settings
        changed = {"watchdog_s": settings.watchdog_s, "limits": settings.limits.model_dump()}
        self.endpoint.operated("reconfigure", settings=changed)
        guard = settings.guard(self._loop.period_ns, self.endpoint.wire.voltage.quantizer().outermost)
        self.endpoint.protect(settings.watchdog_s, guard)

    def _run_real_time(self) -> None:
        front = self._front
        front.notes = prepare_process(self._loop)
        timing = front.timing = LoopTiming()
        grid = None if self._plant.paces else TickGrid(self._loop.period_ns)
        while not self._stop.is_set():
            skipped = grid.skipped if grid else 0
            k = grid.wait() if grid else self.endpoint.ticked + self._plant.passed
            woke_ns = time.monotonic_ns()
            due_ns = grid.due_ns if grid else woke_ns
            before = self.endpoint.session
            front.take_inbox()
            if grid and self.endpoint.session not in (None, before):
                # Granting took time, and the controller takes its grid from the session's first measurement.
                k, skipped = grid.wait(), grid.skipped
            self._tick(self._command(), k)
            if self.endpoint.session:
                front.skipped += grid.skipped - skipped if grid else self._plant.passed - 1
            timing.woke(due_ns, woke_ns)
            timing.done()

    def _command(self) -> Arrival | None:
        """Return the command for this period. Hardware applies it at once, so the loop waits for it."""
        link = self._front.link
        if link is None:
            return None
        return link.wait(ANSWER_SHARE * self._loop.period) if self._plant.paces else link.take()

    def _run_lockstep(self) -> None:
        arrival = None
        while not self._stop.is_set():
            self._front.take_inbox()
            if self._front.link is None or not self._may_step():
                time.sleep(IDLE_WAIT_S if self._front.link is None else 0)
                self._front.publish_when_due()
                continue
            echo = self._tick(arrival, self.endpoint.ticked + 1)
            arrival = None if echo is None else self._await_answer(echo)

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Tick the plant end without the network: `Endpoint.tick`, with the hook for commands before it."""
        if frame and len(frame) != self._command_bytes:
            frame = self._malformed
        passed = self._incoming(frame)
        measurement = self.endpoint.tick(passed, k)
        if passed is None and frame is not None:
            self.endpoint.outcome = Outcome.WITHHELD
        return measurement

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        """Tick on the network. Returns the counter that the answer to its measurement echoes, or None without one."""
        front = self._front
        measurement = self.tick(arrival.frame if arrival is not None else None, k)
        sent_ns = time.monotonic_ns()
        echo = None
        for sent in self._outgoing(measurement):
            front.send(sent)
            if self._loop.lockstep:
                # The controller takes a frame without a counter for the tick after its last.
                measured = self.endpoint.wire.measurement
                echo = measured.counter(sent)
                self._counter = (self._counter + 1) % measured.counters if echo is None else echo
                if sent == SILENCE:
                    echo = self._counter
        front.after_tick(measurement, arrival, sent_ns)
        return echo

    def _await_answer(self, echo: int) -> Arrival | None:
        """Wait for the command that echoes a counter. Returns None if the session ends first."""
        deadline = time.monotonic() + self._settings.answer_timeout_s
        while self._front.link and not self._stop.is_set():
            arrival = self._front.link.wait(IDLE_WAIT_S)
            if arrival is not None and self.endpoint.wire.command.counter(arrival.frame) in (echo, None):
                return arrival
            self._front.take_inbox()
            if time.monotonic() > deadline:
                self.endpoint.expire(TripCause.NO_ANSWER, f"no answer for {self._settings.answer_timeout_s:g} s")
            self._front.follow_session()
            self._front.publish_when_due()
        return None

    # ── hooks of subclasses ──

    def _may_step(self) -> bool:
        """Whether lockstep may take its next step."""
        return True

    def _incoming(self, frame: bytes | None) -> bytes | None:
        """Change or drop a received command before the endpoint gets it."""
        return frame

    def _outgoing(self, frame: bytes | None) -> list[bytes]:
        """Return the frames to send for the endpoint's measurement."""
        return [] if frame is None else [frame]
