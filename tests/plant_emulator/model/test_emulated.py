"""The emulated plant: the pieces together, each one on and off, and settings that no plant has."""

from __future__ import annotations

from math import cos, sin

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from aeroloop.plant_emulator.model.aero import AeroSettings, aero_dynamics
from aeroloop.plant_emulator.model.emulated import EmulatedPlant, RotorSettings
from aeroloop.plant_emulator.model.rigid_body import RigidBody, RigidBodySettings
from aeroloop.plant_emulator.model.sensors import Sensors
from aeroloop.plant_emulator.model.wind import Wind, WindSettings
from aeroloop.plant_emulator.plant import Measurement, State
from aeroloop.plant_emulator.settings import IDEAL_AERO, IDEAL_FRICTION, IDEAL_ROTOR, IDEAL_SENSORS, PlantSettings
from aeroloop.protocol.wire.attitude import IDENTITY
from tests.support.numpy_twin import Array

PERIOD = 0.002
WEIGHTLESS = AeroSettings(gravity=0.0, thrust=((0.001, 0.0), (0.0, 0.001)))
"""u₂ is a torque about pitch and u₃ one about yaw, and nothing else acts."""
BARE = PlantSettings(rotor=IDEAL_ROTOR, friction=IDEAL_FRICTION, sensors=IDEAL_SENSORS)
"""The Aero with every piece off: no lag, no friction, calm, perfect sensors."""


def _with(settings: PlantSettings = BARE, **sections: BaseModel) -> PlantSettings:
    return settings.model_copy(update=sections)


@pytest.mark.parametrize(
    ("attitude", "rate"), [("encoders", "derivative"), ("encoders", "perfect"), ("perfect", "derivative")]
)
def test_encoders_on_a_free_body_are_refused_with_what_to_set(attitude: str, rate: str) -> None:
    free = {"kind": "rigid_body", "sensors": {"attitude": attitude, "rate": rate}}
    with pytest.raises(ValidationError) as refused:
        PlantSettings.model_validate(free)
    for word in ("sensors.attitude", "sensors.rate", "'perfect'", "'gyro'", "ideal"):
        assert word in str(refused.value)
    assert PlantSettings.model_validate(free | {"kind": "aero"}).sensors.attitude == attitude
    assert PlantSettings.model_validate(free | {"ideal": True}).build(PERIOD).actuators == 3


@pytest.mark.parametrize("rate", ["gyro", "perfect"])
def test_a_free_body_with_sensors_that_need_no_joints_is_built(rate: str) -> None:
    settings = PlantSettings.model_validate(
        {"kind": "rigid_body", "sensors": {"attitude": "perfect", "rate": rate}, "rigid_body": {"rate": (1, 2, 3)}}
    )
    plant = settings.build(PERIOD)
    assert plant.actuators == 3
    assert plant.measure() == (IDENTITY, (1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"rotor": {"lag_up_s": 0.0}}, "lag_up_s and lag_down_s"),
        ({"aero": {"inertia": [0.02, 0.0, 0.02]}}, "inertia"),
        ({"rigid_body": {"inertia": [0.02, -0.02, 0.02]}}, "inertia"),
        ({"rigid_body": {"attitude": [0.0, 0.0, 0.0, 0.0]}}, "quaternion"),
    ],
)
def test_a_body_that_cannot_be_is_refused(settings: dict[str, object], names: str) -> None:
    with pytest.raises(ValidationError, match=names):
        PlantSettings.model_validate(settings)


def _voltages(k: int) -> tuple[float, float]:
    return 12 * sin(0.02 * k), 9 * cos(0.013 * k)


def _driven(settings: PlantSettings, periods: int = 300) -> list[tuple[State, Measurement]]:
    """What is true and what is measured, after each period of a drive that goes to and fro."""
    plant = settings.build(PERIOD)
    seen = []
    for k in range(periods):
        plant.actuate(_voltages(k))
        plant.advance()
        seen.append((plant.truth(), plant.measure()))
    return seen


def test_with_every_piece_off_the_plant_is_the_bare_mechanism() -> None:
    """Its equations of motion, in a Runge–Kutta step typed here."""
    p = AeroSettings(inertia=(0.02, 0.03, 0.04), damping=(0.01, 0.02, 0.03))
    dynamics = aero_dynamics(p)

    def slope(x: Array, u: tuple[float, float]) -> Array:
        return np.array(dynamics(x, u, np.zeros(2)), dtype=np.float64).ravel()

    x, h = np.zeros(4), PERIOD / BARE.substeps
    for k, (state, measured) in enumerate(_driven(_with(aero=p), 200)):
        u = _voltages(k)
        for _ in range(BARE.substeps):
            a = slope(x, u)
            b = slope(x + h / 2 * a, u)
            c = slope(x + h / 2 * b, u)
            d = slope(x + h * c, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        pitch, yaw = (float(angle) / 2 for angle in x[:2])
        q = [cos(yaw) * cos(pitch), -sin(yaw) * sin(pitch), cos(yaw) * sin(pitch), sin(yaw) * cos(pitch)]
        omega = [-sin(x[0]) * x[3], x[2], cos(x[0]) * x[3]]
        # the same operations: rounding of some tens a step, 400 steps, of values up to 1
        assert state.attitude == pytest.approx(q, abs=1e-13)
        assert state.rate == pytest.approx(omega, abs=1e-13)
        assert state.voltages == u
        assert measured == (state.attitude, state.rate)


GUSTY = PlantSettings(wind=WindSettings(blowing=True, gust=0.5), rotor=RotorSettings(dead_zone_v=1.0))
"""Every piece on."""


def test_two_plants_of_the_same_settings_move_alike_and_another_seed_changes_its_own_piece_only() -> None:
    states, seen = zip(*_driven(GUSTY), strict=True)
    assert (states, seen) == tuple(zip(*_driven(GUSTY), strict=True))
    blown, _ = zip(*_driven(_with(GUSTY, wind=GUSTY.wind.model_copy(update={"seed": 1}))), strict=True)
    assert all(one.attitude != other.attitude for one, other in zip(states, blown, strict=True))
    same, otherwise = zip(*_driven(_with(GUSTY, sensors=GUSTY.sensors.model_copy(update={"seed": 1}))), strict=True)
    assert same == states
    assert otherwise != seen


def test_wind_is_a_torque_about_the_axes() -> None:
    plant = _with(
        aero=WEIGHTLESS.model_copy(update={"inertia": (0.02, 0.03, 0.05)}),
        wind=WindSettings(blowing=True, torque=(0.0, 0.01), gust=0.0),
    ).build(PERIOD)
    for _ in range(100):
        plant.advance()
    # constant acceleration, level: Runge–Kutta is exact; rounding of a hundred periods
    assert plant.truth().rate[:2] == (0.0, 0.0)
    assert plant.truth().rate[2] == pytest.approx(0.01 * 0.2 / 0.05, rel=1e-12)


def test_the_ideal_plant_has_no_piece_whatever_is_set() -> None:
    ideal = GUSTY.model_copy(update={"ideal": True, "aero": WEIGHTLESS})
    assert _driven(ideal) == _driven(_with(aero=IDEAL_AERO))


def test_the_ideal_free_body_keeps_its_own_body() -> None:
    body = RigidBodySettings(inertia=(0.01, 0.02, 0.03), rate=(1.0, 2.0, 3.0))
    ideal = GUSTY.model_copy(update={"kind": "rigid_body", "rigid_body": body, "ideal": True}).build(PERIOD)
    bare = EmulatedPlant(
        RigidBody(body),
        IDEAL_ROTOR,
        IDEAL_FRICTION,
        Wind(WindSettings(), 3, PERIOD),
        Sensors(IDEAL_SENSORS, PERIOD),
        period=PERIOD,
        voltage_limit=24.0,
        substeps=2,
    )
    for plant in (ideal, bare):
        plant.actuate((1.0, -2.0, 3.0))
        for _ in range(100):
            plant.advance()
    assert ideal.truth() == bare.truth()
    assert ideal.measure() == (ideal.truth().attitude, ideal.truth().rate)
