"""Control law of the paper: agrees with an independent twin and has the properties that the paper proves.

States, bodies and gains are random and states move, so that no term hides behind a zero, a symmetry or a product of
equal numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest

from aeroloop.service.control.laws.adaptive import AdaptiveSettings, projection
from tests.support import numpy_twin as twin
from tests.support.law_tick import Tick, acceleration, errors_at, unit
from tests.support.numpy_twin import Array
from tests.support.twin_body import body_of

both_signs = pytest.mark.parametrize("s", [1.0, -1.0])
both_bodies = pytest.mark.parametrize("paper", [True, False], ids=["paper's body", "random bodies"])


class Point(NamedTuple):
    """Everything that the law depends on but θ̂ and its sign."""

    q: Array
    omega: Array
    q_d: Array
    omega_d: Array
    omega_d_dot: Array


def point(rng: np.random.Generator) -> Point:
    omega, omega_d, omega_d_dot = rng.normal(size=(3, 3))
    return Point(unit(rng), omega, unit(rng), omega_d, omega_d_dot)


def estimate(rng: np.random.Generator, p: AdaptiveSettings) -> Array:
    """Every other θ̂ lies where the projection acts, up to k_θ/0.95."""
    length = rng.uniform(1.0, 1 / 0.95) if rng.uniform() < 0.5 else rng.uniform()
    return np.array(p.damping_estimate) + unit(rng, 3) * length * p.damping_bound


def random_settings(rng: np.random.Generator) -> AdaptiveSettings:
    """A body and gains that have nothing in common with Table C.1."""
    body = {"inertia": rng.uniform(0.5, 2, 3), "mass": rng.uniform(0.5, 2), "gravity": rng.uniform(5, 10)}
    body |= {"centre_of_mass": rng.normal(size=3), "damping_bound": rng.uniform(0.1, 2)}
    gains = {name: rng.uniform(0.1, 2, 3) for name in ("C1", "C2", "Gamma")}
    allocation = rng.normal(size=(3, 3)) + 3 * np.identity(3)  # + 3 I: well away from singular
    return AdaptiveSettings.model_validate({**body, **gains, "allocation": allocation})


def close(a: Array, b: Array) -> bool:
    """Equal but for rounding: 2e-16 through some hundred operations, times the condition of B, 900 for the paper's."""
    return bool(np.linalg.norm(a - b) <= 1e-12 * np.linalg.norm(b))


@both_signs
@both_bodies
def test_the_law_agrees_with_the_twin_at_moving_states(paper: bool, s: float) -> None:
    rng, period, projected = np.random.default_rng(1), 0.002, 0
    for _ in range(1 if paper else 5):
        p = AdaptiveSettings() if paper else random_settings(rng)
        tick, body, outer = Tick(p, period), body_of(p), p.damping_bound / 0.95
        for _ in range(100 if paper else 20):
            x, theta = point(rng), estimate(rng, p)
            found, t = tick(np.append(theta, s), *x), twin.law(body, *x, theta, s)
            moved = theta + period * t.theta_dot - body.centre
            after = body.centre + moved * min(1.0, outer / float(np.linalg.norm(moved)))
            e = np.append(found["eta_e"], found["eps_e"])
            pairs = ((e, t.e), (found["u"], t.u), (found["omega_e"], t.omega_e), (found["state_next"][:3], after))
            assert all(close(a, b) for a, b in pairs)
            projected += bool(np.any(t.theta_dot != t.tau))
    assert 10 < projected < 90  # of a hundred: both branches of the projection were drawn often


def lyapunov(
    p: AdaptiveSettings, x: Point, s: float, wrong: Array, omega_dot: Array, t: float
) -> tuple[float, Array, Array]:
    """V of (C.24), ε̃ and z₂ a little later than x; θ̂ moves by (C.23), which does not project."""
    J, C1, Gamma = map(np.array, (p.inertia, p.C1, p.Gamma))
    e, omega_e = errors_at(t, x.q, x.omega, omega_dot, *x[2:])
    z2 = omega_e + s * C1 * e[1:]
    wrong = wrong + t * Gamma * x.omega * z2
    return 2 * (1 - s * e[0]) + z2 @ (J * z2) / 2 + wrong @ (wrong / Gamma) / 2, e[1:], z2


@both_signs
@both_bodies
def test_without_quantization_the_lyapunov_function_falls_exactly_as_c25_says(paper: bool, s: float) -> None:
    """Along a body that is written out, by differences."""
    rng = np.random.default_rng(3)
    for _ in range(1 if paper else 4):
        p = AdaptiveSettings() if paper else random_settings(rng)
        tick = Tick(p)
        for _ in range(30):
            x, estimated, theta = point(rng), estimate(rng, p), rng.normal(size=3) * p.damping_bound
            torque = np.array(p.allocation) @ tick(np.append(estimated, s), *x)["u"] - theta * x.omega
            omega_dot = acceleration(p, x.q, x.omega, torque)
            later, (_, eps_e, z2), before = (
                lyapunov(p, x, s, theta - estimated, omega_dot, t) for t in (1e-6, 0, -1e-6)
            )
            promised = -eps_e @ np.diag(p.C1) @ eps_e - z2 @ np.diag(p.C2) @ z2  # (C.25) with (C.49)
            assert (later[0] - before[0]) / 2e-6 == pytest.approx(promised, rel=1e-5, abs=1e-8)


BOUND = 0.05  # k_θ, which is the projection's inner ball
GAMMA = np.array([0.02, 0.01, 0.05])


def test_the_projection_never_hurts_the_lyapunov_function() -> None:
    """Remark 5: −θ̃ᵀΓ⁻¹Proj(τ) ≤ −θ̃ᵀΓ⁻¹τ, for every θ of Assumption 2 and every θ̂ that the projection allows.

    τ has any direction and, over eight decades, any size. Near k_θ the inequality is tightest where θ and θ̂ are nearly
    parallel, so half of the θ are drawn there.
    """
    rng, helped = np.random.default_rng(9), 0
    symbols = ca.SX.sym("tau", 3), ca.SX.sym("theta", 3)
    proj = ca.Function("projection", symbols, [projection(*symbols, ca.diag(ca.SX(GAMMA)), BOUND)])
    for i in range(2000):
        tau, direction = rng.normal(size=3) * 10.0 ** rng.uniform(-6, 2), unit(rng, 3)
        theta = direction * BOUND / 0.95 * rng.uniform(0.9, 1.0)
        true = unit(rng, 3) if i % 2 else direction + 0.2 * unit(rng, 3)
        wrong = true / np.linalg.norm(true) * BOUND * rng.uniform() ** (1 / 3) - theta  # uniform in the whole ball
        projected, without = -(wrong / GAMMA) @ np.array(proj(tau, theta)).ravel(), -(wrong / GAMMA) @ tau
        # rounding of the two sums: 2e-16 times the size of their addends, some tens of operations
        assert projected <= without + 1e-14 * np.linalg.norm(wrong / GAMMA) * np.linalg.norm(tau)
        helped += projected < 0.99 * without
    assert helped > 200  # it did act, and by more than rounding


@pytest.mark.parametrize("gain", [1.0, 100.0])
def test_the_estimate_stays_within_its_bound_under_any_drive(gain: float) -> None:
    """Remark 5, with k_θ/0.95 for k_θ: at every tick and not only in continuous time."""
    rng, pressed = np.random.default_rng(10), 0
    p = AdaptiveSettings(Gamma=(0.02 * gain,) * 3)
    tick, first, x = Tick(p), np.array(p.damping_estimate), point(rng)
    theta = first + np.array([0.0, 0.0, p.damping_bound])
    for k in range(3000):
        if k % 300 == 0:
            x = point(rng)  # another drive, kept long enough to press against the bound
        theta = tick(np.append(theta, 1.0), *x)["state_next"][:3]
        pressed += bool(np.linalg.norm(theta - first) > p.damping_bound)
        # scaling to a length of k_θ/0.95 rounds in the last place
        assert np.linalg.norm(theta - first) <= p.damping_bound / 0.95 * (1 + 1e-14)
    assert pressed > 300
