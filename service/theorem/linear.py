"""Gains of the linear error equations, from a start and from bounded disturbances, by variation of constants.

For ε̄' = −C₁/2 ε̄ + z̄/2 + d₁ and J z̄' = −φ (ε̄ + C₂ z̄) + d₂, of each axis, with E₁ = (1, 0) and E₂ = (0, 1/J):
‖h x(t)‖ ≤ ‖x(t₀)‖ sup ‖h e^{As}‖ + D₁ ∫‖h e^{As} E₁‖ ds + D₂ ∫‖h e^{As} E₂‖ ds.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.control.reference import Floats

_SAMPLES: Final = 1000
"""Times of e^{As} until it has fallen by e^{-20}; the quadrature is rounded up by `_SLACK`."""
_SLACK: Final = 1.002


class Gains(NamedTuple):
    """Gains of one output h x: from ‖x(t₀)‖, from D₁ and from D₂."""

    start: float
    d1: float
    d2: float


class Outputs(NamedTuple):
    """Gains of ε̄, z̄, ω_e = z̄ − C₁ ε̄, the torque ε̄ + C₂ z̄, and x itself."""

    eps: Gains
    z: Gains
    omega: Gains
    torque: Gains
    x: Gains


@lru_cache(maxsize=256)
def gains_of(axes: tuple[Vector, ...], phi: float) -> Outputs | None:
    """Gains of the outputs, of the worst axis at every time; None if an axis does not decay.

    Args:
        axes: (C₁, C₂, J) of each axis.
        phi: φ.
    """
    matrices = [np.array([[-c1 / 2, 0.5], [-phi / j, -phi * c2 / j]]) for c1, c2, j in axes]
    slowest = min(-np.linalg.eigvals(A).real.max() for A in matrices)
    if slowest <= 0:
        return None
    fastest = max(np.abs(np.linalg.eigvals(A)).max() for A in matrices)
    s = np.append(0.0, np.geomspace(1e-4 / fastest, 20 / slowest, _SAMPLES))
    rows = [_exponential(A, s) for A in matrices]
    outputs = [
        np.array([(1.0, 0.0) for _ in axes]),
        np.array([(0.0, 1.0) for _ in axes]),
        np.array([(-c1, 1.0) for c1, _, _ in axes]),
        np.array([(1.0, c2) for _, c2, _ in axes]),
    ]
    through = [[np.einsum("k,nkl->nl", h[i], rows[i]) for i in range(len(axes))] for h in outputs]
    inputs = [np.array([[1.0, 0.0], [0.0, 1 / j]]) for _, _, j in axes]

    def gains(start: list[Floats], forced: list[Floats]) -> Gains:
        size = np.max([np.abs(f) for f in forced], axis=0)
        d1, d2 = np.trapezoid(size, s, axis=0) * _SLACK
        return Gains(float(np.max(start)) * _SLACK, float(d1), float(d2))

    eps, z, omega, torque = (
        gains([np.linalg.norm(t, axis=1) for t in ts], [t @ E for t, E in zip(ts, inputs, strict=True)])
        for ts in through
    )
    whole = gains(
        [_largest_singular(X) for X in rows],
        [np.linalg.norm(X @ E, axis=1) for X, E in zip(rows, inputs, strict=True)],
    )
    return Outputs(eps, z, omega, torque, whole)


def _exponential(A: Floats, s: Floats) -> Floats:
    """e^{As} of a 2 × 2 matrix, by Sylvester's formula. Shape (n, 2, 2)."""
    mean, deviator = np.trace(A) / 2, A - np.identity(2) * np.trace(A) / 2
    root = np.sqrt(complex(-np.linalg.det(deviator)))
    faster, slower = np.exp((mean - root) * s), np.exp((mean + root) * s)
    even, odd = (slower + faster) / 2, (slower - faster) / (2 * root) if root else s * slower
    exponential: Floats = np.real(even[:, None, None] * np.identity(2) + odd[:, None, None] * deviator)
    return exponential


def _largest_singular(X: Floats) -> Floats:
    """The norm of each 2 × 2 matrix. Shape (n,)."""
    square = (X**2).sum(axis=(1, 2))
    norm: Floats = np.sqrt((square + np.sqrt(np.maximum(0.0, square**2 - 4 * np.linalg.det(X) ** 2))) / 2)
    return norm
