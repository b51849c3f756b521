"""The emulated plant: rotors, friction and wind against closed solutions, each on and off, and all together."""

from __future__ import annotations

from collections.abc import Callable
from math import exp

import casadi as ca
import numpy as np
import pytest
from pydantic import ValidationError

from aeroloop.plant_emulator.model.bodies import AeroSettings, aero
from aeroloop.plant_emulator.model.emulated import (
    FrictionSettings,
    RotorSettings,
    friction_torque,
    step_function,
)
from aeroloop.plant_emulator.settings import PlantSettings
from tests.support import ideal
from tests.support.numpy_twin import Array

PERIOD = 0.002
WEIGHTLESS = AeroSettings(gravity=0.0, thrust=((0.001, 0.0), (0.0, 0.001)))
"""u₂ is a torque about pitch and u₃ one about yaw, and nothing else acts."""
BARE = PlantSettings(rotor=ideal.ROTOR, friction=ideal.FRICTION, sensors=ideal.SENSORS)
"""The Aero with every piece off: no lag, no friction, calm, perfect sensors."""


def _with(settings: PlantSettings = BARE, **sections: object) -> PlantSettings:
    return settings.model_copy(update=sections)


# ── rotors ──


UP, DOWN = 0.1, 0.3
ROTOR = RotorSettings(lag_up_s=UP, lag_down_s=DOWN)


@pytest.mark.parametrize(
    ("start", "command", "lag"),
    [(0, 10, UP), (10, 20, UP), (0, -10, UP), (10, 0, DOWN), (20, 10, DOWN), (-10, 0, DOWN), (7, 7, UP)],
)
def test_a_rotor_follows_with_the_time_constant_of_the_direction(start: float, command: float, lag: float) -> None:
    """Up is where |thrust| rises, whichever its sign: V(t) = V∞ + (V₀ − V∞) exp(−t/τ)."""
    step = step_function(aero(WEIGHTLESS), ROTOR, ideal.FRICTION, PERIOD)
    x = ca.DM([0.0, 0.0, 0.0, 0.0, 0.0, start])
    for periods in range(1, 251):
        x = step(x, [0.0, command], [0.0, 0.0])[0]
        expected = command + (start - command) * exp(-periods * PERIOD / lag)
        # fourth order, exact but for (h/τ)⁵/120 a step of h = 1 ms: 1e-12 of it, 500 times, of 10 V
        assert float(x[5]) == pytest.approx(expected, abs=1e-8)


def test_thrust_begins_beyond_the_dead_zone() -> None:
    """With a dead zone of 5 V, thrust begins τ ln(10/(10 − 5)) after a step to 10 V."""
    plant = _with(aero=WEIGHTLESS, rotor=ROTOR.model_copy(update={"dead_zone_v": 5.0})).build(PERIOD)
    plant.actuate((10.0, 0.0))
    periods = 0
    while plant.truth().rate[1] == 0.0 and periods < 1000:
        plant.advance()
        periods += 1
    assert (periods - 1) * PERIOD <= UP * np.log(2) <= periods * PERIOD
    assert plant.truth().voltages == (10.0, 0.0)  # the truth holds the voltage at the motor, not the thrust


# ── friction ──


FRICTION = FrictionSettings(viscous=(0.02, 0.03, 0.04), coulomb=(0.001, 0.002, 0.003), width=0.01)


def _friction(settings: FrictionSettings, axes: int) -> Callable[[Array], Array]:
    rates = ca.SX.sym("rates", axes)
    function = ca.Function("friction", [rates], [friction_torque(settings, rates)])
    return lambda values: np.array(function(values), dtype=np.float64).ravel()


def test_viscous_friction_is_in_proportion_to_the_rate_and_coulomb_friction_constant_against_it() -> None:
    torque = _friction(FRICTION.model_copy(update={"coulomb": ()}), 3)
    for rates in (np.array([1.0, -2.0, 3.0]), np.array([1e-3, 0.0, -1e-5])):
        assert torque(rates).tolist() == (-np.array(FRICTION.viscous) * rates).tolist()
    torque = _friction(FRICTION.model_copy(update={"viscous": ()}), 3)
    c = np.array(FRICTION.coulomb)
    assert torque(np.array([0.2, 5.0, 100.0])).tolist() == (-c).tolist()  # 1 − tanh(20) is 8.5e-18: nothing in floats
    assert torque(np.array([-0.2, -5.0, -100.0])).tolist() == c.tolist()
    # tanh(½ ln 3) is ½; some operations of 1e-16
    assert torque(np.full(3, FRICTION.width * np.log(3) / 2)) == pytest.approx(-c / 2, rel=1e-14)


# ── supply, start and end ──


def test_voltages_are_clipped_to_the_supply() -> None:
    plant, other = BARE.build(PERIOD), BARE.build(PERIOD)
    plant.actuate((30.0, -1e9))
    other.actuate((24.0, -24.0))
    for each in (plant, other):
        each.advance()
    assert plant.truth().voltages == (24.0, -24.0)
    assert plant.truth() == other.truth()


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"rotor": {"lag_up_s": 0.0}}, "lag_up_s and lag_down_s"),
        ({"kind": "rigid_body", "sensors": {"rate": "perfect"}}, "set sensors.attitude to 'perfect' and sensors.rate"),
        ({"rigid_body": {"attitude": [0.0, 0.0, 0.0, 0.0]}}, "quaternion"),
    ],
)
def test_a_body_that_cannot_be_is_refused(settings: dict[str, object], names: str) -> None:
    with pytest.raises(ValidationError, match=names):
        PlantSettings.model_validate(settings)
