"""Reference: Euler angles over time, and the q_d, ω_d, ω̇_d that the law uses.

Every reference is a sequence of pieces, and every piece a quintic plus a sinusoid, of which either may be zero. One
CasADi function evaluates any piece: the desired quaternion, the angular velocity of (C.12) in the inertial frame and
its derivative follow by CasADi's own derivatives, so they are exact and consistent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import degrees, pi
from typing import Final, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Hold, Points, Reference, Sinusoid
from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.symbolic import Compiled, in_columns

Floats = NDArray[np.float64]

POWERS: Final = 6
SAMPLES: Final = 65
"""Samples of a quintic. Its rate is a polynomial of degree 4: the largest of so many is within 0.4 % of the maximum."""
_TURNS: Final = 8
_MOST_SAMPLES: Final = 100_000


class FollowError(AeroloopError):
    """A reference that the vehicle must not follow; one line with the limit and a remedy."""


class Limits(NamedTuple):
    """Limits of a reference.

    Attributes:
        rate: Largest angular velocity [rad/s].
        braking: Largest acceleration with which roll, pitch and yaw each brake before a motion [rad/s²].
        tilt: Largest angle between the body's z axis and the vertical [rad].
        rolls: Whether the vehicle can roll; a 2-DOF bench cannot.
    """

    rate: float
    braking: float
    tilt: float
    rolls: bool


class Angles(NamedTuple):
    """Roll, pitch, yaw [rad], their rates [rad/s] and accelerations [rad/s²]; each of shape (…, 3)."""

    angle: Floats
    rate: Floats
    acceleration: Floats

    def speeds(self) -> Floats:
        """Angular velocities [rad/s]: ‖ω‖² = φ̇² + θ̇² + ψ̇² − 2 φ̇ ψ̇ sin θ, for roll φ, pitch θ, yaw ψ. Shape (n,)."""
        square = (self.rate**2).sum(axis=1)
        square -= 2 * self.rate[:, 0] * self.rate[:, 2] * np.sin(self.angle[:, 1])
        speeds: Floats = np.sqrt(np.maximum(0.0, square))  # NaN stays NaN
        return speeds

    def tilts(self) -> Floats:
        """Angles between the body's z axis and the vertical [rad]. Shape (n,)."""
        tilts: Floats = np.arccos(np.clip(np.cos(self.angle[:, 0]) * np.cos(self.angle[:, 1]), -1.0, 1.0))
        return tilts


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

    @property
    def first(self) -> Angles:
        """The state at its start. Shapes (1, 3)."""
        return Angles(*(part[:1, 0] for part in self.at(np.zeros((len(self.starts), 1)))))

    def after(self, starts: Floats, lengths: Floats, knots: Angles) -> Plan:
        """This plan from the last of these times on, preceded by quintics through the states at them.

        Args:
            starts: Times [s], increasing. Shape (n,).
            lengths: Their differences, before they were rounded by an addition [s]. Shape (n − 1,).
            knots: States, the last of them this plan's first. Shapes (n, 3).
        """
        later = replace(self, starts=self.starts + starts[-1])
        here, there = Angles(*(part[:-1] for part in knots)), Angles(*(part[1:] for part in knots))
        return self._polynomial(starts[:-1], join(here, there, lengths))._then(later)

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
        every = Angles(*(part.reshape(-1, 3) for part in self.at(lengths[:, None] * np.linspace(0, 1, SAMPLES))))
        if not self.frequency[-1].any():
            return every
        return Angles(*(np.concatenate(both) for both in zip(every, self._swing(), strict=True)))

    def third(self) -> Floats:
        """The largest third derivative of roll, pitch and yaw [rad/s³]. Shape (3,)."""
        ends = np.append(np.diff(self.starts), 0.0)[:, None, None] * np.linspace(0, 1, SAMPLES)[:, None]
        c = self.quintic[:, None]
        jerk = np.abs(6 * c[:, :, 3] + 24 * c[:, :, 4] * ends + 60 * c[:, :, 5] * ends**2)
        largest: Floats = (jerk.max(axis=1) + np.abs(self.amplitude * self.frequency**3)).max(axis=0)
        return largest

    def _swing(self) -> Angles:
        """The last piece's sinusoid over `_TURNS` periods of its slowest axis; its bounds if too many samples."""
        moving = self.frequency[-1][self.frequency[-1] > 0]
        count = int(_TURNS * (SAMPLES - 1) * moving.max() / moving.min()) + 1
        if count <= _MOST_SAMPLES:
            tau = np.zeros((len(self.starts), count))
            tau[-1] = np.linspace(0, _TURNS * 2 * pi / moving.min(), count)
            return Angles(*(part[-1] for part in self.at(tau)))
        signs = np.array(list(product((-1.0, 1.0), repeat=6)))
        amplitude, f = self.amplitude[-1], self.frequency[-1]
        return Angles(signs[:, :3] * amplitude, signs[:, 3:] * amplitude * f, signs[:, :3] * amplitude * f * f)

    def fastest(self) -> float:
        """The largest angular velocity [rad/s]."""
        return float(self.samples().speeds().max())

    def check(self, limits: Limits) -> None:
        """Raise FollowError if the reference itself, however it is reached, goes beyond the limits."""
        with np.errstate(over="ignore", invalid="ignore"):  # a rate that is not finite counts as too fast
            fastest = self.fastest()
        if not fastest <= limits.rate:
            raise FollowError(
                f"the reference itself turns at {fastest:.2f} rad/s, more than controller.max_reference_rate = "
                f"{limits.rate:g} rad/s, however it is approached: make it slower or smaller"
            )
        samples = self.samples()
        # A sinusoid with an amplitude beyond the limit passes through it, though its extremes may be level again.
        swings = (np.abs(self.amplitude) * (self.frequency > 0))[:, :2]
        tilt = max(float(samples.tilts().max()), float(np.minimum(swings, pi).max()))
        if tilt > limits.tilt:
            raise FollowError(
                f"the reference itself tilts by {degrees(tilt):.1f}°, more than controller.max_reference_tilt_deg = "
                f"{degrees(limits.tilt):g}°, however it is approached"
            )
        if not limits.rolls and np.abs(samples.angle[:, 0]).max() > 0:
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


def desired(reference: Reference, period: float, ticks: int) -> Floats:
    """q_d, ω_d, ω̇_d of a reference at each tick of a `period` [s], as `Motion` has them. Shape (ticks, 10)."""
    plan = Plan.of(reference)
    t = np.arange(ticks) * period
    piece = np.maximum(0, np.searchsorted(plan.starts, t, side="right") - 1)
    function = Compiled(in_columns(reference_function(), ticks))
    given = {"t": t, "start": plan.starts[piece], "quintic": plan.quintic[piece].reshape(ticks, -1)}
    for name, rows in {**given, "amplitude": plan.amplitude[piece], "frequency": plan.frequency[piece]}.items():
        np.asarray(function.inputs[name]).reshape(-1, ticks)[:] = rows.T
    function()
    return np.concatenate([np.asarray(memory).reshape(-1, ticks) for memory in function.outputs.values()]).T
