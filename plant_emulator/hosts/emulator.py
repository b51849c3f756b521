"""Emulator: a driver with a computed plant and injectable faults.

Faults act on the plant's sensors and motors, on measurements before they are sent and on commands after they were
received; an event says when each begins and when it ends. On Zenoh the emulator also publishes the true state, accepts
faults while it runs, and steps on request in lockstep.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from aeroloop.plant_emulator.endpoint.vehicle_claim import Notice
from aeroloop.plant_emulator.faults.injection import FaultyPlant, FaultyStream
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.faults.schedule import FaultTransition, Schedule, Source
from aeroloop.plant_emulator.hosts.driver import Driver, PlantNetwork
from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import FaultStatus, Truth
from aeroloop.protocol.messages.operator import Advance, Answer, Inject
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED


class FaultError(AeroloopError):
    """A fault that cannot be injected; one line that says why."""


class Emulator(Driver):
    """The emulator, for any network: of our bodies, or of the plant that `plant.kind` names.

    Raises:
        PluginError, PlantError: There is no such plant, or it cannot be made.
        ValueError: A fault of a motor that the plant does not have, or another number of motors than the wire's.
    """

    def __init__(self, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, stop: threading.Event) -> None:
        limit, seed = settings.voltage_limit, settings.fault_seed
        self._faulty = FaultyPlant(settings.make(loop.period), (), loop.period, voltage_limit=limit, seed=seed)
        self._measurements = FaultyStream("measurement", (), seed)
        self._commands = FaultyStream("command", (), seed)
        self._schedule = Schedule(loop.period)
        self._session: str | None = None
        try:
            super().__init__(self._faulty, loop, wire, settings, stop)
            self._add(settings.parsed_faults, "configured")
        except ValueError:
            self._faulty.close()  # it may be a machine
            raise

    def inject(self, faults: Sequence[Fault], *, clear: bool = False) -> list[str]:
        """Add faults with start and end counted from now; if `clear`, remove all others first.

        Returns:
            What was done, a line each; they are events, too.

        Raises:
            ValueError: A fault of a motor that the plant does not have, or too many faults. Then nothing has changed.
        """
        for fault in faults:
            self._faulty.check(fault)
        if not clear:
            self._schedule.make_room(len(faults))
        else:
            self._faulty.clear()
            self._measurements.clear()
            self._commands.clear()
            self._publish(self._schedule.clear(self._faulty.ticks))
            self.endpoint.record_change("inject", name=None)
        self._add(faults, "injected")
        done = ["no faults any more"] if clear else []
        for fault in faults:
            self.endpoint.record_change("inject", name=str(fault))
            done.append(f"fault injected: {fault}")
        self._publish([FaultTransition(self._faulty.ticks, text) for text in done])
        return done

    def fault_statuses(self) -> list[FaultStatus]:
        """Status of every fault."""
        ticks = self._faulty.ticks
        return self._schedule.statuses(None if ticks < 0 else self.endpoint.ticked - ticks)

    def truth(self) -> Truth | None:
        """The present true state, with the tick of the measurement taken of it; None where the plant knows none."""
        state, session = self._faulty.plant.truth(), self.endpoint.session
        return state and Truth(
            tick=self.endpoint.ticked,
            attitude=state.attitude,
            rate=state.rate,
            voltages=state.voltages,
            session=session,
            session_tick=None if session is None else self.endpoint.session_tick,
        )

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Tick the plant end, and note the faults that began or ended."""
        measurement = super().tick(frame, k)
        if self._faulty.ticks >= self._schedule.due:
            self._publish(self._schedule.transitions(self._faulty.ticks))
        return measurement

    def _add(self, faults: Sequence[Fault], source: Source) -> None:
        now = self._faulty.time
        self._schedule.make_room(len(faults))
        for fault in faults:
            acting = (
                self._faulty.inject(fault) or self._measurements.inject(fault, now) or self._commands.inject(fault, now)
            )
            assert acting is not None
            self._schedule.add(acting, source)

    def _publish(self, transitions: Sequence[FaultTransition]) -> None:
        """Queue events of faults, with the session's tick if there was one then."""
        endpoint = self.endpoint
        for transition in transitions:
            tick = endpoint.event_tick
            if tick is not None:
                tick = max(0, tick + transition.tick - self._faulty.ticks)
            endpoint.notices.append(Notice("fault", transition.text, endpoint.session, tick))

    def _incoming(self, frame: bytes | None) -> bytes | None:
        session = self.endpoint.session
        if session != self._session:
            self._session = session
            self._measurements.forget()
            self._commands.forget()
            if session is not None:
                self._faulty.start()
        passed = self._commands.passes(frame, self._faulty.elapsed)
        return passed[-1] if passed else None

    def _outgoing(self, frame: bytes | None) -> list[bytes]:
        if frame == UNCHANGED and not self._loop.lockstep:  # not a frame, so no fault acts on it
            return self._measurements.passes(None, self._faulty.elapsed) or [UNCHANGED]
        return self._measurements.passes(frame, self._faulty.elapsed)


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

    def run(self, network: PlantNetwork | None = None) -> None:
        """Run until the role stops; then set 0 V and publish a last status."""
        self._role.serve("inject", Inject, self._inject)
        self._role.serve("advance", Advance, lambda advance: lambda: self._advance(advance.seconds))
        if network is None:
            directory = self._settings.state_directory
            network = ZenohNetwork(self._role, self._loop, self.endpoint, directory, faults=self.fault_statuses)
        super().run(network)

    def _may_step(self) -> bool:
        return self._steps != 0

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        echo = super()._tick(arrival, k)
        if self._truth_every and k % self._truth_every == 0 and (truth := self.truth()) is not None:
            self._role.publish("truth", truth)
        if self._steps is not None:
            self._steps -= 1
        return echo

    def _await_answer(self, echo: int) -> Arrival | None:
        arrival = super()._await_answer(echo)
        if self._steps == 0:
            self._network.publish_status()  # ends the wait of the `advance` query's sender
        return arrival

    def _ticks_between_truths(self) -> int:
        rate = self._settings.truth_rate_hz
        return max(1, round(self._loop.rate_hz / rate)) if rate else 0

    # ── queries `inject` and `advance`, for tests ──

    def _inject(self, request: Inject) -> Callable[[], Answer]:
        try:
            faults = [Fault.parse(text) for text in request.faults]
        except ValueError as error:
            raise FaultError(str(error)) from None

        def inject() -> Answer:
            try:
                done = self.inject(faults, clear=request.clear)
            except ValueError as error:
                raise FaultError(str(error)) from None
            return Answer(done=bool(done), text="; ".join(done) or "no fault was given")

        return inject

    def _advance(self, seconds: float) -> Answer:
        if self._steps is None:
            return Answer(done=False, text="this plant steps by itself: set plant.steps_on_request and loop.lockstep")
        self._steps += self._loop.ticks(seconds)
        return Answer(done=True, text=f"goes on for {seconds:g} s")
