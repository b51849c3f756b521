"""Emulated Aero: the paper's rigid body on the Aero's mechanism, and the error of its integration.

Its twin is derived differently from Kane's projection: Lagrange's equations in pitch and yaw, written by hand. (A third
derivation, with the torque that the mechanism bears, is in tests/support/numpy_twin.py.)
"""

from __future__ import annotations

from itertools import pairwise
from math import cos, sin

import numpy as np
import numpy.typing as npt
import pytest

from aeroloop.plant_emulator.model.aero import Aero, AeroSettings, aero_dynamics
from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.plant_emulator.model.sensors import Sensors
from aeroloop.plant_emulator.model.wind import Wind, WindSettings
from aeroloop.plant_emulator.settings import IDEAL_AERO, IDEAL_FRICTION, IDEAL_ROTOR, IDEAL_SENSORS

LOSSLESS = AeroSettings(damping=(0.0, 0.0, 0.0), inertia=(0.01, 0.02, 0.03), centre_of_mass=(0.001, 0.002, -0.0038))
"""At 0 V it keeps its energy. J_x and J_z differ, which the paper's do not: that couples pitch and yaw."""


def _plant(p: AeroSettings, period: float, substeps: int = 2) -> EmulatedPlant:
    """The bare Aero: nothing acts on it but its motors, and its sensors are perfect."""
    return EmulatedPlant(
        Aero(p),
        IDEAL_ROTOR,
        IDEAL_FRICTION,
        Wind(WindSettings(), 2, period),
        Sensors(IDEAL_SENSORS, period),
        period=period,
        voltage_limit=24.0,
        substeps=substeps,
    )


def _random_settings(rng: np.random.Generator) -> AeroSettings:
    """A body without any symmetry: three inertias, a centre of mass off every axis, damping about each."""
    J, r_g, damping = rng.uniform(0.5, 2.0, 3), rng.normal(size=3), rng.uniform(0.1, 2.0, 3)
    thrust = rng.normal(size=(2, 2))
    return AeroSettings.model_validate(
        {
            "inertia": J.tolist(),
            "mass": rng.uniform(0.5, 2.0),
            "gravity": rng.uniform(5.0, 10.0),
            "centre_of_mass": r_g.tolist(),
            "thrust": thrust.tolist(),
            "damping": damping.tolist(),
        }
    )


def _lagrange(p: AeroSettings, x: npt.NDArray[np.float64], u: npt.NDArray[np.float64]) -> list[float]:
    """ẋ by Lagrange's equations.

    Kinetic energy T = ½ (J_x sin²p + J_z cos²p) ẏ² + ½ J_y ṗ².
    Potential energy U = m g (r_z cos p − r_x sin p), the height of the centre of mass.
    Work of damping and thrust: that on pitch directly, that on yaw through the vertical's share of each body axis.
    """
    pitch, _, dp, dy = (float(value) for value in x)
    (Jx, Jy, Jz), (rx, _, rz), (dx_, dy_, dz_) = p.inertia, p.centre_of_mass, p.damping
    s, c = sin(pitch), cos(pitch)
    torque_y = p.thrust[0][0] * u[0] + p.thrust[0][1] * u[1]
    torque_z = p.thrust[1][0] * u[0] + p.thrust[1][1] * u[1]
    slope = p.mass * p.gravity * (-rz * s - rx * c)  # ∂U/∂p
    pitch_force = torque_y - dy_ * dp
    yaw_force = c * torque_z - (dx_ * s * s + dz_ * c * c) * dy
    ddp = ((Jx - Jz) * s * c * dy * dy - slope + pitch_force) / Jy
    ddy = (yaw_force - 2 * (Jx - Jz) * s * c * dp * dy) / (Jx * s * s + Jz * c * c)
    return [dp, dy, ddp, ddy]


@pytest.mark.parametrize("paper", [True, False], ids=["paper's body", "random bodies"])
def test_the_dynamics_agree_with_lagranges_equations_at_moving_states(paper: bool) -> None:
    rng = np.random.default_rng(1)
    for _ in range(1 if paper else 20):
        p = IDEAL_AERO if paper else _random_settings(rng)
        dynamics = aero_dynamics(p)
        for _ in range(20):
            x, u = rng.normal(size=4), rng.normal(size=2) * 10
            got = np.array(dynamics(x, u, np.zeros(2)), dtype=np.float64).ravel()
            expected = np.array(_lagrange(p, x, u))
            # about a hundred operations of 2e-16 each; torques of some units cancel to accelerations of some tenths
            assert np.linalg.norm(got - expected) <= 1e-12 * np.linalg.norm(expected)


def _energy(p: AeroSettings, plant: EmulatedPlant) -> float:
    """½ ωᵀJω + m g h, from what the plant says of itself; h by the last row of the rotation matrix."""
    (w, x, y, z), omega, _ = plant.truth()
    rx, ry, rz = p.centre_of_mass
    height = 2 * (x * z - w * y) * rx + 2 * (y * z + w * x) * ry + (1 - 2 * (x * x + y * y)) * rz
    return sum(J * rate * rate for J, rate in zip(p.inertia, omega, strict=True)) / 2 + p.mass * p.gravity * height


def _thrown(p: AeroSettings, period: float) -> EmulatedPlant:
    """An Aero that pitches and yaws at 1 rad/s or so, motors off."""
    plant = _plant(p, period)
    plant.actuate((20.0, -10.0))
    for _ in range(round(1.0 / period)):
        plant.advance()
    plant.actuate((0.0, 0.0))
    return plant


def test_without_damping_and_input_the_energy_stays() -> None:
    period = 0.02
    plant = _thrown(LOSSLESS, period)
    before = _energy(LOSSLESS, plant)
    assert np.linalg.norm(plant.truth().rate) > 0.5  # it does move
    kinetic = sum(J * w * w for J, w in zip(LOSSLESS.inertia, plant.truth().rate, strict=True)) / 2
    drift = 0.0
    for _ in range(1000):
        plant.advance()
        drift = max(drift, abs(_energy(LOSSLESS, plant) - before))
    # A Runge–Kutta step of fourth order takes (ω h)⁶/72 of an oscillation's energy; ω = 2 rad/s of pendulum and spin
    # together, h = 0.01 s, 2000 steps. A method of third order would take (ω h)⁴/12 a step, a thousand times as much.
    assert drift <= 2000 * (2 * 0.01) ** 6 / 72 * kinetic


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    """Fourth order, over a whole period with its substeps."""

    def end(substeps: int) -> npt.NDArray[np.float64]:
        plant = _plant(IDEAL_AERO, 1.0, substeps)
        plant.actuate((24.0, -20.0))
        for _ in range(3):
            plant.advance()
        return np.array([*plant.truth().attitude, *plant.truth().rate])

    exact = end(100)  # its own error is 6⁻⁴, a thousandth, of the finest's below
    errors = [np.linalg.norm(end(substeps) - exact) for substeps in (4, 8, 16)]
    for coarse, fine in pairwise(errors):
        # 16 in the limit; the next order's terms still show a little. Orders 3 and 5 would give 8 and 32.
        assert 14 < coarse / fine < 18


def test_the_attitude_turns_with_the_rates() -> None:
    """(C.1): q̇ = ½ q ⊗ [0, ω], by a central difference."""
    period = 1e-3
    plant = _plant(IDEAL_AERO, period)
    plant.actuate((24.0, 10.0))
    states = []
    for _ in range(1000):
        plant.advance()
        states.append(plant.truth())
    for before, at, after in zip(states, states[1:], states[2:], strict=False):
        (w, x, y, z), (a, b, c) = at.attitude, at.rate
        expected = [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
        moved = (np.array(after.attitude) - np.array(before.attitude)) / period
        # period²/6 of the third derivative, which is below 10 here
        assert np.abs(moved - expected).max() <= 2e-6


@pytest.mark.parametrize(("commanded", "held"), [((30.0, -1e9), (24.0, -24.0)), ((-24.5, 23.5), (-24.0, 23.5))])
def test_voltages_are_clipped_to_the_supply(commanded: tuple[float, float], held: tuple[float, float]) -> None:
    plant, other = _plant(IDEAL_AERO, 0.01), _plant(IDEAL_AERO, 0.01)
    plant.actuate(commanded)
    other.actuate(held)
    for _ in range(10):
        plant.advance()
        other.advance()
    assert plant.truth().voltages == held
    assert plant.truth() == other.truth()


def test_it_starts_level_at_rest_and_stays_there_at_0_v() -> None:
    plant = _plant(IDEAL_AERO, 0.002)
    level = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert plant.measure() == level
    for _ in range(1000):
        plant.advance()
    assert plant.measure() == level


def test_a_closed_plant_has_no_voltage() -> None:
    plant = _plant(IDEAL_AERO, 0.002)
    plant.actuate((10.0, -10.0))
    plant.close()
    plant.close()  # twice does no harm
    plant.advance()
    assert plant.truth().voltages == (0.0, 0.0)
    assert plant.measure() == ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
