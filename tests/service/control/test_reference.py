"""Reference: a path, its angular velocity as in (C.12), and its derivative."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from aeroloop.protocol.messages.operator import Reference, Sinusoid
from aeroloop.protocol.wire.symbolic import buffer
from aeroloop.service.control.motion import Motion
from tests.support.numpy_twin import Array, Sinusoids

PAPER = Sinusoid()
EVERY_AXIS = Sinusoid(amplitude=(30.0, 60.0, 250.0), frequency=(2.3, 0.7, 1.1))
"""Rolls too, which the paper's does not, and yaws through more than a half turn."""

references = pytest.mark.parametrize("settings", [PAPER, EVERY_AXIS], ids=["paper's", "every axis"])
TIMES = np.linspace(0.0, 50.0, 401)


class Followed:
    """A motion, and the memory that it writes."""

    def __init__(self, reference: Reference) -> None:
        self.memory = {name: buffer(n) for name, n in (("q_d", 4), ("omega_d", 3), ("omega_d_dot", 3))}
        self.motion = Motion(reference, self.memory)


def _desired(followed: Followed, t: float) -> tuple[Array, Array, Array]:
    followed.motion.at(t)
    q_d, omega_d, omega_d_dot = (np.array(memory) for memory in followed.memory.values())
    return q_d, omega_d, omega_d_dot


def _twin(settings: Sinusoid) -> Sinusoids:
    return Sinusoids(np.radians(settings.amplitude), np.array(settings.frequency))


@references
def test_the_reference_agrees_with_derivatives_by_hand(settings: Sinusoid) -> None:
    function, twin = Followed(settings), _twin(settings)
    for t in TIMES:
        for got, expected in zip(_desired(function, t), twin.desired(t), strict=True):
            # some fifty operations of 2e-16; the sine's argument, up to 115 rad, rounds by 1e-14 and the rates of
            # EVERY_AXIS reach 10 rad/s and rad/s²
            assert np.abs(got - expected).max() <= 1e-12


@references
def test_the_desired_attitude_moves_as_c12_says(settings: Sinusoid) -> None:
    function = Followed(settings)
    h = 1e-3
    for t in TIMES:
        (w, x, y, z), (a, b, c), _ = _desired(function, t)
        # (C.12) row by row: ½ [−ε_dᵀ; η_d I − S(ε_d)] ω_d
        expected = 0.5 * np.array(
            [
                -x * a - y * b - z * c,
                w * a + z * b - y * c,
                -z * a + w * b + x * c,
                y * a - x * b + w * c,
            ]
        )
        after, before = _desired(function, t + h)[0], _desired(function, t - h)[0]
        # a central difference errs by h²/6 of the third derivative, which is below 100 here: 2e-5
        assert np.abs((after - before) / (2 * h) - expected).max() <= 2e-5


@references
def test_the_desired_acceleration_is_the_derivative_of_the_velocity(settings: Sinusoid) -> None:
    function = Followed(settings)
    h = 1e-3
    for t in TIMES:
        _, after, _ = _desired(function, t + h)
        _, before, _ = _desired(function, t - h)
        # as above: h²/6 of the third derivative of ω_d, which is below 600 here: 1e-4
        assert np.abs((after - before) / (2 * h) - _desired(function, t)[2]).max() <= 1e-4


@references
def test_the_reference_is_bounded_as_assumption_1_asks(settings: Sinusoid) -> None:
    function = Followed(settings)
    amplitude, frequency = np.radians(settings.amplitude), np.array(settings.frequency)
    rates, accelerations = amplitude * frequency, amplitude * frequency**2
    # ω_d is a sum of rates along unit axes; ω̇_d adds each rate turned by those of the axes that carry it
    velocity_bound = rates.sum()
    acceleration_bound = accelerations.sum() + rates[0] * rates[1] + rates[0] * rates[2] + rates[1] * rates[2]
    for t in TIMES:
        q_d, omega_d, omega_d_dot = _desired(function, t)
        assert abs(np.linalg.norm(q_d) - 1) <= 1e-14  # twenty operations of 2e-16
        assert np.linalg.norm(omega_d) <= velocity_bound
        assert np.linalg.norm(omega_d_dot) <= acceleration_bound


def test_the_papers_reference_starts_where_the_aero_rests() -> None:
    q_d, omega_d, _ = _desired(Followed(PAPER), 0.0)
    assert q_d.tolist() == [1.0, 0.0, 0.0, 0.0]
    # level, the pitch axis is y and the yaw axis is z: the rates are amplitude · frequency of each
    assert omega_d == pytest.approx([0.0, 40 * pi / 180 * 0.1 * pi, 100 * pi / 180 * 0.05 * pi], rel=1e-14)


def test_the_angular_velocity_is_inertial_and_not_the_bodys() -> None:
    """At a constant pitch, a yaw rate is about the inertial z axis alone; seen from the body it would not be."""
    held = Sinusoid(amplitude=(0.0, 40.0, 100.0), frequency=(0.0, pi / 2, 0.3))
    _, omega_d, _ = _desired(Followed(held), 1.0)  # pitch is at its crest, so its rate is 0
    yaw_rate = 100 * pi / 180 * 0.3 * np.cos(0.3)
    assert omega_d == pytest.approx([0.0, 0.0, yaw_rate], abs=1e-14)  # rounding of cos(π/2) and of twenty operations
