"""Attitudes for drawing: without jumps of 360°, or of sign."""

from __future__ import annotations

import numpy as np

from aeroloop.service.logs.traces import Array


def without_jumps(angles: Array, last: Array) -> Array:
    """Angles ±360°, each row nearest to the row before, the first to `last` [deg]. Shapes (n, 3) and (3,)."""
    return np.unwrap(np.vstack([last, angles]), period=360.0, axis=0)[1:]


def beside(angles: Array, others: Array) -> Array:
    """Angles ±360°, nearest to others [deg]. Shapes (n, 3)."""
    return np.asarray(others + (angles - others + 180.0) % 360.0 - 180.0)


def of_nearer_sign(q: Array, desired: Array) -> Array:
    """Of ±q, which are the same attitude, the one nearer to the desired one. Shapes (n, 4)."""
    return np.where(np.sum(q * desired, axis=1, keepdims=True) < 0, -q, q)
