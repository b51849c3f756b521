"""Operator changes: gains and reference of the running controller, by request, by a stream, and at a session's start.

A request is checked in a thread beside the loop; what touches the controller runs in the loop, between two ticks. Every
change is in the trace with the tick from which it holds, so that a log can be computed again. What a session begins
with is decided by `controller.after_restart`; the plant gets a record, for the controller after this one.
"""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, pi
from typing import Any, Final

from zenoh.handlers import RingChannel

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import SessionRecord, Source
from aeroloop.protocol.messages.operator import (
    Answer,
    Change,
    Gains,
    Hold,
    MessageError,
    Points,
    Reference,
    Request,
    Setpoint,
    Stream,
    Track,
    in_words,
)
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import TraceWriter
from aeroloop.protocol.runtime.node import Node
from aeroloop.protocol.wire.attitude import Quaternion, Vector, distance, to_euler
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.registry import LawError, gains_of, with_gains
from aeroloop.service.control.motion import START_WITHIN_DEG, Approach, shortest, shortest_from_rest, to_set_point
from aeroloop.service.control.reference import FollowError, Limits, Trajectory

START_S: Final = 1.0  # least time to reach a reference that no operator gave a time for, at a session's start [s]
SETPOINTS: Final = 4  # set-points of a stream that wait for a tick, the newest; only if it is refused, the one before
_DECIMALS: Final = 3  # of an attitude found [deg]: far finer than any level, and short to print


class OperatorChanges:
    """Gains and reference of one controller, and their changes, which are recorded in the trace.

    `record` has both as they are now, of the next session if none runs: a new object with every change, not with every
    set-point of a stream. `why_none` says why no session runs and what to do.
    """

    def __init__(self, role: Node, settings: Settings, trace: TraceWriter, why_none: Callable[[], str]) -> None:
        own, reference = settings.controller, settings.reference
        self._role, self._law, self._trace, self._why_none = role, settings.law, trace, why_none
        self._configured, self._after_restart = reference, own.after_restart
        self._limits = Limits.of(own, settings.wire.actuators)
        self._received = role.zenoh.declare_subscriber(topics.key("reference", role.vehicle), RingChannel(SETPOINTS))
        self._setpoint_s = 0.0  # when the stream last had a set-point, or began; 0 once its silence was an event
        self.refused = 0  # set-points so far, malformed or beyond the limits
        self._controller: Controller | None = None
        self._k = 0
        self._started_near = True
        self._present_reference: Reference = reference  # what the motion follows: of a stream, its last set-point
        self._last: SessionRecord | None = None  # this controller's own last session
        self.record = SessionRecord(
            controller=role.name, session=None, gains=gains_of(settings.law), gains_from="configured",
            reference=reference, reference_from="configured", within_s=0.0, since_tick=0,
        )  # fmt: skip
        if self._after_restart != "configured":
            self._begin_with(Hold(), "held")

    # ── requests: checked in their topic's thread, applied between two ticks ──

    def serve(self) -> None:
        """Serve `set_gains`, `track` and `show`."""
        self._role.serve("set_gains", Gains, self._prepare_gains)
        self._role.serve("track", Track, self._prepare_track)
        self._role.serve("show", Request, lambda _: self.record)

    def _prepare_gains(self, gains: Gains) -> Callable[[], Answer]:
        self._running()
        with_gains(self._law, gains)
        return lambda: self._set_gains(gains)

    def _prepare_track(self, track: Track) -> Callable[[], Answer]:
        source: Source = "configured" if track.reference is None else "operator"
        reference = track.reference or self._configured
        trajectory = Trajectory.of(reference)
        trajectory.check(self._limits)
        self._running()
        return lambda: self._track(reference, trajectory, track.within_s, source)

    def _set_gains(self, gains: Gains) -> Answer:
        controller = self._running()
        before = controller.gains
        controller.set_gains(gains)
        text = ", ".join(f"{name} = {list(value)}" for name, value in gains.named.items())
        if controller.gains != before:
            self._record_change(gains=gains)
            self._update_record(gains=controller.gains, gains_from="operator", gains_since_tick=self._k)
            self._role.event("changed", f"gains set: {text}", self.record.session, self._k)
        return Answer(done=True, text=f"{self._role.vehicle}: {text or 'no gain was given, so none has changed'}")

    def _track(self, reference: Reference, trajectory: Trajectory, within_s: float | None, source: Source) -> Answer:
        """Follow a checked reference from this tick on, reached in `within_s` [s]; None: as soon as the limits allow.

        Coming to rest takes as long as braking does, whatever is given.
        """
        motion, held, t = self._running().motion, reference, self._time
        if isinstance(reference, Stream) or reference == Hold():
            held = motion.rest(t, self._limits)
            trajectory = Trajectory.of(held)
            approach = shortest(trajectory, motion.here(t), self._limits).at_least(START_S)
        else:
            approach = shortest(trajectory, motion.here(t), self._limits)
            approach = approach.lasting(approach.within_s if within_s is None else within_s, self._limits)
        self._discard_setpoints()
        self._setpoint_s = self._role.clock.monotonic()
        words = in_words(reference if isinstance(reference, Stream) else held)
        text = f"follows {words} within {approach.within_s:.4g} s"
        self._approach(held, trajectory, approach, text, reference, source)
        return Answer(done=True, text=f"{self._role.vehicle} {text}")

    # ── a session's start and end ──

    def begin(self, controller: Controller, session: str, last: SessionRecord | None = None) -> None:
        """Begin a session as configured; `last` is the plant's record. A stream starts at its last set-point."""
        self._controller = controller
        self._k = 0
        self._update_record(session=session, since_tick=0, gains_since_tick=0)
        if self._after_restart == "resume":
            self._resume(last or self._last)
        controller.set_gains(self.record.gains)
        controller.motion.follow(Trajectory.of(self._present_reference), 0.0, Approach())
        self._started_near = False
        self._discard_setpoints()
        self._record_change(gains=self.record.gains, reference=self._present_reference)

    def end(self) -> None:
        """End the session."""
        self._last = self.record.model_copy(update={"ended_tick": self._k})
        self._controller = None
        self._update_record(session=None)
        if self._after_restart == "hold":
            self._begin_with(Hold(), "held")

    def _resume(self, last: SessionRecord | None) -> None:
        """Take up the gains of the last session and, unless an operator stopped it since, its reference."""
        self._begin_with(Hold(), "held")
        if last is None:
            return
        reference = rest_of_reference(last, self._running().period)
        try:
            Trajectory.of(reference).check(self._limits)
            with_gains(self._law, last.gains)
            gains = last.gains.over(self.record.gains)
        except (FollowError, LawError) as error:
            self._role.event("fault", f"the last session is not resumed: {error}", self.record.session)
            return
        self._update_record(gains=gains, gains_from="resumed")
        if last.ended is TripCause.OPERATOR or reference == Hold():
            return
        self._begin_with(reference, "resumed", last.within_s)
        if isinstance(reference, Stream):
            self._present_reference = Hold()  # until the first set-point

    def _begin_with(self, reference: Reference, source: Source, within_s: float = 0.0) -> None:
        """A hold without attitude holds the attitude found."""
        self._present_reference = reference
        self._update_record(reference=reference, reference_from=source, **Approach(within_s)._asdict())

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
        start, t, target = hold_here(attitude, rolls=self._limits.rolls), self._time, self._present_reference
        if self.record.reference_from != "configured" and target == Hold():
            target, approach = Hold(attitude=start), Approach(start=start)
            trajectory = Trajectory.of(target)
            text = f"holds the attitude found, {in_words(target)}; `aeroloop op track configured` moves it"
        else:
            w, x, y, z = controller.motion.at(t)[0]
            away = degrees(distance(attitude, (w, x, y, z)))
            if self._after_restart == "configured" and away <= START_WITHIN_DEG:
                return
            trajectory = Trajectory.of(target)
            limits = self._limits._replace(tilt=pi)  # the body may have been found beyond its own limit
            approach = shortest_from_rest(trajectory, start, limits).at_least(max(START_S, self.record.within_s))
            text = f"begins {away:.0f}° away from its reference: approaches within {approach.within_s:.1f} s"
        self._approach(target, trajectory, approach, text, self.record.reference, self.record.reference_from)

    # ── in the loop ──

    def before_tick(self, k: int, frame: bytes) -> None:
        """Apply the changes received since the last tick, from tick k on; `frame` is the measurement of that tick."""
        self._k = k
        if not self._started_near:
            self._start_near(frame)
        self._role.take_inbox()
        if isinstance(self.record.reference, Stream):
            self._follow_stream(self.record.reference)

    def between_ticks(self, k: int) -> None:
        """Apply the changes received while the plant pauses, from its next tick k on."""
        self._k = k
        self._role.take_inbox()

    def _follow_stream(self, stream: Stream) -> None:
        """Follow the newest set-point received since the last tick that is not refused; report a silent stream."""
        now_s = self._role.clock.monotonic()
        newest = self._newest_setpoint()
        if newest is not None:
            self._setpoint_s = now_s
            trajectory = Trajectory.of(newest)
            try:
                here = self._running().motion.here(self._time)
                self._follow(newest, trajectory, to_set_point(trajectory, here, stream.within_s, self._limits))
            except FollowError as error:
                self._refuse_setpoint(error)
        elif self._setpoint_s and now_s - self._setpoint_s > stream.timeout_s:
            self._setpoint_s = 0.0
            text = f"no set-point for {stream.timeout_s:g} s: holds the last one"
            self._role.event("lost", text, self.record.session, self._k)

    def _newest_setpoint(self) -> Hold | None:
        """The newest set-point received since the last tick that is not refused. Older ones are not looked at."""
        for payload in reversed(self._take_setpoints()):
            try:
                hold = Hold(attitude=Setpoint.decode(payload).attitude)
                Trajectory.of(hold).check(self._limits)
            except (MessageError, FollowError) as error:
                self._refuse_setpoint(error)
            else:
                return hold
        return None

    def _take_setpoints(self) -> list[bytes]:
        """Payloads of the set-points received since this was last called, the newest last."""
        payloads: list[bytes] = []
        for _ in range(SETPOINTS):
            sample = self._received.try_recv()
            if sample is None:
                break
            payloads.append(sample.payload.to_bytes())
        return payloads

    def _refuse_setpoint(self, error: AeroloopError) -> None:
        self.refused += 1
        self._role.warn("set-point", "fault", f"set-point refused: {error}", self.record.session)

    def _discard_setpoints(self) -> None:
        """Discard those received before now, which are of the previous stream or session."""
        while self._received.try_recv() is not None:
            pass

    def _approach(
        self, to: Reference, trajectory: Trajectory, approach: Approach, text: str, asked: Reference, source: Source
    ) -> None:
        """Follow from this tick on; the record has it, or the stream that was asked for."""
        self._follow(to, trajectory, approach)
        reference = asked if isinstance(asked, Stream) else to
        self._update_record(reference=reference, reference_from=source, since_tick=self._k, **approach._asdict())
        self._role.event("changed", text, self.record.session, self._k)

    def _follow(self, reference: Reference, trajectory: Trajectory, approach: Approach) -> None:
        self._running().motion.follow(trajectory, self._time, approach)
        self._present_reference = reference
        self._record_change(reference=reference, **approach._asdict())

    @property
    def _time(self) -> float:
        return self._k * self._running().period

    def _running(self) -> Controller:
        if self._controller is None:
            raise FollowError(f"nothing to change: {self._why_none()}")
        return self._controller

    def _record_change(self, **change: Any) -> None:
        self._trace.changes.append(Change(session=self.record.session or "", tick=self._k, **change))

    def _update_record(self, **changed: Any) -> None:
        self.record = self.record.model_copy(update=changed)


def rest_of_reference(last: SessionRecord, period: float) -> Reference:
    """What a session that was cut short had still to follow; period in s.

    Points go on with the first that it had not reached; a sinusoid begins anew.
    """
    reference = last.reference
    if not isinstance(reference, Points):
        return reference
    followed_s = ((last.ended_tick or 0) - last.since_tick) * period - last.within_s
    ahead = [i for i, time in enumerate(reference.times) if time >= followed_s]
    if len(ahead) < 2:
        return Hold(attitude=reference.attitudes[-1])
    times, first = reference.times[ahead[0] :], reference.times[ahead[0]]
    return Points(
        times=[time - first for time in times],
        attitudes=reference.attitudes[ahead[0] :],
        interpolation=reference.interpolation,
    )


def hold_here(attitude: Quaternion, *, rolls: bool) -> Vector:
    """Roll, pitch, yaw at which the body is found [deg]; roll is 0 for a vehicle that cannot roll."""
    roll, pitch, yaw = (round(degrees(angle), _DECIMALS) for angle in to_euler(attitude))
    return (roll if rolls else 0.0, pitch, yaw)
