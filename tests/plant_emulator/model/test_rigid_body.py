"""Free rigid body: agrees with (C.1), (C.2) and (C.78), conserves momentum and energy, and held in roll is the Aero.

Its twin is written here in NumPy. The last part compares two independently built models: the Aero by projection onto
its two motions, and the free body with a spring about roll, which becomes the Aero as the spring stiffens.
"""

from __future__ import annotations

from itertools import pairwise
from math import sqrt

import casadi as ca
import numpy as np
import pytest

from aeroloop.plant_emulator.model.emulated import EmulatedPlant, FrictionSettings
from aeroloop.plant_emulator.model.rigid_body import RigidBody, RigidBodySettings
from aeroloop.plant_emulator.model.wind import WindSettings
from aeroloop.plant_emulator.settings import IDEAL_FRICTION, IDEAL_ROTOR, IDEAL_SENSORS, PlantSettings
from tests.support import numpy_twin as twin
from tests.support.numpy_twin import Array

PERIOD = 0.01
SUBSTEPS = 2


def _plant(body: RigidBodySettings, **changed: object) -> EmulatedPlant:
    """The bare body unless stated otherwise."""
    bare = PlantSettings(
        kind="rigid_body",
        rigid_body=body,
        rotor=IDEAL_ROTOR,
        friction=IDEAL_FRICTION,
        sensors=IDEAL_SENSORS,
        substeps=SUBSTEPS,
    )
    return bare.model_copy(update=changed).build(PERIOD)


def _dynamics(body: RigidBodySettings) -> ca.Function:
    x, u, load = ca.SX.sym("x", 7), ca.SX.sym("u", 3), ca.SX.sym("load", 3)
    return ca.Function("body", [x, u, load], [RigidBody(body).derivative(x, u, load)])


def _random_settings(rng: np.random.Generator) -> RigidBodySettings:
    """A body without any symmetry: three inertias, a centre of mass off every axis, motors that act on all axes."""
    return RigidBodySettings.model_validate(
        {
            "inertia": rng.uniform(0.5, 2.0, 3).tolist(),
            "mass": rng.uniform(0.5, 2.0),
            "gravity": rng.uniform(5.0, 10.0),
            "centre_of_mass": rng.normal(size=3).tolist(),
            "allocation": rng.normal(size=(3, 3)).tolist(),
            "damping": rng.uniform(0.1, 2.0, 3).tolist(),
        }
    )


def _equations(p: RigidBodySettings, q: Array, omega: Array, u: Array, tau_d: Array) -> Array:
    """(C.1), and (C.2) with the disturbance of (C.78), both sides in full."""
    w, x, y, z = q
    a, b, c = omega
    # ½ q ⊗ [0, ω], by Hamilton's table
    q_dot = np.array([-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]) / 2
    J = np.diag(p.inertia)
    weight = twin.rotation(q).T @ np.array([0.0, 0.0, -p.mass * p.gravity])
    torque = (
        -np.cross(omega, J @ omega)
        + np.cross(p.centre_of_mass, weight)
        - np.array(p.damping) * omega
        + np.array(p.allocation) @ u
        + tau_d
    )
    return np.append(q_dot, np.linalg.inv(J) @ torque)


def test_the_dynamics_agree_with_the_equations_at_moving_states() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        p = _random_settings(rng)
        dynamics = _dynamics(p)
        for _ in range(20):
            q = rng.normal(size=4)
            q /= np.linalg.norm(q)
            omega, u, load = rng.normal(size=3), rng.normal(size=3) * 5, rng.normal(size=3)
            got = np.array(dynamics(np.append(q, omega), u, load), dtype=np.float64).ravel()
            expected = _equations(p, q, omega, u, load)
            # about a hundred operations of 2e-16 each, of torques up to some tens of the sum they make
            assert np.linalg.norm(got - expected) <= 1e-12 * np.linalg.norm(expected)


def test_a_load_is_a_torque_about_the_body_axes() -> None:
    """What (C.78) adds is J⁻¹ τ_d, at any attitude and in any motion."""
    rng = np.random.default_rng(2)
    p = _random_settings(rng)
    dynamics = _dynamics(p)
    for _ in range(20):
        q, omega, u, load = rng.normal(size=4), rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
        x = np.append(q / np.linalg.norm(q), omega)
        added = np.array(dynamics(x, u, load) - dynamics(x, u, np.zeros(3)), dtype=np.float64).ravel()
        # the difference of two sums of some tens, each rounded by 1e-14
        assert added == pytest.approx([0, 0, 0, 0, *(load / p.inertia)], abs=1e-12)


def test_wind_and_friction_act_on_the_body_as_voltages_and_damping_would() -> None:
    """A steady wind is B u; viscous friction about the axes is θ."""
    torque, theta = (0.01, -0.02, 0.015), (0.01, 0.02, 0.03)
    calm = RigidBodySettings(damping=theta, rate=(1.0, -2.0, 3.0))
    free = calm.model_copy(update={"damping": (0.0, 0.0, 0.0)})
    driven = _plant(calm)
    blown = _plant(
        free,
        wind=WindSettings(blowing=True, torque=torque, gust=0.0),
        friction=FrictionSettings(viscous=theta, coulomb=()),
    )
    driven.actuate([t / 0.01 for t in torque])
    for _ in range(200):
        driven.advance()
        blown.advance()
    # rounding of 400 steps, of rates up to 4 rad/s
    assert blown.truth().rate == pytest.approx(driven.truth().rate, abs=1e-12)
    assert blown.truth().attitude == pytest.approx(driven.truth().attitude, abs=1e-12)
    assert np.abs(np.array(blown.truth().rate) - free.rate).max() > 0.5  # and both did act


# What a body keeps

TUMBLING = RigidBodySettings(inertia=(0.01, 0.02, 0.03), damping=(0.0, 0.0, 0.0), rate=(0.3, 3.0, 0.3))
"""Nearly about the axis of intermediate inertia, about which no body turns for long: it tumbles over and over."""

TOP = TUMBLING.model_copy(update={"centre_of_mass": (0.0, 0.0, -0.004)})
"""The same with its weight below the pivot."""


def _energy(p: RigidBodySettings, plant: EmulatedPlant) -> float:
    """½ ωᵀJω + m g h."""
    q, omega = np.array(plant.truth().attitude), np.array(plant.truth().rate)
    height = (twin.rotation(q) @ np.array(p.centre_of_mass))[2]
    return float(omega @ np.diag(p.inertia) @ omega / 2 + p.mass * p.gravity * height)


def _momentum(p: RigidBodySettings, plant: EmulatedPlant) -> Array:
    """R(q) J ω, in the inertial frame."""
    q, omega = np.array(plant.truth().attitude), np.array(plant.truth().rate)
    momentum: Array = twin.rotation(q) @ np.diag(p.inertia) @ omega
    return momentum


def _drift(periods: int) -> float:
    """What a step of fourth order may take of the energy or the momentum, relative, over all steps.

    A step is wrong by (ω h)⁵/120. ω is the fastest that anything turns here: the body at 5 rad/s at most.
    """
    return periods * SUBSTEPS * (5.0 * PERIOD / SUBSTEPS) ** 5 / 120


def test_a_free_body_keeps_its_energy_and_momentum_through_full_turns() -> None:
    plant = _plant(TUMBLING)
    energy, momentum = _energy(TUMBLING, plant), _momentum(TUMBLING, plant)
    periods, turned_over, fastest = 2000, 0, 0.0
    slack = _drift(periods)
    last = plant.truth()
    for _ in range(periods):
        plant.advance()
        state = plant.truth()
        turned_over += (state.attitude[0] < 0) != (last.attitude[0] < 0)
        fastest = max(fastest, float(np.linalg.norm(state.rate)))
        last = state
        assert abs(_energy(TUMBLING, plant) - energy) <= slack * energy
        assert np.linalg.norm(_momentum(TUMBLING, plant) - momentum) <= slack * np.linalg.norm(momentum)
    assert turned_over >= 8  # η passes zero twice in two turns; 3 rad/s for 20 s are nearly ten turns
    assert fastest < 5.0  # as `_drift` takes for granted
    assert np.ptp([r * J for r, J in zip(last.rate, TUMBLING.inertia, strict=True)]) > 0.01  # in the body it does move


def test_a_heavy_body_keeps_its_energy_and_its_momentum_about_the_vertical() -> None:
    plant = _plant(TOP)
    energy, momentum = _energy(TOP, plant), _momentum(TOP, plant)
    periods = 2000
    slack = _drift(periods)
    kinetic = energy + TOP.mass * TOP.gravity * 0.004
    swayed = 0.0
    for _ in range(periods):
        plant.advance()
        now = _momentum(TOP, plant)
        assert abs(_energy(TOP, plant) - energy) <= slack * kinetic
        assert abs(now[2] - momentum[2]) <= slack * np.linalg.norm(momentum)
        swayed = max(swayed, float(np.linalg.norm(now - momentum)))
    assert swayed > 0.1 * np.linalg.norm(momentum)  # the weight does act


def test_the_quaternion_stays_unit_and_never_jumps() -> None:
    body = TUMBLING.model_copy(update={"rate": (3.0, 20.0, 3.0)})  # so fast that a step alone stretches it by 1e-9
    plant = _plant(body)
    attitudes = []
    for _ in range(1000):
        plant.advance()
        attitudes.append(np.array(plant.truth().attitude))
    # a square, a sum, a root and a division: each rounds by 1e-16
    assert max(abs(float(q @ q) - 1) for q in attitudes) <= 1e-15
    # in a period it turns by less than 33 rad/s · 0.01 s, and q by half of that
    assert max(float(np.linalg.norm(after - before)) for before, after in pairwise(attitudes)) < 33 * PERIOD / 2
    assert min(q[0] for q in attitudes) < -0.9  # so it did turn over


@pytest.mark.parametrize("attitude", [(2.0, 0.0, 0.0, 2.0), (-0.1, 0.2, -0.2, 0.4), (1.0, 0.0, 0.0, 0.0)])
def test_the_attitude_at_the_start_is_scaled_to_unit_length(attitude: tuple[float, float, float, float]) -> None:
    plant = _plant(RigidBodySettings(attitude=attitude, rate=(0.1, 0.2, 0.3)))
    length = sqrt(sum(part * part for part in attitude))
    # the sign is kept; a root and a division round by 1e-16
    assert plant.truth().attitude == pytest.approx([part / length for part in attitude], abs=5e-16)
    assert plant.truth().rate == (0.1, 0.2, 0.3)
    assert plant.measure() == (plant.truth().attitude, plant.truth().rate)


# The Aero by another route

"""J_x and J_z differ and the centre of mass lies off every axis, so that the mechanism has something to hold."""

"""[s]; the stiffer spring and its damper settle within 7 ms."""
