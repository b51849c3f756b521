"""Friction: viscous in proportion to the rate, Coulomb against its direction, and an axis that slides to rest."""

from __future__ import annotations

from collections.abc import Callable
from math import asinh, exp, sinh

import casadi as ca
import numpy as np
import pytest

from aeroloop.plant_emulator.model.emulated import FrictionSettings, friction_torque
from aeroloop.plant_emulator.model.rigid_body import RigidBodySettings
from aeroloop.plant_emulator.settings import IDEAL_ROTOR, IDEAL_SENSORS, PlantSettings
from tests.support.numpy_twin import Array

PERIOD = 0.002
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
    # tanh(½ ln 3) is ½; some operations of 1e-16
    assert torque(np.full(3, FRICTION.width * np.log(3) / 2)) == pytest.approx(-c / 2, rel=1e-14)


def test_friction_is_odd_and_takes_energy_from_every_axis() -> None:
    torque = _friction(FRICTION, 3)
    rng = np.random.default_rng(1)
    for scale in (1e-6, 1e-3, 1e-2, 1.0, 1e2):
        for _ in range(20):
            rates = rng.normal(size=3) * scale
            assert torque(-rates).tolist() == (-torque(rates)).tolist()
            assert (torque(rates) * rates < 0).all()


@pytest.mark.parametrize("kind", ["viscous", "coulomb"])
def test_missing_axes_have_no_friction(kind: str) -> None:
    off = {"viscous": (), "coulomb": ()}
    torque = _friction(FrictionSettings.model_validate(off | {kind: (0.1,)}), 3)(np.ones(3))
    assert torque[0] == -0.1
    assert torque[1:].tolist() == [0.0, 0.0]
    two = _friction(FrictionSettings.model_validate(off | {kind: (0.1, 0.2, 0.3)}), 2)(np.ones(2))
    assert two.tolist() == [-0.1, -0.2]  # nor does one too many do any harm


@pytest.mark.parametrize("rate", [0.5, -0.5])
def test_an_axis_slides_down_and_comes_to_rest(rate: float) -> None:
    """ω̇ = −(c/J) tanh(ω/w) has the solution sinh(ω/w) = sinh(ω₀/w) exp(−c t/(J w))."""
    c, width, inertia = 0.003, 0.01, 0.02
    body = RigidBodySettings(inertia=(inertia,) * 3, damping=(0.0, 0.0, 0.0), rate=(0.0, 0.0, rate))
    friction = FrictionSettings(viscous=(), coulomb=(0.0, 0.0, c), width=width)
    plant = PlantSettings(
        kind="rigid_body", rigid_body=body, rotor=IDEAL_ROTOR, friction=friction, sensors=IDEAL_SENSORS
    ).build(PERIOD)
    stop = abs(rate) * inertia / c  # where a Coulomb torque that does not turn over would have brought it to rest
    for periods in range(1, round(1.5 * stop / PERIOD)):
        plant.advance()
        expected = width * asinh(sinh(rate / width) * exp(-c / (inertia * width) * periods * PERIOD))
        # (h c/(J w))⁵/120 = 6e-12 of the width a step while it turns over, some 100 steps; rounding of 1e-16·periods
        assert plant.truth().rate[2] == pytest.approx(expected, abs=1e-11)
    # By then sinh(ω/w) is ½ exp(ω₀/w − 1.5 ω₀/w): at rest but for 1e-11 of the width.
    assert abs(plant.truth().rate[2]) < width * exp(-0.5 * abs(rate) / width)
