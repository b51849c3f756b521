"""The law is the paper's: it agrees with an independent twin, and what the paper proves of it holds of it.

States are random and moving, gains are random and not the default, so that no term is hidden behind a zero, a symmetry
or a product of equal numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
import pytest

from service.law import Law, LawSettings, build_law, law_function, projection
from tests.service import numpy_twin as twin
from tests.service.numpy_twin import Array

SIGNS = (1.0, -1.0)
DRAWS = 100
PERIOD = 0.002


@dataclass(frozen=True)
class Point:
    """Everything that the law depends on, and the true θ that it does not know."""

    q: Array
    omega: Array
    q_d: Array
    omega_d: Array
    omega_d_dot: Array
    theta: Array
    true_theta: Array


def _unit(rng: np.random.Generator) -> Array:
    q = rng.normal(size=4)
    return np.asarray(q / np.linalg.norm(q), dtype=np.float64)


def _point(rng: np.random.Generator, bound: float) -> Point:
    """A moving state. θ̂ lies anywhere within k_θ, so some draws fall where the projection acts."""
    theta = rng.normal(size=3)
    theta *= bound * rng.uniform() ** 0.2 / np.linalg.norm(theta)
    return Point(
        _unit(rng),
        rng.normal(size=3),
        _unit(rng),
        rng.normal(size=3),
        rng.normal(size=3),
        theta,
        rng.normal(size=3) * bound,
    )


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _settings(rng: np.random.Generator) -> LawSettings:
    """A body and gains that have nothing in common with Table C.1."""
    allocation = rng.normal(size=(3, 3)) + 3 * np.identity(3)  # far from singular: rounding stays near 1e-16
    return LawSettings(
        inertia=_triple(rng.uniform(0.5, 2.0, 3)),
        mass=float(rng.uniform(0.5, 2.0)),
        gravity=float(rng.uniform(5.0, 10.0)),
        centre_of_mass=_triple(rng.normal(size=3)),
        allocation=(_triple(allocation[0]), _triple(allocation[1]), _triple(allocation[2])),
        C1=_triple(rng.uniform(0.1, 2.0, 3)),
        C2=_triple(rng.uniform(0.1, 2.0, 3)),
        Gamma=_triple(rng.uniform(0.1, 2.0, 3)),
        damping_bound=float(rng.uniform(0.1, 2.0)),
    )


def _body(p: LawSettings) -> twin.Body:
    return twin.Body(
        J=np.diag(p.inertia),
        m=p.mass,
        g=p.gravity,
        r_g=np.array(p.centre_of_mass),
        B=np.array(p.allocation),
        C1=np.diag(p.C1),
        C2=np.diag(p.C2),
        Gamma=np.diag(p.Gamma),
        bound=p.damping_bound,
    )


def _array(value: ca.DM) -> Array:
    return np.array(value, dtype=np.float64).ravel()


@pytest.mark.parametrize("s", SIGNS)
@pytest.mark.parametrize("body", ["paper", "random"])
def test_the_law_agrees_with_the_twin_at_moving_states(body: Literal["paper", "random"], s: float) -> None:
    rng = np.random.default_rng(1)
    projected = 0
    for _ in range(DRAWS):
        p = LawSettings() if body == "paper" else _settings(rng)
        x = _point(rng, p.damping_bound)
        u, theta_next, eta_e, eps_e, omega_e = (
            _array(value)
            for value in law_function(p, PERIOD)(x.q, x.omega, x.q_d, x.omega_d, x.omega_d_dot, x.theta, s)
        )
        expected = twin.law(_body(p), x.q, x.omega, x.q_d, x.omega_d, x.omega_d_dot, x.theta, s)

        # Both compute in doubles (2e-16) through some hundred operations, and B⁻¹ multiplies what rounding left before
        # it by its condition, 900 for the paper's B: 1e-12 of the vector's length is reached only by equal equations.
        def close(a: Array, b: Array) -> bool:
            return bool(np.linalg.norm(a - b) <= 1e-12 * np.linalg.norm(b))

        assert close(u, expected.u)
        assert close(theta_next - x.theta, PERIOD * expected.theta_dot) or close(
            theta_next, x.theta + PERIOD * expected.theta_dot
        )
        assert close(np.append(eta_e, eps_e), expected.e)
        assert close(omega_e, expected.omega_e)
        projected += bool(np.any(expected.theta_dot != expected.tau))
    assert 10 < projected < 90  # both branches of the projection were drawn often
