"""Attitude conventions (C.3)–(C.11): composition of rotations, kinematics, and no η on the wire.

`rotate` below is Rodrigues' formula, with which the matrices are compared. T and S, by which they move, are tried in
tests/plant_emulator/model/test_emulated.py.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector, received_quaternion, sent_vector, to_euler

Array: TypeAlias = NDArray[np.float64]

ROUNDING = 1e-14
"""Entries are sums of a dozen products of numbers up to 1: some tens of 2^-53."""


def normalized(values: tuple[float, ...]) -> tuple[float, ...]:
    length = hypot(*values)
    return tuple(value / length for value in values)


def units(size: int) -> st.SearchStrategy[Any]:
    """Unit vectors, those along an axis included; too short ones are left out, for they lose digits."""
    return st.tuples(*[st.floats(-1.0, 1.0)] * size).filter(lambda v: hypot(*v) > 0.01).map(normalized)


quaternions: st.SearchStrategy[Quaternion] = units(4)
axes: st.SearchStrategy[Vector] = units(3)
vectors = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


def numbers(expression: ca.SX) -> Array:
    return np.asarray(ca.DM(expression), dtype=np.float64).squeeze()


def R(q: Quaternion) -> Array:  # noqa: N802  # the paper's letter
    return numbers(attitude.R(ca.SX(ca.DM(q))))


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    w, x, y, z = numbers(attitude.product(ca.SX(ca.DM(p)), ca.SX(ca.DM(q)))).tolist()
    return w, x, y, z


def opposite(q: Quaternion) -> Quaternion:
    return -q[0], -q[1], -q[2], -q[3]


def about(axis: Vector, theta: float) -> Quaternion:
    s = sin(theta / 2)
    return cos(theta / 2), s * axis[0], s * axis[1], s * axis[2]


def rotate(axis: Vector, theta: float, v: Vector) -> Array:
    k, a = np.array(axis), np.array(v)
    turned = a * cos(theta) + np.cross(k, a) * sin(theta) + k * np.dot(k, a) * (1 - cos(theta))
    return np.asarray(turned, dtype=np.float64)


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    w, x, y, z = numbers(attitude.from_euler(ca.SX(ca.DM([roll, pitch, yaw])))).tolist()
    return w, x, y, z


def test_quaternions_multiply_as_hamilton_s() -> None:
    one, i, j, k = map(tuple, np.eye(4))
    assert [product(i, j), product(j, k), product(k, i), product(i, i)] == [k, i, j, opposite(one)]


@given(quaternions, quaternions)
def test_rotations_multiply_as_their_matrices(p: Quaternion, q: Quaternion) -> None:
    np.testing.assert_allclose(R(product(p, q)), R(p) @ R(q), rtol=0, atol=ROUNDING)
    w, x, y, z = numbers(attitude.conjugate(ca.SX(ca.DM(q))))
    np.testing.assert_allclose(product(q, (w, x, y, z)), IDENTITY, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(R(q).T @ R(q), np.eye(3), rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(R(opposite(q)), R(q))


@given(axes, st.floats(-pi, pi), vectors)
def test_r_turns_vectors_as_rodrigues_does(axis: Vector, theta: float, v: Vector) -> None:
    # Vectors up to 5√3 long.
    np.testing.assert_allclose(R(about(axis, theta)) @ v, rotate(axis, theta, v), rtol=0, atol=10 * ROUNDING)


angles = st.floats(-3.14, 3.14)  # ±π are one angle: a round trip may give either


@given(angles, st.floats(-1.55, 1.55), angles)  # at a pitch of ±π/2 roll and yaw turn about one axis
def test_euler_angles_turn_yaw_then_pitch_then_roll_and_survive_a_round_trip(
    roll: float, pitch: float, yaw: float
) -> None:
    q = from_euler(roll, pitch, yaw)
    x, y, z = about((1.0, 0.0, 0.0), roll), about((0.0, 1.0, 0.0), pitch), about((0.0, 0.0, 1.0), yaw)
    np.testing.assert_allclose(R(q), R(z) @ R(y) @ R(x), rtol=0, atol=ROUNDING)
    # Digits are lost as 1/cos(pitch), up to 48.
    np.testing.assert_allclose(to_euler(q), (roll, pitch, yaw), rtol=0, atol=100 * ROUNDING)


@settings(max_examples=200)
@given(quaternions, quaternions)
def test_what_is_received_is_the_attitude_sent_with_the_sign_of_the_last(q: Quaternion, last: Quaternion) -> None:
    sent = sent_vector(q)
    assert q[0] == 0 or sent_vector(opposite(q)) == sent
    assert received_quaternion(*sent, last=IDENTITY)[0] >= 0
    received = received_quaternion(*sent, last=last)
    assert np.dot(received, last) >= 0
    # η = √(1 − εᵀε): where η is small, the root makes a rounding of some 2^-52 into 3e-8.
    assert min(np.linalg.norm(np.subtract(received, of)) for of in (q, opposite(q))) <= 1e-7


@given(axes, st.floats(1.001, 2.0), quaternions)
def test_what_quantization_made_too_long_is_scaled_to_unit_length(axis: Vector, scale: float, last: Quaternion) -> None:
    along = np.dot(axis, last[1:])
    assume(abs(along) > ROUNDING)  # or rounding chooses the sign
    w, *eps = received_quaternion(scale * axis[0], scale * axis[1], scale * axis[2], last=last)
    assert w == 0
    np.testing.assert_allclose(eps, np.multiply(np.sign(along), axis), rtol=0, atol=ROUNDING)
    assert attitude.angle(scale * axis[0], scale * axis[1], scale * axis[2]) == pi


@given(axes, st.floats(0.0, pi), quaternions)
def test_the_angle_of_an_error_and_between_two_attitudes_is_that_of_the_rotation(
    axis: Vector, theta: float, q: Quaternion
) -> None:
    _, x, y, z = about(axis, theta)
    # Below 3 rad the arc sine loses a factor of 14 at the most, at π half the digits: 2·√(2·2^-52).
    assert attitude.angle(x, y, z) == pytest.approx(theta, abs=20 * ROUNDING if theta <= 3 else 2e-7)
    assert attitude.distance(q, opposite(product(q, about(axis, theta)))) == pytest.approx(theta, abs=2e-7)
