"""Rotations as CasADi expressions, by the conventions of `attitude.py`. S, T and R are the paper's matrices."""

from __future__ import annotations

import casadi as ca


def S(v: ca.SX) -> ca.SX:
    """Skew-symmetric matrix of (C.7): `S(a) b = a × b`. Shape (3, 3)."""
    return ca.skew(v)


def T(q: ca.SX) -> ca.SX:
    """Kinematics of (C.3): `q̇ = T(q) ω`, ω in the body frame. Shape (4, 3)."""
    eta, eps = q[0], q[1:4]
    return 0.5 * ca.vertcat(-eps.T, eta * ca.SX.eye(3) + S(eps))


def R(q: ca.SX) -> ca.SX:
    """Rotation matrix of (C.8), body to inertial. In SO(3) as in (C.9), moving as in (C.10). Shape (3, 3)."""
    eta, eps = q[0], q[1:4]
    return ca.SX.eye(3) + 2 * eta * S(eps) + 2 * S(eps) @ S(eps)


def conjugate(q: ca.SX) -> ca.SX:
    """The inverse rotation `q̄ = [η, −ε]`. Shape (4, 1)."""
    return ca.vertcat(q[0], -q[1:4])


def product(p: ca.SX, q: ca.SX) -> ca.SX:
    """Hamilton product `p ⊗ q`. Shape (4, 1)."""
    return ca.vertcat(p[0] * q[0] - ca.dot(p[1:4], q[1:4]), p[0] * q[1:4] + q[0] * p[1:4] + ca.cross(p[1:4], q[1:4]))


def from_euler(angles: ca.SX) -> ca.SX:
    """Quaternion of [roll, pitch, yaw] in rad: yaw about z, then pitch about y, then roll about x. Shape (4, 1)."""
    c, s = ca.cos(angles / 2), ca.sin(angles / 2)
    about_x = ca.vertcat(c[0], s[0], 0, 0)
    about_y = ca.vertcat(c[1], 0, s[1], 0)
    about_z = ca.vertcat(c[2], 0, 0, s[2])
    return product(product(about_z, about_y), about_x)
