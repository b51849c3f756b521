"""Sensors and wind against closed solutions: encoders, the filtered derivative, a gyro's noise and bias; gusts.

Random numbers are seeded; a tolerance is five standard deviations of the estimate.
"""

from __future__ import annotations

from math import atan2, cos, exp, hypot, pi, sin, sqrt

import numpy as np
import pytest

from aeroloop.plant_emulator.model.emulated import (
    DAMPING_RATIO,
    Sensors,
    SensorSettings,
    WindSettings,
    filtered_derivative,
    wind_torques,
)
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector
from tests.support.numpy_twin import Array

PERIOD = 0.002
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
