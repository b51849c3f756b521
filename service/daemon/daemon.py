"""Controller process: claims a vehicle, then waits → ticks → sends → accounts, until it is stopped.

`tick_source.py` defines a tick; in lockstep the same loop runs as fast as the plant sends. Without a session the daemon
claims four times a second, so either end may start first and either may be restarted. After `stale_s` without a
measurement it gives the session up and sends nothing more; the plant's watchdog does the rest. Every tick is a row of
the trace, which is published after the command.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Final, Literal

from zenoh.handlers import RingChannel

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import SessionRecord, Status
from aeroloop.protocol.messages.operator import Answer, MessageError, Request, in_words
from aeroloop.protocol.messages.states import CONTROLLER_TABLE, ControllerState, ControllerTrigger, Machine
from aeroloop.protocol.messages.trace import ControllerRow, Received, Sent, TraceWriter, batches_per_s
from aeroloop.protocol.runtime.node import Node, RecorderWatch
from aeroloop.protocol.runtime.realtime import collect_garbage, prepare_process
from aeroloop.protocol.runtime.timing import LoopTiming, RollingHistogram, report, summary
from aeroloop.protocol.transport.link import ZenohLink
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import PythonLaw
from aeroloop.service.daemon import operator_requests
from aeroloop.service.daemon.claim import ClaimClient, SessionLostError
from aeroloop.service.daemon.law_watch import LawWatch
from aeroloop.service.daemon.operator_changes import OperatorChanges
from aeroloop.service.daemon.telemetry import telemetry_of
from aeroloop.service.daemon.tick_source import PlantTick, TickSource

STATUS_PERIOD_NS: Final = 1_000_000_000
CLAIM_PERIOD_S: Final = 0.25
LOCKSTEP_PATIENCE_S: Final = 2.0
"""Longest wait for the first measurement in lockstep [s]; between steps a plant may pause for any time."""
WAIT_S: Final = 0.02
"""How often the session is checked while nothing is received [s]."""
STATUSES: Final = 4
"""Statuses of the plant that wait to be read; the newest of more."""
READ_S: Final = 0.01
"""How often they are read [s]."""
STALL_TICKS: Final = 10
"""Ticks missed in a row that cause a warning."""

State, Trigger = ControllerState, ControllerTrigger


class Daemon:
    """The controller end as a process. The role's name must be unique: the plant identifies its holder by it.

    Raises:
        LawError: The law cannot be used.
        PluginError: There is no such law.
    """

    def __init__(
        self,
        role: Node,
        configured: Settings,
    ) -> None:
        loop, wire, law, reference = configured.loop, configured.wire, configured.law, configured.reference
        settings = configured.controller
        self._role = role
        self._clock = role.clock
        self._loop = loop
        self._wire = wire
        self._settings = settings
        self._new_controller: Callable[[], Controller] = lambda: Controller(wire, law, reference, loop.period)
        self._controller = self._new_controller()
        self._own_grid = settings.pace == "clock" and not loop.lockstep
        self._claims = ClaimClient(role, loop, wire, auto_arm=settings.auto_arm)
        self._trace = TraceWriter("controller", wire, secrets.randbits(64), round(loop.trace_s * 1e9))
        self._changes = OperatorChanges(
            role,
            law,
            reference,
            settings,
            self._trace,
            rolls=wire.actuators > 2,
            why_none=self._why_none,
        )
        self._machine = Machine(State.SEARCHING, CONTROLLER_TABLE)
        self._last_tick = loop.ticks(settings.duration_s) - 1 if settings.duration_s else None
        self._plant: Status | None = None
        self._plant_due = 0.0
        self._plants = 0  # how often a plant's token has appeared or disappeared
        self._granted = False  # whether the plant's status has ever named this session
        self._lost = ""
        self._link: ZenohLink | None = None  # of the session
        self._too_slow: float | None = None  # time of a tick beyond law_timeout_s, before it is a fault
        self._watch = LawWatch(role, f"law {law.kind}")
        self._ticks = self._sent = self._received = self._skipped = self._refused = self._saturated = self._stale = 0
        self._notes: list[str] = []
        self._timing: LoopTiming | None = None
        self._age = RollingHistogram(self._clock)
        self._status_due = 0
        self._shown: SessionRecord | None = None  # by the last status
        self._status_ticks = 0
        self._status_time = self._clock.monotonic()
        self._stale_s = settings.stale_s
        self._law_timeout_s = settings.law_timeout_s
        self._telemetry_every = max(1, round(loop.rate_hz / settings.telemetry_rate_hz))

    def run(self) -> None:
        """Run until the role's `stop` is set or `duration_s` of the law's time is over."""
        if not self._loop.lockstep:
            self._notes = prepare_process(self._loop)
            self._timing = LoopTiming(clock=self._clock)
        role, loop = self._role, self._loop
        role.declare("telemetry", self._settings.telemetry_rate_hz)
        role.declare("trace", batches_per_s(loop), lossless=loop.lockstep)
        operator_requests.serve(role, self._changes)
        role.serve("stand_down", Request, lambda _: self._stand_down)
        role.serve("recall", Request, lambda _: self._recall)
        role.serve("show", Request, lambda _: lambda: self._changes.record)
        self._plant_statuses = role.zenoh.declare_subscriber(
            topics.key("status", role.vehicle, role="plant"), RingChannel(STATUSES)
        )
        self._recorder = RecorderWatch(role)
        role.watch_token("plant", self._see_plant)
        role.announce()
        role.event("started", f"{role.name} looks for {role.vehicle}")
        if isinstance(self._controller.law, PythonLaw):
            self._watch.start()
        try:
            finished = False
            while not finished and not role.stop.is_set():
                link = self._claim() if self._may_claim() and self._machine.state is State.SEARCHING else None
                if link is None:
                    self._publish_when_due()
                    role.stop.wait(CLAIM_PERIOD_S)
                    role.take_inbox()
                    collect_garbage()
                    continue
                try:
                    finished = self._run(link)
                finally:
                    self._end(link)
                if not finished and self._last_tick is not None and not role.stop.is_set():
                    raise SessionLostError(
                        f"{self._lost} after {self._controller.tick_index + 1} ticks, so the run is over"
                        + ("" if self._loop.lockstep else "; a machine too busy for real time can run it in lockstep")
                    )
        finally:
            self._machine.fire(Trigger.STAND_DOWN)
            role.event("stopped", f"{role.name} stopped commanding")
            self._publish_status()

    def _run(self, link: ZenohLink) -> bool:
        """Run one session. True once the duration is over, False if the session was lost."""
        controller, changes, timing, lockstep = self._controller, self._changes, self._timing, self._loop.lockstep
        watch = self._watch
        source = TickSource(
            link, self._loop, self._wire, own_grid=self._own_grid, stale_s=self._stale_s, clock=self._clock
        )
        k, last = -1, self._clock.monotonic()
        while self._may_continue() and (self._last_tick is None or k < self._last_tick):
            now = source.next(min(WAIT_S, self._stale_s))
            if now is not None and now.fresh:
                last = self._clock.monotonic()
            elif (reason := self._is_lost(self._clock.monotonic() - last)) is not None:
                return self._lose(reason)
            if now is None:
                if lockstep:  # a plant may pause for any time, and a request does not wait for its next step
                    changes.between_ticks(k + 1)
                self._publish_trace_when_due()
                self._publish_when_due()
                continue
            if now.received_as is Received.LATE or now.tick == k:
                self._take_late(now)
                continue
            woke_ns = self._clock.monotonic_ns()
            changes.before_tick(now.tick, now.frame)
            if not self._may_continue():
                break
            watch.begun = self._clock.monotonic()
            command = controller.tick(now.frame, now.tick)
            took_s, watch.begun = self._clock.monotonic() - watch.begun, None
            if took_s > self._law_timeout_s and not lockstep:
                self._too_slow, command = took_s, None
            if command or (command is not None and lockstep):
                link.send(command)
            k = now.tick
            sent_ns = self._clock.monotonic_ns()
            if timing:
                timing.woke(now.due_ns, woke_ns)
            self._age.add(sent_ns - now.at_ns)
            self._record(now, command, sent_ns)
            self._account(command, now)
            collect_garbage()
            if timing:
                timing.done()
        return self._may_continue()

    def _take_late(self, late: PlantTick) -> None:
        """A late or malformed frame, which is no tick: its levels, if it has any, hold from the next tick on."""
        self._received += 1
        self._controller.hold(late.frame)
        if not late.fresh and late.received_as is Received.LATE:
            self._stale += 1
            text = f"measurements arrive {late.late_ns * 1e-6:.0f} ms later than the fastest: not answered"
            self._role.warn("stale", "fault", text, self._claims.session, late.tick)
        self._record(late, None, 0)

    def _record(self, now: PlantTick, command: bytes | None, sent_ns: int) -> None:
        """Add a row to the trace. A command that repeats the last one is silent, in lockstep too."""
        sent_as = Sent.NONE if command is None else Sent.FRAME if command else Sent.SILENT
        if command is None:
            sent_ns = 0
        tick = max(now.tick, 0)
        row = ControllerRow(tick, now.received_as, sent_as, now.at_ns, sent_ns, now.frame, command or b"")
        self._trace.row(row)
        self._publish_trace_when_due()

    def _publish_trace_when_due(self) -> None:
        now_ns = self._clock.monotonic_ns()
        if self._trace.due(now_ns):
            self._role.publish_bytes("trace", self._trace.take(now_ns, self._clock.time_ns()))
            self._trace.state = self._controller.state.model_dump(mode="json")

    def _may_continue(self) -> bool:
        return not self._role.stop.is_set() and self._machine.state not in (State.HOLDING, State.FAULTED)

    def _account(self, command: bytes | None, now: PlantTick) -> None:
        tick, session = now.tick, self._claims.session
        assert session is not None
        self._ticks += 1
        self._read_plant()
        if now.frame != UNCHANGED:
            self._received += 1
        self._skipped += now.missed
        if now.missed >= STALL_TICKS:
            self._role.warn("stall", "fault", f"{now.missed} ticks missed at once", session, tick)
        if command is not None:
            self._sent += command != UNCHANGED
        if command is not None or self._too_slow is not None:
            self._advance_state(tick)
        if self._controller.tick_index == tick and tick % self._telemetry_every == 0:
            self._role.publish("telemetry", telemetry_of(self._controller, session))
        self._publish_when_due()

    def _advance_state(self, tick: int) -> None:
        """Move the state machine after an answer."""
        before, session, role = self._machine.state, self._claims.session, self._role
        fault = self._controller.fault
        if self._too_slow is not None:
            fault = f"law {self._controller.law.settings.kind} took {self._too_slow:.3g} s for a tick"
            self._too_slow = None
        if fault is not None:
            self._machine.fire(Trigger.FAULT)
            self._lost = fault
            role.event("fault", f"{self._lost}: stopped commanding until `aeroloop op arm`", session, tick)
        elif self._controller.tick_index != tick:
            if before is not State.READY:
                self._machine.fire(Trigger.INVALID)
                role.warn("invalid", "fault", "no valid measurement: commands no valid value", session, tick)
        elif before is not State.RUNNING:
            self._machine.fire(Trigger.ANSWERED)
            if before is State.CLAIMED:
                by = ", its frames by datagrams" if self._claims.by_datagrams else ""
                role.event("claimed", f"{role.name} has {role.vehicle}{by}", session, tick)
        if self._machine.state is not before:
            self._status_due = 0

    # ── the session ──

    def _may_claim(self) -> bool:
        return self._recorder.present or not self._settings.require_recorder

    def _claim(self) -> ZenohLink | None:
        if self._controller.tick_index >= 0:  # created before the claim, because ticks start with the grant
            self._refused += self._controller.refused
            self._saturated += self._controller.saturated
            self._controller = self._new_controller()
        self._link = link = self._claims.claim()
        if link is None:
            return None
        session = self._claims.session
        assert session is not None
        self._granted = False
        self._machine.fire(Trigger.GRANT)
        self._status_due = 0
        self._trace.session = session
        self._trace.state = self._controller.state.model_dump(mode="json")
        self._changes.begin(self._controller, session, self._claims.last)
        return link

    def _is_lost(self, silent_s: float) -> str | None:
        """Why the session is lost, if it is: the plant has ended it, is gone, or has been silent for too long."""
        plant = self._read_plant()
        if plant is not None and self._granted and plant.session != self._claims.session:
            return f"the plant ended the session{': ' + plant.cause if plant.cause else ''}"
        # In lockstep a granted plant may pause between steps: it is lost only when its session ends or it is gone.
        patience = LOCKSTEP_PATIENCE_S if self._loop.lockstep and not self._granted else self._stale_s
        if silent_s > patience and not (self._loop.lockstep and self._granted and plant is not None):
            return f"no measurement for {silent_s * 1e3:.0f} ms"
        return None

    def _lose(self, reason: str) -> bool:
        self._machine.fire(Trigger.LOST)
        self._lost = reason
        text = f"{reason}: stopped commanding, looking for {self._role.vehicle}"
        self._role.event("lost", text, self._claims.session, self._last_computed)
        return False

    def _end(self, link: ZenohLink) -> None:
        if self._timing:
            self._timing.pause()
        self._changes.end()
        self._role.publish_bytes(
            "trace", self._trace.take(self._clock.monotonic_ns(), self._clock.time_ns(), final=True)
        )
        self._claims.release()
        link.close()
        self._link, self._refused = None, self._refused + link.refused
        if self._claims.by_datagrams:
            self._role.datagrams.close()  # the next claim connects anew: the plant may be another one
        self._status_due = 0

    def _see_plant(self, appeared: bool) -> None:
        self._plants += 1
        if not appeared:
            while self._plant_statuses.try_recv() is not None:  # its last ones
                pass
            self._plant = None

    def _read_plant(self) -> Status | None:
        """The plant's newest status; None before the first, and once the plant is gone. Reads what came, at times."""
        now, plants = self._clock.monotonic(), self._plants
        if now < self._plant_due:
            return self._plant
        self._plant_due = now + READ_S
        for _ in range(STATUSES):
            if (sample := self._plant_statuses.try_recv()) is None:
                break
            try:
                plant = Status.decode(sample.payload.to_bytes(), extra="ignore")
            except MessageError:
                self._role.warn("plant's status", "fault", "the plant's status cannot be read: another version?")
                continue
            if plants == self._plants:
                self._plant = plant
            self._granted = self._granted or plant.session == self._claims.session is not None
        return self._plant

    # ── an operator's requests, taken between ticks ──

    def _why_none(self) -> str:
        """Why no session runs, and what to do."""
        name, vehicle, state = self._role.name, self._role.vehicle, self._machine.state
        if state in (State.FAULTED, State.HOLDING):
            return f"{name} is {state}: {self._lost}; `aeroloop op arm` lets it claim {vehicle} again"
        return f"{name} does not have {vehicle}"

    def _stand_down(self) -> Answer:
        name, vehicle = self._role.name, self._role.vehicle
        if self._claims.session is None:
            return Answer(done=False, text=self._why_none())
        self._machine.fire(Trigger.STAND_DOWN)
        self._lost = "released by an operator"
        text = f"{self._lost}: {name} holds until `aeroloop op arm`"
        self._role.event("released", text, self._claims.session, self._last_computed)
        return Answer(done=True, text=f"{name} releases {vehicle} and holds until `aeroloop op arm`")

    def _recall(self) -> Answer:
        if self._machine.state not in (State.HOLDING, State.FAULTED):
            return Answer(done=False, text=f"{self._role.name} is {self._machine.state}")
        self._machine.fire(Trigger.RECALL)
        return Answer(done=True, text=f"{self._role.name} looks for {self._role.vehicle} again")

    @property
    def _last_computed(self) -> int | None:
        """The last tick that was answered; None before the first."""
        return self._controller.tick_index if self._controller.tick_index >= 0 else None

    def _lacks_recorder(self) -> Literal["gone", "required"] | None:
        if self._recorder.gone:
            return "gone"
        return "required" if self._settings.require_recorder and not self._recorder.present else None

    # ── publications ──

    def _publish_when_due(self) -> None:
        if self._clock.monotonic_ns() >= self._status_due or self._shown is not self._changes.record:
            self._publish_status()

    def _publish_status(self) -> None:
        now = self._clock.monotonic()
        self._shown = record = self._changes.record
        self._claims.keep(record)
        self._age.turn_when_due()
        self._role.status(
            Status(
                role=self._role.role,
                state=self._machine.state,
                session=self._claims.session,
                cause=self._lost if self._machine.state is State.FAULTED else None,
                uptime_s=self._role.uptime_s,
                ticks=self._ticks,
                rate_hz=(self._ticks - self._status_ticks) / (now - self._status_time),
                skipped=self._skipped,
                received=self._received,
                sent=self._sent,
                refused=self._refused
                + self._controller.refused
                + self._changes.setpoints.refused
                + (self._link.refused if self._link else 0),
                stale=self._stale,
                saturated=self._saturated + self._controller.saturated,
                age_us=summary(self._age.recent()),
                timing=report(self._timing) if self._timing else None,
                notes=self._notes,
                lacks_recorder=self._lacks_recorder(),
                gains=record.gains,
                gains_from=record.gains_from,
                reference=in_words(record.reference),
                reference_from=record.reference_from,
            )
        )
        self._status_ticks, self._status_time = self._ticks, now
        self._status_due = self._clock.monotonic_ns() + STATUS_PERIOD_NS
