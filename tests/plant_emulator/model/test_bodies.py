"""Both bodies: they agree with the paper's equations, and are integrated to fourth order.

The Aero's twin is derived differently from its own projection: Lagrange's equations in pitch and yaw, written by hand.
(A third derivation, with the torque that the mechanism bears, is in tests/support/numpy_twin.py.) The free body's twin
is (C.1), (C.2) and (C.78) in NumPy.
"""

from __future__ import annotations

from itertools import pairwise
from math import cos, sin

import numpy as np

from aeroloop.plant_emulator.model.bodies import AeroSettings, RigidBodySettings, aero, rigid_body
from aeroloop.plant_emulator.model.emulated import step_function
from tests.support import ideal
from tests.support import numpy_twin as twin
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


def _lagrange(p: AeroSettings, x: Array, u: Array) -> list[float]:
    """ẋ by Lagrange's equations.

    Kinetic energy T = ½ (J_x sin²p + J_z cos²p) ẏ² + ½ J_y ṗ².
    Potential energy U = m g (r_z cos p − r_x sin p), the height of the centre of mass.
    Work of damping and thrust: that on pitch directly, that on yaw through the vertical's share of each body axis.
    """
    pitch, _, dp, dy = (float(value) for value in x)
    (Jx, Jy, Jz), (rx, _, rz), (dx_, dy_, dz_) = p.inertia, p.centre_of_mass, p.damping
    s, c = sin(pitch), cos(pitch)
    torque_y, torque_z = (row[0] * u[0] + row[1] * u[1] for row in p.thrust)
    slope = p.mass * p.gravity * (-rz * s - rx * c)  # ∂U/∂p
    yaw_force = c * torque_z - (dx_ * s * s + dz_ * c * c) * dy
    ddp = ((Jx - Jz) * s * c * dy * dy - slope + torque_y - dy_ * dp) / Jy
    ddy = (yaw_force - 2 * (Jx - Jz) * s * c * dp * dy) / (Jx * s * s + Jz * c * c)
    return [dp, dy, ddp, ddy]


def test_the_aero_agrees_with_lagranges_equations_at_moving_states() -> None:
    rng = np.random.default_rng(1)
    random = (
        AeroSettings.model_validate({**_asymmetric(rng), "thrust": rng.normal(size=(2, 2)).tolist()}) for _ in range(20)
    )
    for p in (ideal.AERO, *random):
        dynamics = aero(p).derivative
        for _ in range(20):
            x, u = rng.normal(size=4), rng.normal(size=2) * 10
            got = np.array(dynamics(x, u, np.zeros(2)), dtype=np.float64).ravel()
            expected = np.array(_lagrange(p, x, u))
            # about a hundred operations of 2e-16 each; torques of some units cancel to accelerations of some tenths
            assert np.linalg.norm(got - expected) <= 1e-12 * np.linalg.norm(expected)


def _equations(p: RigidBodySettings, q: Array, omega: Array, u: Array, tau_d: Array) -> Array:
    """(C.1), and (C.2) with the disturbance of (C.78), both sides in full."""
    w, x, y, z = q
    a, b, c = omega
    # ½ q ⊗ [0, ω], by Hamilton's table
    q_dot = np.array([-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]) / 2
    J = np.diag(p.inertia)
    weight = twin.rotation(q).T @ np.array([0.0, 0.0, -p.mass * p.gravity])
    torque = (
        -np.cross(omega, J @ omega)
        + np.cross(p.centre_of_mass, weight)
        - np.array(p.damping) * omega
        + np.array(p.allocation) @ u
        + tau_d
    )
    return np.append(q_dot, np.linalg.inv(J) @ torque)


def test_the_free_body_agrees_with_the_equations_at_moving_states_under_loads() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        p = RigidBodySettings.model_validate({**_asymmetric(rng), "allocation": rng.normal(size=(3, 3)).tolist()})
        dynamics = rigid_body(p).derivative
        for _ in range(20):
            q = rng.normal(size=4)
            q /= np.linalg.norm(q)
            omega, volts, tau_d = rng.normal(size=3), rng.normal(size=3) * 5, rng.normal(size=3)
            got = np.array(dynamics(np.append(q, omega), volts, tau_d), dtype=np.float64).ravel()
            expected = _equations(p, q, omega, volts, tau_d)
            # about a hundred operations of 2e-16 each, of torques up to some tens of the sum they make
            assert np.linalg.norm(got - expected) <= 1e-12 * np.linalg.norm(expected)


# ── integration ──


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    """Fourth order, over a whole period with its substeps."""

    def end(substeps: int) -> Array:
        step, x = step_function(aero(ideal.AERO), ideal.ROTOR, ideal.FRICTION, 1.0, substeps), np.zeros(4)
        for _ in range(3):
            x = np.array(step(x, [24.0, -20.0], [0.0, 0.0])[0]).ravel()
        return x

    exact = end(100)  # its own error is 6⁻⁴, a thousandth, of the finest's below
    errors = [np.linalg.norm(end(substeps) - exact) for substeps in (4, 8, 16)]
    for coarse, fine in pairwise(errors):
        # 16 in the limit; the next order's terms still show a little. Orders 3 and 5 would give 8 and 32.
        assert 14 < coarse / fine < 18
