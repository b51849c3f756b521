"""Wind: a steady torque, and gusts of the configured mean, deviation and memory; estimates within five deviations."""

from __future__ import annotations

from math import exp, hypot, sqrt

import numpy as np
import pytest

from aeroloop.plant_emulator.model.wind import Wind, WindSettings
from tests.support.numpy_twin import Array

PERIOD = 0.002
FAN = (-0.003, 0.004)
"""Its magnitude is 0.005 N·m."""


def _blown(n: int, axes: int = 2, period: float = 0.1, **changed: object) -> Array:
    """n samples of wind. Shape (n, axes)."""
    settings = WindSettings.model_validate({"blowing": True, "torque": FAN, "gust": 0.0} | changed)
    wind = Wind(settings, axes, period)
    return np.array([wind.sample() for _ in range(n)])


def test_calm_is_no_torque_whatever_the_gusts_and_without_gusts_it_is_steady() -> None:
    assert not WindSettings().blowing
    assert (_blown(5000) == FAN).all()
    for axes, torque in ((2, (0.1, 0.2)), (3, (0.1, 0.2, 0.0))):
        assert not _blown(5000, axes, blowing=False, gust=5.0).any()
        assert (_blown(10, axes, torque=(0.1, 0.2)) == torque).all()  # missing axes are 0
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
