"""Search in a cube: random points first, then mutations of the best."""

from __future__ import annotations

from typing import Final

import numpy as np

from aeroloop.service.control.reference import Floats

_FRESH: Final = 0.25
"""Share of points that are drawn at random although there are parents."""
_MUTATED: Final = 0.3
"""Share of a parent's coordinates that change."""
_OVERSHOOT: Final = 1.5
"""So that a third of the coordinates of a random point are extremes, where an adversary mostly wants them."""
_DECIMALS: Final = 4


def proposals(rng: np.random.Generator, parents: Floats, count: int, size: int) -> Floats:
    """Points of the cube −1…1, rounded to keep text short. Shape (count, size), of the parents (m, size), m ≥ 0."""
    fresh = np.clip(rng.uniform(-_OVERSHOOT, _OVERSHOOT, (count, size)), -1, 1)
    if not len(parents):
        return fresh.round(_DECIMALS)
    chosen = parents[rng.integers(len(parents), size=count)]
    step = 10 ** rng.uniform(-2.5, 0, (count, 1)) * rng.normal(size=(count, size))
    moved = np.clip(chosen + step * (rng.random((count, size)) < _MUTATED), -1, 1)
    points: Floats = np.where(rng.random((count, 1)) < _FRESH, fresh, moved).round(_DECIMALS)
    return points


def ball(cube: Floats) -> Floats:
    """Points of the cube −1…1 moved into the unit ball, its surface onto the sphere. Shape as given, (n, m)."""
    length = np.linalg.norm(cube, axis=1, keepdims=True)
    points: Floats = cube * (np.abs(cube).max(axis=1, keepdims=True) / np.maximum(length, 1e-300))
    return points
