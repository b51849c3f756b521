"""Attitude conventions, (C.3)–(C.11): one definition for both ends.

A quaternion `q = [η, ε]` is scalar first, multiplies as Hamilton's, and turns body vectors into the inertial frame
through `R(q)`. Axes: x roll, y pitch, z yaw, z up. Euler angles are roll, pitch, yaw in radians, applied Z–Y–X. First
plain floats, for the loop; then CasADi expressions, for equations. S, T and R are the paper's matrices.
"""

from __future__ import annotations

from math import acos, asin, atan2, copysign, hypot, pi, sqrt
from typing import TypeAlias

import casadi as ca

Quaternion: TypeAlias = tuple[float, float, float, float]  # [η, ε₁, ε₂, ε₃], unit length

Vector: TypeAlias = tuple[float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def to_euler(q: Quaternion) -> Vector:
    """[roll, pitch, yaw] in rad of a unit quaternion; pitch within ±π/2, roll and yaw within ±π."""
    w, x, y, z = q
    roll = atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    sine = 2 * (w * y - z * x)
    pitch = asin(sine) if -1 < sine < 1 else copysign(pi / 2, sine)
    yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def sent_vector(q: Quaternion) -> Vector:
    """ε as it is sent: that of ±q, one attitude, with η ≥ 0. η itself is never sent (Remark 1)."""
    w, x, y, z = q
    return (x, y, z) if w >= 0 else (-x, -y, -z)


def received_quaternion(x: float, y: float, z: float, last: Quaternion) -> Quaternion:
    """q of a received ε: η = +√(1 − εᵀε) by (C.11), then of ±q the one nearest to `last`.

    Near η = 0 quantization can make ‖ε‖ > 1; then ε is scaled to unit length (Remark 2).
    """
    square = x * x + y * y + z * z
    if square <= 1.0:
        w = sqrt(1.0 - square)
    else:
        w, length = 0.0, sqrt(square)
        x, y, z = x / length, y / length, z / length
    if w * last[0] + x * last[1] + y * last[2] + z * last[3] < 0.0:
        return -w, -x, -y, -z
    return w, x, y, z


def angle(x: float, y: float, z: float) -> float:
    """The rotation angle in rad, 0…π, of an error quaternion's vector part ε̃."""
    return 2 * asin(min(1.0, hypot(x, y, z)))


def distance(p: Quaternion, q: Quaternion) -> float:
    """The angle in rad, 0…π, of the rotation between two attitudes."""
    return 2 * acos(min(1.0, abs(sum(a * b for a, b in zip(p, q, strict=True)))))


def S(v: ca.SX) -> ca.SX:
    """Skew-symmetric matrix of (C.7): `S(a) b = a × b`. Shape (3, 3)."""
    return ca.skew(v)


def T(q: ca.SX) -> ca.SX:
    """Kinematics of (C.3): `q̇ = T(q) ω`, ω in the body frame. Shape (4, 3)."""
    eta, eps = q[0], q[1:4]
    return 0.5 * ca.vertcat(-eps.T, eta * ca.SX.eye(3) + S(eps))


def R(q: ca.SX) -> ca.SX:
    """Rotation matrix of (C.8), body to inertial. In SO(3) as in (C.9), moving as in (C.10). Shape (3, 3)."""
    eta, eps = q[0], q[1:4]
    return ca.SX.eye(3) + 2 * eta * S(eps) + 2 * S(eps) @ S(eps)


def conjugate(q: ca.SX) -> ca.SX:
    """The inverse rotation `q̄ = [η, −ε]`. Shape (4, 1)."""
    return ca.vertcat(q[0], -q[1:4])


def product(p: ca.SX, q: ca.SX) -> ca.SX:
    """Hamilton product `p ⊗ q`. Shape (4, 1)."""
    return ca.vertcat(p[0] * q[0] - ca.dot(p[1:4], q[1:4]), p[0] * q[1:4] + q[0] * p[1:4] + ca.cross(p[1:4], q[1:4]))


def from_euler(angles: ca.SX) -> ca.SX:
    """Quaternion of [roll, pitch, yaw] in rad: yaw about z, then pitch about y, then roll about x. Shape (4, 1)."""
    return from_half_angles(ca.sin(angles / 2), ca.cos(angles / 2))


def from_half_angles(s: ca.SX, c: ca.SX) -> ca.SX:
    """The same, of the sines and cosines of half these angles. Shape (4, 1)."""
    about_x = ca.vertcat(c[0], s[0], 0, 0)
    about_y = ca.vertcat(c[1], 0, s[1], 0)
    about_z = ca.vertcat(c[2], 0, 0, s[2])
    return product(product(about_z, about_y), about_x)
