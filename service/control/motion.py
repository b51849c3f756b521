"""Motion: the reference as the loop follows it tick by tick, and the approach from one reference to another.

However often the reference changes, its angle, rate and acceleration never jump. In an approach each axis brakes to
rest, then all of them turn along a straight line of roll, pitch and yaw, from rest to rest, and each runs up to the
rate of the reference that is reached; the run-up is a braking seen backwards. So no axis goes further beyond its start
or its target than it takes to stop there, and the time given changes the speed of the turn and nothing else. A
set-point of a stream is reached by a single quintic, which need not stop, where that swings out no further.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil, degrees, inf, isfinite
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.messages.operator import MAX_WITHIN_S, Change, Hold, Reference
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.protocol.wire.symbolic import Buffer, Compiled
from aeroloop.service.control.reference import (
    SAMPLES,
    Angles,
    Floats,
    FollowError,
    Limits,
    Trajectory,
    reference_function,
)

BRAKING: Final = 1.0
"""Largest acceleration with which roll, pitch and yaw each brake before a motion and run up to a reference that moves
[rad/s²]; from the rate v an axis stops within 0.75 v². The Aero's motors turn it by 2.4 rad/s² in pitch at 24 V."""
START_WITHIN_DEG: Final = 20.0
"""A session that begins further than this from its reference first approaches it smoothly [deg]; from nearer the law
gets there before a motor has been at its limit for the second after which the Aero trips."""
LEAST_TURN_S: Final = 0.02  # least time of the turn [s], however small it is
LET_GO_S: Final = 0.1  # least time in which an acceleration is reduced to 0 [s]: a jump would be a step of torque
_HARDER: Final = 6  # how often the time of a braking is halved at the most
_SLOWER, _TRIES = 1.05, 8  # of a quintic to a set-point
_SLACK: Final = 1 + 1e-9  # rounding of what is compared with a limit


class Approach(NamedTuple):
    """Times of an approach, as in the trace's changes. The default is a jump."""

    within_s: float = 0.0  # all of it [s]
    start: Vector | None = None  # roll, pitch, yaw to begin from, at rest, instead of the present reference [deg]
    brake_s: Vector | None = None  # in which roll, pitch, yaw each brake to rest; None for a single quintic [s]
    run_up_s: Vector | None = None  # in which each runs up to the rate of the target at its end [s]
    here: tuple[Vector, Vector, Vector] | None = None  # angles [rad], rates and accelerations to begin from

    @property
    def state(self) -> Angles | None:
        """The state it begins from, of shapes (1, 3); None for that of the present reference."""
        if self.start is not None:
            return at_rest(self.start)
        if self.here is not None:
            return Angles(*(np.array([row]) for row in self.here))
        return None

    def at_least(self, within_s: float) -> Approach:
        """This shortest approach, extended to `within_s` if that is longer."""
        return self._replace(within_s=max(within_s, self.within_s))

    def lasting(self, within_s: float, limits: Limits) -> Approach:
        """This shortest approach, extended to `within_s`. FollowError names the shortest time if that is too short."""
        if within_s * _SLACK >= self.within_s:
            return self.at_least(within_s)
        least_s = ceil(100 * self.within_s) / 100
        remedy = f"--in {least_s:g} would do" if least_s <= MAX_WITHIN_S else f"even {MAX_WITHIN_S:g} s would be"
        raise FollowError(
            f"the approach is too short: with controller.max_reference_rate = {limits.rate:g} rad/s it takes longer "
            f"than {within_s:g} s; {remedy}"
        )


def braked(state: Angles, brake_s: Floats, s: Floats) -> Angles:
    """States on the way to rest, at times s since it began [s]; shape (n,). It begins in `state`, of shapes (1, 3).

    The rate is a cubic of time that ends at 0 without an acceleration. Each axis takes its `brake_s` [s], 0 at rest.
    """
    angle, rate, acceleration = state
    T = np.where(brake_s > 0, brake_s, 1.0)
    u = np.clip(s[:, None] / T, 0.0, 1.0)
    left = 1 - u
    return Angles(
        angle + rate * T * u * (1 - u * u * (1 - u / 2)) + acceleration * T * T * u * u * (6 - 8 * u + 3 * u * u) / 12,
        (rate * (1 + 2 * u) + acceleration * T * u) * left * left,
        (acceleration * (1 - 3 * u) - 6 * rate / T * u) * left,
    )


def braking_times(state: Angles, limits: Limits) -> Floats:
    """Time in which each axis brakes to rest [s], whole milliseconds. Shape (3,).

    The acceleration stays within BRAKING, or the present one where that is larger. Where rate or tilt would exceed
    their limits meanwhile, because the body still gathers speed or is near the limit, it brakes harder.
    """
    rate, acceleration = np.abs(state.rate[0]), np.abs(state.acceleration[0])
    # `braked` accelerates by at most 3/2 rate / T + acceleration / 3, or by what it begins with.
    times: Floats = 1.5 * rate / (np.maximum(BRAKING, acceleration) - acceleration / 3)
    times = np.ceil(1000 * np.where(acceleration > 0, np.maximum(times, LET_GO_S), times)) / 1000
    for _ in range(_HARDER):
        way = braked(state, times, np.linspace(0.0, float(times.max()), SAMPLES))
        speeds, tilts = way.speeds(), way.tilts()
        if speeds.max() <= max(limits.rate, speeds[0]) * _SLACK and tilts.max() <= max(limits.tilt, tilts[0]) * _SLACK:
            break
        times = np.ceil(500 * times) / 1000
    return times


def _backwards(state: Angles) -> Angles:
    return Angles(state.angle, -state.rate, state.acceleration)


def shortest(target: Trajectory, here: Angles, limits: Limits) -> Approach:
    """The shortest approach to a target within the limits, from a state. Raises FollowError if there is none."""
    there = _backwards(target.first)
    brake_s, run_up_s = braking_times(here, limits), braking_times(there, limits)
    still_s = float(brake_s.max()) + float(run_up_s.max())
    begin, end = (
        braked(state, times, np.array([times.max()])).angle for state, times in ((here, brake_s), (there, run_up_s))
    )
    u = np.linspace(0.0, 1.0, SAMPLES)[:, None]  # the turn, within 1 s
    way = begin + (end - begin) * u**3 * (10 - 15 * u + 6 * u * u)
    turn = Angles(way, (end - begin) * 30 * (u * (1 - u)) ** 2, np.zeros_like(way))
    within_s = still_s + max(LEAST_TURN_S, float(turn.speeds().max()) / limits.rate)
    if not isfinite(within_s):
        raise FollowError("that is too far, or too fast, for any approach")
    tilts = turn.tilts()
    if tilts.max() > max(limits.tilt, tilts[0], tilts[-1]) * _SLACK:
        raise FollowError(
            f"the approach tilts by {degrees(float(tilts.max())):.1f}°, more than controller.max_reference_tilt_deg = "
            f"{degrees(limits.tilt):g}°, however long it takes: go there in smaller steps"
        )
    if not still_s:
        return Approach(within_s, here=here.row)  # from rest to rest it is a single quintic
    return Approach(within_s, None, tuple(brake_s.tolist()), tuple(run_up_s.tolist()), here.row)


def at_rest(attitude: Vector) -> Angles:
    """The state of a body at rest at roll, pitch, yaw [deg]. Shapes (1, 3)."""
    return Angles(np.radians([attitude]), np.zeros((1, 3)), np.zeros((1, 3)))


def shortest_from_rest(target: Trajectory, found: Vector, limits: Limits) -> Approach:
    """The shortest approach from roll, pitch, yaw at which a body is found [deg], −10° or 350°. Raises FollowError."""
    turns = np.round((np.degrees(target.first.angle[0]) - found) / 360.0)
    roll, pitch, yaw = (np.array(found) + 360.0 * turns).tolist()
    start = roll, pitch, yaw
    return shortest(target, at_rest(start), limits)._replace(start=start, here=None)


def to_set_point(target: Trajectory, here: Angles, within_s: float, limits: Limits) -> Approach:
    """The approach to a set-point within the limits: a single quintic in `within_s` or somewhat more, or the shortest.

    A quintic is taken if it goes no further beyond its start or its target than braking does, within the limits or
    within `within_s`. Raises FollowError if there is no approach.
    """
    if _is_surely_within(target.first.angle, here, within_s, limits):
        return Approach(within_s, here=here.row)
    brake_s = np.maximum(braking_times(here, limits), within_s)
    ends = np.concatenate([here.angle, target.first.angle])
    stops_within = np.abs(here.rate[0]) * brake_s / 2 + np.abs(here.acceleration[0]) * brake_s**2 / 12
    margin = stops_within + 1e-9  # rounding of what is hardly moving
    low, high = ends.min(axis=0) - margin, ends.max(axis=0) + margin
    candidate = within_s
    for _ in range(_TRIES):
        way = approached(target, here, 0.0, Approach(candidate)).samples()
        if not (np.all((low <= way.angle) & (way.angle <= high)) and way.tilts().max() <= limits.tilt):
            break  # a slower one would swing further
        fastest = float(way.speeds().max())
        if fastest <= limits.rate:
            return Approach(candidate, here=here.row)
        candidate *= _SLOWER * fastest / limits.rate
    return shortest(target, here, limits).at_least(within_s)


def _is_surely_within(target: Floats, here: Angles, within_s: float, limits: Limits) -> bool:
    """Whether the quintic from a state to rest at `target` [rad], shape (1, 3), keeps the limits by its control points.

    Angle and rate stay within the convex hulls of the control points of their Bernstein forms, and the bounds of tilt
    and speed are convex. The control points of the angle lie no further from both ends than a braking in `within_s`.
    """
    angle, rate, acceleration = here
    second = angle + rate * (2 * within_s / 5) + acceleration * (within_s**2 / 20)
    angles = np.concatenate([angle, angle + rate * (within_s / 5), second, target])
    rates = np.concatenate([rate, rate + acceleration * (within_s / 4), 5 * (target - second) / within_s])
    control = Angles(angles, rates, rates)
    return bool(control.tilt_bounds().max() <= limits.tilt and control.speed_bounds().max() <= limits.rate)


def approached(target: Trajectory, here: Angles, t: float, approach: Approach) -> Trajectory:
    """A trajectory that reaches the target by an approach; the target's own time begins when it is reached.

    It begins at time t [s] from the state `here`, of shapes (1, 3), unless the approach has one of its own.
    """
    within_s, brake, run_up, begin = approach.within_s, approach.brake_s, approach.run_up_s, approach.state
    if begin is not None:
        here = begin
    there = target.first
    if brake is None or run_up is None:
        if not within_s:
            return target.after(np.array([t]), np.array([]), here)
        knots = Angles(*map(np.concatenate, zip(here, there, strict=True)))
        return target.after(np.array([t, t + within_s]), np.array([within_s]), knots)
    brake_s, run_up_s = np.array(brake), np.array(run_up)
    s = np.unique(np.concatenate([[0.0, within_s], brake_s, within_s - run_up_s]))
    before = braked(here, brake_s, s)
    after = _backwards(braked(_backwards(there), run_up_s, within_s - s))
    braking = (s <= brake_s.max())[:, None]
    knots = Angles(*(np.where(braking, b, a) for b, a in zip(before, after, strict=True)))
    return target.after(t + s, np.diff(s), knots)


class Motion:
    """The reference as the loop evaluates it, tick by tick, from t = 0 on, and `trajectory`, which is followed now.

    `shared` is memory to use instead of its own, by name: that of a function with the inputs of `reference_function`.
    """

    def __init__(self, reference: Reference, shared: Mapping[str, Buffer] | None = None) -> None:
        self._function = Compiled(reference_function(), shared)
        self._time = self._function.inputs["t"]
        self.trajectory = Trajectory.of(reference)
        self._load(0)

    def set(self, t: float) -> None:
        """Write time t [s] and its piece to the inputs; t never decreases between calls."""
        if t >= self._until:
            self._load(self.trajectory.piece(t))
        self._time[0] = t

    def at(self, t: float) -> tuple[list[float], list[float], list[float]]:
        """q_d [1], ω_d [rad/s] and ω̇_d [rad/s²] at time t [s], the latter two inertial."""
        self.set(t)
        self._function()
        q_d, omega_d, omega_d_dot = map(list, self._function.outputs.values())
        return q_d, omega_d, omega_d_dot

    def follow(self, target: Trajectory, t: float, approach: Approach) -> None:
        """Follow another trajectory from time t [s] on, by an approach; its own time begins when it is reached."""
        begin = approach.state
        here = self.here(t) if begin is None else begin
        self.trajectory = trajectory = approached(target, here, t, approach)
        self._load(trajectory.piece(t))

    def change(self, change: Change, period: float) -> None:
        """Follow the reference of a change, if it has one, from its tick on; period in s."""
        if change.reference is not None:
            approach = Approach(*(getattr(change, name) for name in Approach._fields))
            self.follow(Trajectory.of(change.reference), change.tick * period, approach)

    def rest(self, t: float, limits: Limits) -> Hold:
        """The attitude reached by braking from time t [s] on."""
        here = self.here(t)
        brake_s = braking_times(here, limits)
        roll, pitch, yaw = np.degrees(braked(here, brake_s, np.array([brake_s.max()])).angle[0]).tolist()
        return Hold(attitude=(roll, pitch, yaw))

    def here(self, t: float) -> Angles:
        """Roll, pitch, yaw, their rates and accelerations at time t [s]. Shapes (1, 3)."""
        i = self.trajectory.piece(t)
        return self.trajectory.state(i, t - self.trajectory.starts[i])

    def _load(self, i: int) -> None:
        trajectory, inputs = self.trajectory, self._function.inputs
        self._until = float(trajectory.starts[i + 1]) if i + 1 < len(trajectory.starts) else inf
        inputs["start"][0] = trajectory.starts[i]
        inputs["quintic"][:] = memoryview(trajectory.quintic[i].ravel())  # CasADi is column-major
        inputs["amplitude"][:] = memoryview(trajectory.amplitude[i].copy())
        inputs["frequency"][:] = memoryview(trajectory.frequency[i].copy())
