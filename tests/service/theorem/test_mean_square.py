"""Decay of V of the configured plant: the mechanism's torque against the Aero's equations, and what worsens it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from aeroloop.plant_emulator.model.aero import AeroSettings, aero_dynamics
from aeroloop.service.config import Settings, load
from aeroloop.service.control.laws.adaptive import equations, projection
from aeroloop.service.control.reference import Angles, Floats, Plan
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import Evaluated, evaluate
from aeroloop.service.theorem.invariant import stale_power
from aeroloop.service.theorem.lemma import coordinates
from aeroloop.service.theorem.mean_square import decay, mechanism_torque

PAPER = load(overrides=["plant.ideal=true", "loop.lockstep=true"])
UNEVEN = load(
    overrides=["law.inertia=[0.02, 0.022, 0.024]", "law.C1=[0.3, 0.25, 0.35]", "law.C2=[0.15, 0.2, 0.17]",
               "law.centre_of_mass=[0.001, 0.002, -0.004]", "plant.ideal=true", "loop.lockstep=true"]
)  # fmt: skip


def shares(settings: Settings, size: float, count: int) -> list[float]:
    """z₂ᵀ(J ż₂ + ε̃ + C₂ z₂ − Φ θ̃) of an Aero under the law without noise, as a share of its bound, at random states."""
    law, rng = with_theorem(settings).law, np.random.default_rng(7)
    plant = AeroSettings(inertia=law.inertia, centre_of_mass=law.centre_of_mass)
    dynamics = aero_dynamics(plant)
    built = equations(law)
    inputs = [built.q, built.omega, built.q_d, built.omega_d, built.omega_d_dot, built.theta, built.s]
    command = ca.Function("command", [*inputs, built.C1, built.C2], [built.u])
    angles = Angles(*(part[0] for part in Plan.of(settings.reference).at(np.linspace(0, 40, 513)[None])))
    p = evaluate(settings).plant
    C1, J = np.array(law.C1), np.array(law.inertia)
    found = []
    for i in rng.integers(len(angles.angle), size=count):
        (_, p_d, y_d), (_, dp_d, dy_d), (_, ddp_d, ddy_d) = angles.angle[i], angles.rate[i], angles.acceleration[i]
        x = np.array([p_d, y_d, dp_d, dy_d]) + rng.uniform(-size, size, 4) * [1, 1, 0.7, 0.7]
        theta, theta_hat = (p.k_theta * direction(rng), p.k_theta_hat * direction(rng))

        def desired(t: float) -> tuple[Floats, Floats, Floats]:
            pitch, yaw = p_d + dp_d * t + ddp_d * t**2 / 2, y_d + dy_d * t + ddy_d * t**2 / 2  # noqa: B023
            dp, dy = dp_d + ddp_d * t, dy_d + ddy_d * t  # noqa: B023
            y_axis = np.array([-np.sin(yaw), np.cos(yaw), 0])
            rate = dp * y_axis + [0, 0, dy]
            rate_dot = ddp_d * y_axis - dp * dy * np.array([np.cos(yaw), np.sin(yaw), 0]) + [0, 0, ddy_d]  # noqa: B023
            return quaternion(pitch, yaw), rate, rate_dot

        def errors(t: float, x: Floats) -> Any:
            q_d, omega_d, _ = desired(t)
            q, omega = body(x)
            return coordinates(q[None], omega[None], q_d[None], omega_d[None], np.ones(1), C1)

        q, omega = body(x)
        if q @ desired(0.0)[0] < 0:
            continue
        volts = np.array(command(q, omega, *desired(0.0), theta_hat, 1.0, law.C1, law.C2)).ravel()[1:]
        damping = -free(x[0]).T @ (omega * theta)  # Φ θ about the joints
        x_dot = np.array(dynamics(x, volts, damping)).ravel()
        h = 1e-6
        ahead, behind, now = errors(h, x + h * x_dot), errors(-h, x - h * x_dot), errors(0.0, x)
        z2, eps_e = now.z2[0], now.eps_e[0]
        z2_dot = (ahead.z2[0] - behind.z2[0]) / (2 * h)
        left = float(z2 @ (J * z2_dot + eps_e + np.array(law.C2) * z2 + omega * (theta - theta_hat)))
        norm = float(now.norm[0])
        bound = mechanism_torque(p, norm, float(np.linalg.norm(omega)), float(np.linalg.norm(z2_dot)))
        found.append(left / (bound * norm))
    return found


def direction(rng: np.random.Generator) -> Floats:
    v = rng.standard_normal(3)
    unit: Floats = v / np.linalg.norm(v)
    return unit


def quaternion(pitch: float, yaw: float) -> Floats:
    """R_z(yaw) R_y(pitch)."""
    (cp, sp), (cy, sy) = ((np.cos(angle / 2), np.sin(angle / 2)) for angle in (pitch, yaw))
    return np.array([cy * cp, -sy * sp, cy * sp, sy * cp])


def free(pitch: float) -> Floats:
    """A(p) of the Aero: ω = A [ṗ, ẏ]."""
    return np.array([[0, -np.sin(pitch)], [1, 0], [0, np.cos(pitch)]])


def body(x: Floats) -> tuple[Floats, Floats]:
    return quaternion(x[0], x[1]), free(x[0]) @ x[2:]


@pytest.mark.parametrize("settings", [PAPER, UNEVEN], ids=["paper", "unequal axes"])
@pytest.mark.parametrize("size", [0.02, 0.3])
def test_no_state_of_the_aero_takes_more_from_v_than_the_mechanisms_torque_has_it(
    settings: Settings, size: float
) -> None:
    found = shares(settings, size, 300)
    assert len(found) > 250
    assert 0.1 < max(found) <= 1


def of(*overrides: str) -> Evaluated:
    return evaluate(load(overrides=["plant.ideal=true", "loop.lockstep=true", *overrides]))


def test_without_age_and_mechanism_it_is_the_papers_decay() -> None:
    e = of()
    plain = replace(e, plant=replace(e.plant, tilt=None, age=0.0))
    found = decay(plain, 0.1)
    assert found is not None
    assert (found.k, found.delta) == pytest.approx((e.theorem.k, e.theorem.delta_Q))


@pytest.mark.parametrize(
    "worse",
    [
        "loop.lockstep=false",
        "loop.rate_hz=250",
        "wire.rate.bits=6",
        "law.damping_bound=0.06",
        "law.Gamma=[0.1, 0.1, 0.1]",
    ],
)
def test_v_falls_more_slowly_with_all_that_disturbs(worse: str) -> None:
    before, after = decay(of(), 0.1), decay(of(worse), 0.1)
    assert before is not None
    assert after is not None
    assert after.delta / after.k > before.delta / before.k
    larger = decay(of(), 0.2)
    assert larger is not None
    assert larger.delta > before.delta
    assert decay(of("plant.ideal=false"), 0.1) is None  # the rotors lag by more than any bound of V takes


def test_no_step_of_the_estimate_takes_more_from_v_than_its_power_has_it() -> None:
    """Γ that differs by axis: the clip back to the ball is at its nearest point, not at the nearest in θ̃ᵀΓ⁻¹θ̃."""
    p = replace(evaluate(load(overrides=["law.Gamma=[0.02, 0.2, 2]", "law.damping_bound=0.0119"])).plant, age=0.002)
    rng, count, push = np.random.default_rng(3), 20_000, 0.1  # push: ‖Φ z₂‖
    tau, theta = ca.SX.sym("tau", 3), ca.SX.sym("theta", 3)
    gamma = np.array(p.Gamma)
    step = ca.Function("step", [tau, theta], [projection(tau, theta, ca.diag(gamma), p.k_theta)]).map(count)
    true, estimate, pushed = (
        v / np.linalg.norm(v, axis=1, keepdims=True) * size
        for v, size in zip(rng.standard_normal((3, count, 3)), (p.k_theta, p.k_theta_hat, push), strict=True)
    )
    after = estimate + p.age * np.array(step((gamma * pushed).T, estimate.T)).T
    after *= np.minimum(1, p.k_theta_hat / np.linalg.norm(after, axis=1, keepdims=True))
    grown = (((true - after) ** 2 - (true - estimate) ** 2) / gamma).sum(axis=1) / 2
    taken = float((grown / p.age + ((true - estimate) * pushed).sum(axis=1)).max())
    assert 2 * p.age / 2 * gamma.max() * push**2 < taken  # more than the step's square, which was all that counted
    assert taken <= stale_power(p, z2_dot=0, omega_dot=0, omega=1, z2=push, delta_z2=0)
