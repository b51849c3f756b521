"""One session of the controller, from the grant to its end: wait → tick → send → account.

In lockstep the same loop runs as fast as the plant sends. After `stale_s` without a measurement the session is given up
and nothing more is sent; the plant's watchdog does the rest. Every tick is a row of the trace.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread
from typing import Final

from zenoh.handlers import RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Status, Telemetry
from aeroloop.protocol.messages.operator import MessageError
from aeroloop.protocol.messages.states import CONTROLLER_TABLE, Machine
from aeroloop.protocol.messages.states import ControllerState as State
from aeroloop.protocol.messages.states import ControllerTrigger as Trigger
from aeroloop.protocol.messages.trace import ControllerRow, Received, Sent, TraceWriter
from aeroloop.protocol.runtime.node import Node, log
from aeroloop.protocol.runtime.realtime import collect_garbage
from aeroloop.protocol.runtime.stderr_log import flush_log
from aeroloop.protocol.runtime.timing import LoopTiming, RollingHistogram
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.daemon.claim import ClaimClient
from aeroloop.service.daemon.operator_changes import OperatorChanges
from aeroloop.service.daemon.tick_source import PlantTick, TickSource

LOCKSTEP_PATIENCE_S: Final = 2.0
"""Longest wait for the first measurement in lockstep [s]; between steps a plant may pause for any time."""
WAIT_S: Final = 0.02  # how often the session is checked while nothing is received [s]
READ_S: Final = 0.01  # least time between two readings of the plant's status [s]
STALL_TICKS: Final = 10  # ticks missed in a row that cause a warning
TELEMETRY_HZ: Final = 10.0  # telemetry is for people: the trace has every tick [Hz]
LAW_TIMEOUT_S: Final = 0.1
"""A tick of the law that takes longer on a CPU faults the controller, except in lockstep [s]. By then the plant's
watchdog, with its default time, has set 0 V. Time in which the host halts the process is not the law's."""
REPORT_S: Final = 1.0  # a tick that lasts longer is reported while it lasts [s]
STOP_S: Final = 2.0  # how long a hanging tick may outlast a request to stop [s]
CHECK_S: Final = 0.1  # how often a law in Python is checked [s]


class Shared:
    """What one session leaves to the next: everything of the process but controller and link."""

    def __init__(self, role: Node, settings: Settings, why_none: Callable[[], str]) -> None:
        loop, wire = settings.loop, settings.wire
        self.claims = ClaimClient(role, loop, wire, auto_arm=settings.controller.auto_arm)
        self.machine = Machine(State.SEARCHING, CONTROLLER_TABLE)
        self.cause = ""  # why the last session ended
        self.trace = TraceWriter("controller", wire, secrets.randbits(64))
        self.changes = OperatorChanges(role, settings, self.trace, why_none)
        self.plant = PlantStatus(role)
        self.watch = LawWatch(role, f"law {settings.law.kind}")
        self.timing = None if loop.lockstep else LoopTiming(clock=role.clock)
        self.age = RollingHistogram(role.clock)  # from a measurement received to its command sent
        self.counts = Counts()


@dataclass
class Counts:
    """Ticks answered, frames sent and received, ticks missed, frames refused, voltages saturated, frames too late."""

    ticks: int = 0
    sent: int = 0
    received: int = 0
    skipped: int = 0
    refused: int = 0
    saturated: int = 0
    stale: int = 0


class Session:
    """The session that `Shared.claims` has just been granted; `publish_status` publishes the status when it is due."""

    def __init__(
        self, role: Node, settings: Settings, shared: Shared, controller: Controller, link: ZenohLink,
        publish_status: Callable[[], None],
    ) -> None:  # fmt: skip
        self._role, self._clock, self._shared, self._link = role, role.clock, shared, link
        self._publish_status = publish_status
        self.controller = controller
        self.name = shared.claims.session or ""
        loop, own = settings.loop, settings.controller
        self._lockstep = loop.lockstep
        self._stale_s = own.stale_s
        self._last_tick = loop.ticks(own.duration_s) - 1 if own.duration_s else None
        self._telemetry_every = max(1, round(loop.rate_hz / TELEMETRY_HZ))
        self._source = TickSource(link, loop, settings.wire, stale_s=own.stale_s, clock=role.clock)
        self._k = -1
        shared.machine.fire(Trigger.GRANT)
        shared.plant.follow(self.name)
        shared.trace.session = self.name
        shared.trace.state = controller.state.model_dump(mode="json")
        shared.changes.begin(controller, self.name, shared.claims.last)

    @property
    def refused(self) -> int:
        """Frames refused so far."""
        return self.controller.refused + self._link.refused

    @property
    def last_answered(self) -> int | None:
        """The last tick that was answered; None before the first."""
        return self.controller.tick_index if self.controller.tick_index >= 0 else None

    def run(self) -> bool:
        """Run the session. True once `duration_s` is over, False if it was lost, stopped or released."""
        last = self._clock.monotonic()
        while self._may_continue() and (self._last_tick is None or self._k < self._last_tick):
            now = self._source.next(min(WAIT_S, self._stale_s))
            if now is not None and now.fresh:
                last = self._clock.monotonic()
            elif (reason := self._why_lost(self._clock.monotonic() - last)) is not None:
                self._shared.machine.fire(Trigger.LOST)
                self._shared.cause = reason
                text = f"{reason}: stopped commanding, looking for {self._role.vehicle}"
                self._role.event("lost", text, self.name, self.last_answered)
                return False
            if now is None:
                if self._lockstep:  # a plant may pause for any time, and a request does not wait for its next step
                    self._shared.changes.between_ticks(self._k + 1)
                self._publish_trace_when_due()
                self._publish_status()
            elif now.received_as is Received.LATE or now.tick == self._k:
                self._take_late(now)
            else:
                self._answer(now)
        return self._may_continue()

    def end(self) -> None:
        """Publish what the trace holds and release the vehicle."""
        shared = self._shared
        if shared.timing:
            shared.timing.pause()
        shared.changes.end()
        batch = shared.trace.take(self._clock.monotonic_ns(), self._clock.time_ns(), final=True)
        self._role.publish_bytes("trace", batch)
        shared.claims.release()
        self._link.close()
        shared.counts.refused += self.refused
        shared.counts.saturated += self.controller.saturated
        if shared.claims.by_datagrams:
            self._role.datagrams.close()  # the next claim connects anew: the plant may be another one

    def _may_continue(self) -> bool:
        return not self._role.stop.is_set() and self._shared.machine.state not in (State.HOLDING, State.FAULTED)

    def _why_lost(self, silent_s: float) -> str | None:
        """Why the session is lost, if it is: the plant has ended it, is gone, or has been silent for too long."""
        plant = self._shared.plant
        status, granted = plant.read(), plant.granted
        if status is not None and granted and status.session != self.name:
            return f"the plant ended the session{': ' + status.cause if status.cause else ''}"
        # In lockstep a granted plant may pause between steps: it is lost only when its session ends or it is gone.
        patience = LOCKSTEP_PATIENCE_S if self._lockstep and not granted else self._stale_s
        if silent_s > patience and (plant.gone or not (self._lockstep and granted)):
            return f"no measurement for {silent_s * 1e3:.0f} ms"
        return None

    # ── a tick ──

    def _answer(self, now: PlantTick) -> None:
        shared, clock, timing = self._shared, self._clock, self._shared.timing
        woke_ns = clock.monotonic_ns()
        shared.changes.before_tick(now.tick, now.frame)
        if not self._may_continue():
            return
        shared.watch.begun = clock.monotonic()
        began_s = clock.thread_time()
        command = self.controller.tick(now.frame, now.tick)
        took_s = clock.thread_time() - began_s
        shared.watch.begun = None
        fault = self.controller.fault
        if took_s > LAW_TIMEOUT_S and not self._lockstep:
            command = None
            fault = f"law {self.controller.law.settings.kind} took {took_s:.3g} s of CPU time for a tick"
        if command or (command is not None and self._lockstep):
            self._link.send(command)
        self._k = now.tick
        sent_ns = clock.monotonic_ns()
        if timing:
            timing.woke(now.at_ns, woke_ns)
        shared.age.add(sent_ns - now.at_ns)
        self._record(now, command, sent_ns)
        self._count(now, command)
        if command is not None or fault is not None:
            self._advance_state(now.tick, fault)
        if self.controller.tick_index == now.tick and now.tick % self._telemetry_every == 0:
            self._role.publish("telemetry", telemetry_of(self.controller, self.name))
        self._publish_status()
        collect_garbage()
        if timing:
            timing.done()

    def _take_late(self, late: PlantTick) -> None:
        """A late or malformed frame, which is no tick: its levels, if it has any, hold from the next tick on."""
        self._shared.counts.received += 1
        self.controller.hold(late.frame)
        if not late.fresh and late.received_as is Received.LATE:
            self._shared.counts.stale += 1
            text = f"measurements arrive {late.late_ns * 1e-6:.0f} ms later than the fastest: not answered"
            self._role.warn("stale", "fault", text, self.name, late.tick)
        self._record(late, None, 0)

    def _record(self, now: PlantTick, command: bytes | None, sent_ns: int) -> None:
        """Add a row to the trace. A command that repeats the last one is silent, in lockstep too."""
        sent_as = Sent.NONE if command is None else Sent.FRAME if command else Sent.SILENT
        times = now.at_ns, 0 if command is None else sent_ns
        row = ControllerRow(max(now.tick, 0), now.received_as, sent_as, *times, now.frame, command or b"")
        self._shared.trace.row(row)
        self._publish_trace_when_due()

    def _publish_trace_when_due(self) -> None:
        now_ns, trace = self._clock.monotonic_ns(), self._shared.trace
        if trace.due(now_ns):
            self._role.publish_bytes("trace", trace.take(now_ns, self._clock.time_ns()))
            trace.state = self.controller.state.model_dump(mode="json")

    def _count(self, now: PlantTick, command: bytes | None) -> None:
        counts = self._shared.counts
        self._shared.plant.read()
        counts.ticks += 1
        counts.received += now.frame != UNCHANGED
        counts.sent += bool(command)
        counts.skipped += now.missed
        if now.missed >= STALL_TICKS:
            self._role.warn("stall", "fault", f"{now.missed} ticks missed in a row", self.name, now.tick)

    def _advance_state(self, tick: int, fault: str | None) -> None:
        machine, role = self._shared.machine, self._role
        if fault is not None:
            machine.fire(Trigger.FAULT)
            self._shared.cause = fault
            role.event("fault", f"{fault}: stopped commanding until `aeroloop op arm`", self.name, tick)
        elif self.controller.tick_index != tick:
            if machine.state is not State.READY:
                machine.fire(Trigger.INVALID)
                role.warn("invalid", "fault", "no valid measurement: commands no valid value", self.name, tick)
        elif machine.state is not State.RUNNING:
            claimed = machine.state is State.CLAIMED
            machine.fire(Trigger.ANSWERED)
            if claimed:
                by = ", its frames by datagrams" if self._shared.claims.by_datagrams else ""
                role.event("claimed", f"{role.name} has {role.vehicle}{by}", self.name, tick)


def telemetry_of(controller: Controller, session: str) -> Telemetry:
    """The controller's last tick in a session."""
    return Telemetry(
        session=session, tick=controller.tick_index, counter=controller.counter,
        attitude_error=controller.attitude_error, rate_error=controller.rate_error, desired=controller.desired,
        state=controller.law_state, voltages=controller.voltages,
    )  # fmt: skip


class PlantStatus:
    """The plant's newest status; `granted`: one has named the session that is followed; `gone`: the plant's token is.

    What was received is read every `READ_S`, so that a flood of statuses costs the loop nothing.
    """

    def __init__(self, role: Node) -> None:
        self._role = role
        self._newest: Status | None = None
        self._due_s = 0.0
        self._session, self.granted, self.gone = "", False, False
        key = topics.key("status", role.vehicle, role="plant")
        self._received = role.zenoh.declare_subscriber(key, RingChannel(1))

    def follow(self, session: str) -> None:
        """Follow a new session."""
        self._session, self.granted = session, False

    def see(self, appeared: bool) -> None:
        """The plant's token appears or disappears."""
        self.gone = not appeared

    def read(self) -> Status | None:
        """The newest status; None before the first."""
        if self._role.clock.monotonic() < self._due_s or (sample := self._received.try_recv()) is None:
            return self._newest
        self._due_s = self._role.clock.monotonic() + READ_S
        try:
            self._newest = Status.decode(sample.payload.to_bytes(), extra="ignore")
        except MessageError:
            self._role.warn("plant's status", "fault", "the plant's status cannot be read: another version?")
        else:
            self.granted = self.granted or self._newest.session == self._session
        return self._newest


class LawWatch(Thread):
    """Watch of a law in Python: an event while a tick does not end, and the process's end if it never does.

    The plant's watchdog sets 0 V without it; but a loop that hangs in a user's code cannot stop when it is asked to.
    """

    def __init__(self, role: Node, law: str) -> None:
        super().__init__(name="law watch", daemon=True)
        self._role, self._law = role, law
        self.begun: float | None = None  # when the tick that runs began; None between ticks

    def run(self) -> None:
        """Watch until the process ends."""
        stopping_s = 0.0
        while True:
            time.sleep(CHECK_S)
            begun, stopping_s = self.begun, stopping_s + CHECK_S if self._role.stop.is_set() else 0.0
            lasts_s = 0.0 if begun is None else self._role.clock.monotonic() - begun
            if lasts_s > REPORT_S:
                self._role.warn("law", "fault", f"{self._law} has not ended a tick for {lasts_s:.1f} s")
            if lasts_s > REPORT_S and stopping_s > STOP_S:
                log.error("%s does not end its tick: the process ends without it", self._law)
                flush_log()
                os._exit(1)
