"""Loop of the plant end, for any plant and any network.

The loop is wait → receive → tick → send → account. An emulated plant waits for the tick grid; with hardware `advance`
blocks until the next sample; in lockstep the loop waits for the answer to its last measurement, so that a run repeats
bit for bit.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Plant, PlantError
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.runtime.realtime import collect_garbage, prepare_process
from aeroloop.protocol.runtime.timing import Clock, LoopTiming, TickGrid
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED

IDLE_WAIT_S: Final = 0.02
ANSWER_SHARE: Final = 0.6
"""With hardware, the loop waits for the answer to a sample for this share of the period."""


class PlantNetwork(ABC):
    """Network side of a driver, which alone calls it: ZenohNetwork on Zenoh, CanNetwork on a CAN bus.

    Attributes:
        timing: Timing of the driver's loop; None in lockstep.
        skipped: Ticks of sessions that the driver missed.
        notes: What a status says of the machine, such as real-time settings that it refused.
    """

    def __init__(self) -> None:
        self.timing: LoopTiming | None = None
        self.skipped = 0
        self.notes: list[str] = []

    @property
    @abstractmethod
    def link(self) -> Link | None:
        """Link of the session's frames; None without a session."""

    @abstractmethod
    def serve(self) -> None:
        """Start serving the network."""

    @abstractmethod
    def take_inbox(self) -> None:
        """Between two ticks, process what was received: claims, releases, operator commands."""

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send a measurement frame; UNCHANGED only in lockstep, where the controller cannot detect it by time."""

    @abstractmethod
    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """After the measurement was sent: write the tick's trace row, then as `follow_session`.

        Args:
            measurement: The endpoint's frame; UNCHANGED if it is not to be sent, None if there is none.
            arrival: The command received since the last tick, before any injected fault; None for none.
            sent_ns: When the measurement was sent, on the monotonic clock [ns].
        """

    @abstractmethod
    def follow_session(self) -> None:
        """Publish events and a status that is due, and close the link of a session that ended."""

    @abstractmethod
    def leave(self) -> None:
        """Publish that the plant stopped at 0 V, and leave the network."""


class Driver:
    """Runs the plant end's loop until `stop` is set; `settings` give watchdog, limits and arming.

    Raises:
        ValueError: The wire commands another number of actuators than the plant has.
    """

    def __init__(
        self,
        plant: Plant,
        loop: LoopSettings,
        wire: WireSpec,
        settings: PlantSettings,
        stop: threading.Event,
        clock: Clock = time,
    ) -> None:
        self._plant = plant
        self._clock = clock
        self._loop = loop
        self._settings = settings
        self._stop = stop
        self._counter = 0  # of the measurement sent last
        self._malformed = bytes(wire.command.size + 1)  # stands for every command of a wrong length
        self.endpoint = Endpoint(
            plant,
            wire,
            loop.period_ns,
            lockstep=loop.lockstep,
            watchdog_s=settings.watchdog_s,
            limits=settings.limit_monitor(loop.period_ns, wire.voltage.quantizer().outermost),
            armed=settings.armed_at_start,
        )

    def run(self, network: PlantNetwork) -> None:
        """Run until `stop` is set or the plant fails; then close the plant at 0 V and leave the network.

        Raises:
            PlantError: A plant of one's own failed; the loop has tripped and says so.
        """
        self._network = network
        network.serve()
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
                network.leave()

    def _run_real_time(self) -> None:
        """Wait for a tick, receive, tick and send, account; a plant that paces the loop waits in `advance`."""
        network, endpoint = self._network, self.endpoint
        network.notes = prepare_process(self._loop)
        timing = network.timing = LoopTiming(clock=self._clock)
        grid = None if self._plant.paces else TickGrid(self._loop.period_ns, clock=self._clock)
        while not self._stop.is_set():
            skipped = grid.skipped if grid else 0
            k = grid.wait() if grid else endpoint.ticked + self._plant.passed
            woke_ns = self._clock.monotonic_ns()
            due_ns = grid.due_ns if grid else woke_ns
            before = endpoint.session
            network.take_inbox()
            if grid and endpoint.session not in (None, before):
                # Granting took time, and the controller takes its grid from the session's first measurement.
                k, skipped = grid.wait(), grid.skipped
            self._tick(self._command(), k)
            if endpoint.session:
                network.skipped += grid.skipped - skipped if grid else self._plant.passed - 1
            collect_garbage()
            timing.woke(due_ns, woke_ns)
            timing.done()

    def _command(self) -> Arrival | None:
        """Return the command for this period. Hardware applies it at once, so the loop waits for it."""
        link = self._network.link
        if link is None:
            return None
        return link.wait(ANSWER_SHARE * self._loop.period) if self._plant.paces else link.take()

    def _run_lockstep(self) -> None:
        """Tick and send, then wait for the answer, which is the next tick's command."""
        arrival = None
        while not self._stop.is_set():
            self._network.take_inbox()
            if self._network.link is None or not self._may_step():
                self._clock.sleep(IDLE_WAIT_S if self._network.link is None else 0)
                self._network.follow_session()
                continue
            echo = self._tick(arrival, self.endpoint.ticked + 1)
            arrival = None if echo is None else self._await_answer(echo)

    def _await_answer(self, echo: int) -> Arrival | None:
        """Wait for the command that echoes a counter. Returns None if the session ends first."""
        deadline = self._clock.monotonic() + self._settings.answer_timeout_s
        while self._network.link and not self._stop.is_set():
            arrival = self._network.link.wait(IDLE_WAIT_S)
            if arrival is not None and self.endpoint.wire.command.counter(arrival.frame) in (echo, None):
                return arrival
            self._network.take_inbox()
            if self._clock.monotonic() > deadline:
                self.endpoint.expire(TripCause.NO_ANSWER, f"no answer for {self._settings.answer_timeout_s:g} s")
            self._network.follow_session()
        return None

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        """Tick on the network. Returns the counter that the answer to its measurement echoes, or None without one."""
        network, measured = self._network, self.endpoint.wire.measurement
        measurement = self.tick(arrival.frame if arrival is not None else None, k)
        sent_ns = self._clock.monotonic_ns()
        echo = None
        for sent in self._outgoing(measurement):
            network.send(sent)
            if self._loop.lockstep:
                # The controller takes a frame without a counter for the tick after its last.
                echo = measured.counter(sent)
                self._counter = (self._counter + 1) % measured.counters if echo is None else echo
                if sent == UNCHANGED:
                    echo = self._counter
        network.after_tick(measurement, arrival, sent_ns)
        return echo

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Tick the plant end without the network: `Endpoint.tick`, with the hook for commands before it."""
        if frame and len(frame) != self.endpoint.wire.command.size:
            frame = self._malformed
        passed = self._incoming(frame)
        measurement = self.endpoint.tick(passed, k)
        if passed is None and frame is not None:
            self.endpoint.outcome = Outcome.WITHHELD
        return measurement

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
