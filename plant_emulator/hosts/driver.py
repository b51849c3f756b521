"""Loop of the plant end, for any plant and any network: wait → receive → tick → send → account."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from typing import Final

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.runtime.realtime import collect_garbage, prepare_process
from aeroloop.protocol.runtime.timing import Clock, LoopTiming, TickGrid
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.frames import TickCounter
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.protocol.wire.transmit import UNCHANGED

IDLE_WAIT_S: Final = 0.02
ANSWER_SHARE: Final = 0.6  # of the period: with hardware, the loop waits so long for the answer to a sample
ANSWER_TIMEOUT_S: Final = 2.0
"""Longest wait for an answer in lockstep, where the watchdog stands still; a law in Python may take a second."""


class PlantNetwork(ABC):
    """Network side of a driver, which alone calls it: ZenohNetwork on Zenoh, CanNetwork on a CAN bus."""

    def __init__(self) -> None:
        self.timing: LoopTiming | None = None  # of the driver's loop; None in lockstep
        self.skipped = self.sent = 0  # ticks of sessions that the driver missed, measurement frames, so far
        self.notes: list[str] = []  # of the machine, for the status, such as real-time settings that it refused
        self.steps: int | None = None  # that lockstep may still take; None for no limit

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
    def wait_for_inbox(self, timeout_s: float) -> None:
        """Wait until there is something for `take_inbox`, at most so long [s]."""

    @abstractmethod
    def after_tick(self, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """After a measurement was sent, at `sent_ns` on the monotonic clock: trace row, events, a due status.

        `measurement` is what `Endpoint.tick` returned, `arrival` the command received since the last tick; both are
        before any injected fault.
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
    """Runs the loop of a plant end until `stop` is set.

    A computed plant waits for the tick grid; with hardware `advance` blocks until the next sample; in lockstep the loop
    waits for the answer to its last measurement, so that a run repeats bit for bit.
    """

    def __init__(
        self, endpoint: Endpoint, network: PlantNetwork, loop: LoopSettings, stop: threading.Event, clock: Clock = time
    ) -> None:
        self._endpoint, self._network, self._loop, self._stop, self._clock = endpoint, network, loop, stop, clock
        self._sent = self._ticks_of_session()

    def _ticks_of_session(self) -> TickCounter:
        """What the controller counts in lockstep, from a session's start on."""
        counters = self._endpoint.wire.measurement.counters
        return TickCounter(self._loop.period_ns, counters, lockstep=True)

    def run(self) -> None:
        """Run until `stop` is set, then end the session at 0 V, close the plant and leave the network.

        Raises:
            Exception: Whatever ended the loop instead, such as the plant's PlantError; the plant tripped, latched.
        """
        endpoint = self._endpoint
        try:
            self._network.serve()
            if self._loop.lockstep:
                self._run_lockstep()
            else:
                self._run_real_time()
            endpoint.leave()
            endpoint.raise_failure()
        except Exception as error:
            endpoint.fail(error)
            raise
        finally:
            try:
                endpoint.plant.close()
            finally:
                self._network.leave()

    def _run_real_time(self) -> None:
        network, endpoint, plant = self._network, self._endpoint, self._endpoint.plant
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
            endpoint.raise_failure()
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
        network, endpoint, arrival = self._network, self._endpoint, None
        while not self._stop.is_set():
            network.take_inbox()
            endpoint.raise_failure()
            if network.link is None or network.steps == 0:
                network.wait_for_inbox(IDLE_WAIT_S)
                network.follow_session()
                continue
            echo = self._tick(arrival, endpoint.ticked + 1)
            arrival = None if echo is None else self._await_answer(echo)
            if network.steps is not None:
                network.steps -= 1
                if network.steps == 0:
                    network.publish_status()  # ends the wait of the `advance` query's sender

    def _await_answer(self, echo: int) -> Arrival | None:
        """Wait for the command that echoes a counter. Returns None if the session ends first, even if a next begins."""
        network, endpoint = self._network, self._endpoint
        session = endpoint.session
        deadline = self._clock.monotonic() + ANSWER_TIMEOUT_S
        while network.link and endpoint.session == session and not self._stop.is_set():
            arrival = network.link.wait(IDLE_WAIT_S)
            if arrival is not None and endpoint.wire.command.counter(arrival.frame) in (echo, None):
                return arrival
            network.take_inbox()
            if endpoint.session == session and self._clock.monotonic() > deadline:
                endpoint.expire(TripCause.NO_ANSWER, f"no answer for {ANSWER_TIMEOUT_S:g} s")
            network.follow_session()
        return None

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        """Tick on the network. Returns the counter that the answer to its measurement echoes, or None without one."""
        network, endpoint, lockstep = self._network, self._endpoint, self._loop.lockstep
        measurement = endpoint.tick(arrival.frame if arrival is not None else None, k)
        sent_ns = self._clock.monotonic_ns()
        echo, layout = None, endpoint.wire.measurement
        if endpoint.session_tick == 0:
            self._sent = self._ticks_of_session()
        for sent in endpoint.outgoing:
            if (sent or lockstep) and network.link is not None:
                network.link.send(sent)
                network.sent += sent != UNCHANGED
            if lockstep:
                counter = layout.counter(sent)
                tick = self._sent.advance_one() if counter is None else self._sent.advance(counter, 0)
                # The controller answers no repeated, older or malformed frame.
                if tick is not None and (counter is not None or sent == UNCHANGED):
                    echo = tick % layout.counters
        network.after_tick(measurement, arrival, sent_ns)
        return echo
