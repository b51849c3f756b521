"""Quanser Aero with two degrees of freedom: the rigid body of (C.1)–(C.2) with its roll held by the mechanism.

It yaws about the vertical and pitches about the body's y axis, so its attitude is R_z(yaw) R_y(pitch) and its body
rates are ω = A ν with ν = [ṗ, ẏ]:

    A(p) = [0 −sin p; 1 0; 0 cos p]

The mechanism does no work along A, so projecting (C.2) onto A's columns (Kane's method) leaves two equations in ν̇:

    Aᵀ J A ν̇ = Aᵀ (Ψ(q, ω) + Φ(ω) θ + B u − J Ȧ ν)

A load, a torque about each joint, is added to the right-hand side. Roll's row of B does not matter; two motors act, u₂
and u₃.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from pydantic import Field

from aeroloop.plant_emulator.model.emulated import BodySettings, Mechanism, torque_of_motion
from aeroloop.protocol.wire.attitude import Vector, from_euler


class AeroSettings(BodySettings):
    """The Aero's body. Defaults: Table C.1 of the paper, except the centre of mass, fitted by `lab calibrate`."""

    centre_of_mass: Vector = Field(
        default=(0.0, 0.0, -0.003951),
        description="r_g, pivot to centre of mass, body frame [m]; height by `lab calibrate`, Table C.1: -0.0038",
    )
    thrust: tuple[tuple[float, float], tuple[float, float]] = Field(
        default=((0.0011, 0.0011), (-0.0014, 0.00176)), description="pitch and yaw rows of B, columns u2 and u3 [N·m/V]"
    )
    damping: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="θ of (C.2), damping about the *body* axes [N·m·s/rad]; 0: friction of the bench is in the joints",
    )


def free_motions(pitch: ca.SX) -> ca.SX:
    """A(p) of the module's docstring: ω = A [ṗ, ẏ]. Shape (3, 2)."""
    return ca.vertcat(ca.horzcat(0, -ca.sin(pitch)), ca.horzcat(1, 0), ca.horzcat(0, ca.cos(pitch)))


def aero_dynamics(settings: AeroSettings) -> ca.Function:
    """ẋ(x, u, load) of the Aero: x = [pitch, yaw, ṗ, ẏ], u = [u₂, u₃] in V, load about pitch and yaw in N·m."""
    x, u, load = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("load", 2)
    pitch, yaw, nu = x[0], x[1], x[2:4]
    J = ca.diag(ca.SX(settings.inertia))
    B = ca.vertcat(ca.SX.zeros(1, 2), ca.SX(np.array(settings.thrust)))
    A = free_motions(pitch)
    A_dot = ca.jacobian(ca.vec(A), pitch).reshape((3, 2)) * nu[0]
    q, omega = from_euler(ca.vertcat(0, pitch, yaw)), A @ nu
    torque = A.T @ (torque_of_motion(settings, settings.damping, q, omega) + B @ u - J @ A_dot @ nu) + load
    nu_dot = ca.solve(A.T @ J @ A, torque)
    return ca.Function("aero", [x, u, load], [ca.vertcat(nu, nu_dot)], ["x", "u", "load"], ["x_dot"])


class Aero(Mechanism):
    """x = [pitch, yaw, ṗ, ẏ] in rad and rad/s; the axes are the two joints. Starts level, at rest, at yaw 0."""

    initial = (0.0, 0.0, 0.0, 0.0)
    actuators = 2
    axes = 2

    def __init__(self, settings: AeroSettings) -> None:
        self._dynamics = aero_dynamics(settings)

    def derivative(self, x: ca.SX, voltages: ca.SX, load: ca.SX) -> ca.SX:
        """ẋ under the voltages of u₂ and u₃ [V] and torques about pitch and yaw [N·m]."""
        return self._dynamics(x, voltages, load)

    def attitude(self, x: ca.SX) -> ca.SX:
        """R_z(yaw) R_y(pitch) as q."""
        return from_euler(ca.vertcat(0, x[0], x[1]))

    def rate(self, x: ca.SX) -> ca.SX:
        """ω = A ν."""
        return free_motions(x[0]) @ x[2:4]

    def axis_rates(self, x: ca.SX) -> ca.SX:
        """ν = [ṗ, ẏ]."""
        return x[2:4]

    def axis_angles(self, x: ca.SX) -> ca.SX:
        """[pitch, yaw]."""
        return x[0:2]
