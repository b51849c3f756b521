"""Operator changes: gains and reference that an operator sets while the controller runs.

Requests arrive in Zenoh's threads. Slow checks run there; what touches the controller is queued for the loop, which
takes it between two ticks. Every change is in the trace with the tick from which it holds, so that a log can be
computed again. The next session starts with the gains and the reference of the last.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import degrees, radians
from typing import Any, Final

import zenoh
from pydantic import ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Answer, Change, Gains, Hold, Points, Reference, Setpoint, Stream, Track
from aeroloop.protocol.messages.trace import TraceWriter
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.wire.attitude import distance, to_euler
from aeroloop.protocol.wording import problems
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.law import LawSettings
from aeroloop.service.control.reference import FollowError, Limits, Plan
from aeroloop.service.daemon.certificate_gate import CertificateGate, gains_of
from aeroloop.service.settings import ControllerSettings

START_S: Final = 1.0
"""Least time to reach a reference that is far away when a session begins [s]."""


def _action_text(reference: Reference) -> str:
    match reference:
        case Hold(attitude=None):
            return "comes to rest"
        case Hold(attitude=(roll, pitch, yaw)):
            return f"turns to roll {roll:g}°, pitch {pitch:g}°, yaw {yaw:g}°"
        case Points(times=times):
            return f"follows {len(times)} points over {times[-1]:g} s, from the first of them"
        case Stream(timeout_s=timeout_s):
            return f"follows what streams on `reference`, silent for {timeout_s:g} s at the most; at rest"
        case _:
            return f"follows a {reference.kind}, reached"


class OperatorChanges:
    """Gains and reference of one controller, and their changes.

    Args:
        role: Its presence on the network.
        law: The initial gains.
        reference: The initial reference.
        settings: Limits of references.
        trace: Where changes are recorded.
        gate: Certificates; None requires and publishes none.
        rolls: Whether the vehicle can roll.

    Attributes:
        refused: Malformed set-points so far.
    """

    def __init__(
        self,
        role: Role,
        law: LawSettings,
        reference: Reference,
        settings: ControllerSettings,
        trace: TraceWriter,
        gate: CertificateGate | None = None,
        *,
        rolls: bool,
    ) -> None:
        self._role = role
        self._trace = trace
        self._gate = gate
        self._rolls = rolls
        self._gains = gains_of(law)
        self._reference: Reference = reference
        self._adopted = self._gains, reference
        self._controller: Controller | None = None
        self._session = ""
        self._k = 0
        self._started_near = True
        self._stream = reference if isinstance(reference, Stream) else None
        self._last_setpoint_s = 0.0
        self._setpoint: tuple[Hold, Plan] | None = None  # the newest, not yet taken by a tick
        self.refused = 0
        self.configure(settings)

    def configure(self, settings: ControllerSettings) -> None:
        """Take over limits."""
        self._settings = settings
        self._limits = Limits(settings.max_reference_rate, radians(settings.max_reference_tilt_deg), self._rolls)

    def serve(self) -> None:
        """Serve operators' queries and set-points."""
        role = self._role
        role.serve("set_gains", Gains, lambda gains: GainsChange(self, gains).prepare())
        role.serve("track", Track, lambda track: ReferenceChange(self, track).prepare())
        role.zenoh.declare_subscriber(topics.key("reference", role.vehicle), self._receive_setpoint)

    def prospect(self, law: LawSettings, reference: Reference) -> tuple[Gains, Reference]:
        """The gains and the reference after `adopt`, without adopting."""
        (gains, configured), new = self._adopted, gains_of(law)
        return new if new != gains else self._gains, reference if reference != configured else self._followed

    def adopt(self, law: LawSettings, reference: Reference) -> None:
        """Take over the gains and the reference that changed in a reloaded configuration; others stay as they are."""
        (gains, configured), self._adopted = self._adopted, (gains_of(law), reference)
        if gains_of(law) != gains:
            self._gains = gains_of(law)
            if self._controller is not None:
                self.set_gains(self._gains)
        if reference != configured:
            if self._controller is None:
                self._reference = reference
                self._stream = reference if isinstance(reference, Stream) else None
            else:
                try:
                    self.follow(reference, self.plan(reference), Track(reference=reference).within_s)
                except FollowError as error:
                    self._role.event("fault", f"the configured reference is not followed: {error}", self._session)
        self.certify()

    # ── in the loop ──

    def begin(self, controller: Controller, session: str) -> None:
        """Begin a session with the present gains and reference; a stream starts at its last set-point."""
        self._controller, self._session = controller, session
        controller.set_gains(self._gains)
        controller.motion.follow(Plan.of(self._reference), 0.0, 0.0)
        self._started_near = False
        self._trace.changes.append(Change(session=session, tick=0, gains=self._gains, reference=self._reference))

    def end(self) -> None:
        """End the session."""
        self._controller = None

    def before_tick(self, k: int, frame: bytes) -> None:
        """Apply the changes received since the last tick, from tick k on. The frame is the measurement of that tick."""
        self._k = k
        if not self._started_near:
            self._start_near(frame)
        self._role.take_inbox()
        if self._stream is not None:
            self._follow_stream(self._stream)

    def _start_near(self, frame: bytes) -> None:
        """Start the reference at the body's attitude and approach from there, if the body is far from it.

        A session that was lost in flight begins again with the reference's time at 0; a jump there would hold the
        motors at their limit until the plant trips.
        """
        controller = self._running()
        attitude = controller.attitude_of(frame)
        if attitude is None:
            return
        self._started_near = True
        roll, pitch, yaw = (degrees(angle) for angle in to_euler(attitude))
        start = (roll if self._rolls else 0.0, pitch, yaw)
        target, t = Plan.of(self._reference), self._time
        away = degrees(distance(attitude, controller.motion.attitude(t)))
        if away <= self._settings.start_within_deg:
            return
        within_s, _ = controller.motion.time_to_reach(target, t, START_S, self._limits, start)
        controller.motion.follow(target, t, within_s, start=start)
        self._record(reference=self._reference, within_s=within_s, start=start)
        text = f"begins {away:.0f}° away from its reference: approaches within {within_s:.1f} s"
        self._role.event("changed", text, self._session, self._k)

    # ── requests ──

    def admit(self, gains: Gains | None = None, reference: Reference | None = None) -> None:
        """Check a change against the certificate, where one is required; what is None stays as it is.

        Raises:
            FollowError: No session runs.
            UncertifiedError: The theorem would not hold.
        """
        self._running()
        changed = {name: value for name, value in gains or () if value is not None}
        if self._gate is not None:
            self._gate.admit(self._gains.model_copy(update=changed), reference or self._followed)

    def certify(self) -> None:
        """Publish the certificate of the present gains and reference."""
        if self._gate is not None:
            self._gate.take(self._gains, self._followed)

    @property
    def _followed(self) -> Reference:
        """The reference to certify: the stream itself, not its last set-point."""
        return self._stream or self._reference

    def set_gains(self, gains: Gains) -> Answer:
        """Use other gains from this tick on."""
        controller = self._running()
        controller.set_gains(gains)
        self._gains = controller.gains
        self._record(gains=gains)
        text = ", ".join(f"{name} = {list(value)}" for name, value in gains if value is not None)
        self._role.event("changed", f"gains set: {text or 'nothing'}", self._session, self._k)
        return Answer(done=True, text=f"{self._role.vehicle}: {text or 'no gain was given, so none has changed'}")

    def plan(self, reference: Reference) -> Plan:
        """Plan a reference and check it against the limits, which takes time. Raises FollowError beyond them."""
        plan = Plan.of(reference)
        plan.check(self._limits)
        return plan

    def follow(self, reference: Reference, plan: Plan, within_s: float) -> Answer:
        """Follow a planned reference from this tick on."""
        controller, target, t = self._running(), plan, self._time
        held = reference
        if isinstance(reference, Stream) or (isinstance(reference, Hold) and reference.attitude is None):
            held = controller.motion.rest(t, within_s)
            target = Plan.of(held)
        controller.motion.follow(target, t, within_s, self._limits)
        self._reference = held
        self._stream = reference if isinstance(reference, Stream) else None
        self._setpoint = None  # of the previous stream
        self._last_setpoint_s = time.monotonic()
        self._record(reference=held, within_s=within_s)
        text = f"{_action_text(reference)} within {within_s:g} s"
        self._role.event("changed", text, self._session, self._k)
        return Answer(done=True, text=f"{self._role.vehicle} {text}")

    def _receive_setpoint(self, sample: zenoh.Sample) -> None:
        """Receive a set-point of a stream; the newest wins."""
        if self._stream is None:
            return
        try:
            hold = Hold(attitude=Setpoint.model_validate_json(sample.payload.to_bytes()).attitude)
            plan = self.plan(hold)
        except (ValidationError, FollowError) as error:
            self._refuse(error)
            return
        self._setpoint = hold, plan

    def _follow_stream(self, stream: Stream) -> None:
        now = time.monotonic()
        if self._setpoint is None:
            if self._last_setpoint_s and now - self._last_setpoint_s > stream.timeout_s:
                self._last_setpoint_s = 0.0
                text = f"no set-point for {stream.timeout_s:g} s: holds the last one"
                self._role.event("lost", text, self._session, self._k)
            return
        (hold, plan), self._setpoint, self._last_setpoint_s = self._setpoint, None, now
        motion, t = self._running().motion, self._time
        within_s, ease_s = motion.time_to_reach(plan, t, stream.within_s, self._limits)
        try:
            motion.follow(plan, t, within_s, self._limits, ease_s=ease_s)
        except FollowError as error:
            self._refuse(error)
            return
        self._reference = hold
        self._record(reference=hold, within_s=within_s, ease_s=ease_s)

    def _refuse(self, error: Exception) -> None:
        self.refused += 1
        why = problems(error, Setpoint)[0] if isinstance(error, ValidationError) else str(error)
        self._role.warn("set-point", "fault", f"set-point refused: {why}", self._session)

    @property
    def _time(self) -> float:
        return self._k * self._running().period

    def _running(self) -> Controller:
        if self._controller is None:
            raise FollowError(f"{self._role.name} does not have {self._role.vehicle}, so there is nothing to change")
        return self._controller

    def _record(self, **change: Any) -> None:
        self._trace.changes.append(Change(session=self._session, tick=self._k, **change))


class GainsChange:
    """An operator's new gains. `prepare` runs in any thread, `apply` between two ticks.

    Args:
        changes: The changes of the controller.
        gains: The gains; None where one stays.
    """

    def __init__(self, changes: OperatorChanges, gains: Gains) -> None:
        self._changes, self._gains = changes, gains

    def prepare(self) -> Callable[[], Answer]:
        """Check the gains, which may take time. Raises FollowError or UncertifiedError where they are refused."""
        self._changes.admit(gains=self._gains)
        return self.apply

    def apply(self) -> Answer:
        """Use the gains from this tick on."""
        self._changes.admit(gains=self._gains)  # cached, unless more has changed since
        answer = self._changes.set_gains(self._gains)
        self._changes.certify()
        return answer


class ReferenceChange:
    """An operator's new reference. `prepare` runs in any thread, `apply` between two ticks.

    Args:
        changes: The changes of the controller.
        track: The reference, and in what time to reach it.
    """

    def __init__(self, changes: OperatorChanges, track: Track) -> None:
        self._changes, self._track = changes, track

    def prepare(self) -> Callable[[], Answer]:
        """Plan and check the reference, which takes time. Raises FollowError or UncertifiedError if it is refused."""
        self._plan = self._changes.plan(self._track.reference)
        self._changes.admit(reference=self._track.reference)
        return self.apply

    def apply(self) -> Answer:
        """Follow the reference from this tick on."""
        self._changes.admit(reference=self._track.reference)
        answer = self._changes.follow(self._track.reference, self._plan, self._track.within_s)
        self._changes.certify()
        return answer
