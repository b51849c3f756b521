"""The emulator process: an emulated plant behind an Endpoint, on the network.

The loop is wait → receive → tick → send → account. In real time it waits for the grid; in lockstep it waits for the
answer to its last measurement, so that a run repeats bit for bit. Faults, if any are asked for, act on the plant's
sensors and motors, on the measurements before they are sent and on the commands after they have come.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from plant_emulator.endpoint import Endpoint
from plant_emulator.faults import Fault
from plant_emulator.faulty_stream import FaultyStream
from plant_emulator.presence import Presence
from plant_emulator.settings import PlantSettings
from protocol.clock import LoopSettings, LoopTiming, TickGrid, prepare_process
from protocol.errors import AeroloopError
from protocol.frames import WireSpec
from protocol.links import Arrival
from protocol.messages import Truth
from protocol.role import Role
from protocol.states import TripCause
from protocol.verbs import Advance, Answer, Inject

IDLE_WAIT_S: Final = 0.02


class FaultError(AeroloopError):
    """A fault that cannot be injected; one line that says why."""


class Emulator:
    """The plant end as a process.

    Args:
        role: Its name on the network.
        loop: The grid.
        wire: How frames are read and written.
        settings: The plant.

    Raises:
        ValueError: A fault of a motor that the plant does not have.
    """

    def __init__(self, role: Role, loop: LoopSettings, wire: WireSpec, settings: PlantSettings) -> None:
        self._role = role
        self._loop = loop
        self._settings = settings
        self._emulated = settings.build(loop.period)
        self._plant = settings.with_faults(self._emulated, loop.period)
        self._endpoint = Endpoint(
            self._plant,
            wire,
            loop.period_ns,
            lockstep=loop.lockstep,
            watchdog_s=settings.watchdog_s,
            guard=settings.guard(loop.period_ns, wire.voltage.quantizer().outermost),
            armed=settings.armed_at_start,
        )
        self._presence = Presence(role, loop, self._endpoint, latest_s=settings.watchdog_s)
        faults = settings.parsed_faults
        self._measurements = FaultyStream("measurement", faults, settings.fault_seed)
        self._commands = FaultyStream("command", faults, settings.fault_seed)
        self._k = -1
        self._steps: int | None = 0 if settings.steps_on_request else None  # that may still be taken; None: any number
        self._truth_every = self._ticks_between_truths()

    def run(self) -> None:
        """Run until the role is told to stop; then 0 V and a last status."""
        self._role.serve("inject", Inject, lambda inject: self._inject(inject.fault))
        self._role.serve("advance", Advance, lambda advance: lambda: self._advance(advance.seconds))
        self._presence.serve()
        try:
            if self._loop.lockstep:
                self._run_lockstep()
            else:
                self._run_real_time()
        finally:
            self._plant.close()
            self._presence.leave()

    def reconfigure(self, settings: PlantSettings) -> None:
        """Take over what can change between two ticks: limits, watchdog, how often the truth is told."""
        self._settings = settings
        guard = settings.guard(self._loop.period_ns, self._endpoint.wire.voltage.quantizer().outermost)
        self._endpoint.protect(settings.watchdog_s, guard)
        self._truth_every = self._ticks_between_truths()

    def _run_real_time(self) -> None:
        presence = self._presence
        presence.notes = prepare_process(self._loop)
        timing = presence.timing = LoopTiming()
        grid = TickGrid(self._loop.period_ns)
        while not self._role.stop.is_set():
            skipped = grid.skipped
            k = grid.wait()
            timing.woke(grid.due_ns)
            presence.take_inbox()
            arrival = presence.link.take() if presence.link else None
            self._tick(arrival, k)
            if self._endpoint.session:
                presence.skipped += grid.skipped - skipped
            timing.done()

    def _run_lockstep(self) -> None:
        arrival = None
        while not self._role.stop.is_set():
            self._presence.take_inbox()
            if self._presence.link is None or self._steps == 0:
                time.sleep(IDLE_WAIT_S if self._presence.link is None else 0)
                self._presence.tell_when_due()
                continue
            if self._steps is not None:
                self._steps -= 1
            echo = self._tick(arrival, self._k + 1)
            arrival = None if echo is None else self._await_answer(echo)
            if self._steps == 0:
                self._presence.tell()

    def _tick(self, arrival: Arrival | None, k: int) -> int | None:
        """One tick of the plant end. Returns the counter that an answer to its measurement will echo, if one will."""
        command = None
        if self._endpoint.session is not None:
            self._plant.start()
        t = self._plant.time
        if not self._commands.idle:
            arrival = self._disturbed(arrival, t)
        if arrival is not None and self._presence.arrived(arrival):
            command = arrival.frame
        frame = self._endpoint.tick(command, k)
        frames = [frame] if frame is not None else []
        if not self._measurements.idle:
            frames = self._measurements.passes(frame, t)
        echo = None
        for frame in frames:
            read = self._endpoint.wire.measurement.unpack(frame)
            echo = None if read is None else read[0]
            self._presence.send(frame, self._endpoint.counter if echo is None else echo)
        self._k = k
        self._presence.after_tick(k)
        if self._truth_every and k % self._truth_every == 0:
            state = self._emulated.truth()
            self._role.publish(
                "truth", Truth(tick=k, attitude=state.attitude, rate=state.rate, voltages=state.voltages)
            )
        return echo

    def _disturbed(self, arrival: Arrival | None, t: float) -> Arrival | None:
        """What is left of a command after its faults; one that comes late was still sent when it was."""
        frame, sent_ns = (arrival.frame, arrival.published_ns) if arrival else (None, 0)
        passed = self._commands.passes(frame, t, sent_ns)
        return Arrival(passed[-1], time.monotonic_ns(), self._commands.last_sent_ns) if passed else None

    def _await_answer(self, echo: int) -> Arrival | None:
        """The command that echoes a counter, or None when the session ends before it comes."""
        deadline = time.monotonic() + self._settings.answer_timeout_s
        while self._presence.link and not self._role.stop.is_set():
            arrival = self._presence.link.wait(IDLE_WAIT_S)
            if arrival is not None and _echo(self._endpoint.wire, arrival) in (echo, None):
                return arrival
            self._presence.take_inbox()
            if time.monotonic() > deadline:
                self._endpoint.expire(TripCause.NO_ANSWER, f"no answer for {self._settings.answer_timeout_s:g} s")
            self._presence.follow_session()
            self._presence.tell_when_due()
        return None

    def _ticks_between_truths(self) -> int:
        rate = self._settings.truth_rate_hz
        return max(1, round(self._loop.rate_hz / rate)) if rate else 0

    # ── for tests: what goes wrong, and when ──

    def _inject(self, text: str | None) -> Callable[[], Answer]:
        try:
            fault = Fault.parse(text) if text is not None else None
        except ValueError as error:
            raise FaultError(str(error)) from None

        def inject() -> Answer:
            if fault is None:
                self._plant.clear()
                self._measurements.clear()
                self._commands.clear()
                return self._told("no faults any more")
            try:
                self._plant.inject(fault)
            except ValueError as error:
                raise FaultError(str(error)) from None
            self._measurements.inject(fault, self._plant.time)
            self._commands.inject(fault, self._plant.time)
            return self._told(f"fault injected: {fault}")

        return inject

    def _told(self, text: str) -> Answer:
        self._role.event("fault", text, self._endpoint.session)
        return Answer(done=True, text=text)

    def _advance(self, seconds: float) -> Answer:
        if self._steps is None:
            return Answer(done=False, text="this plant steps by itself: set plant.steps_on_request and loop.lockstep")
        self._steps += self._loop.ticks(seconds)
        return Answer(done=True, text=f"goes on for {seconds:g} s")


def _echo(wire: WireSpec, arrival: Arrival) -> int | None:
    read = wire.command.unpack(arrival.frame)
    return None if read is None else read[0]
