"""Rotors: the lag of the thrust, compared with its closed solution, and the dead zone behind it."""

from __future__ import annotations

from math import exp

import casadi as ca
import numpy as np
import pytest

from aeroloop.plant_emulator.model.aero import Aero, AeroSettings
from aeroloop.plant_emulator.model.emulated import RotorSettings, rotor_derivative, step_function, thrust_voltage
from aeroloop.plant_emulator.settings import IDEAL_FRICTION, IDEAL_ROTOR, IDEAL_SENSORS, PlantSettings

PERIOD = 0.002
WEIGHTLESS = AeroSettings(gravity=0.0, thrust=((0.001, 0.0), (0.0, 0.001)))
"""u₂ is a torque about pitch and u₃ one about yaw, and nothing else acts."""
BARE = PlantSettings(rotor=IDEAL_ROTOR, friction=IDEAL_FRICTION, sensors=IDEAL_SENSORS)
"""The Aero with every piece off: no lag, no friction, calm, perfect sensors."""
UP, DOWN = 0.1, 0.3
ROTOR = RotorSettings(lag_up_s=UP, lag_down_s=DOWN)


def _lagging(rotor: RotorSettings, start: float, command: float, periods: int) -> float:
    """The voltage that makes thrust, after a time under a constant command."""
    step = step_function(Aero(WEIGHTLESS), rotor, IDEAL_FRICTION, PERIOD, 2)
    x = ca.DM([0.0, 0.0, 0.0, 0.0, 0.0, start])
    for _ in range(periods):
        x = step(x, [0.0, command], [0.0, 0.0])[0]
    return float(x[5])


@pytest.mark.parametrize(
    ("start", "command", "lag"),
    [
        (0, 10, UP),
        (10, 20, UP),
        (0, -10, UP),
        (-10, -20, UP),
        (10, 0, DOWN),
        (20, 10, DOWN),
        (-10, 0, DOWN),
        (7, 7, UP),
    ],
)
def test_a_rotor_follows_with_the_time_constant_of_the_direction(start: float, command: float, lag: float) -> None:
    """Up is where |thrust| rises, whichever its sign: V(t) = V∞ + (V₀ − V∞) exp(−t/τ)."""
    for periods in (1, 50, 250):
        expected = command + (start - command) * exp(-periods * PERIOD / lag)
        # fourth order, exact but for (h/τ)⁵/120 a step of h = 1 ms: 1e-12 of it, 500 times, of 10 V
        assert _lagging(ROTOR, start, command, periods) == pytest.approx(expected, abs=1e-8)


def test_a_rotor_that_reverses_falls_with_the_down_lag_before_it_rises_with_the_up_lag() -> None:
    rotor = RotorSettings(lag_up_s=0.1, lag_down_s=0.4)
    falling = float(rotor_derivative(rotor, ca.SX(5.0), ca.SX(-10.0)))
    rising = float(rotor_derivative(rotor, ca.SX(-1.0), ca.SX(-10.0)))
    from_rest = float(rotor_derivative(rotor, ca.SX(0.0), ca.SX(-10.0)))
    assert [falling, rising, from_rest] == pytest.approx([-15 / 0.4, -9 / 0.1, -10 / 0.1], rel=1e-15)


def test_thrust_lags_behind_the_voltage() -> None:
    """A weightless body's rate is the integral of the thrust: B V/J (t − τ (1 − exp(−t/τ)))."""
    plant = BARE.model_copy(update={"aero": WEIGHTLESS, "rotor": ROTOR}).build(PERIOD)
    plant.actuate((20.0, 0.0))
    for periods in range(1, 301):
        plant.advance()
        if periods in {1, 50, 300}:
            t = periods * PERIOD
            expected = 0.001 * 20.0 / WEIGHTLESS.inertia[1] * (t - UP * (1 - exp(-t / UP)))
            # as above, (h/τ)⁵/120 a step; the first period's rate is itself only (t/τ)/2 of what it would be at once
            assert plant.truth().rate[1] == pytest.approx(expected, rel=1e-8)
    assert plant.truth().voltages == (20.0, 0.0)  # the truth holds the voltage at the motor, not the thrust


@pytest.mark.parametrize(
    ("voltage", "left"), [(0.0, 0.0), (2.5, 0.0), (-2.5, 0.0), (1.0, 0.0), (3.0, 0.5), (-3.0, -0.5), (24.0, 21.5)]
)
def test_a_dead_zone_takes_its_width_away_from_the_voltage(voltage: float, left: float) -> None:
    v = ca.SX.sym("v")
    zone = ca.Function("zone", [v], [thrust_voltage(RotorSettings(dead_zone_v=2.5), v)])
    assert float(zone(voltage)) == left
    none = ca.Function("none", [v], [thrust_voltage(RotorSettings(), v)])
    assert float(none(voltage)) == voltage


def test_a_dead_zone_is_met_behind_the_lag() -> None:
    """Thrust begins when the lagging voltage leaves the zone, τ ln(10/(10 − 5)) after a step to 10 V."""
    plant = BARE.model_copy(update={"aero": WEIGHTLESS, "rotor": ROTOR.model_copy(update={"dead_zone_v": 5.0})}).build(
        PERIOD
    )
    plant.actuate((10.0, 0.0))
    periods = 0
    while plant.truth().rate[1] == 0.0 and periods < 1000:
        plant.advance()
        periods += 1
    assert (periods - 1) * PERIOD <= UP * np.log(2) <= periods * PERIOD
