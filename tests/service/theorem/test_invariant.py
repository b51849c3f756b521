"""Invariant set: its error equations against the law and the body, its linear gains, its growth with what disturbs."""

from __future__ import annotations

from dataclasses import replace
from math import asin, sqrt
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest

from aeroloop.plant_emulator.model.aero import AeroSettings, aero_dynamics
from aeroloop.protocol.wire.attitude import R, S, Vector
from aeroloop.service.config import Settings, load_over
from aeroloop.service.control.laws.adaptive import AdaptiveSettings, Equations, equations
from aeroloop.service.control.reference import Angles, Floats, Plan
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import evaluate, premises
from aeroloop.service.theorem.extremes import body_rates, extremes, vectors
from aeroloop.service.theorem.invariant import Premises, largest_start, reach
from aeroloop.service.theorem.linear import gains_of
from aeroloop.service.theorem.plant_bounds import PlantBounds

PAPER = load_over(Settings(), ["law.damping_bound=0.0119"])
ANISOTROPIC = load_over(
    PAPER, ["law.inertia=[0.02, 0.022, 0.024]", "law.C1=[0.3, 0.25, 0.35]", "law.C2=[0.15, 0.2, 0.17]"]
)


def of(settings: Settings, age: float = 0.0) -> Premises:
    return premises(settings, extremes(settings), PlantBounds(age=age))


class Found(NamedTuple):
    """Largest shares of its bound that random states reach: of D₁, of D₂, of ‖q^Q − q‖."""

    d1: float
    d2: float


def worst(settings: Settings, start: float, count: int, seed: int) -> Found:
    """Draw states within the set, errors within the quantizers' bounds, θ and θ̂ within their balls; compute d₁ and d₂.

    d₁ and d₂ are what remains of the true derivatives of x = (ε̃, z₂) − K w_s: those of the body (C.1), (C.2), under the
    law (C.37) with the received state, without hold.
    """
    p = of(settings)
    at = reach(p, start)
    assert at is not None
    rng = np.random.default_rng(seed)
    law = with_theorem(settings).law
    C1, C2, J, B = (np.array(v) for v in (law.C1, law.C2, law.inertia, law.allocation))
    built = equations(law)
    inputs = [built.q, built.omega, built.q_d, built.omega_d, built.omega_d_dot, built.theta, built.s]
    inputs += [built.C1, built.C2, built.Gamma]
    command = ca.Function("command", inputs, [built.u, built.theta_dot])
    Psi = ca.Function("psi", [built.q, built.omega], [_psi(law, built)])
    desired = Angles(*(part[0] for part in Plan.of(settings.reference).at(np.linspace(0, 40, 513)[None])))
    b, b_dot = body_rates(desired)
    eps_d = vectors(desired)
    kappa1 = 1 / (1 + C1 * C2)
    d1, d2 = 0.0, 0.0
    for _ in range(count):
        i = int(rng.integers(len(b)))
        q_d = np.append(sqrt(1 - eps_d[i] @ eps_d[i]), eps_d[i])
        theta, theta_hat = (_in_ball(rng, bound) for bound in (p.k_theta, p.k_theta_hat))
        w_s = -b[i] * (theta - theta_hat)
        w_s_dot_theta = -b_dot[i] * (theta - theta_hat)
        # x within the set: the sizes that the bounds presume, in random directions.
        eps_bar = _direction(rng) * at.eps_bar * rng.random() ** 0.2
        omega_e = _direction(rng) * at.omega_e * rng.random() ** 0.2
        z_bar = omega_e + C1 * eps_bar
        if np.linalg.norm(eps_bar + C2 * z_bar) > at.torque:
            continue
        eps_e = eps_bar + kappa1 * w_s
        e = np.append(sqrt(1 - eps_e @ eps_e), eps_e)
        q = _product(q_d, e)
        R_d, R_b = _matrix(q_d), _matrix(q)
        omega_d, omega_d_dot = R_d @ b[i], R_d @ b_dot[i]  # inertial
        omega = omega_e + R_b.T @ omega_d
        eps_Q = (
            q[1:] + settings.wire.attitude.quantizer().bound * np.sign(rng.standard_normal(3)) * rng.random(3) ** 0.1
        )
        q_Q = np.append(np.sign(q[0]) * sqrt(max(0.0, 1.0 - float(eps_Q @ eps_Q))), eps_Q)
        omega_Q = omega + settings.wire.rate.quantizer().bound * rng.uniform(-1, 1, 3)
        u, theta_hat_dot = (
            np.array(part).ravel()
            for part in command(q_Q, omega_Q, q_d, omega_d, omega_d_dot, theta_hat, 1.0, C1, C2, np.array(law.Gamma))
        )
        u = u + settings.wire.voltage.quantizer().bound * rng.uniform(-1, 1, 3) * [0, 1, 1]
        omega_dot = (np.array(Psi(q, omega)).ravel() - omega * theta + B @ u) / J  # (C.2)
        A = e[0] * np.identity(3) + _skew(eps_e)
        eps_e_dot = A @ omega_e / 2  # (C.17)
        omega_e_dot = omega_dot - R_b.T @ omega_d_dot + np.cross(omega, R_b.T @ omega_d)
        z2_dot = omega_e_dot + C1 * eps_e_dot
        w_s_dot = w_s_dot_theta + b[i] * theta_hat_dot
        found1 = eps_e_dot - kappa1 * w_s_dot - (z_bar - C1 * eps_bar) / 2
        found2 = J * (z2_dot - C1 * kappa1 * w_s_dot) + eps_bar + C2 * z_bar
        d1 = max(d1, float(np.linalg.norm(found1)) / at.D1)
        d2 = max(d2, float(np.linalg.norm(found2)) / at.D2)
    return Found(d1, d2)


@pytest.mark.parametrize("settings", [PAPER, ANISOTROPIC], ids=["paper", "unequal axes"])
@pytest.mark.parametrize("bits", [8, 12])
def test_no_state_within_the_set_is_disturbed_by_more_than_its_bounds(settings: Settings, bits: int) -> None:
    wire = [f"wire.{name}.bits={bits}" for name in ("attitude", "rate", "voltage")]
    for start in (0.0, 0.05):
        found = worst(load_over(settings, wire), start, 400, bits)
        assert 0.2 < found.d1 <= 1
        assert 0.3 < found.d2 <= 1


@pytest.mark.parametrize(
    ("C1", "C2"), [((0.3, 0.3, 0.3), (0.15, 0.15, 0.15)), ((3.0, 0.3, 3.0), (1.0, 1.0, 1.0)), ((1, 1, 1), (0.1, 1, 1))]
)
def test_an_error_of_the_attitude_moves_the_command_by_no_more_than_the_bound(C1: Vector, C2: Vector) -> None:
    """Along the reference, an error d of the attitude alone: (I + C₁C₂) d + 2 C₂ d × R ω_d."""
    names = ("k_theta", "k_theta_hat", "weight", "delta_omega", "delta_u", "k_tau_d", "age", "k_omega_d_dot")
    nothing: dict[str, Any] = dict.fromkeys(names, 0.0)
    p = replace(of(PAPER), C1=C1, C2=C2, J=(0.001,) * 3, k_omega_d=1.0, axis_rate=1.0, **nothing)
    at = reach(replace(p, k_omega_d_ddot=0.0, delta_q=lambda _: 1e-5))
    assert at is not None
    d, omega_d = np.random.default_rng(4).standard_normal((2, 100_000, 3))
    d, omega_d = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (d, omega_d))
    moved = (1 + np.array(C1) * C2) * d + 2 * np.array(C2) * np.cross(d, omega_d)
    assert 0.7 < np.linalg.norm(moved, axis=1).max() * 1e-5 / at.fast <= 1


def test_half_of_the_bounds_is_exceeded() -> None:
    """What the test above rests on can fail: the quantizers' part of D₂ is attained but for its directions."""
    quiet = load_over(PAPER, ["law.damping_bound=0.0119", "wire.voltage.bits=cont", "wire.rate.bits=cont"])
    assert worst(quiet, 0.0, 1500, 1).d2 > 0.5


def test_the_gains_are_the_largest_answers_to_bounded_inputs() -> None:
    """Against the input that is worst for z̄ at the end of an interval: the sign of the impulse response."""
    (axis,) = {(0.3, 0.15, 0.02)}
    gains = gains_of((axis,), 1.0)
    assert gains is not None
    c1, c2, j = axis
    A = np.array([[-c1 / 2, 0.5], [-1 / j, -c2 / j]])
    step, count = 1e-4, 60_000
    advance = np.identity(2) + A * step + A @ A * step**2 / 2 + A @ A @ A * step**3 / 6
    impulse = np.empty((count, 2))
    x = np.array([0.0, 1 / j])
    for k in range(count):
        impulse[k] = x
        x = advance @ x
    for h, gain in (
        ((1.0, 0.0), gains.eps),
        ((0.0, 1.0), gains.z),
        ((-c1, 1.0), gains.omega),
        ((1.0, c2), gains.torque),
    ):
        reached = float(np.abs(impulse @ np.array(h)).sum() * step)
        assert reached == pytest.approx(gain.d2, rel=5e-3)
        assert reached <= gain.d2


@pytest.mark.parametrize(
    "worse",
    [
        {"delta_omega": 0.01},
        {"delta_u": 2.0},
        {"k_tau_d": 0.002},
        {"age": 0.01},
        {"rate_lag": 0.002},
        {"k_theta": 0.014},
        {"weight": 0.2},
        {"k_omega_d": 0.5, "axis_rate": 0.5},
        {"k_omega_d_dot": 0.2},
    ],
)
def test_the_set_grows_with_everything_that_disturbs(worse: dict[str, Any]) -> None:
    p = of(load_over(PAPER, [f"wire.{name}.bits=10" for name in ("attitude", "rate", "voltage")]))
    before, after = reach(p), reach(replace(p, **worse))
    assert before is not None
    assert after is None or after.radius > before.radius
    assert largest_start(replace(p, **worse)) < largest_start(p)


def test_a_start_farther_away_reaches_farther_up_to_the_largest() -> None:
    p = of(PAPER)
    most = largest_start(p)
    sizes = [reach(p, most * share) for share in (0, 0.25, 0.5, 0.75, 1)]
    radii = [size.radius for size in sizes if size is not None]
    assert len(radii) == 5
    assert radii == sorted(radii)
    assert reach(p, 1.02 * most) is None


def test_a_held_roll_takes_from_the_yaw_what_u1_would_have_added() -> None:
    """With the reference at rest nothing is missing; the more it pitches, the less is proven."""
    p = replace(of(load_over(PAPER, [f"wire.{n}.bits=16" for n in ("attitude", "rate", "voltage")])), axis_rate=0.02,
                k_omega_d=0.02, k_omega_d_dot=0.003, k_omega_d_ddot=0.001)  # fmt: skip
    free, level, pitching = reach(p), reach(replace(p, tilt=0.0)), reach(replace(p, tilt=0.3))
    assert free is not None
    assert level is not None
    assert free.radius <= level.radius
    assert pitching is None or pitching.radius > level.radius
    assert reach(replace(p, tilt=1.5)) is None


def test_the_reached_attitude_error_is_that_of_the_angle() -> None:
    e = evaluate(PAPER)
    assert e.body_reach is not None
    assert e.body_reach.half_angle == pytest.approx(
        e.known.half_angle_d + asin(e.body_reach.eps_e),
        rel=1e-3,  # guesses are raised by as much
    )


def _psi(law: AdaptiveSettings, built: Equations) -> ca.SX:
    """Ψ of (C.4) at the true state."""
    J = ca.diag(ca.SX(law.inertia))
    f_g = ca.vertcat(0, 0, -law.mass * law.gravity)
    Psi: ca.SX = -S(built.omega) @ (J @ built.omega) + S(ca.SX(law.centre_of_mass)) @ R(built.q).T @ f_g
    return Psi


def _direction(rng: np.random.Generator) -> Floats:
    v = rng.standard_normal(3)
    direction: Floats = v / np.linalg.norm(v)
    return direction


def _in_ball(rng: np.random.Generator, radius: float) -> Floats:
    inside: Floats = _direction(rng) * radius * rng.random() ** 0.1
    return inside


def _skew(v: Floats) -> Floats:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _matrix(q: Floats) -> Floats:
    V = _skew(q[1:])
    matrix: Floats = np.identity(3) + 2 * q[0] * V + 2 * V @ V
    return matrix


def _product(p: Floats, q: Floats) -> Floats:
    return np.append(p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))


GENTLE = load_over(
    PAPER, ["reference.amplitude=[0, 8, 20]", *(f"wire.{name}.bits=14" for name in ("attitude", "rate", "voltage"))]
)


def test_no_state_of_a_body_with_a_held_roll_is_disturbed_by_more_than_its_bounds() -> None:
    """The Aero's own equations, pitch and yaw near the reference; derivatives by differences over a microsecond."""
    law = with_theorem(GENTLE).law
    p = replace(of(GENTLE), tilt=extremes(GENTLE).tilt)
    at = reach(p, 0.02)
    assert at is not None
    C1, C2, J = (np.array(v) for v in (law.C1, law.C2, law.inertia))
    kappa1 = 1 / (1 + C1 * C2)
    built = equations(law)
    inputs = [built.q, built.omega, built.q_d, built.omega_d, built.omega_d_dot, built.theta, built.s]
    command = ca.Function("c", [*inputs, built.C1, built.C2, built.Gamma], [built.u, built.theta_dot])
    plan, rng, step = Plan.of(GENTLE.reference), np.random.default_rng(7), 1e-6

    def coordinates_at(t: float, x: Floats, theta: Floats, theta_hat: Floats) -> tuple[Floats, ...]:
        desired = plan.at(np.array([[t]]))
        angles = type(desired)(*(part.reshape(1, 3) for part in desired))
        (b,), (b_dot,) = body_rates(angles)
        eps_d = vectors(angles)[0]
        q_d = np.append(sqrt(1 - eps_d @ eps_d), eps_d)
        pitch, yaw, pitch_rate, yaw_rate = x
        sine, cosine = np.sin(pitch), np.cos(pitch)
        turned, pitched = (np.array([np.cos(a / 2), 0, 0, 0]) for a in (yaw, pitch))
        turned[3], pitched[2] = np.sin(yaw / 2), np.sin(pitch / 2)
        q = _product(turned, pitched)
        omega = np.array([-sine * yaw_rate, pitch_rate, cosine * yaw_rate])
        R_d, R_b = _matrix(q_d), _matrix(q)
        omega_d, omega_d_dot = R_d @ b, R_d @ b_dot
        e = _product(q_d * [1, -1, -1, -1], q)
        omega_e = omega - R_b.T @ omega_d
        missing = theta_hat[0] * b[0] + J[0] * (R_b.T @ omega_d_dot)[0]  # the slow part of what u₁ should have been
        vertical = np.array([-sine, 0, cosine])
        force = -b * (theta - theta_hat) + sine * missing * vertical
        w_s = np.array([0, force[1], 0]) + force @ vertical / cosine**2 * vertical
        return e[1:], omega_e + C1 * e[1:], omega_e, w_s, q, omega, q_d, omega_d, omega_d_dot

    most1 = most2 = 0.0
    judged = 0
    for k in range(600):
        if k % 100 == 0:
            theta = _in_ball(rng, p.k_theta)
            damping = (theta[0], theta[1], theta[2])
            aero = aero_dynamics(AeroSettings(centre_of_mass=law.centre_of_mass, damping=damping))
        theta_hat = _in_ball(rng, p.k_theta_hat)
        t = rng.uniform(0, 40)
        desired = plan.at(np.array([[t]]))
        error = rng.uniform(-1, 1, 4) * [2 * at.eps_bar, 2 * at.eps_bar, at.omega_e, at.omega_e]
        x = np.concatenate([desired.angle[0, 0, 1:], desired.rate[0, 0, 1:]]) + error
        eps_e, z2, omega_e, w_s, q, omega, q_d, omega_d, omega_d_dot = coordinates_at(t, x, theta, theta_hat)
        eps_bar, z_bar = eps_e - kappa1 * w_s, z2 - C1 * kappa1 * w_s
        sizes = (eps_bar, at.eps_bar), (omega_e, at.omega_e), (eps_bar + C2 * z_bar, at.torque), (eps_e, at.eps_e)
        if any(np.linalg.norm(v) > most for v, most in sizes):
            continue
        judged += 1
        eps_Q = q[1:] + GENTLE.wire.attitude.quantizer().bound * rng.uniform(-1, 1, 3)
        q_Q = np.append(sqrt(1 - float(eps_Q @ eps_Q)), eps_Q)
        omega_Q = omega + GENTLE.wire.rate.quantizer().bound * rng.uniform(-1, 1, 3)
        given = q_Q, omega_Q, q_d, omega_d, omega_d_dot, theta_hat, 1.0, C1, C2, np.array(law.Gamma)
        u, theta_hat_dot = (np.array(part).ravel() for part in command(*given))
        x_dot = np.array(aero(x, u[1:], [0, 0])).ravel()
        later = coordinates_at(t + step, x + step * x_dot, theta, theta_hat + step * theta_hat_dot)
        eps_bar_dot = (later[0] - kappa1 * later[3] - eps_bar) / step
        z_bar_dot = (later[1] - C1 * kappa1 * later[3] - z_bar) / step
        d1 = eps_bar_dot - (z_bar - C1 * eps_bar) / 2
        d2 = J * z_bar_dot + p.share * (eps_bar + C2 * z_bar)
        most1 = max(most1, float(np.linalg.norm(d1)) / at.D1)
        most2 = max(most2, float(np.linalg.norm(d2)) / at.D2)
    assert judged > 100
    assert 0.2 < most1 <= 1
    assert 0.2 < most2 <= 1
