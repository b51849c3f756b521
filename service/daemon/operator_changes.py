"""Operator changes: gains and reference of the running controller, and what sets them.

An operator's request, a stream's set-point or the start of a session. What touches the
controller runs in the loop, between two ticks. Every change is in the trace with the tick from which it holds, so that
a log can be computed again. `controller.after_restart` decides what a session begins with; the plant gets a record of
both, for the controller after this one.
"""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, pi, radians
from typing import Any, Final

from aeroloop.protocol.messages.models import SessionRecord, Source
from aeroloop.protocol.messages.operator import (
    Change,
    Gains,
    Hold,
    Points,
    Reference,
    Stream,
    in_words,
)
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import TraceWriter
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.wire.attitude import distance
from aeroloop.service.control.approach import Approach, nearest_turn
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import LawError, gains_of, with_gains
from aeroloop.service.control.reference import FollowError, Limits, Plan
from aeroloop.service.daemon.session_start import found, remaining
from aeroloop.service.daemon.setpoint_stream import SetpointStream
from aeroloop.service.settings import ControllerSettings

START_S: Final = 1.0
"""Least time to reach a reference that no operator gave a time for, at a session's start [s]."""


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
        rolls: Whether the vehicle can roll.
        why_none: Says why no session runs and what to do, where none does.

    Attributes:
        record: Gains and reference now, of the next session if none runs; a new object with every change, not with
            every set-point of a stream.
        configured: The configured reference.
        setpoints: What an operator streams.
    """

    record: SessionRecord

    def __init__(
        self,
        role: Node,
        law: LawSettings,
        reference: Reference,
        settings: ControllerSettings,
        trace: TraceWriter,
        *,
        rolls: bool,
        why_none: Callable[[], str],
    ) -> None:
        self._role = role
        self._why_none = why_none
        self.setpoints = SetpointStream(role)
        self._trace = trace
        self._rolls = rolls
        self._law = law
        self._gains = gains_of(law)
        self._reference: Reference = reference
        self.configured = reference
        self._controller: Controller | None = None
        self._session = ""
        self._k = 0
        self._started_near = True
        self._stream = reference if isinstance(reference, Stream) else None
        self._gains_from: Source = "configured"
        self._reference_from: Source = "configured"
        self._approach = Approach()
        self._since_tick = self._gains_since_tick = 0
        self._last: SessionRecord | None = None  # this controller's own last session
        self._settings = settings
        self._limits = Limits(
            rate=settings.max_reference_rate,
            braking=settings.max_reference_braking,
            tilt=radians(settings.max_reference_tilt_deg),
            rolls=rolls,
        )
        if settings.after_restart != "configured":
            self._hold()
        self._note()

    # ── in the loop ──

    def begin(self, controller: Controller, session: str, last: SessionRecord | None = None) -> None:
        """Begin a session as configured; `last` is the plant's record. A stream starts at its last set-point."""
        self._controller, self._session = controller, session
        self.setpoints.session = session
        self._k = self._since_tick = self._gains_since_tick = 0
        if self._settings.after_restart == "resume":
            self._resume(last or self._last)
        controller.set_gains(self._gains)
        controller.motion.follow(Plan.of(self._reference), 0.0)
        self._started_near = False
        self.setpoints.discard()
        self._trace.changes.append(Change(session=session, tick=0, gains=self._gains, reference=self._reference))
        self._note()

    def end(self) -> None:
        """End the session."""
        self._last = self.record.model_copy(update={"ended_tick": self._k})
        self._controller = None
        if self._settings.after_restart == "hold":
            self._hold()
        self._note()

    def _resume(self, last: SessionRecord | None) -> None:
        """Take up the gains of the last session and, unless an operator stopped it since, its reference."""
        self._hold()
        if last is None:
            return
        reference = remaining(last, self._running().period)
        try:
            self.plan(reference)
            with_gains(self._law, last.gains)
            gains = last.gains.over(self._gains)
        except (FollowError, LawError) as error:
            self._role.event("fault", f"the last session is not resumed: {error}", self._session)
            return
        self._gains, self._gains_from = gains, "resumed"
        if last.ended is TripCause.OPERATOR or reference == Hold():
            return
        if isinstance(reference, Stream):
            self._stream, self._reference_from = reference, "resumed"
        else:
            self._begin_with(reference, "resumed")
        self._approach = Approach(last.within_s)

    def _hold(self) -> None:
        """Begin the next session with the attitude found."""
        self._begin_with(Hold(), "held")

    def _begin_with(self, reference: Reference, source: Source) -> None:
        self._reference, self._reference_from, self._approach = reference, source, Approach()
        self._stream = reference if isinstance(reference, Stream) else None

    def before_tick(self, k: int, frame: bytes) -> None:
        """Apply the changes received since the last tick, from tick k on. The frame is the measurement of that tick."""
        self._k = k
        if not self._started_near:
            self._start_near(frame)
        self._role.take_inbox()
        if self._stream is not None:
            self._follow_stream(self._stream)

    def between_ticks(self, k: int) -> None:
        """Apply the changes received while the plant pauses, from its next tick k on."""
        self._k = k
        self._role.take_inbox()

    def _start_near(self, frame: bytes) -> None:
        """Hold the attitude found, or approach the reference from there.

        A session that was lost in flight begins again with the reference's time at 0; a jump there would hold the
        motors at their limit until the plant trips. A configured reference that is near is followed at once.
        """
        controller = self._running()
        attitude = controller.attitude_of(frame)
        if attitude is None:
            return
        self._started_near = True
        start, t, source = found(attitude, rolls=self._rolls), self._time, self._reference_from
        if source != "configured" and self._reference == Hold():
            self._reference, approach = Hold(attitude=start), Approach(start=start)
            text = f"holds the attitude found, {in_words(self._reference)}; `aeroloop op track configured` moves it"
        else:
            away = degrees(distance(attitude, controller.motion.attitude(t)))
            if self._settings.after_restart == "configured" and away <= self._settings.start_within_deg:
                return
            target = Plan.of(self._reference)
            limits = self._limits._replace(tilt=pi)  # the body may have been found beyond its own limit
            approach = controller.motion.shortest(target, t, limits, nearest_turn(start, target))
            approach = approach.at_least(max(START_S, self._approach.within_s))
            text = f"begins {away:.0f}° away from its reference: approaches within {approach.within_s:.1f} s"
        controller.motion.follow(Plan.of(self._reference), t, approach)
        self._approach, self._since_tick = approach, self._k
        self._record(reference=self._reference, **approach._asdict())
        self._note()
        self._role.event("changed", text, self._session, self._k)

    # ── changes: admitted in any thread, applied between two ticks ──

    def admit(self, gains: Gains | None = None) -> None:
        """Raise FollowError if no session runs, or the law has no such gain or bounds it."""
        self._running()
        if gains is not None:
            try:
                with_gains(self._law, gains)
            except LawError as error:
                raise FollowError(str(error)) from None

    def set_gains(self, gains: Gains) -> str:
        """Use other gains from this tick on, in words; empty if there are none. No event if they change nothing."""
        controller = self._running()
        before = controller.gains
        controller.set_gains(gains)
        text = ", ".join(f"{name} = {list(value)}" for name, value in gains.named.items())
        if controller.gains != before:
            self._gains, self._gains_from, self._gains_since_tick = controller.gains, "operator", self._k
            self._record(gains=gains)
            self._note()
            self._role.event("changed", f"gains set: {text}", self._session, self._k)
        return text

    def plan(self, reference: Reference) -> Plan:
        """Plan a reference and check it against the limits, which takes time. Raises FollowError beyond them."""
        plan = Plan.of(reference)
        plan.check(self._limits)
        return plan

    def follow(
        self, reference: Reference, plan: Plan, within_s: float | None = None, source: Source = "operator"
    ) -> str:
        """Follow a planned reference from this tick on, reached in `within_s`; None for as long as it takes.

        Coming to rest takes as long as braking does. Returns in words what is done. Raises FollowError if `within_s` is
        too short.
        """
        motion, target, t = self._running().motion, plan, self._time
        held = reference
        if isinstance(reference, Stream) or (isinstance(reference, Hold) and reference.attitude is None):
            held = motion.rest(t, self._limits)
            target = Plan.of(held)
            within_s = None
        approach = motion.shortest(target, t, self._limits)
        approach = approach.at_least(START_S) if within_s is None else approach.lasting(within_s, self._limits)
        motion.follow(target, t, approach)
        self._reference, self._reference_from = held, source
        self._approach, self._since_tick = approach, self._k
        self._stream = reference if isinstance(reference, Stream) else None
        self.setpoints.begin()
        self._record(reference=held, **approach._asdict())
        self._note()
        text = f"{_action_text(reference)} within {approach.within_s:g} s"
        self._role.event("changed", text, self._session, self._k)
        return text

    def _follow_stream(self, stream: Stream) -> None:
        newest = self.setpoints.newest(stream, self._limits, self._k)
        if newest is None:
            return
        hold, plan = newest
        motion, t = self._running().motion, self._time
        try:
            approach = motion.to_set_point(plan, t, stream.within_s, self._limits)
        except FollowError as error:
            self.setpoints.refuse(error)
            return
        motion.follow(plan, t, approach)
        self._reference = hold
        self._record(reference=hold, **approach._asdict())

    @property
    def _time(self) -> float:
        return self._k * self._running().period

    def _running(self) -> Controller:
        if self._controller is None:
            raise FollowError(f"nothing to change: {self._why_none()}")
        return self._controller

    def _record(self, **change: Any) -> None:
        self._trace.changes.append(Change(session=self._session, tick=self._k, **change))

    def _note(self) -> None:
        """Make the record anew."""
        self.record = SessionRecord(
            controller=self._role.name,
            session=self._session if self._controller is not None else None,
            gains=self._gains,
            gains_from=self._gains_from,
            reference=self._stream or self._reference,
            reference_from=self._reference_from,
            since_tick=self._since_tick,
            gains_since_tick=self._gains_since_tick,
            **self._approach._asdict(),
        )
