"""Extremes of a reference: the bounds k_ω_d and k_ω̇_d of Assumption 1, and the largest angle.

They are maxima over the samples that also check an operator's references. Samples are within half a percent of the
extremes, and Assumption 1 requires bounds that are not reached: half a percent is added. A sinusoid is sampled over
eight periods of its slowest axis, which is all of it where the frequencies have small common multiples.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, pi, sin, sqrt
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Reference, Stream
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.reference import Angles, Floats, Plan
from aeroloop.service.theorem.bounds import attitude_error

_SLACK: Final = 1.005


class BoundlessError(AeroloopError):
    """A reference without bounds; one line."""


class Extremes(NamedTuple):
    """Bounds that a reference never exceeds.

    Attributes:
        rate: k_ω_d, largest ‖ω_d‖ [rad/s].
        acceleration: k_ω̇_d, largest ‖ω̇_d‖ [rad/s²].
        jerk: largest ‖ω̈_d‖ [rad/s³].
        axis_rate: Largest element of ω_d in the desired body frame [rad/s].
        half_angle: Half the largest angle of q_d from [1, 0], at most π/2 [rad].
        tilt: Largest pitch, at most π/2 [rad].
        samples: The samples that these are the maxima of.
    """

    rate: float
    acceleration: float
    jerk: float
    axis_rate: float
    half_angle: float
    tilt: float
    samples: Angles


def extremes(reference: Reference) -> Extremes:
    """The extremes of a reference from its first tick on.

    Raises:
        BoundlessError: A stream, as its set-points have no bounds, or a reference too fast for floats.
    """
    if isinstance(reference, Stream):
        raise BoundlessError(
            "a stream's set-points are not known beforehand: certify a reference like them, by --set reference.kind=…"
        )
    plan = Plan.of(reference)
    with np.errstate(over="ignore", invalid="ignore"):
        samples = plan.samples()
        rate, acceleration = plan.fastest(), float(np.linalg.norm(accelerations(samples), axis=1).max())
        half_angle = float(half_angles(samples).max())
        jerk = jerk_bound(samples, plan.third())
        axis_rate = float(np.abs(body_rates(samples)[0]).max())
    if not isfinite(rate + acceleration + half_angle + jerk):
        raise BoundlessError("the reference is too fast for floating-point numbers: nothing can be certified")
    return Extremes(
        _SLACK * rate,
        _SLACK * acceleration,
        _SLACK * jerk,
        _SLACK * axis_rate,
        min(pi / 2, _SLACK * half_angle),
        min(pi / 2, _SLACK * float(np.abs(samples.angle[:, 1]).max())),
        samples,
    )


def jerk_bound(angles: Angles, third: Floats) -> float:
    """A bound of ‖ω̈_d‖, from the largest of each angle's derivatives [rad/s³].

    Args:
        angles: Samples. Shapes (n, 3).
        third: Largest third derivatives of roll, pitch, yaw [rad/s³]. Shape (3,).
    """
    (d_roll, d_pitch, d_yaw), (dd_roll, dd_pitch, dd_yaw) = (
        np.abs(part).max(axis=0) for part in (angles.rate, angles.acceleration)
    )
    turn, turn_dot = (
        d_yaw + d_pitch,
        dd_yaw + dd_pitch + d_yaw * d_pitch,
    )  # of the roll's axis
    of_pitch = third[1] + 2 * dd_pitch * d_yaw + d_pitch * (dd_yaw + d_yaw**2)
    of_roll = third[0] + 2 * dd_roll * turn + d_roll * (turn_dot + turn**2)
    return float(np.hypot(third[2], of_pitch) + of_roll)


def body_rates(angles: Angles) -> tuple[Floats, Floats]:
    """ω_d and its derivative in the desired body frame [rad/s, rad/s²]. Shapes (n, 3)."""
    (roll, pitch, _), (dr, dp, dy), (ddr, ddp, ddy) = angles.angle.T, angles.rate.T, angles.acceleration.T
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    rate = np.stack([dr - dy * sp, dp * cr + dy * cp * sr, -dp * sr + dy * cp * cr], axis=1)
    acceleration = np.stack(
        [
            ddr - ddy * sp - dy * dp * cp,
            ddp * cr - dp * dr * sr + (ddy * cp - dy * dp * sp) * sr + dy * cp * dr * cr,
            -ddp * sr - dp * dr * cr + (ddy * cp - dy * dp * sp) * cr - dy * cp * dr * sr,
        ],
        axis=1,
    )
    return rate, acceleration


def feedforward(angles: Angles, law: AdaptiveSettings) -> Floats:
    """The torque that the law commands without error and with θ̂ = 0, −Ψ + J R ω̇_d of (C.22) [N·m]. Shape (n, 3)."""
    omega, omega_dot = body_rates(angles)
    roll, pitch, _ = angles.angle.T
    up = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=1)
    J = np.array(law.inertia)
    weight = np.cross(np.array(law.centre_of_mass), -law.mass * law.gravity * up)
    torque: Floats = np.cross(omega, J * omega) - weight + J * omega_dot
    return torque


def accelerations(angles: Angles) -> Floats:
    """ω̇_d in a frame that yaws with the body; its norm is the same in every frame [rad/s²]. Shape (n, 3).

    ω_d = ψ̇ z + θ̇ y + φ̇ x for roll φ, pitch θ, yaw ψ about axes of which y turns with the yaw and x with both.
    """
    _, pitch, _ = angles.angle.T
    d_roll, d_pitch, d_yaw = (rate[:, None] for rate in angles.rate.T)
    dd_roll, dd_pitch, dd_yaw = (acceleration[:, None] for acceleration in angles.acceleration.T)
    z, y = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])
    x = np.stack([np.cos(pitch), np.zeros_like(pitch), -np.sin(pitch)], axis=1)
    turning = d_yaw * z + d_pitch * y  # of x; the yaw alone turns y
    turned = d_pitch * d_yaw * np.cross(z, y) + d_roll * np.cross(turning, x)
    omega_d_dot: Floats = dd_yaw * z + dd_pitch * y + dd_roll * x + turned
    return omega_d_dot


def half_angles(angles: Angles) -> Floats:
    """Half the angle of each q_d from [1, 0], for the nearer of ±q_d, 0…π/2 [rad]. Shape (n,)."""
    (a, b, c) = angles.angle.T / 2
    eta_d = np.cos(a) * np.cos(b) * np.cos(c) + np.sin(a) * np.sin(b) * np.sin(c)
    nearest: Floats = np.arccos(np.minimum(1.0, np.abs(eta_d)))
    return nearest


def chords(angles: Angles, delta: float) -> Callable[[float], float]:
    """‖q^Q − q‖ as a function of half the attitude error [rad], for |ε_k^Q − ε_k| ≤ delta.

    The difference of η is at most δ ‖ε‖₁/η on the way from ε to ε^Q, and ‖ε − ε_d‖ at most twice the sine of half the
    half angle. Where η may vanish on the way, it is the bound of `attitude_error`, as for every attitude.
    """
    half = _SLACK * half_angles(angles)
    eps = _SLACK * np.abs(vectors(angles)).sum(axis=1)
    length = sqrt(3) * delta

    def chord(error: float) -> float:
        outer = np.sin(np.minimum(pi / 2, half + error)) + length
        if outer.max() >= 1:
            return attitude_error(length, min(pi / 2, float(half.max()) + error))
        slope = (eps + sqrt(3) * (2 * sin(error / 2) + length)) / np.sqrt(1 - outer**2)
        return delta * sqrt(3 + float(slope.max()) ** 2)

    return chord


def vectors(angles: Angles) -> Floats:
    """ε_d of each q_d. Shape (n, 3)."""
    (a, b, c) = angles.angle.T / 2
    eps: Floats = np.stack(
        [
            np.sin(a) * np.cos(b) * np.cos(c) - np.cos(a) * np.sin(b) * np.sin(c),
            np.cos(a) * np.sin(b) * np.cos(c) + np.sin(a) * np.cos(b) * np.sin(c),
            np.cos(a) * np.cos(b) * np.sin(c) - np.sin(a) * np.sin(b) * np.cos(c),
        ],
        axis=1,
    )
    return eps
