"""Extremes of a reference: the bounds k_ω_d and k_ω̇_d of Assumption 1, and the largest angle.

They are maxima over the samples that also check an operator's references. Samples are within half a percent of the
extremes, and Assumption 1 requires bounds that are not reached: half a percent is added. A sinusoid is sampled over
eight periods of its slowest axis, which is all of it where the frequencies have small common multiples.
"""

from __future__ import annotations

from math import isfinite, pi
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.operator import Reference, Stream
from aeroloop.service.control.reference import Angles, Floats, Plan

_SLACK: Final = 1.005


class BoundlessError(AeroloopError):
    """A reference without bounds; one line."""


class Extremes(NamedTuple):
    """Bounds that a reference never exceeds.

    Attributes:
        rate: k_ω_d, largest ‖ω_d‖ [rad/s].
        acceleration: k_ω̇_d, largest ‖ω̇_d‖ [rad/s²].
        half_angle: Half the largest angle of q_d from [1, 0], at most π/2 [rad].
    """

    rate: float
    acceleration: float
    half_angle: float


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
    if not isfinite(rate + acceleration + half_angle):
        raise BoundlessError("the reference is too fast for floating-point numbers: nothing can be certified")
    return Extremes(_SLACK * rate, _SLACK * acceleration, min(pi / 2, _SLACK * half_angle))


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
