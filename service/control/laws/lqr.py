"""LQR law about the reference: the discrete-time optimal regulator of the errors over the feedforward of the model.

    symbol   name in code          meaning                                          unit             shape
    φ        2 · sign · eps_e      attitude error, to first order the angle         rad              3
    q_φ      attitude_weight       of φ², against the square of the torque          (N·m/rad)²       3
    q_ω      rate_weight           of ω_e², likewise                                (N·m·s/rad)²     3
    K        gain                  optimal gain                                     N·m, N·m·s       3 × 2

    τ = −K [±2ε̃, ω_e]

With the feedforward an axis is a double integrator, J φ̈ = τ, held for a period. K is computed from the stabilising
solution of its discrete-time algebraic Riccati equation when the law is built; it holds near the reference only.
Regulator: B. D. O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990. Solution by doubling: E.
K.-W. Chu, H.-Y. Fan, W.-W. Lin and C.-S. Wang, Structure-Preserving Algorithms for Periodic Discrete-Time Algebraic
Riccati Equations, International Journal of Control 77(8), 2004.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import casadi as ca
import numpy as np
from pydantic import Field, NonNegativeFloat

from aeroloop.service.control.laws.interface import Diagonal, Floats, Now, Vector
from aeroloop.service.control.laws.tracking import TrackingLaw, TrackingSettings
from aeroloop.service.control.laws.tuning import PAPER, PAPER_BODY, tune_lqr

_TUNED = tune_lqr(PAPER_BODY, PAPER)
_DOUBLINGS: Final = 60
"""Each doubles the horizon in ticks; a loop that slow has ended before."""


class LQRSettings(TrackingSettings):
    """Model of the plant and weights. The default weights are those of the tuning rule."""

    kind: Literal["lqr"] = Field(default="lqr", description="which law")
    attitude_weight: Diagonal = Field(
        default=_TUNED["attitude_weight"], description="q_φ, of the angle's square against the torque's [(N·m/rad)²]"
    )
    rate_weight: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = Field(
        default=_TUNED["rate_weight"], description="q_ω, of the rate's square against the torque's [(N·m·s/rad)²]"
    )


class LQR(TrackingLaw[LQRSettings]):
    """LQR with feedforward. Its gains follow from weights and period, so none may change while it runs."""

    Settings = LQRSettings

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """Optimal for small errors."""
        p = self.settings
        K = ca.SX(optimal_gains(p.inertia, p.attitude_weight, p.rate_weight, self.period))
        return -K[:, 0] * 2 * sign * now.attitude_error[1:4] - K[:, 1] * now.rate_error, {}


def optimal_gains(inertia: Vector, attitude_weight: Vector, rate_weight: Vector, period: float) -> Floats:
    """Gains of angle [N·m/rad] and rate [N·m·s/rad], a row an axis. Shape (3, 2)."""
    axes = zip(inertia, attitude_weight, rate_weight, strict=True)
    found: Floats = np.array([_gain(J, np.diag([angle, rate]), period) for J, angle, rate in axes])
    return found


def _gain(J: float, Q: Floats, T: float) -> Floats:
    """K of x⁺ = A x + B τ and the cost Σ xᵀQx + τ². Shape (2,)."""
    A = np.array([[1.0, T], [0.0, 1.0]])
    B = np.array([[T * T / 2], [T]]) / J
    X = riccati(A, B @ B.T, Q)
    gain: Floats = (B.T @ X @ A / (1 + B.T @ X @ B))[0]
    return gain


def riccati(A: Floats, G: Floats, Q: Floats) -> Floats:
    """The stabilising X = AᵀX(I + GX)⁻¹A + Q, by doubling. Shapes (n, n).

    Raises:
        ValueError: The doubling does not end.
    """
    X = Q
    for _ in range(_DOUBLINGS):
        W = np.linalg.inv(np.eye(len(A)) + G @ X)
        A, G, X, last = A @ W @ A, G + A @ W @ G @ A.T, X + A.T @ X @ W @ A, X
        if np.abs(X - last).max() <= 1e-14 * np.abs(X).max():
            return X
    raise ValueError("law: these weights and this period have no optimal gains")
