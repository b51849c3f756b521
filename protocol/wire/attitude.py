"""Attitude conventions, (C.3)–(C.11): one definition for both ends.

A quaternion `q = [η, ε]` is scalar first, multiplies as Hamilton's, and turns body vectors into the inertial frame
through `R(q)`. Axes: x roll, y pitch, z yaw, z up. Euler angles are roll, pitch, yaw in radians, applied Z–Y–X.

Here are plain floats, for the loop; `rotations.py` has the equations in CasADi.
"""

from __future__ import annotations

from math import acos, asin, atan2, copysign, hypot, pi, sqrt
from typing import TypeAlias

Quaternion: TypeAlias = tuple[float, float, float, float]
"""[η, ε₁, ε₂, ε₃], unit length."""

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
    """ε as it is sent: that of ±q with η ≥ 0.

    q and −q are the same attitude, so the receiver can assume η ≥ 0. η itself is never sent (Remark 1).
    """
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
