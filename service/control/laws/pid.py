"""PID law: the PD+ law with an integral, whose windup a back-calculation ends.

    symbol    name in code    meaning                                         unit        shape
    k_p k_d   kp, kd          gains of attitude and rate error                N·m, N·m·s  3
    k_i       ki              gain of the integral                            N·m/rad     3
    c         attitude_share  attitude error beside the rate in the integral  1/s         3
    e_I       integral        integral of ω_e ± c ε̃                           rad         3
    T_t       reset_time      time constant of the back-calculation           s           3

    τ = −k_p (±ε̃) − k_d ω_e − k_i e_I,    ė_I = ω_e ± c ε̃ + B(u − sat u)/(k_i T_t)

Integral and its Lyapunov function: F. Goodarzi, D. Lee and T. Lee, Geometric Nonlinear PID Control of a Quadrotor UAV
on SE(3), European Control Conference, 2013, with ε̃ in place of their error in SO(3). Back-calculation: K. J. Åström
and T. Hägglund, PID Controllers: Theory, Design, and Tuning, 2nd edition, 1995, section on integrator windup.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import casadi as ca
from pydantic import Field

from aeroloop.service.control.laws.body import check_allocation
from aeroloop.service.control.laws.interface import Diagonal, Gains3, Now
from aeroloop.service.control.laws.tracking import TrackingLaw, TrackingSettings
from aeroloop.service.control.laws.tuning import PAPER, PAPER_BODY, VOLTAGE_LIMIT, tune_pid

_TUNED = tune_pid(PAPER_BODY, PAPER)


class PIDSettings(TrackingSettings):
    """Model of the plant, gains and anti-windup. The defaults are those of the tuning rule."""

    kind: Literal["pid"] = Field(default="pid", description="which law")
    kp: Gains3 = Field(default=_TUNED["kp"], description="gain of the attitude error ε̃ [N·m]")
    kd: Gains3 = Field(default=_TUNED["kd"], description="gain of the rate error [N·m·s/rad]")
    ki: Gains3 = Field(default=_TUNED["ki"], description="gain of the integral [N·m/rad]")
    attitude_share: Diagonal = Field(
        default=_TUNED["attitude_share"], description="c, of ε̃ beside the rate error in the integral [1/s]"
    )
    reset_time: Diagonal = Field(
        default=_TUNED["reset_time"], description="T_t, time in which the integral gives way to a saturated motor [s]"
    )
    voltage_limit: float = Field(default=VOLTAGE_LIMIT, gt=0, description="at which a motor saturates [V]")


class PID(TrackingLaw[PIDSettings]):
    """PID with feedforward and anti-windup."""

    Settings = PIDSettings
    gains = ("kp", "kd", "ki")
    units: ClassVar = {"integral": "rad"}

    def initial(self) -> Mapping[str, Sequence[float]]:
        """Nothing integrated yet."""
        return {**super().initial(), "integral": [0.0] * 3}

    def feedback(self, now: Now[ca.SX], sign: ca.SX) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """Proportional to both errors and to their integral."""
        eps_e = sign * now.attitude_error[1:4]
        e_I = now.state["integral"]
        torque = -now.gains["kp"] * eps_e - now.gains["kd"] * now.rate_error - now.gains["ki"] * e_I
        return torque, {"integral": e_I + self.period * (now.rate_error + ca.SX(self.settings.attitude_share) * eps_e)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """The voltages, and the integral less what they exceed the limit by."""
        u, state = super().expressions(now)
        p = self.settings
        B = ca.SX(check_allocation(p, self.actuators)[:, -self.actuators :])
        excess = B @ (u - ca.fmax(-p.voltage_limit, ca.fmin(p.voltage_limit, u)))
        ki = ca.fmax(now.gains["ki"], 1e-9)  # a gain of 0 is no integral
        share = ca.fmin(1, self.period / ca.SX(p.reset_time))
        return u, {**state, "integral": state["integral"] + share * excess / ki}
