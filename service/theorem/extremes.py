"""Extremes of a reference: the bounds k_ω_d and k_ω̇_d of Assumption 1, its largest angles, rates and voltages.

Of a sinusoid they are suprema over its phases (`Trajectory.largest`): over every combination, but for axes that
commensurate frequencies lock to each other. Of points they are the largest of 65 samples a quintic, which also check an
operator's references; those are within half a percent, which is added.
"""

from __future__ import annotations

from collections.abc import Callable
from math import asin, isfinite, pi, sin, sqrt
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Stream
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.interface import LawSettings, check_invertible
from aeroloop.service.control.reference import Angles, Floats, Trajectory, turning
from aeroloop.service.theorem.bounds import attitude_error

_SLACK: Final = 1.005
"""Of the samples of a quintic."""
_WEIGHTS: Final = (0.0, 1.0, 2.0, 4.0)
_STEPS: Final = 257
"""Of ‖ε_d‖, in `chords`."""


class BoundlessError(AeroloopError):
    """A reference without bounds; one line."""


class Extremes(NamedTuple):
    """Bounds that a reference never exceeds."""

    rate: float  # k_ω_d, largest ‖ω_d‖ [rad/s]
    acceleration: float  # k_ω̇_d, largest ‖ω̇_d‖ [rad/s²]
    jerk: float  # largest ‖ω̈_d‖ [rad/s³]
    axis_rate: float  # largest element of ω_d in the desired body frame [rad/s]
    half_angle: float  # half the largest angle of q_d from [1, 0], at most π/2 [rad]
    pitch: float  # largest pitch, at most π/2 [rad]
    tilt: float  # largest angle between the body's z axis and the vertical [rad]
    eps: tuple[tuple[float, float], ...]  # w and the largest Σ|ε_d,k| + w ‖ε_d‖: both are large at few attitudes [1]
    voltages: tuple[float, ...]  # largest |u_k| of each motor present, without error and with θ̂ = 0 [V]


def extremes(settings: Settings) -> Extremes:
    """The extremes of a configuration's reference from its first tick on, for the body that its law assumes.

    Raises BoundlessError for a stream and for a reference too fast for floats, ValueError if B cannot be inverted.
    """
    law, inverse = settings.law, np.linalg.inv(motors(settings))
    if isinstance(settings.reference, Stream):
        raise BoundlessError(
            "a stream's set-points are not known beforehand: certify a reference like them, by --set reference.kind=…"
        )
    trajectory = Trajectory.of(settings.reference)
    slack = 1.0 if trajectory.swings else _SLACK
    with np.errstate(over="ignore", invalid="ignore"):
        angle, rate, acceleration, jerk = trajectory.peaks()
        half, rates, changes, torques = _products(trajectory, law)

        def voltage(row: Floats) -> float:
            return trajectory.largest(
                lambda at: np.abs(feedforward(at, law)[:, -len(row) :] @ row), torques * [np.linalg.norm(row), 1, 1, 1]
            )

        def weighed(w: float) -> float:
            return trajectory.largest(
                lambda at: np.linalg.norm(vectors(at), 1, axis=1) + w * np.linalg.norm(vectors(at), axis=1),
                half * [sqrt(3) + w, 1, 1, 1],
            )

        largest_sine = trajectory.largest(lambda at: np.linalg.norm(vectors(at), axis=1), half)
        found = Extremes(
            rate=slack * trajectory.fastest(),
            acceleration=slack * trajectory.largest(lambda at: np.linalg.norm(body_rates(at)[1], axis=1), changes),
            jerk=slack * jerk_bound(rate, acceleration, jerk),
            axis_rate=slack * trajectory.largest(lambda at: np.abs(body_rates(at)[0]).max(axis=1), rates),
            half_angle=min(pi / 2, slack * asin(min(1.0, largest_sine))),
            pitch=min(pi / 2, slack * float(angle[1])),
            tilt=min(pi, slack * trajectory.steepest()),
            eps=tuple((w, slack * weighed(w)) for w in _WEIGHTS),
            voltages=tuple(slack * voltage(row) for row in inverse),
        )
    if not isfinite(found.rate + found.acceleration + found.half_angle + found.jerk):
        raise BoundlessError("the reference is too fast for floating-point numbers: nothing can be certified")
    return found


def _products(trajectory: Trajectory, law: LawSettings) -> tuple[Floats, Floats, Floats, Floats]:
    """The products that q_d, ω_d, ω̇_d and the feedforward's torque are sums of. Shapes (m, 4) of `terms`.

    ω_d is a sum of an angle's rate times a unit vector that turns with roll and pitch, ω̇_d its derivative. Of ω × Jω
    counts ω × (J − jI)ω, with the mean j of the largest and the least moment.
    """
    angle, (r, p, y), (dr, dp, dy), _ = trajectory.peaks()
    a, b, _ = turning(angle)
    half = np.array([[1.0, *turning(angle / 2)]])
    rates = np.array([[r, 1, 0, 0], [p, a, 1, 0], [y, a, b, 1]])
    changes = np.array([
        [dr, 1, 0, 0], [dp, a, 1, 0], [dy, a, b, 1],
        [r * p, 1 + a, 1, 0], [r * y, 1 + a, b, 1], [p * y, a, 1 + b, 1],
    ])  # fmt: skip
    spread = (max(law.inertia) - min(law.inertia)) / 2
    squares = [[spread * one[0] * other[0], *(one + other)[1:]] for one in rates for other in rates]
    weight = law.mass * law.gravity * float(np.linalg.norm(law.centre_of_mass))
    torques = np.concatenate([changes * [max(law.inertia), 1, 1, 1], squares, [[weight, a, b, 0]]])
    return half, rates, changes, torques


def motors(settings: Settings) -> Floats:
    """B of the motors present. Raises ValueError if it cannot be inverted. Shape (m, m)."""
    # With two motors the mechanism holds the roll, and the first row and column of B are fictitious.
    if settings.wire.actuators not in (2, 3):
        raise ValueError(f"the theorem is about two or three motors, and wire.actuators is {settings.wire.actuators}")
    first = 3 - settings.wire.actuators
    B: Floats = np.array(settings.law.allocation)[first:, first:]
    check_invertible(B)
    return B


def jerk_bound(rate: Floats, acceleration: Floats, jerk: Floats) -> float:
    """A bound of ‖ω̈_d‖, from the largest of each angle's derivatives [rad/s³]. Shapes (3,)."""
    (d_roll, d_pitch, d_yaw), (dd_roll, dd_pitch, dd_yaw) = rate, acceleration
    turn, turn_dot = d_yaw + d_pitch, dd_yaw + dd_pitch + d_yaw * d_pitch  # of the roll's axis
    of_pitch = jerk[1] + 2 * dd_pitch * d_yaw + d_pitch * (dd_yaw + d_yaw**2)
    of_roll = jerk[0] + 2 * dd_roll * turn + d_roll * (turn_dot + turn**2)
    return float(np.hypot(jerk[2], of_pitch) + of_roll)


def body_rates(angles: Angles) -> tuple[Floats, Floats]:
    """ω_d and its derivative in the desired body frame [rad/s, rad/s²]. Shapes (n, 3)."""
    (roll, pitch, _), (dr, dp, dy), (ddr, ddp, ddy) = angles.angle.T, angles.rate.T, angles.acceleration.T
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    across, across_dot = dy * cp, ddy * cp - dy * dp * sp
    rate = np.stack([dr - dy * sp, dp * cr + across * sr, across * cr - dp * sr], axis=1)
    about_y = ddp * cr - dp * dr * sr + across_dot * sr + across * dr * cr
    about_z = across_dot * cr - across * dr * sr - ddp * sr - dp * dr * cr
    return rate, np.stack([ddr - ddy * sp - dy * dp * cp, about_y, about_z], axis=1)


def feedforward(angles: Angles, law: LawSettings) -> Floats:
    """The torque that the law commands without error and with θ̂ = 0, −Ψ + J R ω̇_d of (C.22) [N·m]. Shape (n, 3)."""
    omega, omega_dot = body_rates(angles)
    roll, pitch, _ = angles.angle.T
    up = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=1)
    J = np.array(law.inertia)
    weight = np.cross(np.array(law.centre_of_mass), -law.mass * law.gravity * up)
    torque: Floats = np.cross(omega, J * omega) - weight + J * omega_dot
    return torque


def chords(desired: Extremes, delta: float) -> Callable[[float], float]:
    """‖q^Q − q‖ as a function of half the attitude error [rad], for |ε_k^Q − ε_k| ≤ delta.

    The difference of η is at most δ ‖ε‖₁/η on the way from ε to ε^Q, and ‖ε − ε_d‖ at most twice the sine of half the
    half angle. Where η may vanish on the way, it is the bound of `attitude_error`, as for every attitude.
    """
    length = sqrt(3) * delta
    norms = np.linspace(0, sin(desired.half_angle), _STEPS)
    sums = np.min([most - w * norms[:-1] for w, most in desired.eps], axis=0)
    halves = np.arcsin(norms[1:])

    def chord(error: float) -> float:
        outer = np.sin(np.minimum(pi / 2, halves + error)) + length
        if outer[-1] >= 1:
            return attitude_error(length, min(pi / 2, desired.half_angle + error))
        slope = (sums + sqrt(3) * (2 * sin(error / 2) + length)) / np.sqrt(1 - outer**2)
        return delta * sqrt(3 + float(slope.max()) ** 2)

    return chord


def vectors(angles: Angles) -> Floats:
    """ε_d of each q_d. Shape (n, 3)."""
    (a, b, c), (x, y, z) = np.cos(angles.angle.T / 2), np.sin(angles.angle.T / 2)
    eps: Floats = np.stack([x * b * c - a * y * z, a * y * c + x * b * z, a * b * z - x * y * c], axis=1)
    return eps
