"""Emulator: a driver with a computed plant and injectable faults.

Faults act on the plant's sensors and motors, on measurements before they are sent and on commands after they were
received. On Zenoh it also publishes the true state, accepts faults while it runs, and steps on request in lockstep.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.endpoint.front import Front
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.faults.streams import FaultyStream
from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.hosts.zenoh_front import ZenohFront
from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.operator import Advance, Answer, Inject
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import SILENCE


def truth_of(plant: EmulatedPlant, endpoint: Endpoint) -> Truth:
    """The present true state, with the tick of the measurement taken of it."""
    state, session = plant.truth(), endpoint.session
    return Truth(
        tick=endpoint.ticked,
        attitude=state.attitude,
        rate=state.rate,
        voltages=state.voltages,
        session=session,
        session_tick=None if session is None else endpoint.session_tick,
    )


class FaultError(AeroloopError):
    """A fault that cannot be injected; one line that says why."""


class Emulator(Driver):
    """The emulator, for any network.

    Raises:
        ValueError: A fault of a motor that the plant does not have.
    """

    def __init__(self, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, stop: threading.Event) -> None:
        self._emulated = settings.build(loop.period)
        self._faulty = settings.with_faults(self._emulated, loop.period)
        super().__init__(self._faulty, loop, wire, settings, stop)
        faults = settings.parsed_faults
        self._measurements = FaultyStream("measurement", faults, settings.fault_seed)
        self._commands = FaultyStream("command", faults, settings.fault_seed)
        self._session: str | None = None

    def inject(self, fault: Fault | None) -> None:
        """Add a fault with start and end counted from now; None removes all faults.

        Raises:
            ValueError: A fault of a motor that the plant does not have.
        """
        if fault is None:
            self._faulty.clear()
            self._measurements.clear()
            self._commands.clear()
        else:
            self._faulty.inject(fault)
            self._measurements.inject(fault, self._faulty.time)
            self._commands.inject(fault, self._faulty.time)
        self.endpoint.operated("inject", name=None if fault is None else str(fault))

    def _incoming(self, frame: bytes | None) -> bytes | None:
        session = self.endpoint.session
        if session != self._session:
            self._session = session
            self._measurements.forget()
            self._commands.forget()
        if session is not None:
            self._faulty.start()
        passed = self._commands.passes(frame, self._faulty.time)
        return passed[-1] if passed else None

    def _outgoing(self, frame: bytes | None) -> list[bytes]:
        if frame == SILENCE and not self._loop.lockstep:  # not a frame, so no fault acts on it
            return self._measurements.passes(None, self._faulty.time) or [SILENCE]
        return self._measurements.passes(frame, self._faulty.time)


class EmulatorOnZenoh(Emulator):
    """The emulator on Zenoh.

    Raises:
        ValueError: A fault of a motor that the plant does not have.
    """

    def __init__(self, role: Role, loop: LoopSettings, wire: WireSpec, settings: PlantSettings) -> None:
        super().__init__(loop, wire, settings, role.stop)
        self._role = role
        self._steps: int | None = 0 if settings.steps_on_request else None  # steps left; None: no limit
        self._truth_every = self._ticks_between_truths()

    def run(self, front: Front | None = None) -> None:
        """Run until the role stops; then set 0 V and publish a last status."""
        self._role.serve("inject", Inject, lambda inject: self._inject(inject.fault))
        self._role.serve("advance", Advance, lambda advance: lambda: self._advance(advance.seconds))
        super().run(front or ZenohFront(self._role, self._loop, self.endpoint))

    def reconfigure(self, settings: PlantSettings) -> None:
        """Apply limits, watchdog and the rate of true states."""
        super().reconfigure(settings)
        self._truth_every = self._ticks_between_truths()

    def _may_step(self) -> bool:
        return self._steps != 0

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        echo = super()._tick(arrival, k)
        if self._truth_every and k % self._truth_every == 0:
            self._role.publish("truth", truth_of(self._emulated, self.endpoint))
        if self._steps is not None:
            self._steps -= 1
        return echo

    def _await_answer(self, echo: int) -> Arrival | None:
        arrival = super()._await_answer(echo)
        if self._steps == 0:
            self._front.publish_status()  # ends the wait of the `advance` query's sender
        return arrival

    def _ticks_between_truths(self) -> int:
        rate = self._settings.truth_rate_hz
        return max(1, round(self._loop.rate_hz / rate)) if rate else 0

    # ── queries `inject` and `advance`, for tests ──

    def _inject(self, text: str | None) -> Callable[[], Answer]:
        try:
            fault = Fault.parse(text) if text is not None else None
        except ValueError as error:
            raise FaultError(str(error)) from None

        def inject() -> Answer:
            try:
                self.inject(fault)
            except ValueError as error:
                raise FaultError(str(error)) from None
            text = "no faults any more" if fault is None else f"fault injected: {fault}"
            self._role.event("fault", text, self.endpoint.session, self.endpoint.event_tick)
            return Answer(done=True, text=text)

        return inject

    def _advance(self, seconds: float) -> Answer:
        if self._steps is None:
            return Answer(done=False, text="this plant steps by itself: set plant.steps_on_request and loop.lockstep")
        self._steps += self._loop.ticks(seconds)
        return Answer(done=True, text=f"goes on for {seconds:g} s")
