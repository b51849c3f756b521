"""Free rigid body, (C.1)–(C.2) with the disturbance of (C.78): three axes, three actuators, any attitude."""

from __future__ import annotations

from math import hypot

import casadi as ca
import numpy as np
from pydantic import BaseModel, Field, field_validator

from aeroloop.plant_emulator.model.mechanism import Inertia, Mechanism
from aeroloop.protocol.wire.attitude import Quaternion, R, S, T, Vector


class RigidBodySettings(BaseModel, extra="forbid"):
    """A body about a fixed point. Defaults: the inertia and mass of Table C.1, turning about its centre of mass."""

    inertia: Inertia = Field(default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]")
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: Vector = Field(default=(0.0, 0.0, 0.0), description="r_g, origin to centre of mass, body frame [m]")
    allocation: tuple[Vector, Vector, Vector] = Field(
        default=((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)), description="B [N·m/V]"
    )
    damping: Vector = Field(default=(0.01, 0.01, 0.01), description="θ about the body axes [N·m·s/rad]")
    attitude: Quaternion = Field(default=(1.0, 0.0, 0.0, 0.0), description="q at the start [1]")
    rate: Vector = Field(default=(0.0, 0.0, 0.0), description="ω at the start, body frame [rad/s]")

    @field_validator("attitude")
    @classmethod
    def _attitude_has_a_direction(cls, attitude: Quaternion) -> Quaternion:
        if not 0 < hypot(*attitude) < float("inf"):
            raise ValueError("a quaternion of any finite length but zero")
        return attitude


class RigidBody(Mechanism):
    """x = [q, ω]; the axes are the body's own."""

    actuators = 3
    axes = 3

    def __init__(self, settings: RigidBodySettings) -> None:
        self._settings = settings
        length = float(np.linalg.norm(settings.attitude))
        self.initial = (*(part / length for part in settings.attitude), *settings.rate)

    def derivative(self, x: ca.SX, voltages: ca.SX, load: ca.SX) -> ca.SX:
        """q̇ by (C.1), ω̇ by (C.78) with the load as τ_d."""
        p = self._settings
        q, omega = x[0:4], x[4:7]
        J, B, theta = ca.diag(ca.SX(p.inertia)), ca.SX(np.array(p.allocation)), ca.SX(p.damping)
        weight = ca.vertcat(0, 0, -p.mass * p.gravity)
        g = -S(ca.SX(p.centre_of_mass)) @ R(q).T @ weight  # (C.6)
        Psi = -S(omega) @ (J @ omega) - g  # (C.4)
        Phi = ca.diag(-omega)  # (C.5)
        omega_dot = ca.solve(J, Psi + Phi @ theta + B @ voltages + load)  # (C.2), (C.78)
        return ca.vertcat(T(q) @ omega, omega_dot)  # (C.1)

    def attitude(self, x: ca.SX) -> ca.SX:
        """q."""
        return x[0:4]

    def rate(self, x: ca.SX) -> ca.SX:
        """ω."""
        return x[4:7]

    axis_rates = rate  # the axes are the body's

    def axis_angles(self, x: ca.SX) -> ca.SX:
        """Empty: a free body has no joints."""
        return x[0:0]

    def settle(self, x: ca.SX) -> ca.SX:
        """Scale q to unit length."""
        return ca.vertcat(x[0:4] / ca.norm_2(x[0:4]), x[4:7])
