"""What the body shall do: Euler angles as expressions of time, and what the law needs of them.

A reference says roll, pitch and yaw as a CasADi expression of t. The desired quaternion, the angular velocity of (C.12)
in the inertial frame and its derivative follow by CasADi's own derivatives, so they are exact and agree.
"""

from __future__ import annotations

from math import pi
from typing import Annotated, Literal

import casadi as ca
from pydantic import BaseModel, ConfigDict, Field

from protocol.attitude import conjugate, from_euler, product

Triple = tuple[float, float, float]
Frequency = Annotated[float, Field(ge=0, le=100)]


class SinusoidSettings(BaseModel):
    """amplitude · sin(frequency · t) on each of roll, pitch and yaw. The default is the paper's experiment, C.5."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Triple = Field(default=(0.0, 40.0, 100.0), description="of roll, pitch, yaw [deg]")
    frequency: tuple[Frequency, Frequency, Frequency] = Field(
        default=(0.0, 0.1 * pi, 0.05 * pi), description="of roll, pitch, yaw [rad/s]"
    )

    def angles(self, t: ca.SX) -> ca.SX:
        """[roll, pitch, yaw] at time t [s], in rad. Shape (3,)."""
        amplitude = ca.SX(self.amplitude) * (pi / 180)
        return amplitude * ca.sin(ca.SX(self.frequency) * t)


def reference_function(settings: SinusoidSettings) -> ca.Function:
    """t ↦ q_d, ω_d, ω̇_d: desired attitude [1], angular velocity [rad/s] and acceleration [rad/s²], both inertial."""
    t = ca.SX.sym("t")
    q_d = from_euler(settings.angles(t))
    q_d_dot = ca.jacobian(q_d, t)
    omega_d = 2 * product(q_d_dot, conjugate(q_d))[1:4]  # (C.12), solved for ω_d
    omega_d_dot = ca.jacobian(omega_d, t)
    return ca.Function("reference", [t], [q_d, omega_d, omega_d_dot], ["t"], ["q_d", "omega_d", "omega_d_dot"])
