"""Attitude conventions (C.3)–(C.11): composition of rotations, kinematics, and no η on the wire.

`rotate` below is Rodrigues' formula and `spin` the exact motion at a constant rate; the matrices are compared with
these.
"""

from __future__ import annotations

from collections.abc import Callable
from math import acos, cos, hypot, isfinite, pi, sin, sqrt
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aeroloop.protocol.wire import attitude
from aeroloop.protocol.wire.attitude import IDENTITY, Quaternion, Vector, received_quaternion, sent_vector, to_euler
from aeroloop.protocol.wire.quantizer import UniformQuantizer

Array: TypeAlias = NDArray[np.float64]

ROUNDING = 1e-14
"""Entries are sums of a dozen products of numbers up to 1: some tens of 2^-53."""

unit_floats = st.floats(-1.0, 1.0)


def normalized(values: tuple[float, ...]) -> tuple[float, ...]:
    """The values at unit length."""
    length = hypot(*values)
    return tuple(value / length for value in values)


def units(size: int) -> st.SearchStrategy[Any]:
    """Unit vectors, those along an axis included; too short ones are left out, for they lose digits."""
    return st.tuples(*[unit_floats] * size).filter(lambda v: hypot(*v) > 0.01).map(normalized)


quaternions: st.SearchStrategy[Quaternion] = units(4)
axes: st.SearchStrategy[Vector] = units(3)
vectors = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


def number(value: Any) -> Array:
    """A CasADi matrix of constants, or a tuple, as an array."""
    return np.asarray(ca.DM(value) if isinstance(value, ca.SX) else value, dtype=np.float64).squeeze()


def constant(values: tuple[float, ...]) -> ca.SX:
    """Numbers as the matrix functions take them."""
    return ca.SX(ca.DM(values))


def R(q: Quaternion) -> Array:  # noqa: N802  # the paper's letter
    """R(q) in numbers."""
    return number(attitude.R(constant(q)))


def T(q: Quaternion) -> Array:  # noqa: N802  # the paper's letter
    """T(q) in numbers."""
    return number(attitude.T(constant(q)))


def S(v: Vector) -> Array:  # noqa: N802  # the paper's letter
    """S(v) in numbers."""
    return number(attitude.S(constant(v)))


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product, written out: i² = j² = k² = ijk = −1."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def about(axis: Vector, theta: float) -> Quaternion:
    """The rotation by θ about an axis."""
    s = sin(theta / 2)
    return cos(theta / 2), s * axis[0], s * axis[1], s * axis[2]


def rotate(axis: Vector, theta: float, v: Vector) -> Array:
    """Rodrigues' formula."""
    k, a = np.array(axis), np.array(v)
    turned = a * cos(theta) + np.cross(k, a) * sin(theta) + k * np.dot(k, a) * (1 - cos(theta))
    return np.asarray(turned, dtype=np.float64)


def spin(q: Quaternion, omega: Vector, t: float) -> Quaternion:
    """Where a constant body rate takes q in time t."""
    speed = hypot(*omega)
    if speed == 0:
        return q
    return product(q, about((omega[0] / speed, omega[1] / speed, omega[2] / speed), speed * t))


@pytest.mark.parametrize(
    ("function", "sizes"),
    [
        (attitude.S, (3,)),
        (attitude.T, (4,)),
        (attitude.R, (4,)),
        (attitude.conjugate, (4,)),
        (attitude.product, (4, 4)),
        (attitude.from_euler, (3,)),
    ],
)
def test_symbols_and_numbers_give_the_same(function: Callable[..., Any], sizes: tuple[int, ...]) -> None:
    symbols = [ca.SX.sym(f"x{i}", size) for i, size in enumerate(sizes)]
    evaluate = ca.Function("f", symbols, [function(*symbols)])
    rng = np.random.default_rng(1)
    for _ in range(20):
        values = [ca.DM(rng.normal(size=size)) for size in sizes]
        # One and the same expression; only the order in which constants are folded may differ.
        np.testing.assert_allclose(number(evaluate(*values)), number(function(*values)), rtol=1e-14, atol=1e-14)


@given(vectors, vectors)
def test_s_is_the_cross_product(a: Vector, b: Vector) -> None:
    # Products of numbers up to 5.
    np.testing.assert_allclose(S(a) @ b, np.cross(a, b), rtol=0, atol=25 * ROUNDING)


@given(quaternions)
def test_r_is_a_rotation_and_the_same_for_both_signs(q: Quaternion) -> None:
    np.testing.assert_allclose(R(q).T @ R(q), np.eye(3), rtol=0, atol=ROUNDING)
    assert np.linalg.det(R(q)) == pytest.approx(1.0, abs=ROUNDING)
    w, x, y, z = q
    np.testing.assert_array_equal(R((-w, -x, -y, -z)), R(q))


@given(axes, st.floats(-pi, pi), vectors)
def test_r_turns_vectors_as_rodrigues_does(axis: Vector, theta: float, v: Vector) -> None:
    # Vectors up to 5√3 long.
    np.testing.assert_allclose(R(about(axis, theta)) @ v, rotate(axis, theta, v), rtol=0, atol=10 * ROUNDING)


@given(quaternions, quaternions)
def test_the_product_is_hamilton_s(p: Quaternion, q: Quaternion) -> None:
    multiplied = number(attitude.product(constant(p), constant(q)))
    np.testing.assert_allclose(multiplied, product(p, q), rtol=0, atol=ROUNDING)


@given(quaternions, quaternions)
def test_rotations_compose_as_quaternions_multiply(p: Quaternion, q: Quaternion) -> None:
    np.testing.assert_allclose(R(product(p, q)), R(p) @ R(q), rtol=0, atol=ROUNDING)


@given(quaternions)
def test_the_conjugate_is_the_inverse(q: Quaternion) -> None:
    w, x, y, z = number(attitude.conjugate(constant(q)))
    inverse: Quaternion = (float(w), float(x), float(y), float(z))
    np.testing.assert_allclose(product(q, inverse), IDENTITY, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(R(inverse), R(q).T, rtol=0, atol=ROUNDING)


H = 1e-5
"""Step of central differences [s]. At |ω| ≤ 9 rad/s they err by H²|ω|³/6 = 1.2e-8, and rounding adds 1e-11."""

DIFFERENCE = 2e-8


@given(quaternions, vectors)
def test_t_is_how_a_quaternion_moves(q: Quaternion, omega: Vector) -> None:
    moved = (np.array(spin(q, omega, H)) - np.array(spin(q, omega, -H))) / (2 * H)
    np.testing.assert_allclose(T(q) @ omega, moved, rtol=0, atol=DIFFERENCE)


@given(quaternions, vectors)
def test_a_rotation_moves_as_c_10_says(q: Quaternion, omega: Vector) -> None:
    moved = (R(spin(q, omega, H)) - R(spin(q, omega, -H))) / (2 * H)
    np.testing.assert_allclose(R(q) @ S(omega), moved, rtol=0, atol=DIFFERENCE)
    inertial = R(q) @ omega
    np.testing.assert_allclose(S(tuple(inertial)) @ R(q), moved, rtol=0, atol=DIFFERENCE)


def test_c_10_follows_from_c_3_without_differences() -> None:
    q, omega = ca.SX.sym("q", 4), ca.SX.sym("omega", 3)
    # Both sides as the paper has them for unit q: dR/dt by the chain rule through T, and R S(ω).
    chain = ca.reshape(ca.jacobian(ca.vec(attitude.R(q)), q) @ (attitude.T(q) @ omega), 3, 3)
    difference = ca.Function("difference", [q, omega], [chain - attitude.R(q) @ attitude.S(omega)])
    rng = np.random.default_rng(2)
    for _ in range(100):
        unit = rng.normal(size=4)
        unit /= np.linalg.norm(unit)
        # Products of ω up to a few rad/s.
        np.testing.assert_allclose(number(difference(unit, rng.normal(size=3))), 0, rtol=0, atol=10 * ROUNDING)


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """from_euler in numbers."""
    w, x, y, z = number(attitude.from_euler(constant((roll, pitch, yaw))))
    return float(w), float(x), float(y), float(z)


angles = st.floats(-3.14, 3.14)  # ±π are one angle: a round trip may give either
pitches = st.floats(-1.55, 1.55)  # at ±π/2 roll and yaw turn about one axis


@given(angles, pitches, angles)
def test_euler_angles_survive_a_round_trip(roll: float, pitch: float, yaw: float) -> None:
    # Digits are lost as 1/cos(pitch), up to 48.
    np.testing.assert_allclose(to_euler(from_euler(roll, pitch, yaw)), (roll, pitch, yaw), rtol=0, atol=100 * ROUNDING)


@given(angles, st.floats(-pi / 2, pi / 2), angles)
def test_euler_angles_turn_yaw_then_pitch_then_roll(roll: float, pitch: float, yaw: float) -> None:
    x, y, z = about((1.0, 0.0, 0.0), roll), about((0.0, 1.0, 0.0), pitch), about((0.0, 0.0, 1.0), yaw)
    np.testing.assert_allclose(R(from_euler(roll, pitch, yaw)), R(z) @ R(y) @ R(x), rtol=0, atol=ROUNDING)


def test_the_axes_are_x_forward_y_left_z_up() -> None:
    quarter = pi / 2
    x, y, z = np.eye(3)
    np.testing.assert_allclose(R(from_euler(0.0, 0.0, quarter)) @ x, y, rtol=0, atol=ROUNDING)  # yaw: x to y
    np.testing.assert_allclose(R(from_euler(0.0, quarter, 0.0)) @ x, -z, rtol=0, atol=ROUNDING)  # pitch: x down
    np.testing.assert_allclose(R(from_euler(quarter, 0.0, 0.0)) @ y, z, rtol=0, atol=ROUNDING)  # roll: y to z


@given(quaternions)
def test_euler_angles_are_finite_and_in_their_ranges(q: Quaternion) -> None:
    roll, pitch, yaw = to_euler(q)
    assert -pi <= roll <= pi
    assert -pi / 2 <= pitch <= pi / 2
    assert -pi <= yaw <= pi


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("scale", [1.0, 1 + 2.0**-50])
def test_straight_up_or_down_rounding_does_not_break_the_pitch(sign: float, scale: float) -> None:
    half = scale * sqrt(0.5)
    roll, pitch, yaw = to_euler((half, 0.0, sign * half, 0.0))
    # The arc sine loses half the digits where it is steepest.
    assert pitch == pytest.approx(sign * pi / 2, abs=1e-7)
    assert isfinite(roll)
    assert isfinite(yaw)


@given(quaternions)
def test_what_is_sent_is_of_the_sign_with_a_positive_eta(q: Quaternion) -> None:
    w, x, y, z = q
    sent = sent_vector(q)
    assert sent == ((x, y, z) if w >= 0 else (-x, -y, -z))
    if w != 0:
        assert sent_vector((-w, -x, -y, -z)) == sent


def distance(p: Quaternion, q: Quaternion) -> float:
    """How far apart two quaternions are, signs included."""
    return float(np.linalg.norm(np.subtract(p, q)))


@given(quaternions)
def test_a_receiver_without_a_memory_gets_the_attitude(q: Quaternion) -> None:
    received = received_quaternion(*sent_vector(q), last=IDENTITY)
    opposite: Quaternion = (-q[0], -q[1], -q[2], -q[3])
    # η = √(1 − εᵀε): where η is small, the root makes a rounding of some 2^-52 into 3e-8.
    assert min(distance(received, q), distance(received, opposite)) <= 1e-7
    assert received[0] >= 0


@settings(max_examples=80)
@given(st.tuples(*[st.floats(-1.2, 1.2)] * 3), quaternions)
def test_what_is_received_is_a_unit_quaternion_near_the_last(eps: Vector, last: Quaternion) -> None:
    q = received_quaternion(*eps, last=last)
    assert hypot(*q) == pytest.approx(1.0, abs=ROUNDING)
    assert np.dot(q, last) >= 0
    length = hypot(*eps)
    x, y, z = eps if length <= 1 else normalized(eps)
    # (C.11), or 0 where εᵀε > 1; the root makes a rounding of some 2^-52 into 3e-8 where η is small.
    root: Quaternion = (sqrt(max(0.0, 1 - length**2)), x, y, z)
    opposite: Quaternion = (-root[0], -x, -y, -z)
    nearest = root if distance(q, root) < distance(q, opposite) else opposite
    assert q[0] == pytest.approx(nearest[0], abs=1e-7)
    np.testing.assert_allclose(q[1:], nearest[1:], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("bits", [None, 16, 10, 8, 6, 4])
@pytest.mark.parametrize("seed", range(3))
def test_a_receiver_follows_a_walk_through_full_turns_and_keeps_its_sign(bits: int | None, seed: int) -> None:
    rng = np.random.default_rng(seed)
    quantizer = None if bits is None else UniformQuantizer(bits, 1.0)
    # Each ε is off by at most d; η² then by 2d + d², and scaling to unit length moves ε by d more.
    d = sqrt(3) * quantizer.bound if quantizer else 4 * 2.0**-52
    slack = 2 * d + sqrt(2 * d + d * d)
    q, last = IDENTITY, IDENTITY
    omega = rng.normal(size=3)
    crossings, scaled = 0, 0
    for _ in range(2000):
        omega += 0.2 * rng.normal(size=3) - 0.01 * omega
        turned = spin(q, (float(omega[0]), float(omega[1]), float(omega[2])), 0.02)
        crossings += turned[0] * q[0] < 0
        w, x, y, z = normalized(turned)
        q = (w, x, y, z)
        eps = sent_vector(q)
        if quantizer:
            eps = (quantizer.quantize(eps[0]), quantizer.quantize(eps[1]), quantizer.quantize(eps[2]))
        scaled += hypot(*eps) > 1
        last = received_quaternion(*eps, last=last)
        assert hypot(*last) == pytest.approx(1.0, abs=ROUNDING)
        assert distance(last, q) <= slack  # not up to its sign: it started with it and never loses it
    assert crossings >= 4  # or it never went through η = 0
    assert scaled > 0 or bits in (None, 16)  # or the quantizer never made ‖ε‖ > 1; 16 bits seldom do


@given(axes, st.floats(0.0, 3.0))
def test_the_angle_is_that_of_the_rotation(axis: Vector, theta: float) -> None:
    eps = about(axis, theta)[1:]
    # At 3 rad the arc sine loses a factor of 14.
    assert attitude.angle(*eps) == pytest.approx(theta, abs=20 * ROUNDING)
    assert attitude.angle(-eps[0], -eps[1], -eps[2]) == attitude.angle(*eps)


@given(axes, st.floats(3.0, pi))
def test_the_angle_of_about_half_a_turn_is_right_to_what_the_arc_sine_can_tell(axis: Vector, theta: float) -> None:
    # 2·√(2·2^-52): the arc sine's error where it is steepest.
    assert attitude.angle(*about(axis, theta)[1:]) == pytest.approx(theta, abs=2e-7)


@given(axes, st.floats(1.0, 2.0))
def test_the_angle_of_what_quantization_made_too_long_is_half_a_turn(axis: Vector, scale: float) -> None:
    length = hypot(*(scale * e for e in axis))
    expected = pi if length >= 1 else 2 * acos(sqrt(1 - length**2))
    assert attitude.angle(scale * axis[0], scale * axis[1], scale * axis[2]) == pytest.approx(expected, abs=2e-7)
