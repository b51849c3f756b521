"""What may change while the controller runs: its gains and its reference, at an operator's word.

Requests come in threads of Zenoh's. What takes time is done there; what touches the controller waits for the loop,
which takes it between two ticks. Every change is in the trace with the tick from which it holds, so that a log can be
computed again, and the next session starts with what the last one ended with.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import degrees, radians
from typing import Final

import zenoh
from pydantic import ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.operator import Answer, Change, Gains, Hold, Points, Reference, Setpoint, Stream, Track
from aeroloop.protocol.messages.trace import TraceWriter
from aeroloop.protocol.runtime.role import Role
from aeroloop.protocol.wire.attitude import Vector, distance, to_euler
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.law import LawSettings
from aeroloop.service.control.reference import FollowError, Limits, Plan
from aeroloop.service.daemon.certificate_gate import CertificateGate, gains_of
from aeroloop.service.settings import ControllerSettings

START_S: Final = 1.0
"""The least time for the way to a reference that is far when a session begins [s]."""


def _described(reference: Reference) -> str:
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
    """Gains and reference of one controller, and how they change.

    Args:
        role: Its presence on the network.
        law: The gains to begin with.
        reference: The reference to begin with.
        settings: How far a reference may go.
        trace: Where changes are written down.
        assurance: What the theorem promises of it; nobody asks if None.
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
        assurance: CertificateGate | None = None,
        *,
        rolls: bool,
    ) -> None:
        self._role = role
        self._trace = trace
        self._assurance = assurance
        self._rolls = rolls
        self._gains = gains_of(law)
        self._reference: Reference = reference
        self._adopted = self._gains, reference
        self._controller: Controller | None = None
        self._session = ""
        self._k = 0
        self._placed = True
        self._stream = reference if isinstance(reference, Stream) else None
        self._heard = 0.0
        self._setpoint: tuple[Hold, Plan] | None = None  # the newest that no tick has taken yet
        self.refused = 0
        self.configure(settings)

    def configure(self, settings: ControllerSettings) -> None:
        """Take other limits."""
        self._settings = settings
        self._limits = Limits(settings.max_reference_rate, radians(settings.max_reference_tilt_deg), self._rolls)

    def serve(self) -> None:
        """Listen to operators."""
        role = self._role
        role.serve("set_gains", Gains, self._asked_gains)
        role.serve("track", Track, self._asked_reference)
        role.zenoh.declare_subscriber(topics.key("reference", role.vehicle), self._streamed)

    def prospect(self, law: LawSettings, reference: Reference) -> tuple[Gains, Reference]:
        """The gains and the reference there would be after `adopt`."""
        (gains, configured), new = self._adopted, gains_of(law)
        return new if new != gains else self._gains, reference if reference != configured else self._followed

    def adopt(self, law: LawSettings, reference: Reference) -> None:
        """Take over what differs in a configuration that was read again; what it leaves alone stays as it is."""
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
                    self.track(reference, Track(reference=reference).within_s)()
                except FollowError as error:
                    self._role.event("fault", f"the configured reference is not followed: {error}", self._session)
        self._assure()

    # ── the loop's side ──

    def begin(self, controller: Controller, session: str) -> None:
        """A session begins with the gains and the reference of now; a stream waits where its last set-point was."""
        self._controller, self._session = controller, session
        controller.set_gains(self._gains)
        controller.motion.follow(Plan.of(self._reference), 0.0, 0.0)
        self._placed = False
        first = Change(session=session, tick=0, gains=self._gains, reference=self._reference)
        self._trace.changes.append(first)

    def end(self) -> None:
        """The session is over."""
        self._controller = None

    def before_tick(self, k: int, frame: bytes) -> None:
        """Take what came since the last tick; it holds from tick k on. The frame is the measurement of that tick."""
        self._k = k
        if not self._placed:
            self._place(frame)
        self._role.take_inbox()
        if self._stream is not None:
            self._follow_stream(self._stream)

    def _place(self, frame: bytes) -> None:
        """Where the body is far from its reference as a session begins, go there from where it is.

        A session that was lost in mid-flight begins again with the reference's own time from 0; to jump back there
        would hold the motors at their limit until the plant trips.
        """
        controller = self._running()
        attitude = controller.attitude_of(frame)
        if attitude is None:
            return
        self._placed = True
        roll, pitch, yaw = (degrees(angle) for angle in to_euler(attitude))
        start = (roll if self._rolls else 0.0, pitch, yaw)
        target, t = Plan.of(self._reference), self._time
        away = degrees(distance(attitude, controller.motion.attitude(t)))
        if away <= self._settings.start_within_deg:
            return
        within_s, _ = controller.motion.time_to_reach(target, t, START_S, self._limits, start)
        controller.motion.follow(target, t, within_s, start=start)
        self._tell(reference=self._reference, within_s=within_s, start=start)
        text = f"begins {away:.0f}° away from its reference: goes there within {within_s:.1f} s"
        self._role.event("changed", text, self._session, self._k)

    # ── what can be asked ──

    def _asked_gains(self, gains: Gains) -> Callable[[], Answer]:
        def act() -> Answer:
            self._admit(self._gains.model_copy(update=changed), self._followed)  # looked up, unless more has changed
            answer = self.set_gains(gains)
            self._assure()
            return answer

        self._running()
        changed = {name: value for name, value in gains if value is not None}
        self._admit(self._gains.model_copy(update=changed), self._followed)
        return act

    def _asked_reference(self, track: Track) -> Callable[[], Answer]:
        def act() -> Answer:
            self._admit(self._gains, track.reference)
            answer = follow()
            self._assure()
            return answer

        follow = self.track(track.reference, track.within_s)
        self._running()
        self._admit(self._gains, track.reference)
        return act

    def _admit(self, gains: Gains, reference: Reference) -> None:
        if self._assurance is not None:
            self._assurance.admit(gains, reference)

    def _assure(self) -> None:
        if self._assurance is not None:
            self._assurance.take(self._gains, self._followed)

    @property
    def _followed(self) -> Reference:
        """The reference of which the theorem is asked: a stream's set-points are not known beforehand."""
        return self._stream or self._reference

    def set_gains(self, gains: Gains) -> Answer:
        """Use other gains from this tick on."""
        controller = self._running()
        controller.set_gains(gains)
        self._gains = controller.gains
        self._tell(gains=gains)
        text = ", ".join(f"{name} = {list(value)}" for name, value in gains if value is not None)
        self._role.event("changed", f"gains set: {text or 'nothing'}", self._session, self._k)
        return Answer(done=True, text=f"{self._role.vehicle}: {text or 'no gain was given, so none has changed'}")

    def track(self, reference: Reference, within_s: float) -> Callable[[], Answer]:
        """Check a reference by itself, which takes time; what is returned makes the loop follow it."""
        plan = Plan.of(reference)
        plan.check(self._limits)

        def follow() -> Answer:
            controller, target, t = self._running(), plan, self._time
            held = reference
            if isinstance(reference, Stream) or (isinstance(reference, Hold) and reference.attitude is None):
                held = controller.motion.rest(t, within_s)
                target = Plan.of(held)
            controller.motion.follow(target, t, within_s, self._limits)
            self._reference = held
            self._stream = reference if isinstance(reference, Stream) else None
            self._setpoint = None  # of the stream before
            self._heard = time.monotonic()
            self._tell(reference=held, within_s=within_s)
            text = f"{_described(reference)} within {within_s:g} s"
            self._role.event("changed", text, self._session, self._k)
            return Answer(done=True, text=f"{self._role.vehicle} {text}")

        return follow

    def _streamed(self, sample: zenoh.Sample) -> None:
        """A set-point of a stream; the newest wins."""
        if self._stream is None:
            return
        try:
            hold = Hold(attitude=Setpoint.model_validate_json(sample.payload.to_bytes()).attitude)
            plan = Plan.of(hold)
            plan.check(self._limits)
        except (ValidationError, FollowError) as error:
            self._refuse(error)
            return
        self._setpoint = hold, plan

    def _follow_stream(self, stream: Stream) -> None:
        now = time.monotonic()
        if self._setpoint is None:
            if self._heard and now - self._heard > stream.timeout_s:
                self._heard = 0.0
                text = f"no set-point for {stream.timeout_s:g} s: holds the last one"
                self._role.event("lost", text, self._session, self._k)
            return
        (hold, plan), self._setpoint, self._heard = self._setpoint, None, now
        motion, t = self._running().motion, self._time
        within_s, ease_s = motion.time_to_reach(plan, t, stream.within_s, self._limits)
        try:
            motion.follow(plan, t, within_s, self._limits, ease_s=ease_s)
        except FollowError as error:
            self._refuse(error)
            return
        self._reference = hold
        self._tell(reference=hold, within_s=within_s, ease_s=ease_s)

    def _refuse(self, error: Exception) -> None:
        self.refused += 1
        self._role.warn("set-point", "fault", f"set-point refused: {str(error).splitlines()[0]}", self._session)

    @property
    def _time(self) -> float:
        return self._k * self._running().period

    def _running(self) -> Controller:
        if self._controller is None:
            raise FollowError(f"{self._role.name} does not have {self._role.vehicle}, so there is nothing to change")
        return self._controller

    def _tell(
        self,
        *,
        gains: Gains | None = None,
        reference: Reference | None = None,
        within_s: float = 0.0,
        ease_s: float = 0.0,
        start: Vector | None = None,
    ) -> None:
        change = Change(
            session=self._session,
            tick=self._k,
            gains=gains,
            reference=reference,
            within_s=within_s,
            ease_s=ease_s,
            start=start,
        )
        self._trace.changes.append(change)
