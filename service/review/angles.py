"""Roll, pitch and yaw for drawing: in degrees, and without jumps of 360°."""

from __future__ import annotations

import numpy as np

from aeroloop.service.logs.traces import Array


def roll_pitch_yaw(q: Array) -> Array:
    """`protocol.wire.attitude.to_euler` of many unit quaternions, in degrees. Shapes (n, 4) and (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.asarray(np.degrees(np.column_stack([roll, pitch, yaw])))


def without_jumps(angles: Array, last: Array) -> Array:
    """Angles ±360°, each row nearest to the row before, the first to `last` [deg]. Shapes (n, 3) and (3,)."""
    return np.unwrap(np.vstack([last, angles]), period=360.0, axis=0)[1:]


def beside(angles: Array, others: Array) -> Array:
    """Angles ±360°, nearest to others [deg]. Shapes (n, 3)."""
    return np.asarray(others + (angles - others + 180.0) % 360.0 - 180.0)


def of_nearer_sign(q: Array, desired: Array) -> Array:
    """Of ±q, which are the same attitude, the one nearer to the desired one. Shapes (n, 4)."""
    return np.where(np.sum(q * desired, axis=1, keepdims=True) < 0, -q, q)
