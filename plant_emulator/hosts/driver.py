"""Loop of the plant end, for any plant and any network: wait → receive → tick → send → account.

A computed plant waits for the tick grid; with hardware `advance` blocks until the next sample; in lockstep the loop
waits for the answer to its last measurement, so that a run repeats bit for bit. A tick passes the command through the
injected faults to the endpoint, and the endpoint's measurement through them to the network.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import isfinite
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.vehicle_claim import Notice
from aeroloop.plant_emulator.faults.injection import FaultTransition
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.plant import Plant, PlantError
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import FaultStatus, Truth
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
ANSWER_TIMEOUT_S: Final = 2.0
"""Longest wait for an answer in lockstep, where the watchdog, counted in ticks, stands still. A live controller answers
within milliseconds, with a law in Python within a second."""


class PlantNetwork(ABC):
    """Network side of a driver, which alone calls it: ZenohNetwork on Zenoh, CanNetwork on a CAN bus.

    Attributes:
        timing: Timing of the driver's loop; None in lockstep.
        skipped: Ticks of sessions that the driver missed.
        notes: What a status says of the machine, such as real-time settings that it refused.
        sent: Measurement frames sent; not UNCHANGED, which is sent in lockstep only.
        steps: Steps that lockstep may still take; None for no limit.
    """

    def __init__(self) -> None:
        self.timing: LoopTiming | None = None
        self.skipped = self.sent = 0
        self.notes: list[str] = []
        self.steps: int | None = None

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
    def publish_status(self) -> None:
        """Publish the status now."""

    @abstractmethod
    def leave(self) -> None:
        """Publish that the plant stopped at 0 V, and leave the network."""


class Driver:
    """Runs the plant end's loop until `stop` is set; `settings` give watchdog, limits, arming and faults.

    Raises:
        ValueError: The wire commands another number of actuators than the plant has, or a fault is of a motor that it
            does not have. The plant is closed then.

    Attributes:
        faulty: The plant with its faults.
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
        self._loop, self._stop, self._clock = loop, stop, clock
        self._session: str | None = None  # of the last tick
        self._counter = 0  # of the measurement sent last
        self._malformed = bytes(wire.command.size + 1)  # stands for every command of a wrong length
        try:
            self.faulty = settings.with_faults(plant, loop.period)
            self.endpoint = Endpoint(
                self.faulty,
                wire,
                loop.period_ns,
                lockstep=loop.lockstep,
                watchdog_s=settings.watchdog_s,
                limits=settings.limit_monitor(loop.period_ns, wire.voltage.quantizer().outermost),
                armed=settings.armed_at_start,
            )
        except ValueError:
            plant.close()  # it may be a machine
            raise

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
                self.faulty.close()
            finally:
                network.leave()

    def _run_real_time(self) -> None:
        """Wait for a tick, receive, tick and send, account; a plant that paces the loop waits in `advance`."""
        network, endpoint, plant = self._network, self.endpoint, self.faulty
        network.notes = prepare_process(self._loop)
        timing = network.timing = LoopTiming(clock=self._clock)
        grid = None if plant.paces else TickGrid(self._loop.period_ns, clock=self._clock)
        while not self._stop.is_set():
            skipped = grid.skipped if grid else 0
            k = grid.wait() if grid else endpoint.ticked + plant.passed
            woke_ns = self._clock.monotonic_ns()
            due_ns = grid.due_ns if grid else woke_ns
            before = endpoint.session
            network.take_inbox()
            if grid and endpoint.session not in (None, before):
                # Granting took time, and the controller takes its grid from the session's first measurement.
                k, skipped = grid.wait(), grid.skipped
            arrival = None
            if (link := network.link) is not None:  # hardware applies a command at once, so the loop waits for it
                arrival = link.wait(ANSWER_SHARE * self._loop.period) if plant.paces else link.take()
            self._tick(arrival, k)
            if endpoint.session:
                network.skipped += grid.skipped - skipped if grid else plant.passed - 1
            collect_garbage()
            timing.woke(due_ns, woke_ns)
            timing.done()

    def _run_lockstep(self) -> None:
        """Tick and send, then wait for the answer, which is the next tick's command."""
        network, arrival = self._network, None
        while not self._stop.is_set():
            network.take_inbox()
            if network.link is None or network.steps == 0:
                self._clock.sleep(IDLE_WAIT_S if network.link is None else 0)
                network.follow_session()
                continue
            echo = self._tick(arrival, self.endpoint.ticked + 1)
            arrival = None if echo is None else self._await_answer(echo)
            if network.steps is not None:
                network.steps -= 1
                if network.steps == 0:
                    network.publish_status()  # ends the wait of the `advance` query's sender

    def _await_answer(self, echo: int) -> Arrival | None:
        """Wait for the command that echoes a counter. Returns None if the session ends first."""
        network = self._network
        deadline = self._clock.monotonic() + ANSWER_TIMEOUT_S
        while network.link and not self._stop.is_set():
            arrival = network.link.wait(IDLE_WAIT_S)
            if arrival is not None and self.endpoint.wire.command.counter(arrival.frame) in (echo, None):
                return arrival
            network.take_inbox()
            if self._clock.monotonic() > deadline:
                self.endpoint.expire(TripCause.NO_ANSWER, f"no answer for {ANSWER_TIMEOUT_S:g} s")
            network.follow_session()
        return None

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        """Tick on the network. Returns the counter that the answer to its measurement echoes, or None without one."""
        network, measured, lockstep = self._network, self.endpoint.wire.measurement, self._loop.lockstep
        measurement = self.tick(arrival.frame if arrival is not None else None, k)
        sent_ns = self._clock.monotonic_ns()
        if measurement == UNCHANGED and not lockstep:  # not a frame, so no fault acts on it
            outgoing = self.faulty.passes("measurement", None) or [UNCHANGED]
        else:
            outgoing = self.faulty.passes("measurement", measurement)
        echo = None
        for sent in outgoing:
            if (sent or lockstep) and network.link is not None:
                network.link.send(sent)
                network.sent += sent != UNCHANGED
            if lockstep:
                # The controller takes a frame without a counter for the tick after its last.
                echo = measured.counter(sent)
                self._counter = (self._counter + 1) % measured.counters if echo is None else echo
                if sent == UNCHANGED:
                    echo = self._counter
        network.after_tick(measurement, arrival, sent_ns)
        return echo

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Tick the plant end without the network: `Endpoint.tick`, with the faults of commands before it."""
        endpoint = self.endpoint
        if frame and len(frame) != endpoint.wire.command.size:
            frame = self._malformed
        if endpoint.session != self._session:
            self._session = endpoint.session
            self.faulty.forget_frames()
            if self._session is not None:
                self.faulty.start()
        passed = self.faulty.passes("command", frame)
        measurement = endpoint.tick(passed[-1] if passed else None, k)
        if frame is not None and not passed:
            endpoint.outcome = Outcome.WITHHELD
        self._notify(self.faulty.transitions())
        return measurement

    def inject(self, faults: Sequence[Fault], *, clear: bool = False) -> list[str]:
        """Add faults with start and end counted from now; if `clear`, remove all others first.

        Returns:
            What was done, a line each; they are events, too.

        Raises:
            FaultError: A fault of a motor that the plant does not have, or too many faults. Then nothing has changed.
        """
        self._notify(self.faulty.inject(faults, "injected", clear=clear))
        names = [*([None] if clear else []), *map(str, faults)]
        for name in names:
            self.endpoint.record_change("inject", name=name)
        done = ["no faults any more" if name is None else f"fault injected: {name}" for name in names]
        self._notify([FaultTransition(self.faulty.ticks, text) for text in done])
        return done

    def fault_statuses(self) -> list[FaultStatus]:
        """Status of every fault."""
        ticks = self.faulty.ticks
        return self.faulty.statuses(None if ticks < 0 else self.endpoint.ticked - ticks)

    def truth(self) -> Truth | None:
        """The present true state, with the tick of the measurement taken of it; None where the plant has none."""
        state, endpoint = self.faulty.plant.truth(), self.endpoint
        return state and Truth(
            tick=endpoint.ticked,
            attitude=state.attitude,
            rate=state.rate,
            voltages=state.voltages,
            signals={name: value if isfinite(value) else None for name, value in state.signals.items()},
            session=endpoint.session,
            session_tick=None if endpoint.session is None else endpoint.session_tick,
        )

    def _notify(self, transitions: Sequence[FaultTransition]) -> None:
        """Queue events of faults, with the session's tick if there was one then."""
        endpoint = self.endpoint
        for transition in transitions:
            tick = endpoint.event_tick
            if tick is not None:
                tick = max(0, tick + transition.tick - self.faulty.ticks)
            endpoint.notices.append(Notice("fault", transition.text, endpoint.session, tick))
