"""Bodies of the emulated plant: the paper's rigid body (C.1)–(C.2), free, or as a Quanser Aero with its roll held.

*The Aero* yaws about the vertical and pitches about the body's y axis, so its attitude is R_z(yaw) R_y(pitch) and its
body rates are ω = A ν with ν = [ṗ, ẏ]:

    A(p) = [0 −sin p; 1 0; 0 cos p]

The mechanism does no work along A, so projecting (C.2) onto A's columns (Kane's method) leaves two equations in ν̇:

    Aᵀ J A ν̇ = Aᵀ (Ψ(q, ω) + Φ(ω) θ + B u − J Ȧ ν) + a load, a torque about each joint

Roll's row of B does not matter; two motors act, u₂ and u₃.

*The free body* has three axes, three actuators and any attitude; a load is the disturbance τ_d of (C.78).
"""

from __future__ import annotations

from math import hypot, inf
from typing import Annotated, NamedTuple

import casadi as ca
import numpy as np
from pydantic import AfterValidator, BaseModel, Field

from aeroloop.protocol.wire.attitude import Quaternion, R, S, T, Vector, from_euler


class Mechanism(NamedTuple):
    """Equations of motion in CasADi, without rotors, friction, wind and sensors. States are in rad, rad/s and 1."""

    initial: tuple[float, ...]
    actuators: int
    axes: int  # that a load acts about: joints, or the body's own
    derivative: ca.Function  # ẋ of x, voltages that make thrust [V] and a load on each axis [N·m]
    outputs: ca.Function  # of x: q, ω in the body frame [rad/s], rates about the axes [rad/s], joint angles [rad]
    settle: ca.Function  # x without the drift of an integration step


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _with_a_direction(attitude: Quaternion) -> Quaternion:
    if not 0 < hypot(*attitude) < inf:
        raise ValueError("a quaternion of any finite length but zero")
    return attitude


class BodySettings(BaseModel, extra="forbid"):
    """A body about a fixed point. Defaults: the inertia and mass of Table C.1."""

    inertia: tuple[Positive, Positive, Positive] = Field(
        default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]"
    )
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: Vector = Field(default=(0.0, 0.0, 0.0), description="r_g, origin to centre of mass, body frame [m]")


class AeroSettings(BodySettings):
    """The Aero's body. Defaults: Table C.1 of the paper, except the centre of mass, fitted to the paper."""

    centre_of_mass: Vector = Field(
        default=(0.0, 0.0, -0.003951),
        description="r_g, pivot to centre of mass, body frame [m]; height fitted to the paper, Table C.1: -0.0038",
    )
    thrust: tuple[tuple[float, float], tuple[float, float]] = Field(
        default=((0.0011, 0.0011), (-0.0014, 0.00176)), description="pitch and yaw rows of B, columns u2 and u3 [N·m/V]"
    )
    damping: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="θ of (C.2), damping about the *body* axes [N·m·s/rad]; 0: friction of the bench is in the joints",
    )


class RigidBodySettings(BodySettings):
    """A body about a fixed point. Defaults: the inertia and mass of Table C.1, turning about its centre of mass."""

    allocation: tuple[Vector, Vector, Vector] = Field(
        default=((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)), description="B [N·m/V]"
    )
    damping: Vector = Field(default=(0.01, 0.01, 0.01), description="θ about the body axes [N·m·s/rad]")
    attitude: Annotated[Quaternion, AfterValidator(_with_a_direction)] = Field(
        default=(1.0, 0.0, 0.0, 0.0), description="q at the start, scaled to unit length [1]"
    )
    rate: Vector = Field(default=(0.0, 0.0, 0.0), description="ω at the start, body frame [rad/s]")


def torque_of_motion(body: BodySettings, damping: Vector, q: ca.SX, omega: ca.SX) -> ca.SX:
    """Ψ(q, ω) + Φ(ω) θ of (C.2): gyroscopic torque, weight and damping θ, in the body frame [N·m]. Shape (3,)."""
    J, weight = ca.diag(ca.SX(body.inertia)), ca.vertcat(0, 0, -body.mass * body.gravity)
    g = -S(ca.SX(body.centre_of_mass)) @ R(q).T @ weight  # (C.6)
    Psi = -S(omega) @ (J @ omega) - g  # (C.4)
    Phi = ca.diag(-omega)  # (C.5)
    return Psi + Phi @ ca.SX(damping)


def aero(settings: AeroSettings) -> Mechanism:
    """The Aero: x = [pitch, yaw, ṗ, ẏ], u = [u₂, u₃], loads about pitch and yaw. Starts level, at rest, at yaw 0."""
    x, u, load = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("load", 2)
    pitch, yaw, nu = x[0], x[1], x[2:4]
    J = ca.diag(ca.SX(settings.inertia))
    B = ca.vertcat(ca.SX.zeros(1, 2), ca.SX(np.array(settings.thrust)))
    A = ca.vertcat(ca.horzcat(0, -ca.sin(pitch)), ca.horzcat(1, 0), ca.horzcat(0, ca.cos(pitch)))
    A_dot = ca.jacobian(ca.vec(A), pitch).reshape((3, 2)) * nu[0]
    q, omega = from_euler(ca.vertcat(0, pitch, yaw)), A @ nu
    torque = A.T @ (torque_of_motion(settings, settings.damping, q, omega) + B @ u - J @ A_dot @ nu) + load
    nu_dot = ca.solve(A.T @ J @ A, torque)
    derivative = ca.Function("aero", [x, u, load], [ca.vertcat(nu, nu_dot)])
    outputs = ca.Function("outputs", [x], [q, omega, nu, x[0:2]])
    return Mechanism((0.0,) * 4, 2, 2, derivative, outputs, ca.Function("settle", [x], [x]))


def rigid_body(settings: RigidBodySettings) -> Mechanism:
    """The free body: x = [q, ω], u = [u₁, u₂, u₃], loads about the body's axes; no joints. q is kept at unit length."""
    x, u, load = ca.SX.sym("x", 7), ca.SX.sym("u", 3), ca.SX.sym("load", 3)
    q, omega = x[0:4], x[4:7]
    J, B = ca.diag(ca.SX(settings.inertia)), ca.SX(np.array(settings.allocation))
    torque = torque_of_motion(settings, settings.damping, q, omega) + B @ u + load
    omega_dot = ca.solve(J, torque)  # (C.2), (C.78)
    derivative = ca.Function("rigid_body", [x, u, load], [ca.vertcat(T(q) @ omega, omega_dot)])  # (C.1)
    outputs = ca.Function("outputs", [x], [q, omega, omega, x[0:0]])
    settle = ca.Function("settle", [x], [ca.vertcat(q / ca.norm_2(q), omega)])
    length = float(np.linalg.norm(settings.attitude))
    initial = (*(part / length for part in settings.attitude), *settings.rate)
    return Mechanism(initial, 3, 3, derivative, outputs, settle)
