"""Control law of the paper: agrees with an independent twin and has the properties that the paper proves.

States, bodies and gains are random and states move, so that no term hides behind a zero, a symmetry or a product of
equal numbers.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, received_quaternion
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.service.control.laws.adaptive import Adaptive, AdaptiveSettings, equations, projection
from aeroloop.service.control.laws.evaluation import law_function, received
from tests.support import numpy_twin as twin
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


class ClosedLoop:
    """The law on a body without quantization, and derivatives along it.

    The body is written out here and not taken from the project: kinematics as products of quaternions, gravity through
    the last row of the rotation matrix.
    """

    def __init__(self, p: AdaptiveSettings) -> None:
        self._p = p
        names = ("q", "omega", "q_d", "omega_d", "omega_d_dot", "theta", "s", "C1", "C2", "Gamma")
        self._given = given = {name: ca.SX.sym(name, {"q": 4, "q_d": 4, "s": 1}.get(name, 3)) for name in names}
        self.law = given | equations(p, 3, given)
        self.true_theta = ca.SX.sym("true_theta", 3)
        q, omega, q_d, omega_d, omega_d_dot, theta = (given[name] for name in names[:6])
        self._moves = [
            (q, _product(q, ca.vertcat(0, omega)) / 2),  # (C.1): ω in the body frame
            (omega, self._omega_dot()),  # (C.2)
            (q_d, _product(ca.vertcat(0, omega_d), q_d) / 2),  # (C.12): ω_d in the inertial frame
            (omega_d, omega_d_dot),
            (theta, self.law["tau"]),  # (C.23), which does not project
        ]

    def _omega_dot(self) -> ca.SX:
        """(C.2) solved for ω̇, with the law's u."""
        p, omega, J = self._p, self._given["omega"], ca.SX(self._p.inertia)
        w, x, y, z = (self._given["q"][i] for i in range(4))
        up = ca.vertcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2))  # seen from the body
        gravity = ca.cross(ca.SX(p.centre_of_mass), -p.mass * p.gravity * up)
        motors = ca.SX(np.array(p.allocation)) @ self.law["u"]
        return (gravity - ca.cross(omega, J * omega) - self.true_theta * omega + motors) / J

    def rates(self, y: ca.SX) -> list[ca.SX]:
        """ẏ as its addends, one for each thing that moves."""
        return [ca.jacobian(y, x) @ x_dot for x, x_dot in self._moves]

    def evaluator(self, *expressions: ca.SX) -> ca.Function:
        """A function of a point's fields and the sign."""
        *symbols, s, C1, C2, Gamma = self._given.values()
        values = [ca.SX(gain) for gain in (self._p.C1, self._p.C2, self._p.Gamma)]
        expressions = tuple(ca.substitute(list(expressions), [C1, C2, Gamma], values))
        return ca.Function("values", [*symbols, self.true_theta, s], expressions)


def _product(p: ca.SX, q: ca.SX) -> ca.SX:
    """Hamilton's p ⊗ q, by its sixteen products."""
    return ca.vertcat(
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def _values(function: ca.Function, x: Point, s: float) -> Sequence[Array]:
    return [_array(v) for v in function(x.q, x.omega, x.q_d, x.omega_d, x.omega_d_dot, x.theta, x.true_theta, s)]


def _close(a: Array, b: Array) -> bool:
    """Equal but for rounding: 2e-16 through some hundred operations, times the condition of B, 900 for the paper's."""
    return bool(np.linalg.norm(a - b) <= 1e-12 * np.linalg.norm(b))


@both_signs
@both_bodies
def test_the_law_agrees_with_the_twin_at_moving_states(paper: bool, s: float) -> None:
    rng = np.random.default_rng(1)
    projected = 0
    for _ in range(1 if paper else 20):
        p = AdaptiveSettings() if paper else _random_settings(rng)
        loop = ClosedLoop(p)
        law = loop.law
        e = ca.vertcat(law["eta_e"], law["eps_e"])
        function = loop.evaluator(e, *(law[name] for name in ("u", "theta_dot", "tau", "omega_e", "z1", "z2")))
        for _ in range(100 if paper else 5):
            x = _point(rng, p)
            t = twin.law(body_of(p), x.q, x.omega, x.q_d, x.omega_d, x.omega_d_dot, x.theta, s)
            expected = (t.e, t.u, t.theta_dot, t.tau, t.omega_e, t.z1, t.z2)
            assert all(_close(a, b) for a, b in zip(_values(function, x, s), expected, strict=True))
            projected += bool(np.any(t.theta_dot != t.tau))
    assert 10 < projected < 90  # of a hundred: both branches of the projection were drawn often


@both_signs
@both_bodies
def test_without_quantization_the_lyapunov_function_falls_exactly_as_c25_says(paper: bool, s: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(1 if paper else 10):
        p = AdaptiveSettings() if paper else _random_settings(rng)
        loop = ClosedLoop(p)
        z1, z2 = loop.law["z1"], loop.law["z2"]
        wrong = loop.true_theta - loop.law["theta"]
        V = ca.dot(z1, z1) + ca.dot(z2, ca.SX(p.inertia) * z2) / 2 + ca.dot(wrong, wrong / ca.SX(p.Gamma)) / 2  # (C.24)
        power = ca.fabs(z2).T @ ca.fabs(ca.SX(np.array(p.allocation))) @ ca.fabs(loop.law["u"])
        function = loop.evaluator(ca.vertcat(*loop.rates(V)), power, loop.law["eps_e"], z2)
        for _ in range(30):
            addends, through_B, eps_e, z_2 = _values(function, _point(rng, p), s)
            promised = -eps_e @ np.diag(p.C1) @ eps_e - z_2 @ np.diag(p.C2) @ z_2  # (C.25) with (C.49)
            # V̇ is a sum of large addends that cancel, z₂ᵀB u among them: it can be no more exact than 2e-16 of these,
            # times the few hundred operations behind each.
            scale = np.abs(addends).sum() + through_B.sum()
            assert abs(addends.sum() - promised) <= 1e-12 * scale
            assert promised < -1e-6 * scale  # what is claimed stands well above that tolerance


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
    tick, gains = law_function(Adaptive(p, 0.002, 3)), [*p.C1, *p.C2, *p.Gamma]
    first = np.array(p.damping_estimate)
    theta = first + np.array([0.0, 0.0, p.damping_bound])
    x = _point(rng, p)
    pressed = 0
    for k in range(3000):
        if k % 300 == 0:
            x = _point(rng, p)  # another drive, kept long enough to press against the bound
        desired = x.q_d, x.omega_d, x.omega_d_dot
        theta = _array(tick(x.q, [*theta, 1.0], gains, _sent(x.q), x.omega, *desired)[2])[:3]
        pressed += bool(np.linalg.norm(theta - first) > p.damping_bound)
        # scaling to a length of k_θ/0.95 rounds in the last place
        assert np.linalg.norm(theta - first) <= p.damping_bound / 0.95 * (1 + 1e-14)
    assert pressed > 300


def test_attitudes_are_received_to_the_bits_of_the_plain_function() -> None:
    """Whether the last pointed away, along, or at a right angle, or ε was longer than 1, or −0."""
    corners = [0.0, -0.0, 0.6, -0.6, 0.8, -0.8, 1.0, -1.0, 1.3, 1e200]
    rng = np.random.default_rng(0)
    given = ca.SX.sym("eps", 3), ca.SX.sym("last", 4)
    step = Compiled(ca.Function("attitude", [*given], [received(*given)], ["eps", "last"], ["q"]))
    last, eps, q = step.inputs["last"], step.inputs["eps"], step.outputs["q"]
    starts: list[Quaternion] = [IDENTITY, (-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.6, -0.8)]
    for before in starts:
        now = before
        for x, y, z in rng.choice(corners, size=(2000, 3), p=[0.25, 0.05, *[0.1] * 6, 0.05, 0.05]).tolist():
            last[:], eps[:] = memoryview(array("d", now)), memoryview(array("d", (x, y, z)))
            step()
            now = received_quaternion(x, y, z, now)
            assert q.tobytes() == array("d", now).tobytes()
