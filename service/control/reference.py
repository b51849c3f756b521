"""Reference: Euler angles over time, and the q_d, ω_d, ω̇_d that the law uses.

Every reference is a sequence of pieces, and every piece a quintic plus a sinusoid, of which either may be zero. One
CasADi function evaluates any piece: the desired quaternion, the angular velocity of (C.12) in the inertial frame and
its derivative follow by CasADi's own derivatives, so they are exact and consistent. A new reference is joined to the
present one by a quintic piece, so angle, rate and acceleration never jump, however often the reference changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from math import acos, degrees, pi
from typing import Final, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Change, Hold, Points, Reference, Sinusoid
from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.symbolic import Buffer, Compiled

Floats = NDArray[np.float64]

POWERS: Final = 6
_SAMPLES: Final = 65
"""Samples of a quintic. Its rate is a polynomial of degree 4: the largest of so many is within 0.4 % of the maximum."""
_TURNS: Final = 8
_MOST_SAMPLES: Final = 100_000
_SLOWER: Final = 1.05
_TRIES: Final = 8
_LONGEST_S: Final = 3600.0
"""Longest approach tried [s]. One that would take longer begins too fast for any; it is tried again with an ease."""


class FollowError(AeroloopError):
    """A reference that the vehicle must not follow; one line with the limit and a remedy."""


class Limits(NamedTuple):
    """Limits of a reference.

    Attributes:
        rate: Largest angular velocity [rad/s].
        tilt: Largest angle between the body's z axis and the vertical [rad].
        rolls: Whether the vehicle can roll; a 2-DOF bench cannot.
    """

    rate: float
    tilt: float
    rolls: bool


class Angles(NamedTuple):
    """Roll, pitch, yaw [rad], their rates [rad/s] and accelerations [rad/s²]; each of shape (…, 3)."""

    angle: Floats
    rate: Floats
    acceleration: Floats


@dataclass(frozen=True)
class Plan:
    """Consecutive pieces, each Σ cₙ τⁿ + amplitude · sin(frequency · τ) with τ = t − start; the last never ends.

    Attributes:
        starts: Start time of each [s], increasing. Shape (n,).
        quintic: c₀…c₅ of roll, pitch, yaw [rad/sᵖ]. Shape (n, 6, 3).
        amplitude: Of roll, pitch, yaw [rad]. Shape (n, 3).
        frequency: Of roll, pitch, yaw [rad/s]. Shape (n, 3).
    """

    starts: Floats
    quintic: Floats
    amplitude: Floats
    frequency: Floats

    @classmethod
    def of(cls, reference: Reference) -> Plan:
        """The plan of a reference that begins at t = 0. A stream holds 0 until its first set-point."""
        if isinstance(reference, Points):
            return cls._through(np.array(reference.times), np.radians(np.array(reference.attitudes)))
        still = cls._polynomial(np.zeros(1), np.zeros((1, POWERS, 3)))
        if isinstance(reference, Sinusoid):
            amplitude = np.array([[a * (pi / 180) for a in reference.amplitude]])
            return replace(still, amplitude=amplitude, frequency=np.array([reference.frequency]))
        if isinstance(reference, Hold) and reference.attitude is not None:
            still.quintic[0, 0] = np.radians(reference.attitude)
        return still

    @classmethod
    def _polynomial(cls, starts: Floats, quintic: Floats) -> Plan:
        return cls(starts, quintic, np.zeros((len(starts), 3)), np.zeros((len(starts), 3)))

    @classmethod
    def _through(cls, times: Floats, angles: Floats) -> Plan:
        """A plan through points, with rates and accelerations by differences; at rest at both ends."""
        rates = np.gradient(angles, times, axis=0)
        rates[0] = rates[-1] = 0.0
        accelerations = np.gradient(rates, times, axis=0)
        accelerations[0] = accelerations[-1] = 0.0
        here = Angles(angles[:-1], rates[:-1], accelerations[:-1])
        there = Angles(angles[1:], rates[1:], accelerations[1:])
        last = np.zeros((1, POWERS, 3))
        last[0, 0] = angles[-1]
        return cls._polynomial(times, np.concatenate([join(here, there, np.diff(times)), last]))

    def joined(self, here: Angles, t: float, within_s: float, ease_s: float = 0.0) -> Plan:
        """This plan from t + ease_s + within_s on, reached by a quintic from the state at t; shapes (1, 3).

        With `ease_s`, the present acceleration is first reduced to 0: a long approach that began with it would only get
        faster.
        """
        if ease_s:
            eased = Angles(
                here.angle + here.rate * ease_s + here.acceleration * ease_s**2 / 3,
                here.rate + here.acceleration * ease_s / 2,
                np.zeros((1, 3)),
            )
            rest = self.joined(eased, t + ease_s, within_s)
            return self._polynomial(np.array([t]), join(here, eased, np.array([ease_s])))._then(rest)
        later = replace(self, starts=self.starts + (t + within_s))
        if not within_s:
            return later
        first = Angles(*(part[:1, 0] for part in self.at(np.zeros((len(self.starts), 1)))))
        approach = self._polynomial(np.array([t]), join(here, first, np.array([within_s])))
        return approach._then(later)

    def _then(self, later: Plan) -> Plan:
        return Plan(*(np.concatenate([getattr(p, name) for p in (self, later)]) for name in self.__annotations__))

    def piece(self, t: float) -> int:
        """Index of the piece that contains time t [s]."""
        return max(0, int(np.searchsorted(self.starts, t, side="right")) - 1)

    def at(self, tau: Floats) -> Angles:
        """Angles of every piece at times τ since its start [s]. Shape of τ: (n, m), of the angles (n, m, 3)."""
        tau = tau[:, :, None]
        angle, rate, acceleration = np.zeros((3, *tau.shape[:2], 3))
        for power in reversed(range(POWERS)):  # Horner's rule, for the polynomial and its derivatives at once
            acceleration = acceleration * tau + 2 * rate
            rate = rate * tau + angle
            angle = angle * tau + self.quintic[:, None, power]
        amplitude, f = self.amplitude[:, None], self.frequency[:, None]
        return Angles(
            angle + amplitude * np.sin(f * tau),
            rate + amplitude * f * np.cos(f * tau),
            acceleration - amplitude * f * f * np.sin(f * tau),
        )

    def samples(self) -> Angles:
        """All pieces, sampled densely enough for their extremes, concatenated. Shapes (n, 3)."""
        lengths = np.append(np.diff(self.starts), 0.0)
        every = Angles(*(part.reshape(-1, 3) for part in self.at(lengths[:, None] * np.linspace(0, 1, _SAMPLES))))
        if not self.frequency[-1].any():
            return every
        return Angles(*(np.concatenate(both) for both in zip(every, self._swing(), strict=True)))

    def _swing(self) -> Angles:
        """The last piece's sinusoid over `_TURNS` periods of its slowest axis; its bounds if too many samples."""
        moving = self.frequency[-1][self.frequency[-1] > 0]
        count = int(_TURNS * (_SAMPLES - 1) * moving.max() / moving.min()) + 1
        if count <= _MOST_SAMPLES:
            tau = np.zeros((len(self.starts), count))
            tau[-1] = np.linspace(0, _TURNS * 2 * pi / moving.min(), count)
            return Angles(*(part[-1] for part in self.at(tau)))
        signs = np.array(list(product((-1.0, 1.0), repeat=6)))
        amplitude, f = self.amplitude[-1], self.frequency[-1]
        return Angles(signs[:, :3] * amplitude, signs[:, 3:] * amplitude * f, signs[:, :3] * amplitude * f * f)

    def fastest(self) -> float:
        """The largest angular velocity [rad/s]: ‖ω‖² = φ̇² + θ̇² + ψ̇² − 2 φ̇ ψ̇ sin θ, for roll φ, pitch θ, yaw ψ."""
        angles = self.samples()
        square = (angles.rate**2).sum(axis=1)
        square -= 2 * angles.rate[:, 0] * angles.rate[:, 2] * np.sin(angles.angle[:, 1])
        return float(np.sqrt(np.maximum(0.0, square).max()))  # NaN stays NaN

    def check(self, limits: Limits) -> None:
        """Raise FollowError if it goes beyond the limits."""
        with np.errstate(over="ignore", invalid="ignore"):  # a rate that is not finite counts as too fast
            fastest = self.fastest()
        if not fastest <= limits.rate:
            raise FollowError(
                f"that would turn at {fastest:.2f} rad/s, more than controller.max_reference_rate = "
                f"{limits.rate:g} rad/s; allow more time, or a smaller motion"
            )
        angle = self.samples().angle
        tilt = acos(max(-1.0, float((np.cos(angle[:, 0]) * np.cos(angle[:, 1])).min())))
        # A sinusoid with an amplitude beyond the limit passes through it, though its extremes may be level again.
        swings = (np.abs(self.amplitude) * (self.frequency > 0))[:, :2]
        tilt = max(tilt, float(np.minimum(swings, pi).max()))
        if tilt > limits.tilt:
            raise FollowError(
                f"that would tilt by {degrees(tilt):.1f}°, more than controller.max_reference_tilt_deg = "
                f"{degrees(limits.tilt):g}°"
            )
        if not limits.rolls and np.abs(angle[:, 0]).max() > 0:
            raise FollowError("this vehicle has no motor that rolls it: set its roll to 0")


def join(here: Angles, there: Angles, length: Floats) -> Floats:
    """The quintics from states `here` to states `there`, of shape (n, 3), in `length` seconds, of shape (n,).

    Returns:
        Their coefficients. Shape (n, 6, 3).
    """
    (p, v, a), T = here, length[:, None]
    angle = there.angle - (p + v * T + a * T * T / 2)
    rate = (there.rate - (v + a * T)) * T
    acceleration = (there.acceleration - a) * T * T
    return np.stack(
        [
            p,
            v,
            a / 2,
            (10 * angle - 4 * rate + acceleration / 2) / T**3,
            (-15 * angle + 7 * rate - acceleration) / T**4,
            (6 * angle - 3 * rate + acceleration / 2) / T**5,
        ],
        axis=1,
    )


def reference_function() -> ca.Function:
    """A piece at time t ↦ q_d, ω_d, ω̇_d: desired attitude [1], angular velocity [rad/s], acceleration [rad/s²].

    The latter two are inertial. Inputs: t, start, quintic (3 × 6, a column a power), amplitude, frequency.
    """
    t, start, quintic = ca.SX.sym("t"), ca.SX.sym("start"), ca.SX.sym("quintic", 3, POWERS)
    amplitude, frequency = ca.SX.sym("amplitude", 3), ca.SX.sym("frequency", 3)
    tau = t - start
    angles = ca.SX.zeros(3)
    for n in reversed(range(POWERS)):
        angles = angles * tau + quintic[:, n]
    q_d = attitude.from_euler(angles + amplitude * ca.sin(frequency * tau))
    q_d_dot = ca.jacobian(q_d, t)
    omega_d = 2 * attitude.product(q_d_dot, attitude.conjugate(q_d))[1:4]  # (C.12), solved for ω_d
    omega_d_dot = ca.jacobian(omega_d, t)
    return ca.Function(
        "reference",
        [t, start, quintic, amplitude, frequency],
        [q_d, omega_d, omega_d_dot],
        ["t", "start", "quintic", "amplitude", "frequency"],
        ["q_d", "omega_d", "omega_d_dot"],
        {"cse": True},  # the derivatives repeat sines and cosines: 12 instead of 36, and the same numbers
    )


def at_rest(attitude: Vector) -> Angles:
    """The state of a body at rest at roll, pitch, yaw [deg]. Shapes (1, 3)."""
    return Angles(np.radians(np.array([attitude])), np.zeros((1, 3)), np.zeros((1, 3)))


class Motion:
    """The reference as the loop evaluates it, tick by tick.

    Args:
        reference: What to follow from t = 0 on.
        shared: Memory for the outputs q_d, omega_d and omega_d_dot; own memory if None.

    Attributes:
        plan: The plan followed now.
    """

    def __init__(self, reference: Reference, shared: Mapping[str, Buffer] | None = None) -> None:
        self._function = Compiled(reference_function(), shared)
        self._time = self._function.inputs["t"]
        self.plan = Plan.of(reference)
        self._load(0)

    def at(self, t: float) -> None:
        """Write the desired motion at time t [s]; t never decreases between calls."""
        if t >= self._until:
            self._load(self.plan.piece(t))
        self._time[0] = t
        self._function()

    def follow(
        self,
        target: Plan,
        t: float,
        within_s: float,
        limits: Limits | None = None,
        *,
        ease_s: float = 0.0,
        start: Vector | None = None,
    ) -> None:
        """Follow another plan, reached from the present one after `within_s`; its own time begins then.

        Args:
            target: What to follow.
            t: The time now [s].
            within_s: Time to reach it [s]; 0 jumps.
            limits: Limits of the approach; None for no limits.
            ease_s: Time before that to reduce the present acceleration to 0 [s].
            start: Roll, pitch, yaw to begin from, at rest, instead of the present plan [deg].

        Raises:
            FollowError: The approach exceeds the limits; the present plan stays.
        """
        here = self._here(t) if start is None else at_rest(start)
        plan = target.joined(here, t, within_s, ease_s)
        if limits is not None and within_s:
            count = plan.piece(t + ease_s + within_s) + 1  # pieces, up to the target's first
            replace(plan, **{name: getattr(plan, name)[:count] for name in plan.__annotations__}).check(limits)
        self.plan = plan
        self._load(plan.piece(t))

    def change(self, change: Change, period: float) -> None:
        """Follow the reference of a change, if it has one, from its tick on; period in s."""
        if change.reference is not None:
            t = change.tick * period
            self.follow(Plan.of(change.reference), t, change.within_s, ease_s=change.ease_s, start=change.start)

    def attitude(self, t: float) -> Quaternion:
        """q_d at time t [s]."""
        self.at(t)
        w, x, y, z = self._function.outputs["q_d"]
        return w, x, y, z

    def rest(self, t: float, within_s: float) -> Hold:
        """The attitude reached when braking evenly to rest within `within_s` [s]."""
        here = self._here(t)
        roll, pitch, yaw = (degrees(float(angle)) for angle in here.angle[0] + here.rate[0] * within_s / 2)
        return Hold(attitude=(roll, pitch, yaw))

    def time_to_reach(
        self, target: Plan, t: float, within_s: float, limits: Limits, start: Vector | None = None
    ) -> tuple[float, float]:
        """The times that keep an approach within the rate limit: `within_s`, at least as given, and `ease_s` [s]."""
        here = self._here(t) if start is None else at_rest(start)
        least = within_s
        for ease_s in (0.0, least):
            within_s = least
            for _ in range(_TRIES):
                fastest = target.joined(here, t, within_s, ease_s).fastest()
                if fastest <= limits.rate:
                    return within_s, ease_s
                within_s = min(within_s * _SLOWER * fastest / limits.rate, _LONGEST_S)
        return within_s, least

    def _here(self, t: float) -> Angles:
        i = self.plan.piece(t)
        tau = np.zeros((len(self.plan.starts), 1))
        tau[i] = t - self.plan.starts[i]
        return Angles(*(part[i] for part in self.plan.at(tau)))

    def _load(self, i: int) -> None:
        plan, inputs = self.plan, self._function.inputs
        self._until = float(plan.starts[i + 1]) if i + 1 < len(plan.starts) else float("inf")
        inputs["start"][0] = plan.starts[i]
        inputs["quintic"][:] = memoryview(plan.quintic[i].ravel())  # CasADi is column-major
        inputs["amplitude"][:] = memoryview(plan.amplitude[i].copy())
        inputs["frequency"][:] = memoryview(plan.frequency[i].copy())
