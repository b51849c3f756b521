"""Bounds of a plant: lags of several motors, gyro noise, encoders that turn joint rates into ω."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from aeroloop.plant_emulator.model.sensors import rate_of
from aeroloop.service.config import Settings, load_over
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.plant_bounds import PlantBounds, plant_bounds


def of(*changes: str) -> PlantBounds:
    return plant_bounds(with_theorem(load_over(Settings(), ["loop.lockstep=true", *changes])), True)


def test_motors_of_which_one_rises_while_the_other_falls_are_not_older_than_the_bound() -> None:
    """In the end a ramp of the torque errs by B diag(K₁, K₂) B⁻¹ times its rate, which is more than the larger lag."""
    up, down = 0.05, 0.2
    B = np.array(with_theorem(Settings()).law.allocation)[1:, 1:]
    ramp = float(np.linalg.norm(B @ np.diag([up, down]) @ np.linalg.inv(B), 2))
    age = of(f"plant.rotor.lag_up_s={up}", f"plant.rotor.lag_down_s={down}").age - Settings().loop.period
    assert down < ramp <= age < 1.5 * ramp
    age = of("plant.rotor.lag_up_s=0.2", "plant.rotor.lag_down_s=0.2").age - Settings().loop.period
    assert abs(age - 0.2) < 1e-12


def test_an_hour_of_gyro_noise_stays_within_its_bound_about_every_axis() -> None:
    found = of("plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01")
    noise = np.abs(np.random.default_rng(5).standard_normal(3600 * 500 * 3)).max() * 0.01
    assert 0.04 < noise < found.delta_omega / sqrt(3)


def test_an_encoders_step_of_the_pitch_turns_the_rate_by_no_more_than_is_counted() -> None:
    """At rest but for a yaw as fast as the wire's range allows; the filter's ripple is counted beside it."""
    counts, limit = (64, 4096), 1.0
    few, many = (
        of(f"plant.sensors.counts={list(c)}", f"wire.rate.limit={limit}", "plant.sensors.bandwidth=1e-6")
        for c in (counts, (10**9, 4096))
    )
    yaw_rate = sqrt(2) * limit
    true, seen = (rate_of(pitch, 0.0, yaw_rate) for pitch in (pi / 4, pi / 4 + 2 * pi / counts[0]))
    assert 0.9 < np.linalg.norm(np.subtract(seen, true)) / (few.delta_omega - many.delta_omega) <= 1
