"""A control law of your own: PD with the body's weight, as CasADi expressions; and PID, in plain Python.

aeroloop lab experiment --set law.kind=own_law:OwnLaw
aeroloop demo --set law.kind=own_law:OwnPythonLaw
aeroloop op set-gains --stiffness 1.5 1.5 1.5
"""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca
import numpy as np
from pydantic import Field

import aeroloop


class OwnSettings(aeroloop.LawSettings):
    """Keys of [law], with units and bounds, beside the body's: inertia, mass, centre_of_mass, allocation."""

    stiffness: aeroloop.Gains3 = Field(default=(1.0, 1.0, 1.0), description="torque by attitude error [N·m]")
    damping: aeroloop.Gains3 = Field(default=(0.15, 0.15, 0.15), description="torque by rate error [N·m·s/rad]")
    integral: aeroloop.Gains3 = Field(default=(1.0, 1.0, 1.0), description="torque by its integral [N·m/s]")


class OwnLaw(aeroloop.ExpressionLaw[OwnSettings]):
    """Compiled with the rest of the tick: experiments and searches run it thousands of times faster than real time."""

    Settings = OwnSettings
    gains = ("stiffness", "damping")  # an operator may change these while it runs, within the bounds of their types

    def expressions(self, now: aeroloop.Now[ca.SX]) -> tuple[ca.SX, dict[str, ca.SX]]:
        """The voltages [V], and the named state after this tick: this law has none."""
        eta, eps = now.attitude_error[0], now.attitude_error[1:4]
        nearer = ca.if_else(eta < 0, -1, 1)  # q and −q are one attitude: turn the shorter way
        torque = -now.gains["stiffness"] * nearer * eps - now.gains["damping"] * now.rate_error
        torque -= aeroloop.gravity_torque(self.settings, now.attitude)
        return aeroloop.voltages_for(self.settings, torque, self.actuators), {}


class OwnPythonLaw(aeroloop.PythonLaw[OwnSettings]):
    """Called once a tick between two frames; the integral finds the weight by itself."""

    Settings = OwnSettings
    gains = ("stiffness", "damping", "integral")
    units: ClassVar = {"error_integral": "s"}

    def reset(self) -> None:
        """What is carried from tick to tick, by name: logs have it, so that a replay may begin at any tick."""
        self.state = {"error_integral": np.zeros(3)}

    def step(self, now: aeroloop.Now[Any]) -> Any:
        """The voltages [V]; the clip is the anti-windup."""
        eps = now.attitude_error[1:4] * (-1 if now.attitude_error[0] < 0 else 1)
        self.state["error_integral"] = np.clip(now.state["error_integral"] + self.period * eps, -1, 1)
        torque = -now.gains["stiffness"] * eps - now.gains["damping"] * now.rate_error
        torque -= now.gains["integral"] * self.state["error_integral"]
        return aeroloop.voltages_for(self.settings, torque, self.actuators)
