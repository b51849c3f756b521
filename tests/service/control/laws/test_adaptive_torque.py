"""Law with estimates of friction and torque: its Lyapunov inequality, and what it learns.

Bodies, gains and motions are random, so that no term hides behind a zero or a symmetry. The body is written out here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aeroloop.service.config import load
from aeroloop.service.control.controller import Controller
from aeroloop.service.control.laws.adaptive_torque import AdaptiveTorqueSettings
from aeroloop.service.lab.experiment import run_experiment
from tests.service.control.laws.test_baselines import BODY
from tests.support.law_tick import Tick, acceleration, errors, errors_at, unit
from tests.support.numpy_twin import Array

WIDTH = 0.5
FIRST = np.array([0.1, 0.2, 0.3])  # of the damping


def body(rng: np.random.Generator) -> dict[str, Any]:
    """A body that has nothing in common with Table C.1, and a first estimate of its damping."""
    return {
        "inertia": rng.uniform(0.5, 2, 3),
        "mass": rng.uniform(0.5, 2),
        "centre_of_mass": rng.normal(size=3),
        "allocation": rng.normal(size=(3, 3)) + 3 * np.eye(3),
        "damping_estimate": FIRST,
        "voltage_limit": 1e9,
    }


def descent(rng: np.random.Generator, pressed: bool) -> tuple[float, float, float]:
    """V̇ at a random state of a random body with friction and a constant torque; what the module says of it; a bound."""
    C1, C2, k1 = rng.uniform(0.2, 2, 3), rng.uniform(0.5, 2, 3), rng.uniform(0.2, 2)
    Gamma = rng.uniform(0.2, 2, (3, 3))
    names = ("Gamma_torque", "Gamma_damping", "Gamma_coulomb")
    gains = {"C1": C1, "C2": C2, "k1": [k1] * 3, **dict(zip(names, Gamma, strict=True))}
    bounds = {"damping_bound": 0.15, "coulomb_bound": 0.4, "torque_bound": [0.7] * 3, "friction_width": WIDTH}
    p = AdaptiveTorqueSettings.model_validate(body(rng) | gains | bounds)
    J = np.array(p.inertia)
    low, high = (np.array([side * 0.7 + 0 * FIRST, FIRST + side * 0.15, side * 0.4 + 0 * FIRST]) for side in (-1, 1))
    low[1:] = np.maximum(0, low[1:])  # friction is never negative
    theta = rng.uniform(low, high)
    at_bounds = np.where(rng.uniform(size=(3, 3)) < 0.5, low, high)
    learned = at_bounds if pressed else rng.uniform(low + 0.001, high - 0.001)
    q, q_d = unit(rng), unit(rng)
    omega, omega_d, omega_d_dot = rng.normal(size=(3, 3))
    sign = 1.0 if errors(q, omega, q_d, omega_d)[0][0] >= 0 else -1.0

    period = 1e-6  # so short that a step is a rate
    found = Tick(p, period)(np.array([sign, *learned.ravel()]), q, omega, q_d, omega_d, omega_d_dot)
    rates = (found["state_next"][1:].reshape(3, 3) - learned) / period
    friction = theta[1] * omega + theta[2] * np.tanh(omega / WIDTH)
    omega_dot = acceleration(p, q, omega, np.array(p.allocation) @ found["u"] - friction + theta[0])

    def lyapunov(t: float) -> tuple[float, Array, Array]:
        e, omega_e = errors_at(t, q, omega, omega_dot, q_d, omega_d, omega_d_dot)
        z2 = omega_e + C1 * sign * e[1:]
        wrong = theta - learned - t * rates
        return 2 * k1 * (1 - sign * e[0]) + z2 @ (J * z2) / 2 + (wrong**2 / Gamma).sum() / 2, e[1:], z2

    _, eps, z2 = lyapunov(0)
    slope = (lyapunov(1e-6)[0] - lyapunov(-1e-6)[0]) / 2e-6
    monotone = z2 @ (theta[2] * (np.tanh(omega / WIDTH) - np.tanh((omega - z2) / WIDTH)))
    promised = -k1 * eps @ (C1 * eps) - z2 @ ((C2 + theta[1] - FIRST) * z2) - monotone
    return slope, promised, -k1 * eps @ (C1 * eps) - z2 @ ((C2 - FIRST) * z2)


@pytest.mark.parametrize("pressed", [False, True], ids=["free estimates", "estimates at their bounds"])
def test_the_lyapunov_function_falls_with_both_frictions_and_a_constant_torque(pressed: bool) -> None:
    """As the module says, and faster where the projection acts; never slower than a negative form of ε̃ and z₂."""
    rng = np.random.default_rng(1)
    projected = 0
    for _ in range(60):
        slope, promised, bound = descent(rng, pressed)
        assert slope <= promised + 1e-6 * (1 + abs(promised))
        assert promised <= bound < 0
        projected += slope < promised - 1e-6 * (1 + abs(promised))
    assert projected > 20 if pressed else projected == 0


MODELLED = """
    plant.sensors.attitude=perfect plant.sensors.rate=perfect plant.rotor.lag_up_s=0 plant.rotor.lag_down_s=0
    plant.friction.viscous=[0.01] plant.friction.coulomb=[0.004,0.002,0.003] plant.friction.width=0.03
    plant.wind.blowing=true plant.wind.torque=[0.01,-0.02,0.005] plant.wind.gust=0 loop.rate_hz=100
    reference.amplitude=[40,40,100] reference.frequency=[0.4,0.5,0.45] law.damping_estimate=[0,0.02,0.02]
    law.Gamma_damping=[5,5,5] law.Gamma_coulomb=[0.5,0.5,0.5] law.kind=adaptive-torque"""


def test_it_learns_friction_and_wind_of_a_body_that_it_models() -> None:
    settings = load(overrides=[*BODY, *MODELLED.split()])
    settings = settings.model_copy(update={"wire": settings.wire.with_bits("cont/cont")})
    controller = Controller(settings.wire, settings.law, settings.reference, settings.loop.period)
    run_experiment(settings, 100.0, controller=controller)
    learned, friction = controller.law_state, settings.plant.friction
    assert learned["torque_estimate"] == pytest.approx(settings.plant.wind.torque, abs=0.0005)
    assert learned["damping_estimate"] == pytest.approx((0.01, 0.0070, 0.0095), abs=0.001)
    assert learned["coulomb_estimate"] == pytest.approx(friction.coulomb, abs=0.0003)
