"""The Quanser Aero with two degrees of freedom: the rigid body of (C.1)–(C.2) with its roll held by the mechanism.

It yaws about the vertical and pitches about the body's y axis, so its attitude is R_z(yaw) R_y(pitch) and its body
rates are ω = A ν with ν = [ṗ, ẏ]:

    A(p) = [0 −sin p; 1 0; 0 cos p]

The mechanism does no work along A, so projecting (C.2) onto A's columns (Kane's method) leaves two equations in ν̇:

    Aᵀ J A ν̇ = Aᵀ (Ψ(q, ω) + Φ(ω) θ + B u − J Ȧ ν)

Roll's row of B does not matter to them; two motors act, u₂ and u₃.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from plant_emulator.integrate import rk4
from plant_emulator.plant import EmulatedPlant, Measurement, State
from protocol.attitude import R, S, from_euler
from protocol.symbolic import Compiled


class AeroSettings(BaseModel):
    """The physical Aero. Defaults: Table C.1 of the paper; damping as measured (see `damping`)."""

    model_config = ConfigDict(extra="forbid")

    inertia: tuple[float, float, float] = Field(default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]")
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: tuple[float, float, float] = Field(
        default=(0.0, 0.0, -0.0038), description="r_g, pivot to centre of mass, body frame [m]"
    )
    thrust: tuple[tuple[float, float], tuple[float, float]] = Field(
        default=((0.0011, 0.0011), (-0.0014, 0.00176)),
        description="pitch and yaw rows of B, columns u2 and u3 [N·m/V]",
    )
    damping: tuple[float, float, float] = Field(
        default=(0.0, 0.0071, 0.0220),
        description="θ, true viscous damping about the body axes [N·m·s/rad]; pitch, yaw from Quanser's lab material",
    )
    voltage_limit: float = Field(default=24.0, gt=0, description="largest voltage at a motor [V]")
    substeps: int = Field(default=2, ge=1, le=100, description="Runge–Kutta steps a period")


def aero_dynamics(settings: AeroSettings) -> ca.Function:
    """ẋ(x, u) of the Aero. x = [pitch, yaw, ṗ, ẏ] in rad and rad/s, u = [u₂, u₃] in V."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    pitch, yaw, nu = x[0], x[1], x[2:4]
    J = ca.diag(ca.SX(settings.inertia))
    r_g = ca.SX(settings.centre_of_mass)
    theta = ca.SX(settings.damping)
    B = ca.vertcat(ca.SX.zeros(1, 2), ca.SX(np.array(settings.thrust)))

    A = ca.vertcat(ca.horzcat(0, -ca.sin(pitch)), ca.horzcat(1, 0), ca.horzcat(0, ca.cos(pitch)))
    A_dot = ca.jacobian(ca.vec(A), pitch).reshape((3, 2)) * nu[0]
    q = from_euler(ca.vertcat(0, pitch, yaw))
    omega = A @ nu

    weight = ca.vertcat(0, 0, -settings.mass * settings.gravity)
    g = -S(r_g) @ R(q).T @ weight  # (C.6)
    Psi = -S(omega) @ (J @ omega) - g  # (C.4)
    Phi = ca.diag(-omega)  # (C.5)
    torque = A.T @ (Psi + Phi @ theta + B @ u - J @ A_dot @ nu)
    nu_dot = ca.solve(A.T @ J @ A, torque)
    return ca.Function("aero", [x, u], [ca.vertcat(nu, nu_dot)], ["x", "u"], ["x_dot"])


class Aero(EmulatedPlant):
    """The Aero, emulated. Starts level, at rest, at yaw 0: q = [1, 0, 0, 0].

    Args:
        settings: The physical parameters.
        period: Time that `advance` lets pass [s].
    """

    actuators = 2

    def __init__(self, settings: AeroSettings, period: float) -> None:
        dynamics = aero_dynamics(settings)
        x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
        after = rk4(lambda state: dynamics(state, u), x, period, settings.substeps)
        q = from_euler(ca.vertcat(0, after[0], after[1]))
        omega = ca.vertcat(-ca.sin(after[0]) * after[3], after[2], ca.cos(after[0]) * after[3])
        self._step = Compiled(ca.Function("step", [x, u], [after, q, omega], ["x", "u"], ["after", "attitude", "rate"]))
        self._x = self._step.inputs["x"]
        self._u = self._step.inputs["u"]
        self._after = self._step.outputs["after"]
        self._attitude = self._step.outputs["attitude"]
        self._rate = self._step.outputs["rate"]
        self._attitude[0] = 1.0
        self._limit = settings.voltage_limit

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold two voltages [V], clipped to the supply's limits."""
        for i in range(2):
            self._u[i] = max(-self._limit, min(self._limit, voltages[i]))

    def advance(self) -> None:
        """Integrate one period."""
        self._step()
        self._x[:] = self._after

    def measure(self) -> Measurement:
        """Perfect sensors."""
        return Measurement(tuple(self._attitude), tuple(self._rate))  # type: ignore[arg-type]  # lengths are 4 and 3

    def truth(self) -> State:
        """The state as integrated."""
        return State(tuple(self._attitude), tuple(self._rate), tuple(self._u))  # type: ignore[arg-type]  # as above

    def close(self) -> None:
        """0 V."""
        self.actuate((0.0, 0.0))
