"""Controller process: claims a vehicle, runs the session, and claims again when it is lost, until it is stopped.

Without a session the daemon claims four times a second, so either end may start first and either may be restarted. Its
status is published once a second, and with every change of state, gains or reference.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Final, Literal

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import SessionRecord, Status
from aeroloop.protocol.messages.operator import Answer, MessageError, Request, in_words
from aeroloop.protocol.messages.states import ControllerState as State
from aeroloop.protocol.messages.states import ControllerTrigger as Trigger
from aeroloop.protocol.runtime.node import ASKED_BY, Node, RecorderWatch
from aeroloop.protocol.runtime.realtime import collect_garbage, prepare_process
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import PythonLaw
from aeroloop.service.daemon.claim import ANSWER_WAIT_S, SessionLostError
from aeroloop.service.daemon.session import Session, Shared

STATUS_PERIOD_S: Final = 1.0
CLAIM_PERIOD_S: Final = 0.25


class Daemon:
    """The controller end as a process. Raises as `law_of`."""

    def __init__(self, role: Node, settings: Settings) -> None:
        self._role, self._clock, self._settings = role, role.clock, settings
        self._next: Controller | None = self._new_controller()  # of the next session
        self._session: Session | None = None
        self._shared = Shared(role, settings, self._why_none)
        self._notes: list[str] = []
        self._status_due_s = 0.0
        self._status_time_s = self._clock.monotonic()
        self._status_ticks = 0
        self._shown: tuple[State, SessionRecord] | None = None  # by the last status

    def run(self) -> None:
        """Run until the role's `stop` is set or `duration_s` of the law's time is over."""
        role, loop, machine, own = self._role, self._settings.loop, self._shared.machine, self._settings.controller
        if not loop.lockstep:
            self._notes = prepare_process(loop)
        role.declare("telemetry")
        role.declare("trace", lossless=loop.lockstep)
        self._shared.changes.serve()
        role.serve("stand_down", Request, lambda _: self._stand_down)
        role.serve("recall", Request, lambda _: self._recall)
        role.serve("forward_stop", Request, self._forward_stop)
        self._recorder = RecorderWatch(role)
        role.watch_token("plant", self._shared.plant.see)
        role.announce()
        role.event("started", f"{role.name} looks for {role.vehicle}")
        if self._next is not None and isinstance(self._next.law, PythonLaw):
            self._shared.watch.start()
        try:
            finished = False
            while not finished and not role.stop.is_set():
                may_claim = self._recorder.present or not own.require_recorder
                self._session = session = self._claim() if may_claim and machine.state is State.SEARCHING else None
                if session is None:
                    self._publish_when_due()
                    role.stop.wait(CLAIM_PERIOD_S)
                    role.take_inbox()
                    collect_garbage()
                    continue
                try:
                    finished = session.run()
                finally:
                    self._session = None
                    session.end()
                if not finished and own.duration_s and not role.stop.is_set():
                    ticks = session.controller.tick_index + 1
                    text = f"{self._shared.cause} after {ticks} ticks, so the run is over"
                    if machine.state is State.SEARCHING and not loop.lockstep:  # lost, not faulted, stopped or released
                        text += "; a machine too busy for real time can run it in lockstep"
                    raise SessionLostError(text)
        finally:
            machine.fire(Trigger.STAND_DOWN)
            role.event("stopped", f"{role.name} stopped commanding")
            self._publish_status()

    # ── sessions ──

    def _new_controller(self) -> Controller:
        settings = self._settings
        return Controller(settings.wire, settings.law, settings.reference, settings.loop.period)

    def _claim(self) -> Session | None:
        """Claim the vehicle. The controller is made before the claim, because ticks start with the grant."""
        controller = self._next = self._next or self._new_controller()
        link = self._shared.claims.claim()
        if link is None:
            return None
        self._next = None
        return Session(self._role, self._settings, self._shared, controller, link, self._publish_when_due)

    # ── an operator's requests, taken between ticks ──

    def _why_none(self) -> str:
        """Why no session runs, and what to do."""
        name, vehicle, state = self._role.name, self._role.vehicle, self._shared.machine.state
        if state in (State.FAULTED, State.HOLDING):
            return f"{name} is {state}: {self._shared.cause}; `aeroloop op arm` lets it claim {vehicle} again"
        refusal = self._shared.claims.refusal
        return f"{name} does not have {vehicle}" + (f", which refuses: {refusal}" if refusal else "")

    def _stand_down(self) -> Answer:
        name, session = self._role.name, self._session
        if session is None:
            return Answer(done=False, text=self._why_none())
        self._shared.machine.fire(Trigger.STAND_DOWN)
        self._shared.cause = "released by an operator"
        text = f"released by an operator: {name} holds until `aeroloop op arm`"
        self._role.event("released", text, session.name, session.last_answered)
        return Answer(done=True, text=f"{name} releases {self._role.vehicle} and holds until `aeroloop op arm`")

    def _recall(self) -> Answer:
        if self._shared.machine.state not in (State.HOLDING, State.FAULTED):
            return Answer(done=False, text=f"{self._role.name} is {self._shared.machine.state}")
        self._shared.machine.fire(Trigger.RECALL)
        return Answer(done=True, text=f"{self._role.name} looks for {self._role.vehicle} again")

    def _forward_stop(self, request: Request) -> Answer:
        """Pass an operator's stop on to the plant, which no new link of the operator's own may reach.

        Waits for the answer in the topic's thread, not in the loop. Only operators may ask for it, by the access rules.
        """
        key, vehicle = topics.key("forwarded_stop", self._role.vehicle), self._role.vehicle
        answer = Answer(done=False, text=f"no plant of {vehicle} answers {self._role.name}")
        for reply in self._role.zenoh.get(
            key, payload=request.encode(), attachment=ASKED_BY.get(), timeout=ANSWER_WAIT_S
        ):
            with suppress(MessageError):
                if reply.ok is not None:
                    answer = Answer.decode(reply.ok.payload.to_bytes(), extra="ignore")
        return answer

    # ── status ──

    def _publish_when_due(self) -> None:
        shown = self._shown
        record, state = self._shared.changes.record, self._shared.machine.state
        changed = shown is None or shown[0] is not state or shown[1] is not record
        if changed or self._clock.monotonic() >= self._status_due_s:
            self._publish_status()

    def _publish_status(self) -> None:
        now, shared, counts, session = self._clock.monotonic(), self._shared, self._shared.counts, self._session
        record, state = shared.changes.record, shared.machine.state
        self._shown = state, record
        self._shared.claims.keep(record)
        refused = counts.refused + shared.changes.refused + (session.refused if session else 0)
        self._role.status(Status(
            role=self._role.role, state=state, session=shared.claims.session,
            cause=shared.cause if state is State.FAULTED else None, uptime_s=self._role.uptime_s,
            ticks=counts.ticks, rate_hz=(counts.ticks - self._status_ticks) / max(now - self._status_time_s, 1e-3),
            skipped=counts.skipped, received=counts.received, sent=counts.sent, refused=refused, stale=counts.stale,
            saturated=counts.saturated + (session.controller.saturated if session else 0),
            age_us=shared.age.recent(), timing=shared.timing.report() if shared.timing else None,
            notes=self._notes, lacks_recorder=self._lacks_recorder(), gains=record.gains, gains_from=record.gains_from,
            reference=in_words(record.reference), reference_from=record.reference_from,
        ))  # fmt: skip
        self._status_ticks, self._status_time_s = counts.ticks, now
        self._status_due_s = self._clock.monotonic() + STATUS_PERIOD_S

    def _lacks_recorder(self) -> Literal["gone", "required"] | None:
        if self._recorder.gone:
            return "gone"
        return "required" if self._settings.controller.require_recorder and not self._recorder.present else None
