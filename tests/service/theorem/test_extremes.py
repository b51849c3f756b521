"""Extremes of a reference, which no instant of a long run exceeds; and bounds of a plant."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pytest

from aeroloop.plant_emulator.model.emulated import rate_of
from aeroloop.protocol.messages.operator import Sinusoid
from aeroloop.service.config import Settings, load_over
from aeroloop.service.control.reference import Angles, Floats, Trajectory
from aeroloop.service.theorem.extremes import body_rates, chords, extremes, feedforward, vectors
from aeroloop.service.theorem.premises import PlantBounds, plant_bounds
from tests.support.certified import certified_settings

NEARLY_EQUAL = Sinusoid(amplitude=(60, 50, 80), frequency=(0.04, 0.04006, 0.04002))
SLOW_ROLL = Sinusoid(amplitude=(85, 40, 40), frequency=(0.0009, 0.2, 0.2))
UNEVEN = Sinusoid(amplitude=(40, 45, 80), frequency=(0.03, 0.013, 0.018))
PAPER = Sinusoid()
LOCKED = Sinusoid(amplitude=(20, 30, 60), frequency=(0.4, 0.3, 0.15))


def largest(reference: Sinusoid, angles: Angles) -> Floats:
    """‖ω_d‖, ‖ω̇_d‖, max |ω_d,k|, half the angle, pitch, Σ|ε_k|, each motor's voltage, and tilt, of all these states."""
    settings = certified_settings().model_copy(update={"reference": reference})
    (omega, omega_dot), eps = body_rates(angles), vectors(angles)
    volts = feedforward(angles, settings.law) @ np.linalg.inv(np.array(settings.law.allocation)).T
    found = [np.linalg.norm(omega, axis=1), np.linalg.norm(omega_dot, axis=1), np.abs(omega).max(axis=1)]
    found += [np.arcsin(np.minimum(1, np.linalg.norm(eps, axis=1))), np.minimum(pi / 2, np.abs(angles.angle[:, 1]))]
    return np.array([each.max() for each in (*found, np.abs(eps).sum(axis=1), *np.abs(volts).T, angles.tilts())])


def bounds(reference: Sinusoid) -> Floats:
    """What `extremes` says of the same."""
    e = extremes(certified_settings().model_copy(update={"reference": reference}))
    return np.array([e.rate, e.acceleration, e.axis_rate, e.half_angle, e.pitch, e.eps[0][1], *e.voltages, e.tilt])


RUNS = [(SLOW_ROLL, 0.1, 7_000), (UNEVEN, 0.5, 80_000), (PAPER, 0.001, 40), (LOCKED, 0.005, 126)]


@pytest.mark.parametrize(("reference", "step_s", "duration_s"), RUNS, ids=["slow roll", "uneven", "paper", "locked"])
def test_no_instant_of_a_long_run_exceeds_the_extremes(reference: Sinusoid, step_s: float, duration_s: float) -> None:
    """At least once through every beat; the first two were exceeded by up to 27 % after some periods."""
    run = Trajectory.of(reference).at(np.arange(0, duration_s, step_s)[None])
    reached, allowed = largest(reference, Angles(*(part[0] for part in run))), bounds(reference)
    assert np.all(reached <= allowed)
    if reference in (PAPER, LOCKED):  # the others' frequencies have a common multiple, too, if a large one
        assert np.all(reached >= 0.999 * allowed)


@pytest.mark.parametrize("reference", [NEARLY_EQUAL, "random"])
def test_the_extremes_are_above_those_of_many_phases_and_near_the_largest(reference: Sinusoid | str) -> None:
    """Frequencies that share no short period, so that every combination of phases comes, some day."""
    rng = np.random.default_rng(0)
    if isinstance(reference, str):
        amplitude = tuple(rng.uniform((0, 0, 0), (80, 89, 300)).tolist())
        frequency = tuple((rng.uniform(0.1, 1, 3) * np.sqrt([1, 2, 3])).tolist())
        reference = Sinusoid(amplitude=amplitude, frequency=frequency)
    allowed, reached = bounds(reference), np.zeros(10)
    for _ in range(4):
        phases = rng.uniform(0, 2 * pi, (100_000, 3))
        near = np.round(phases[::2] / (pi / 2)) * pi / 2  # many extremes are near these
        phases[::2] = near + 0.1 * (phases[::2] - pi)
        reached = np.maximum(reached, largest(reference, Trajectory.of(reference).swing(phases)))
    assert np.all(reached <= allowed)
    assert np.all(reached >= 0.85 * allowed)  # a random search misses what is narrow


def test_axes_of_one_frequency_or_of_twice_another_keep_their_phases() -> None:
    """The paper's pitch is level where its yaw is farthest; of free phases half the angle would be 52.8°, not 50°."""
    assert np.degrees(extremes(load_over(certified_settings(), [])).half_angle) == pytest.approx(50, rel=1e-6)
    free = extremes(load_over(certified_settings(), ["reference.frequency=[0, 0.314, 0.157001]"]))
    assert np.degrees(free.half_angle) == pytest.approx(52.84, abs=0.01)


def test_no_attitude_along_the_reference_errs_by_more_than_its_chord() -> None:
    rng = np.random.default_rng(2)
    for reference in (PAPER, UNEVEN):
        settings = certified_settings().model_copy(update={"reference": reference})
        delta, error = 0.004, 0.05
        bound = chords(extremes(settings), delta)(error)
        phases = (
            rng.uniform(0, 2 * pi, (50_000, 3)) if reference is UNEVEN else rng.uniform(0, 7, (50_000, 1)) * [0, 2, 1]
        )
        eps = vectors(Trajectory.of(reference).swing(phases))
        turn = rng.standard_normal((50_000, 3))
        turn *= 2 * np.sin(error / 2) * 0.99 / np.linalg.norm(turn, axis=1, keepdims=True) * rng.random((50_000, 1))
        eta = np.sqrt(1 - (eps**2).sum(axis=1))
        eps = eps * np.sqrt(1 - (turn**2).sum(axis=1))[:, None] + turn * eta[:, None] + np.cross(eps, turn)
        wrong = eps + delta * np.sign(rng.standard_normal((50_000, 3)))
        etas = [np.sqrt(1 - (v**2).sum(axis=1)) for v in (eps, wrong)]
        found = np.sqrt(3 * delta**2 + (etas[1] - etas[0]) ** 2).max()
        assert 0.9 * bound < found <= bound


# ── bounds of a plant: lags of several motors, gyro noise, encoders that turn joint rates into ω ──


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
