"""Free rigid body, (C.1)–(C.2) with the disturbance of (C.78): three axes, three actuators, any attitude."""

from __future__ import annotations

import casadi as ca
import numpy as np
from pydantic import Field

from aeroloop.plant_emulator.model.emulated import BodySettings, Direction, Mechanism, torque_of_motion
from aeroloop.protocol.wire.attitude import T, Vector


class RigidBodySettings(BodySettings):
    """A body about a fixed point. Defaults: the inertia and mass of Table C.1, turning about its centre of mass."""

    allocation: tuple[Vector, Vector, Vector] = Field(
        default=((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01)), description="B [N·m/V]"
    )
    damping: Vector = Field(default=(0.01, 0.01, 0.01), description="θ about the body axes [N·m·s/rad]")
    attitude: Direction = Field(default=(1.0, 0.0, 0.0, 0.0), description="q at the start [1]")
    rate: Vector = Field(default=(0.0, 0.0, 0.0), description="ω at the start, body frame [rad/s]")


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
        p, q, omega = self._settings, x[0:4], x[4:7]
        J, B = ca.diag(ca.SX(p.inertia)), ca.SX(np.array(p.allocation))
        torque = torque_of_motion(p, p.damping, q, omega) + B @ voltages + load
        omega_dot = ca.solve(J, torque)  # (C.2), (C.78)
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
