"""Fixed-step integration, unrolled into one CasADi expression: the same steps in the same order every time."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca


def rk4(derivative: Callable[[ca.SX], ca.SX], x: ca.SX, period: float, substeps: int) -> ca.SX:
    """The state one period later, by the classical fourth-order Runge–Kutta method.

    Args:
        derivative: ẋ of a state, inputs held. Shape (n,) to (n,).
        x: State at the start. Shape (n,).
        period: Time to pass [s].
        substeps: Number of equal steps within it.
    """
    h = period / substeps
    for _ in range(substeps):
        k1 = derivative(x)
        k2 = derivative(x + h / 2 * k1)
        k3 = derivative(x + h / 2 * k2)
        k4 = derivative(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
