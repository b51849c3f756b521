"""The emulated plant: bodies, rotors, friction, sensors and wind, against the paper's equations and closed solutions.

The twins are written differently: the Aero's as a free body with the torque that its mechanism bears
(tests/support/numpy_twin.py), the free body's by (C.1), (C.2) and (C.78) in NumPy (tests/support/law_tick.py).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import atan2, cos, exp, hypot, pi, sin, sqrt
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from pydantic import ValidationError

from aeroloop.plant_emulator.model.bodies import AeroSettings, RigidBodySettings, aero, rigid_body
from aeroloop.plant_emulator.model.emulated import (
    DAMPING_RATIO,
    FrictionSettings,
    RotorSettings,
    Sensors,
    SensorSettings,
    WindSettings,
    filtered_derivative,
    friction_torque,
    step_function,
    wind_torques,
)
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector
from tests.support import ideal
from tests.support import numpy_twin as twin
from tests.support.adversary_loop import times as product
from tests.support.law_tick import acceleration, unit
from tests.support.numpy_twin import Array


def _asymmetric(rng: np.random.Generator) -> dict[str, object]:
    """A body without any symmetry: three inertias, a centre of mass off every axis, damping about each."""
    return {
        "inertia": rng.uniform(0.5, 2.0, 3).tolist(),
        "mass": rng.uniform(0.5, 2.0),
        "gravity": rng.uniform(5.0, 10.0),
        "centre_of_mass": rng.normal(size=3).tolist(),
        "damping": rng.uniform(0.1, 2.0, 3).tolist(),
    }


# ── equations of motion ──


def test_the_aero_agrees_with_the_body_whose_roll_a_torque_holds() -> None:
    """At moving states, of the paper's Aero and of twenty that have no symmetry."""
    rng = np.random.default_rng(1)
    random = (
        AeroSettings.model_validate({**_asymmetric(rng), "thrust": rng.normal(size=(2, 2)).tolist()}) for _ in range(20)
    )
    for p in (ideal.PLANT.aero, *random):
        of_body = {"J": np.diag(p.inertia), "m": p.mass, "g": p.gravity, "r_g": np.array(p.centre_of_mass)}
        body: Any = SimpleNamespace(**of_body)
        held = twin.LockedBody(body, np.vstack([np.zeros(2), p.thrust]), np.array(p.damping), np.zeros(4))
        dynamics = aero(p).derivative
        for _ in range(20):
            x, u = rng.normal(size=4), rng.normal(size=2) * 10
            got, expected = np.array(dynamics(x, u, np.zeros(2))).ravel(), held.derivative(x, u)
            # about a hundred operations of 2e-16 each; torques of some units cancel to accelerations of some tenths
            assert np.linalg.norm(got - expected) <= 1e-12 * np.linalg.norm(expected)


def test_the_free_body_agrees_with_c1_and_c2_at_moving_states_under_loads() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        p = RigidBodySettings.model_validate({**_asymmetric(rng), "allocation": rng.normal(size=(3, 3)).tolist()})
        dynamics = rigid_body(p).derivative
        for _ in range(20):
            q, omega, volts, tau_d = unit(rng), rng.normal(size=3), rng.normal(size=3) * 5, rng.normal(size=3)
            got = np.array(dynamics(np.append(q, omega), volts, tau_d)).ravel()
            torque = np.array(p.allocation) @ volts - np.array(p.damping) * omega + tau_d
            expected = np.append(product(q, np.append(0.0, omega)) / 2, acceleration(p, q, omega, torque))
            # about a hundred operations of 2e-16 each, of torques up to some tens of the sum they make
            assert np.linalg.norm(got - expected) <= 1e-12 * np.linalg.norm(expected)


# ── integration ──


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    """Fourth order, over a whole period with its substeps."""

    def end(substeps: int) -> Array:
        step, x = (
            step_function(aero(ideal.PLANT.aero), ideal.PLANT.rotor, ideal.PLANT.friction, 1.0, substeps),
            np.zeros(4),
        )
        for _ in range(3):
            x = np.array(step(x, [24.0, -20.0], [0.0, 0.0])[0]).ravel()
        return x

    exact = end(100)  # its own error is 6⁻⁴, a thousandth, of the finest's below
    errors = [np.linalg.norm(end(substeps) - exact) for substeps in (4, 8, 16)]
    for coarse, fine in pairwise(errors):
        # 16 in the limit; the next order's terms still show a little. Orders 3 and 5 would give 8 and 32.
        assert 14 < coarse / fine < 18


# ── rotors, friction and supply: against closed solutions, each alone ──


PERIOD = 0.002
WEIGHTLESS = AeroSettings(gravity=0.0, thrust=((0.001, 0.0), (0.0, 0.001)))
"""u₂ is a torque about pitch and u₃ one about yaw, and nothing else acts."""
BARE = PlantSettings(rotor=ideal.PLANT.rotor, friction=ideal.PLANT.friction, sensors=ideal.PLANT.sensors)
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
    step = step_function(aero(WEIGHTLESS), ROTOR, ideal.PLANT.friction, PERIOD)
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


# ── sensors and wind, against closed solutions; random numbers are seeded, a tolerance is five standard deviations ──

OMEGA_N, ZETA = 50.0, DAMPING_RATIO


def _step_response(t: float) -> float:
    """Of ωn² s/(s² + 2ζωn s + ωn²) to a unit step [1/s]."""
    ringing = OMEGA_N * sqrt(1 - ZETA**2)
    return OMEGA_N**2 / ringing * exp(-ZETA * OMEGA_N * t) * sin(ringing * t)


@pytest.mark.parametrize("period", [0.002, 0.05])
def test_the_derivative_of_held_samples_is_the_sum_of_their_steps(period: float) -> None:
    """Exact whatever the period, by superposition: so is that of one step, of a ramp and of a constant."""
    rng = np.random.default_rng(2)
    angles = np.cumsum(rng.normal(size=60))
    f = filtered_derivative(OMEGA_N, period)
    held, rate, rates = float(angles[0]), 0.0, []
    for angle in angles:
        held, rate = f(held, rate, float(angle))
        rates.append(rate)
    for k in range(60):
        expected = sum((angles[j] - angles[j - 1]) * _step_response((k - j + 1) * period) for j in range(1, k + 1))
        assert rates[k] == pytest.approx(expected, abs=1e-11)  # rounding of 60 steps of some 20 rad/s


FINE = (2**22, 2**22)
"""Counts so fine, 1.5e-6 rad, that what is seen is what is."""


def _sensors(period: float = PERIOD, **changed: object) -> Sensors:
    return Sensors(SensorSettings.model_validate(changed), period)


def _angles(q: Quaternion) -> tuple[float, float]:
    """[pitch, yaw] of R_z(yaw) R_y(pitch), both within ±π."""
    w, _, y, z = q
    return 2 * atan2(y, w), 2 * atan2(z, w)


AT_REST: Vector = (0.0, 0.0, 0.0)


def test_encoders_read_whole_counts_within_one_count_of_the_truth() -> None:
    sensors = _sensors(rate="perfect", counts=(2048, 4096))
    steps = np.array([2 * pi / 2048, 2 * pi / 4096])
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(2000):
        true = rng.uniform(-3.0, 3.0, 2)
        counts = np.array(_angles(sensors.read(IDENTITY, AT_REST, true.tolist()).attitude)) / steps
        assert np.abs(counts - np.round(counts)).max() < 1e-9  # rounding of 1e-16 rad, a thousandth of a rad a count
        errors.append(counts - true / steps)
    spread = np.ptp(errors, axis=0)
    assert (np.abs(errors) < 1 + 1e-9).all()
    # One count wide and no more; that the outer 2 % are missed by 2000 samples has a chance of e⁻⁴⁰ or so.
    assert (spread < 1 + 1e-9).all()
    assert (spread > 0.98).all()


def test_the_rate_of_encoders_is_that_of_the_joints_in_the_body_frame() -> None:
    """ω = [−sin p ẏ, ṗ, cos p ẏ] while both joints turn steadily."""
    sensors = _sensors(counts=FINE)
    dp, dy = 0.4, -0.9
    for k in range(500):  # ζ ωn t = 40
        p = dp * k * PERIOD
        _, rate = sensors.read(IDENTITY, AT_REST, [p, dy * k * PERIOD])
    # The ripple of a held ramp, (ωn T)²/12 and a tenth for the next order. Counts of l shake it by less than ωn l.
    assert rate == pytest.approx([-sin(p) * dy, dp, cos(p) * dy], abs=0.9 * (50 * PERIOD) ** 2 / 12 * 1.1 + 50 * 1.5e-6)


def test_a_gyro_adds_its_noise_and_bias_to_the_true_rate() -> None:
    noise, bias, n = 0.03, (0.1, -0.2, 0.05), 20_000
    sensors = _sensors(attitude="perfect", rate="gyro", gyro_noise=noise, gyro_bias=bias)
    rng = np.random.default_rng(6)
    true = rng.normal(size=(n, 3))
    seen = [sensors.read(IDENTITY, (x, y, z), []).rate for x, y, z in true.tolist()]
    errors = np.array(seen) - true
    # independent samples: the mean is known to σ/√n, the deviation to σ/√(2n), a correlation to 1/√n
    assert errors.mean(axis=0) == pytest.approx(bias, abs=5 * noise / sqrt(n))
    assert errors.std(axis=0) == pytest.approx([noise] * 3, abs=5 * noise / sqrt(2 * n))
    assert np.abs(np.corrcoef(errors.T) - np.identity(3)).max() < 5 / sqrt(n)
    for seed in (0, 1):  # it repeats with its seed, and only with it
        other = _sensors(attitude="perfect", rate="gyro", gyro_noise=noise, gyro_bias=bias, seed=seed)
        again = [other.read(IDENTITY, (x, y, z), []).rate for x, y, z in true[:5000].tolist()]  # more than one draw
        assert {one == another for one, another in zip(seen, again, strict=False)} == {seed == 0}


# ── wind: a steady torque, and gusts of the configured mean, deviation and memory ──


FAN = (-0.003, 0.004)
"""Its magnitude is 0.005 N·m."""


def _blown(n: int, axes: int = 2, period: float = 0.1, **changed: object) -> Array:
    """n samples of wind. Shape (n, axes)."""
    settings = WindSettings.model_validate({"blowing": True, "torque": FAN, "gust": 0.0} | changed)
    wind = wind_torques(settings, axes, period)
    assert wind is not None
    return np.array([next(wind) for _ in range(n)])


def test_calm_is_no_torque_whatever_the_gusts_and_without_gusts_it_is_steady() -> None:
    assert not WindSettings().blowing
    assert (_blown(5000) == FAN).all()
    for axes, torque in ((2, (0.1, 0.2)), (3, (0.1, 0.2, 0.0))):
        assert wind_torques(WindSettings(gust=5.0), axes, 0.1) is None
        assert (_blown(10, axes, torque=(0.1, 0.2)) == torque).all()  # missing axes are 0
    assert (_blown(10, 2, torque=(0.1, 0.2, 0.3)) == (0.1, 0.2)).all()


@pytest.mark.parametrize("period", [0.02, 0.1])
@pytest.mark.parametrize("axes", [2, 3])
def test_gusts_have_the_configured_mean_deviation_and_memory_whatever_the_period(axes: int, period: float) -> None:
    """`gust` is the deviation of the whole torque as a part of the whole steady torque, spread evenly over the axes.

    For a process with autocorrelation ρ^|k| and n samples, the mean has the variance σ²/n (1 + ρ)/(1 − ρ), the variance
    has 2 σ⁴/n (1 + ρ²)/(1 − ρ²), and the autocorrelation at lag k has, by Bartlett's formula,
    ((1 + ρ²)(1 − ρ²ᵏ)/(1 − ρ²) − 2k ρ²ᵏ)/n.
    """
    n, gust, memory = 20_000, 0.6, 0.5
    x = _blown(n, axes, period, gust=gust, gust_time_s=memory, seed=3)
    rho = exp(-period / memory)
    sigma = gust * hypot(*FAN) / sqrt(axes)
    steady = np.array((*FAN, 0.0)[:axes])
    assert np.abs(x.mean(axis=0) - steady).max() < 5 * sigma * sqrt((1 + rho) / (1 - rho) / n)
    x = x - steady
    variance = (x * x).mean(axis=0)
    assert np.abs(variance / sigma**2 - 1).max() < 5 * sqrt(2 * (1 + rho**2) / (1 - rho**2) / n)
    for seconds in (0.1, 0.5, 1.0):
        k = round(seconds / period)
        correlation = (x[k:] * x[:-k]).mean(axis=0) / variance
        spread = ((1 + rho**2) * (1 - rho ** (2 * k)) / (1 - rho**2) - 2 * k * rho ** (2 * k)) / n
        assert np.abs(correlation - exp(-seconds / memory)).max() < 5 * sqrt(spread)
    cross = (x[:, 0] * x[:, 1]).mean() / sigma**2
    assert abs(cross) < 5 * sqrt((1 + rho**2) / (1 - rho**2) / n)  # the axes are independent


# ── a plant that goes on with other settings ──


def test_other_sensors_go_on_from_the_filters_memory_of_those_before() -> None:
    """Other zeros of the encoders shift the angles by a step at the most, which the filter shows as 0.02 rad/s.

    Filters that start anew would show a body at rest.
    """
    before = PlantSettings()
    after = before.model_copy(update={"sensors": SensorSettings(seed=1)})
    plant, unchanged = before.build(PERIOD), before.build(PERIOD)
    for each in (plant, unchanged):
        for _ in range(300):
            each.actuate((10.0, -10.0))
            each.advance()
    continued = after.continued(plant, before, PERIOD)
    assert continued.measure() == unchanged.measure()
    for each in (continued, unchanged):
        each.advance()
    (_, _, z), (_, _, expected) = continued.measure().rate, unchanged.measure().rate
    assert abs(expected) > 0.1
    assert abs(z - expected) < 0.03
    assert continued.measure() != unchanged.measure()
    assert continued.truth() == unchanged.truth()
