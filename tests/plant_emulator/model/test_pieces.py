"""Pieces of the plant, such as friction, wind and sensors, each against its equation, and the plant they compose.

A piece with a closed solution (step of a lag, sliding to rest, step of a filter) is compared with it. Random numbers
are seeded, so results repeat; a tolerance is five standard deviations of the estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from math import asinh, atan2, cos, exp, hypot, inf, pi, sin, sinh, sqrt

import casadi as ca
import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from aeroloop.plant_emulator.model.aero import Aero, AeroSettings, aero_dynamics
from aeroloop.plant_emulator.model.emulated import EmulatedPlant, step_function
from aeroloop.plant_emulator.model.friction import FrictionSettings, friction_torque
from aeroloop.plant_emulator.model.rigid_body import RigidBody, RigidBodySettings
from aeroloop.plant_emulator.model.rotor import RotorSettings, rotor_derivative, thrust_voltage
from aeroloop.plant_emulator.model.sensors import FilteredDerivative, Sensors, SensorSettings
from aeroloop.plant_emulator.model.wind import Wind, WindSettings
from aeroloop.plant_emulator.plant import Measurement, State
from aeroloop.plant_emulator.settings import IDEAL_AERO, IDEAL_FRICTION, IDEAL_ROTOR, IDEAL_SENSORS, PlantSettings
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector
from tests.support import numpy_twin as twin
from tests.support.numpy_twin import Array

PERIOD = 0.002
WEIGHTLESS = AeroSettings(gravity=0.0, thrust=((0.001, 0.0), (0.0, 0.001)))
"""u₂ is a torque about pitch and u₃ one about yaw, and nothing else acts."""

BARE = PlantSettings(rotor=IDEAL_ROTOR, friction=IDEAL_FRICTION, sensors=IDEAL_SENSORS)
"""The Aero with every piece off: no lag, no friction, calm, perfect sensors."""


def _with(settings: PlantSettings = BARE, **sections: BaseModel) -> PlantSettings:
    return settings.model_copy(update=sections)


# Rotors

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
    [(0, 10, UP), (10, 20, UP), (0, -10, UP), (-10, -20, UP), (10, 0, DOWN), (20, 10, DOWN), (-10, 0, DOWN)],
)
def test_a_rotor_follows_with_the_time_constant_of_the_direction(start: float, command: float, lag: float) -> None:
    """Up is where |thrust| rises, whichever its sign: V(t) = V∞ + (V₀ − V∞) exp(−t/τ)."""
    for periods in (1, 50, 250):
        expected = command + (start - command) * exp(-periods * PERIOD / lag)
        # fourth order, exact but for (h/τ)⁵/120 a step of h = 1 ms: 1e-12 of it, 500 times, of 10 V
        assert _lagging(ROTOR, start, command, periods) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("command", [24.0, -7.0, 0.0])
def test_a_rotor_comes_to_what_is_commanded_and_stays(command: float) -> None:
    state, u = ca.SX.sym("state", 2), ca.SX.sym("u", 2)
    derivative = ca.Function("rotor", [state, u], [rotor_derivative(ROTOR, state, u)])
    assert np.array(derivative([command, 1.0], [command, 2.0])).ravel().tolist() == [0.0, pytest.approx(1 / UP)]
    # 3.2 s are more than ten of the longer time constant
    assert _lagging(ROTOR, 12.0, command, 1600) == pytest.approx(command, abs=exp(-10) * abs(12.0 - command))


def test_thrust_lags_behind_the_voltage() -> None:
    """A weightless body's rate is the integral of the thrust: B V/J (t − τ (1 − exp(−t/τ)))."""
    plant = _with(aero=WEIGHTLESS, rotor=ROTOR).build(PERIOD)
    plant.actuate((20.0, 0.0))
    for periods in range(1, 301):
        plant.advance()
        if periods in {1, 50, 300}:
            t = periods * PERIOD
            expected = 0.001 * 20.0 / WEIGHTLESS.inertia[1] * (t - UP * (1 - exp(-t / UP)))
            # as above, (h/τ)⁵/120 a step; the first period's rate is itself only (t/τ)/2 of what it would be at once
            assert plant.truth().rate[1] == pytest.approx(expected, rel=1e-8)
    assert plant.truth().voltages == (20.0, 0.0)  # the truth holds the voltage at the motor, not the thrust


def test_lags_of_zero_leave_the_rotors_out() -> None:
    plant = _with(aero=WEIGHTLESS).build(PERIOD)
    plant.actuate((20.0, 0.0))
    plant.advance()
    # exact for a constant acceleration: some tens of operations of 2e-16
    assert plant.truth().rate[1] == pytest.approx(0.001 * 20.0 / WEIGHTLESS.inertia[1] * PERIOD, rel=1e-13)


@pytest.mark.parametrize(
    ("voltage", "left"), [(0.0, 0.0), (2.5, 0.0), (-2.5, 0.0), (1.0, 0.0), (3.0, 0.5), (-3.0, -0.5), (24.0, 21.5)]
)
def test_a_dead_zone_takes_its_width_away_from_the_voltage(voltage: float, left: float) -> None:
    v = ca.SX.sym("v")
    zone = ca.Function("zone", [v], [thrust_voltage(RotorSettings(dead_zone_v=2.5), v)])
    assert float(zone(voltage)) == left
    none = ca.Function("none", [v], [thrust_voltage(RotorSettings(), v)])
    assert float(none(voltage)) == voltage


def test_below_the_dead_zone_a_plant_does_not_move() -> None:
    plant = _with(aero=WEIGHTLESS, rotor=RotorSettings(lag_up_s=0, lag_down_s=0, dead_zone_v=2.5)).build(PERIOD)
    plant.actuate((2.4, -2.4))
    for _ in range(100):
        plant.advance()
    assert plant.truth().rate == (0.0, 0.0, 0.0)
    plant.actuate((2.6, 0.0))
    plant.advance()
    assert plant.truth().rate[1] > 0


def test_a_dead_zone_is_met_behind_the_lag() -> None:
    """Thrust begins when the lagging voltage leaves the zone, τ ln(10/(10 − 5)) after a step to 10 V."""
    plant = _with(aero=WEIGHTLESS, rotor=ROTOR.model_copy(update={"dead_zone_v": 5.0})).build(PERIOD)
    plant.actuate((10.0, 0.0))
    periods = 0
    while plant.truth().rate[1] == 0.0 and periods < 1000:
        plant.advance()
        periods += 1
    assert (periods - 1) * PERIOD <= UP * np.log(2) <= periods * PERIOD


# Friction

FRICTION = FrictionSettings(viscous=(0.02, 0.03, 0.04), coulomb=(0.001, 0.002, 0.003), width=0.01)


def _friction(settings: FrictionSettings, axes: int) -> Callable[[Array], Array]:
    rates = ca.SX.sym("rates", axes)
    function = ca.Function("friction", [rates], [friction_torque(settings, rates)])
    return lambda values: np.array(function(values), dtype=np.float64).ravel()


def test_viscous_friction_is_in_proportion_to_the_rate() -> None:
    torque = _friction(FRICTION.model_copy(update={"coulomb": ()}), 3)
    for rates in (np.array([1.0, -2.0, 3.0]), np.array([1e-3, 0.0, -1e-5])):
        assert torque(rates).tolist() == (-np.array(FRICTION.viscous) * rates).tolist()


def test_coulomb_friction_is_constant_against_the_direction_of_motion() -> None:
    torque = _friction(FRICTION.model_copy(update={"viscous": ()}), 3)
    c = np.array(FRICTION.coulomb)
    # 1 − tanh(20) is 8.5e-18: in floats it is nothing
    assert torque(np.array([0.2, 5.0, 100.0])).tolist() == (-c).tolist()
    assert torque(np.array([-0.2, -5.0, -100.0])).tolist() == c.tolist()
    assert torque(np.zeros(3)).tolist() == [0.0, 0.0, 0.0]
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


def _sliding(friction: FrictionSettings, rate: float) -> EmulatedPlant:
    """A body that turns about z, with nothing but friction to stop it."""
    body = RigidBodySettings(inertia=(0.02, 0.02, 0.02), damping=(0.0, 0.0, 0.0), rate=(0.0, 0.0, rate))
    return PlantSettings(
        kind="rigid_body", rigid_body=body, rotor=IDEAL_ROTOR, friction=friction, sensors=IDEAL_SENSORS
    ).build(PERIOD)


@pytest.mark.parametrize("rate", [0.5, -0.5])
def test_an_axis_slides_down_and_comes_to_rest(rate: float) -> None:
    """ω̇ = −(c/J) tanh(ω/w) has the solution sinh(ω/w) = sinh(ω₀/w) exp(−c t/(J w))."""
    c, width, inertia = 0.003, 0.01, 0.02
    plant = _sliding(FrictionSettings(viscous=(), coulomb=(0.0, 0.0, c), width=width), rate)
    stop = abs(rate) * inertia / c  # where a Coulomb torque that does not turn over would have brought it to rest
    for periods in range(1, round(1.5 * stop / PERIOD)):
        plant.advance()
        expected = width * asinh(sinh(rate / width) * exp(-c / (inertia * width) * periods * PERIOD))
        # (h c/(J w))⁵/120 = 6e-12 of the width a step while it turns over, some 100 steps; rounding of 1e-16·periods
        assert plant.truth().rate[2] == pytest.approx(expected, abs=1e-11)
    # By then sinh(ω/w) is ½ exp(ω₀/w − 1.5 ω₀/w): at rest but for 1e-11 of the width.
    assert abs(plant.truth().rate[2]) < width * exp(-0.5 * abs(rate) / width)


def test_viscous_friction_slows_an_axis_down_exponentially() -> None:
    plant = _sliding(FrictionSettings(viscous=(0.0, 0.0, 0.01), coulomb=()), 2.0)
    for periods in range(1, 1001):
        plant.advance()
        # (h v/J)⁵/120 = 3e-19 a step; rounding of a thousand periods remains
        assert plant.truth().rate[2] == pytest.approx(2.0 * exp(-0.5 * periods * PERIOD), rel=1e-12)


# Wind

FAN = (-0.003, 0.004)
"""Its magnitude is 0.005 N·m."""


def _blown(n: int, axes: int = 2, period: float = 0.1, **changed: object) -> Array:
    """n samples of wind. Shape (n, axes)."""
    settings = WindSettings.model_validate({"blowing": True, "torque": FAN, "gust": 0.0} | changed)
    wind = Wind(settings, axes, period)
    return np.array([wind.sample() for _ in range(n)])


@pytest.mark.parametrize("axes", [2, 3])
def test_calm_is_no_torque_whatever_the_gusts(axes: int) -> None:
    assert not WindSettings().blowing
    calm = Wind(WindSettings(), axes, PERIOD)
    assert calm.sample() == [0.0] * axes
    assert not _blown(5000, axes, blowing=False, gust=5.0).any()


def test_without_gusts_the_torque_is_steady() -> None:
    assert (_blown(5000) == FAN).all()
    assert (_blown(10, 3) == (*FAN, 0.0)).all()  # missing axes are 0
    assert (_blown(10, 2, torque=(0.1, 0.2, 0.3)) == (0.1, 0.2)).all()


def test_gusts_repeat_with_their_seed_and_only_with_it() -> None:
    n = 5000  # more than one draw of random numbers
    one, again, other = (_blown(n, gust=0.5, seed=seed) for seed in (1, 1, 2))
    assert (one == again).all()
    assert (one != other).all()
    assert (one[:, 0] != one[:, 1]).all()  # nor do the axes share one gust


@pytest.mark.parametrize("period", [0.02, 0.1])
@pytest.mark.parametrize("axes", [2, 3])
def test_gusts_have_the_configured_mean_deviation_and_memory_whatever_the_period(axes: int, period: float) -> None:
    """`gust` is the deviation of the whole torque as a part of the whole steady torque, spread evenly over the axes.

    For a process with autocorrelation ρ^|k| and n samples, the mean has the variance σ²/n (1 + ρ)/(1 − ρ), the variance
    has 2 σ⁴/n (1 + ρ²)/(1 − ρ²), and the autocorrelation at lag k has, by Bartlett's formula,
    ((1 + ρ²)(1 − ρ²ᵏ)/(1 − ρ²) − 2k ρ²ᵏ)/n.
    """
    n, gust, memory = 100_000, 0.6, 0.5
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


def test_gusts_are_there_from_the_first_sample() -> None:
    first = np.array([_blown(1, gust=1.0, period=PERIOD, seed=seed)[0] for seed in range(80)]) - FAN
    # Of n samples a deviation is known to 1/√(2n); a gust that started at 0 would have a sixteenth of it.
    assert first.std() / (hypot(*FAN) / sqrt(2)) == pytest.approx(1, abs=5 / sqrt(2 * first.size))


def test_a_gust_goes_on_from_where_it_was() -> None:
    """What is new in a sample, x − ρ x₋₁, is normal with the deviation σ √(1 − ρ²), never the gust starting anew."""
    x = (_blown(20_000, gust=1.0, period=PERIOD, gust_time_s=1.0) - FAN) / (hypot(*FAN) / sqrt(2))
    rho = exp(-PERIOD)
    new = (x[1:] - rho * x[:-1]) / sqrt(1 - rho * rho)
    assert np.abs(new).max() < 6  # of 40 000 normal numbers one in 10⁴ times has one beyond; a new start is some 22


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


# The filtered derivative

OMEGA_N, ZETA = 50.0, 0.8


def _step_response(t: float) -> float:
    """Of ωn² s/(s² + 2ζωn s + ωn²) to a unit step [1/s]."""
    ringing = OMEGA_N * sqrt(1 - ZETA**2)
    return OMEGA_N**2 / ringing * exp(-ZETA * OMEGA_N * t) * sin(ringing * t)


@pytest.mark.parametrize("period", [0.002, 0.05])
def test_the_derivative_of_a_step_is_the_filters_step_response(period: float) -> None:
    f = FilteredDerivative(OMEGA_N, ZETA, period)
    assert f.update(0.3) == 0.0
    for n in range(1, 100):
        # exact whatever the period: rounding of a hundred updates of 1e-16, of a rate that peaks at 20 rad/s
        assert f.update(1.3) == pytest.approx(_step_response(n * period), abs=1e-12)


def test_the_derivative_of_held_samples_is_the_sum_of_their_steps() -> None:
    rng = np.random.default_rng(2)
    angles = np.cumsum(rng.normal(size=60))
    f = FilteredDerivative(OMEGA_N, ZETA, PERIOD)
    rates = [f.update(float(angle)) for angle in angles]
    for k in range(60):
        expected = sum((angles[j] - angles[j - 1]) * _step_response((k - j + 1) * PERIOD) for j in range(1, k + 1))
        assert rates[k] == pytest.approx(expected, abs=1e-11)  # rounding of 60 steps of some 20 rad/s


def test_the_derivative_of_a_ramp_is_its_slope() -> None:
    """Once ωn has forgotten the start. The angle is held, so the rate ripples by ωn² a t (T − t)/2 within a period.

    Its mean is the slope a, and it is sampled where the ripple is least: (ωn T)²/12 below the mean.
    """
    slope = 0.7
    for period in (0.002, 0.001, 0.0005):
        f = FilteredDerivative(OMEGA_N, ZETA, period)
        rate = 0.0
        for k in range(round(1.0 / period)):  # ζ ωn t = 40
            rate = f.update(1.0 + slope * k * period)
        x = OMEGA_N * period
        assert rate / slope == pytest.approx(1 - x**2 / 12, abs=x**3 / 12)  # the next order


def test_the_derivative_of_a_constant_is_zero_from_the_first_sample() -> None:
    f = FilteredDerivative(OMEGA_N, ZETA, PERIOD)
    assert [f.update(-2.5) for _ in range(100)] == [0.0] * 100
    f.update(3.0)
    for _ in range(1000):
        rate = f.update(3.0)
    # ζ ωn t = 80, e⁻⁸⁰ of some 100 rad/s; what stays is too slow to move an angle of 3 rad by its rounding in a period
    assert abs(rate) * PERIOD < np.spacing(3.0)


# Sensors

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


def _zero(axis: int, seed: int) -> float:
    """Where within a count an encoder is zeroed: how much of the count from 0 on it already reads as 1."""
    sensors = _sensors(rate="perfect", seed=seed, counts=(1000, 1000))
    step = 2 * pi / 1000
    read = 0
    for k in range(64):
        angles = [0.0, 0.0]
        angles[axis] = (k + 0.5) / 64 * step
        read += _angles(sensors.read(IDENTITY, AT_REST, angles).attitude)[axis] > step / 2
    return read / 64


def test_the_seed_shifts_the_zero_anywhere_within_a_count() -> None:
    zeros = np.array([[_zero(axis, seed) for axis in (0, 1)] for seed in range(100)])
    assert _zero(0, 7) == zeros[7, 0]  # and always to the same place
    # An even spread over 0…1 has the mean ½, the deviation 1/√12 and the kurtosis 1.8: of n seeds the mean is known to
    # 1/√(12 n), the deviation to ½ √(0.8/n) of itself, a correlation to 1/√n. A 64th is as fine as `_zero` looks.
    assert zeros.mean(axis=0) == pytest.approx([0.5, 0.5], abs=5 / sqrt(1200))
    assert zeros.std(axis=0) * sqrt(12) == pytest.approx([1, 1], rel=5 * 0.5 * sqrt(0.8 / 100))
    assert abs(np.corrcoef(zeros.T)[0, 1]) < 5 / sqrt(100)


def test_an_encoder_at_zero_reads_zero_whatever_the_seed() -> None:
    for seed in range(20):
        assert _sensors(seed=seed).read(IDENTITY, AT_REST, [0.0, 0.0]) == Measurement(IDENTITY, AT_REST)


def test_the_attitude_of_encoders_is_yaw_then_pitch() -> None:
    """R_z(yaw) R_y(pitch), multiplied out as matrices."""
    sensors = _sensors(rate="perfect", counts=FINE)
    rng = np.random.default_rng(5)
    for _ in range(50):
        p, y = rng.uniform(-7.0, 7.0, 2)  # more than a turn
        yawed = np.array([[cos(y), -sin(y), 0], [sin(y), cos(y), 0], [0, 0, 1]])
        pitched = np.array([[cos(p), 0, sin(p)], [0, 1, 0], [-sin(p), 0, cos(p)]])
        q = sensors.read(IDENTITY, AT_REST, [p, y]).attitude
        assert np.abs(twin.rotation(np.array(q)) - yawed @ pitched).max() < 2 * 2 * pi / FINE[0]  # a count of each


def test_the_rate_of_encoders_is_that_of_the_joints_in_the_body_frame() -> None:
    """ω = [−sin p ẏ, ṗ, cos p ẏ] while both joints turn steadily."""
    sensors = _sensors(counts=FINE)
    dp, dy = 0.4, -0.9
    for k in range(500):  # ζ ωn t = 40
        p = dp * k * PERIOD
        _, rate = sensors.read(IDENTITY, AT_REST, [p, dy * k * PERIOD])
    # The ripple of a held ramp, (ωn T)²/12 and a tenth for the next order. Counts of l shake it by less than ωn l.
    assert rate == pytest.approx([-sin(p) * dy, dp, cos(p) * dy], abs=0.9 * (50 * PERIOD) ** 2 / 12 * 1.1 + 50 * 1.5e-6)


def test_the_derivative_is_of_the_angles_as_counted() -> None:
    """At rest but for less than a count there is no rate; a count is a step, and its rate the step's response."""
    step = 2 * pi / 2048
    sensors = _sensors(counts=(2048, 4096), seed=1)
    assert all(sensors.read(IDENTITY, AT_REST, [0.0, 0.0]).rate == AT_REST for _ in range(10))
    for n in range(1, 50):
        _, rate = sensors.read(IDENTITY, AT_REST, [step, 0.0])
        assert rate[1] == pytest.approx(step * _step_response(n * PERIOD), abs=1e-14)  # rounding, of 0.06 rad/s


def test_a_gyro_adds_its_noise_and_bias_to_the_true_rate() -> None:
    noise, bias, n = 0.03, (0.1, -0.2, 0.05), 20_000
    sensors = _sensors(attitude="perfect", rate="gyro", gyro_noise=noise, gyro_bias=bias)
    rng = np.random.default_rng(6)
    true = rng.normal(size=(n, 3))
    errors = np.array([sensors.read(IDENTITY, (x, y, z), []).rate for x, y, z in true.tolist()]) - true
    # independent samples: the mean is known to σ/√n, the deviation to σ/√(2n), a correlation to 1/√n
    assert errors.mean(axis=0) == pytest.approx(bias, abs=5 * noise / sqrt(n))
    assert errors.std(axis=0) == pytest.approx([noise] * 3, abs=5 * noise / sqrt(2 * n))
    white = (errors - errors.mean(axis=0)) / noise
    assert np.abs((white[1:] * white[:-1]).mean(axis=0)).max() < 5 / sqrt(n)
    assert np.abs(np.corrcoef(white.T) - np.identity(3)).max() < 5 / sqrt(n)
    assert np.abs((white * true).mean(axis=0)).max() < 5 / sqrt(n)


def test_a_gyro_repeats_with_its_seed_and_only_with_it() -> None:
    def rates(seed: int) -> list[Vector]:
        sensors = _sensors(attitude="perfect", rate="gyro", gyro_noise=0.1, seed=seed)
        return [sensors.read(IDENTITY, AT_REST, []).rate for _ in range(5000)]  # more than one draw

    assert rates(1) == rates(1)
    assert all(one != other for one, other in zip(rates(1), rates(2), strict=True))


def test_a_gyro_without_noise_and_bias_is_perfect() -> None:
    sensors = _sensors(attitude="perfect", rate="gyro")
    assert sensors.read((0.6, 0.0, 0.8, 0.0), (0.1, 0.2, 0.3), []) == ((0.6, 0.0, 0.8, 0.0), (0.1, 0.2, 0.3))


def test_perfect_sensors_pass_everything_through() -> None:
    attitude, rate = (0.6, 0.0, 0.8, 0.0), (0.1, 0.2, 0.3)
    angles = [0.1, 0.2]  # which say something else
    assert _sensors(attitude="perfect", rate="perfect").read(attitude, rate, angles) == (attitude, rate)
    mixed = _sensors(attitude="perfect", rate="derivative").read(attitude, rate, angles)
    assert mixed == (attitude, AT_REST)
    mixed = _sensors(attitude="encoders", rate="perfect").read(attitude, rate, angles)
    assert mixed.rate == rate
    assert mixed.attitude != attitude


# Settings


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


# Together


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


@pytest.mark.parametrize(
    "piece",
    [
        RotorSettings(),
        RotorSettings(lag_up_s=0, lag_down_s=0, dead_zone_v=2.0),
        FrictionSettings(coulomb=()),
        FrictionSettings(viscous=()),
        WindSettings(blowing=True),
    ],
    ids=["lag", "dead zone", "viscous friction", "Coulomb friction", "wind"],
)
def test_each_piece_that_acts_changes_where_the_plant_goes(piece: BaseModel) -> None:
    names = {RotorSettings: "rotor", FrictionSettings: "friction", WindSettings: "wind"}
    changed = BARE.model_copy(update={names[type(piece)]: piece})
    for (before, _), (after, measured) in zip(_driven(BARE), _driven(changed), strict=True):
        assert after.attitude != before.attitude
        assert after.rate != before.rate
        assert after.voltages == before.voltages
        assert measured == (after.attitude, after.rate)


@pytest.mark.parametrize(
    "sensors",
    [
        SensorSettings(rate="perfect"),
        SensorSettings(attitude="perfect"),
        SensorSettings(attitude="perfect", rate="gyro", gyro_noise=0.01),
        SensorSettings(attitude="perfect", rate="gyro", gyro_bias=(0.01, 0.02, 0.03)),
    ],
    ids=["encoders", "derivative", "gyro's noise", "gyro's bias"],
)
def test_each_sensor_changes_what_is_seen_and_not_what_is(sensors: SensorSettings) -> None:
    for (before, _), (after, measured) in zip(_driven(BARE), _driven(_with(sensors=sensors)), strict=True):
        assert after == before
        assert (measured.attitude != after.attitude) == (sensors.attitude != "perfect")
        assert (measured.rate != after.rate) == (sensors.rate != "perfect")


GUSTY = PlantSettings(wind=WindSettings(blowing=True, gust=0.5), rotor=RotorSettings(dead_zone_v=1.0))
"""Every piece on."""


def test_two_plants_of_the_same_settings_move_alike_to_the_last_bit() -> None:
    assert _driven(GUSTY) == _driven(GUSTY)


def test_another_seed_of_the_wind_moves_the_plant_elsewhere() -> None:
    other = _with(GUSTY, wind=GUSTY.wind.model_copy(update={"seed": 1}))
    for (one, _), (another, _) in zip(_driven(GUSTY), _driven(other), strict=True):
        assert one.attitude != another.attitude


def test_another_seed_of_the_sensors_sees_the_same_motion_otherwise() -> None:
    other = _with(GUSTY, sensors=GUSTY.sensors.model_copy(update={"seed": 1}))
    here, there = _driven(GUSTY), _driven(other)
    assert [state for state, _ in here] == [state for state, _ in there]
    assert [measured for _, measured in here] != [measured for _, measured in there]


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


def test_a_rotor_that_reverses_falls_with_the_down_lag_before_it_rises_with_the_up_lag() -> None:
    rotor = RotorSettings(lag_up_s=0.1, lag_down_s=0.4)
    falling = float(rotor_derivative(rotor, ca.SX(5.0), ca.SX(-10.0)))
    rising = float(rotor_derivative(rotor, ca.SX(-1.0), ca.SX(-10.0)))
    from_rest = float(rotor_derivative(rotor, ca.SX(0.0), ca.SX(-10.0)))
    assert [falling, rising, from_rest] == pytest.approx([-15 / 0.4, -9 / 0.1, -10 / 0.1], rel=1e-15)


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


def test_sensors_of_a_state_that_has_left_the_numbers_have_no_valid_value() -> None:
    sensors = Sensors(SensorSettings(), PERIOD)
    attitude, rate = sensors.read((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, inf), (0.0, inf))
    assert all(value != value for value in (*attitude, *rate))
