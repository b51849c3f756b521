"""Bounds of a plant: lags of several motors, gyro noise, encoders that turn joint rates into ω."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from aeroloop.plant_emulator.model.emulated import rate_of
from aeroloop.service.config import Settings, load_over
from aeroloop.service.theorem.premises import PlantBounds, plant_bounds


def of(*changes: str) -> PlantBounds:
    return plant_bounds(load_over(Settings(), ["loop.lockstep=true", *changes]), True)


def test_rotors_that_rise_and_fall_err_beside_their_mean_lag_by_no_more_than_the_share() -> None:
    """V̇ = (u − V)/T of two motors, for any of both lags: the torque's rate, beside (B u − B V)/lag."""
    found = of("plant.rotor.lag_up_s=0.05", "plant.rotor.lag_down_s=0.2")
    B = np.array(Settings().law.allocation)[1:, 1:]
    gaps = np.random.default_rng(3).standard_normal((10_000, 2))
    shares = []
    for lags in ((0.05, 0.2), (0.2, 0.05), (0.05, 0.05), (0.2, 0.2)):
        beside = (gaps / lags) @ B.T * found.lag - gaps @ B.T
        shares.append((np.linalg.norm(beside, axis=1) / np.linalg.norm(gaps @ B.T, axis=1)).max())
    assert 0.99 * found.uneven < max(shares) <= found.uneven
    assert of("plant.rotor.lag_up_s=0.2", "plant.rotor.lag_down_s=0.2").uneven == 0


def test_an_hour_of_gyro_noise_stays_within_its_bound_about_every_axis() -> None:
    found = of("plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01")
    noise = np.abs(np.random.default_rng(5).standard_normal(3600 * 500 * 3)).max() * 0.01
    assert 0.04 < noise < found.delta_omega / sqrt(3)


def test_an_encoders_step_of_the_pitch_turns_the_rate_by_no_more_than_is_counted() -> None:
    """At rest but for a yaw; ω is within the limit about every axis, the filter's ripple is counted beside it."""
    counts, limit = (64, 4096), 1.0
    few = of(f"plant.sensors.counts={list(counts)}")
    yaw_rate = sqrt(2) * limit
    true, seen = (rate_of(pitch, 0.0, yaw_rate) for pitch in (pi / 4, pi / 4 + 2 * pi / counts[0]))
    assert 0.9 < np.linalg.norm(np.subtract(seen, true)) / (few.encoder.turn * limit) <= 1
