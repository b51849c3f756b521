"""Control law of the paper: agrees with an independent twin and has the properties that the paper proves.

States, bodies and gains are random and states move, so that no term hides behind a zero, a symmetry or a product of
equal numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from aeroloop.service.control.laws.adaptive import Adaptive, AdaptiveSettings, projection
from aeroloop.service.control.laws.registry import law_function
from tests.support import numpy_twin as twin
from tests.support.adversary_loop import times as product
from tests.support.numpy_twin import Array
from tests.support.twin_body import body_of

both_signs = pytest.mark.parametrize("s", [1.0, -1.0])
both_bodies = pytest.mark.parametrize("paper", [True, False], ids=["paper's body", "random bodies"])


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


def _sent(q: Array) -> Array:
    """ε on the wire: of whichever of ±q has η ≥ 0."""
    return q[1:] if q[0] >= 0 else -q[1:]


def _unit(rng: np.random.Generator, size: int) -> Array:
    v = rng.normal(size=size)
    return np.asarray(v / np.linalg.norm(v), dtype=np.float64)


def _point(rng: np.random.Generator, p: AdaptiveSettings) -> Point:
    """A moving state; every other θ̂ lies where the projection acts, up to k_θ/0.95."""
    bound = p.damping_bound
    length = rng.uniform(1.0, 1 / 0.95) if rng.uniform() < 0.5 else rng.uniform()
    return Point(
        q=_unit(rng, 4),
        omega=rng.normal(size=3),
        q_d=_unit(rng, 4),
        omega_d=rng.normal(size=3),
        omega_d_dot=rng.normal(size=3),
        theta=np.array(p.damping_estimate) + _unit(rng, 3) * length * bound,
        true_theta=rng.normal(size=3) * bound,
    )


def _random_settings(rng: np.random.Generator) -> AdaptiveSettings:
    """A body and gains that have nothing in common with Table C.1."""
    body = {"inertia": rng.uniform(0.5, 2, 3), "mass": rng.uniform(0.5, 2), "gravity": rng.uniform(5, 10)}
    body |= {"centre_of_mass": rng.normal(size=3), "damping_bound": rng.uniform(0.1, 2)}
    gains = {name: rng.uniform(0.1, 2, 3) for name in ("C1", "C2", "Gamma")}
    allocation = rng.normal(size=(3, 3)) + 3 * np.identity(3)  # + 3 I: well away from singular
    return AdaptiveSettings.model_validate({**body, **gains, "allocation": allocation})


def _array(value: ca.DM) -> Array:
    return np.array(value, dtype=np.float64).ravel()


class Tick:
    """One tick of the law with three motors: its outputs by their names."""

    def __init__(self, p: AdaptiveSettings, period: float) -> None:
        self._function = law_function(Adaptive(p, period, 3))
        self._gains = [*p.C1, *p.C2, *p.Gamma]

    def __call__(self, x: Point, sign: float, theta: Array | None = None) -> dict[str, Array]:
        state = [*(x.theta if theta is None else theta), sign]
        motion = {"omega": x.omega, "q_d": x.q_d, "omega_d": x.omega_d, "omega_d_dot": x.omega_d_dot}
        found = self._function(last=x.q, state=state, gains=self._gains, eps=_sent(x.q), **motion)
        return {name: _array(value) for name, value in found.items()}


def _close(a: Array, b: Array) -> bool:
    """Equal but for rounding: 2e-16 through some hundred operations, times the condition of B, 900 for the paper's."""
    return bool(np.linalg.norm(a - b) <= 1e-12 * np.linalg.norm(b))


@both_signs
@both_bodies
def test_the_law_agrees_with_the_twin_at_moving_states(paper: bool, s: float) -> None:
    rng, period = np.random.default_rng(1), 0.002
    projected = 0
    for _ in range(1 if paper else 5):
        p = AdaptiveSettings() if paper else _random_settings(rng)
        tick = Tick(p, period)
        for _ in range(100 if paper else 20):
            x = _point(rng, p)
            found, body = tick(x, s), body_of(p)
            t = twin.law(body, x.q, x.omega, x.q_d, x.omega_d, x.omega_d_dot, x.theta, s)
            moved, outer = x.theta + period * t.theta_dot - body.centre, p.damping_bound / 0.95
            after = body.centre + moved * min(1.0, outer / float(np.linalg.norm(moved)))
            e = np.append(found["eta_e"], found["eps_e"])
            pairs = ((e, t.e), (found["u"], t.u), (found["omega_e"], t.omega_e), (found["state_next"][:3], after))
            assert all(_close(a, b) for a, b in pairs)
            projected += bool(np.any(t.theta_dot != t.tau))
    assert 10 < projected < 90  # of a hundred: both branches of the projection were drawn often


def lyapunov(p: AdaptiveSettings, x: Point, s: float, omega_dot: Array, t: float) -> tuple[float, Array, Array]:
    """V of (C.24), ε̃ and z₂ a little later than x; (C.1) and (C.12) turn q and q_d."""
    J, C1, Gamma = map(np.array, (p.inertia, p.C1, p.Gamma))
    q = x.q + t / 2 * product(x.q, np.append(0, x.omega))  # of length 1 but for t²
    q_d = x.q_d + t / 2 * product(np.append(0, x.omega_d), x.q_d)
    e = product(q_d * [1, -1, -1, -1], q)
    omega_e = x.omega + t * omega_dot - twin.rotation(q).T @ (x.omega_d + t * x.omega_d_dot)
    z2 = omega_e + s * C1 * e[1:]
    wrong = x.true_theta - x.theta + t * Gamma * x.omega * z2  # (C.23), which does not project
    return 2 * (1 - s * e[0]) + z2 @ (J * z2) / 2 + wrong @ (wrong / Gamma) / 2, e[1:], z2


@both_signs
@both_bodies
def test_without_quantization_the_lyapunov_function_falls_exactly_as_c25_says(paper: bool, s: float) -> None:
    """Along a body that is written out here, by differences."""
    rng = np.random.default_rng(3)
    for _ in range(1 if paper else 4):
        p = AdaptiveSettings() if paper else _random_settings(rng)
        tick, J = Tick(p, 0.002), np.array(p.inertia)
        for _ in range(30):
            x = _point(rng, p)
            weight = twin.rotation(x.q).T @ np.array([0, 0, -p.mass * p.gravity])
            torque = np.cross(p.centre_of_mass, weight) + np.array(p.allocation) @ tick(x, s)["u"]
            omega_dot = (torque - np.cross(x.omega, J * x.omega) - x.true_theta * x.omega) / J  # (C.2)
            later, now, before = (lyapunov(p, x, s, omega_dot, t) for t in (1e-6, 0, -1e-6))
            _, eps_e, z2 = now
            promised = -eps_e @ np.diag(p.C1) @ eps_e - z2 @ np.diag(p.C2) @ z2  # (C.25) with (C.49)
            assert (later[0] - before[0]) / 2e-6 == pytest.approx(promised, rel=1e-5, abs=1e-8)


BOUND = 0.05  # k_θ, which is the projection's inner ball
OUTER = BOUND / 0.95
GAMMA = np.array([0.02, 0.01, 0.05])


def _projection() -> ca.Function:
    tau, theta = ca.SX.sym("tau", 3), ca.SX.sym("theta", 3)
    return ca.Function("projection", [tau, theta], [projection(tau, theta, ca.diag(ca.SX(GAMMA)), BOUND)])


def _drive(rng: np.random.Generator) -> Array:
    """A τ of any direction and, over eight decades, any size."""
    return np.asarray(rng.normal(size=3) * 10.0 ** rng.uniform(-6, 2), dtype=np.float64)


def test_the_projection_never_hurts_the_lyapunov_function() -> None:
    """Remark 5: −θ̃ᵀΓ⁻¹Proj(τ) ≤ −θ̃ᵀΓ⁻¹τ, for every θ of Assumption 2 and every θ̂ that the projection allows.

    Near k_θ the inequality is tightest where θ and θ̂ are nearly parallel, so half of the θ are drawn there.
    """
    rng = np.random.default_rng(9)
    proj = _projection()
    helped = 0
    for i in range(2000):
        tau, direction = _drive(rng), _unit(rng, 3)
        theta = direction * OUTER * rng.uniform(0.9, 1.0)
        true = _unit(rng, 3) if i % 2 else direction + 0.2 * _unit(rng, 3)
        wrong = true / np.linalg.norm(true) * BOUND * rng.uniform() ** (1 / 3) - theta  # uniform in the whole ball
        with_projection, without = -(wrong / GAMMA) @ _array(proj(tau, theta)), -(wrong / GAMMA) @ tau
        # rounding of the two sums: 2e-16 times the size of their addends, some tens of operations
        assert with_projection <= without + 1e-14 * np.linalg.norm(wrong / GAMMA) * np.linalg.norm(tau)
        helped += with_projection < 0.99 * without
    assert helped > 200  # it did act, and by more than rounding


@pytest.mark.parametrize("gain", [1.0, 100.0])
def test_the_estimate_stays_within_its_bound_under_any_drive(gain: float) -> None:
    """Remark 5, with k_θ/0.95 for k_θ: at every tick and not only in continuous time."""
    rng = np.random.default_rng(10)
    p = AdaptiveSettings(Gamma=(0.02 * gain,) * 3)
    tick = Tick(p, 0.002)
    first = np.array(p.damping_estimate)
    theta = first + np.array([0.0, 0.0, p.damping_bound])
    x = _point(rng, p)
    pressed = 0
    for k in range(3000):
        if k % 300 == 0:
            x = _point(rng, p)  # another drive, kept long enough to press against the bound
        theta = tick(x, 1.0, theta)["state_next"][:3]
        pressed += bool(np.linalg.norm(theta - first) > p.damping_bound)
        # scaling to a length of k_θ/0.95 rounds in the last place
        assert np.linalg.norm(theta - first) <= p.damping_bound / 0.95 * (1 + 1e-14)
    assert pressed > 300
