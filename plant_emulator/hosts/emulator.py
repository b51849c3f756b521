"""Emulator: a driver with a computed plant and injectable faults.

Faults act on the plant's sensors and motors, on measurements before they are sent and on commands after they were
received; an event says when each begins and when it ends. On Zenoh the emulator also publishes the true state, accepts
faults while it runs, and steps on request in lockstep.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from math import isfinite

from aeroloop.plant_emulator.endpoint.vehicle_claim import Notice
from aeroloop.plant_emulator.faults.injection import FaultTransition
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.driver import Driver, PlantNetwork
from aeroloop.plant_emulator.hosts.zenoh_network import ZenohNetwork
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import FaultStatus, Truth
from aeroloop.protocol.messages.operator import Advance, Answer, Inject
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED


class Emulator(Driver):
    """The emulator, for any network: of our bodies, or of the plant that `plant.kind` names.

    Raises:
        PluginError, PlantError: There is no such plant, or it cannot be made.
        ValueError: A fault of a motor that the plant does not have, or another number of motors than the wire's.
    """

    def __init__(self, loop: LoopSettings, wire: WireSpec, settings: PlantSettings, stop: threading.Event) -> None:
        self._session: str | None = None
        plant = settings.make(loop.period)
        try:
            self._faulty = settings.with_faults(plant, loop.period)
            super().__init__(self._faulty, loop, wire, settings, stop)
        except ValueError:
            plant.close()  # it may be a machine
            raise

    def inject(self, faults: Sequence[Fault], *, clear: bool = False) -> list[str]:
        """Add faults with start and end counted from now; if `clear`, remove all others first.

        Returns:
            What was done, a line each; they are events, too.

        Raises:
            FaultError: A fault of a motor that the plant does not have, or too many faults. Then nothing has changed.
        """
        self._publish(self._faulty.inject(faults, "injected", clear=clear))
        names = [*([None] if clear else []), *map(str, faults)]
        for name in names:
            self.endpoint.record_change("inject", name=name)
        done = ["no faults any more" if name is None else f"fault injected: {name}" for name in names]
        self._publish([FaultTransition(self._faulty.ticks, text) for text in done])
        return done

    def fault_statuses(self) -> list[FaultStatus]:
        """Status of every fault."""
        ticks = self._faulty.ticks
        return self._faulty.statuses(None if ticks < 0 else self.endpoint.ticked - ticks)

    def truth(self) -> Truth | None:
        """The present true state, with the tick of the measurement taken of it; None where the plant knows none."""
        state, session = self._faulty.plant.truth(), self.endpoint.session
        return state and Truth(
            tick=self.endpoint.ticked,
            attitude=state.attitude,
            rate=state.rate,
            voltages=state.voltages,
            signals={name: value if isfinite(value) else None for name, value in state.signals.items()},
            session=session,
            session_tick=None if session is None else self.endpoint.session_tick,
        )

    def tick(self, frame: bytes | None, k: int) -> bytes | None:
        """Tick the plant end, and publish the faults that began or ended."""
        measurement = super().tick(frame, k)
        self._publish(self._faulty.transitions())
        return measurement

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
            self._faulty.forget_frames()
            if session is not None:
                self._faulty.start()
        passed = self._faulty.passes("command", frame)
        return passed[-1] if passed else None

    def _outgoing(self, frame: bytes | None) -> list[bytes]:
        if frame == UNCHANGED and not self._loop.lockstep:  # not a frame, so no fault acts on it
            return self._faulty.passes("measurement", None) or [UNCHANGED]
        return self._faulty.passes("measurement", frame)


class EmulatorOnZenoh(Emulator):
    """The emulator on Zenoh.

    Raises:
        ValueError: A fault of a motor that the plant does not have.
    """

    def __init__(self, role: Node, loop: LoopSettings, wire: WireSpec, settings: PlantSettings) -> None:
        super().__init__(loop, wire, settings, role.stop)
        self._role = role
        self._steps: int | None = 0 if settings.steps_on_request else None  # steps left; None: no limit
        directory = settings.state_directory
        self._zenoh = ZenohNetwork(role, loop, self.endpoint, directory, faults=self.fault_statuses)
        rate_hz = settings.truth_rate_hz
        self._truth_every = max(1, round(loop.rate_hz / rate_hz)) if rate_hz else 0

    def run(self, network: PlantNetwork | None = None) -> None:
        """Run until the role stops; then set 0 V and publish a last status."""
        self._role.serve("inject", Inject, self._inject)
        self._role.serve("advance", Advance, lambda advance: lambda: self._advance(advance.seconds))
        super().run(network or self._zenoh)

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
            self._zenoh.publish_status()  # ends the wait of the `advance` query's sender
        return arrival

    # ── queries `inject` and `advance`, for tests ──

    def _inject(self, request: Inject) -> Callable[[], Answer]:
        def inject() -> Answer:
            done = self.inject([Fault.parse(text) for text in request.faults], clear=request.clear)
            return Answer(done=bool(done), text="; ".join(done) or "no fault was given")

        return inject

    def _advance(self, seconds: float) -> Answer:
        if self._steps is None:
            return Answer(done=False, text="this plant steps by itself: set plant.steps_on_request and loop.lockstep")
        self._steps += self._loop.ticks(seconds)
        return Answer(done=True, text=f"goes on for {seconds:g} s")
