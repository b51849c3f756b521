"""Backstepping law with estimates of viscous damping, Coulomb friction and a constant torque.

    symbol     name in code       meaning                                           unit            shape
    ±ε̃, ω_e    eps_e, omega_e     tracking errors, (C.16) and (C.18); ± as chosen   1, rad/s        3
    z₂         z2                 ω_e − α with α = −C₁(±ε̃), (C.19) and (C.20)       rad/s           3
    ω_r        omega_r            ω − z₂ = Rω_d + α, the virtual rate               rad/s           3
    θ̂_v        damping_estimate   viscous damping                                   N·m·s/rad       3
    θ̂_c        coulomb_estimate   Coulomb friction                                  N·m             3
    θ̂_d        torque_estimate    constant torque                                   N·m             3
    ε          friction_width     rate within which Coulomb friction changes sign   rad/s           1

The law is (C.22) with a gain k₁ of the attitude error and with Φ(ω) = [−diag ω, −diag tanh(ω/ε), I] at ω_r. Every law
here feeds the damping as first estimated forward at ω = ω_r + z₂, hence the θ̂_v(t₀) beside C₂:

    B u = −k₁(±ε̃) − (C₂ − diag θ̂_v(t₀))z₂ − Φ(ω_r)θ̂ − Ψ − J(S(ω)Rω_d − Rω̇_d − α̇)
    θ̂' = Proj{Γ Φ(ω_r)ᵀ z₂}

service/theorem/README.md derives that V = 2k₁(1 ∓ η̃) + ½ z₂ᵀJz₂ + ½ θ̃ᵀΓ⁻¹θ̃ falls. Proj keeps each element of θ̂ within a
bound of its first value, and friction from being negative. While a motor saturates friction is not learned, and θ̂_d
gives way to what the motors lack, as the PID's integral does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, Literal

import casadi as ca
from pydantic import Field

from aeroloop.protocol.wire.attitude import S
from aeroloop.protocol.wire.elementary import tanh
from aeroloop.service.control.laws.baselines import DEFAULTS, VOLTAGE_LIMIT, TrackingSettings, feedforward, nearer
from aeroloop.service.control.laws.interface import (
    Diagonal,
    ExpressionLaw,
    Gains3,
    MatrixGain,
    Now,
    Vector,
    check_allocation,
    voltages_for,
)

_TUNED: Final = DEFAULTS["adaptive-torque"]


class AdaptiveTorqueSettings(TrackingSettings):
    """Model of the plant, gains, first estimates and their bounds. The default gains are those of the tuning rule."""

    kind: Literal["adaptive-torque"] = Field(default="adaptive-torque", description="which law")
    k1: MatrixGain = Field(default=_TUNED["k1"], description="gain of the attitude error in the torque [N·m]")
    C1: MatrixGain = Field(default=_TUNED["C1"], description="gain of the attitude error in the virtual rate [1/s]")
    C2: MatrixGain = Field(default=_TUNED["C2"], description="gain of z₂ [N·m·s/rad]")
    Gamma_torque: Gains3 = Field(
        default=_TUNED["Gamma_torque"], description="adaptation gain of the constant torque [N·m/rad]"
    )
    Gamma_damping: Gains3 = Field(
        default=_TUNED["Gamma_damping"], description="adaptation gain of the damping [N·m·s²/rad² per s]"
    )
    Gamma_coulomb: Gains3 = Field(
        default=_TUNED["Gamma_coulomb"], description="adaptation gain of the Coulomb friction [N·m/rad]"
    )
    coulomb_estimate: Vector = Field(default=(0.0, 0.0, 0.0), description="first estimate of Coulomb friction [N·m]")
    friction_width: float = Field(
        default=0.03, gt=0, le=1, description="ε, rate within which Coulomb friction changes sign [rad/s]"
    )
    torque_bound: Diagonal = Field(
        default=_TUNED["torque_bound"], description="largest estimate of the constant torque about each axis [N·m]"
    )
    damping_bound: float = Field(
        default=0.03,
        gt=0,
        le=100,
        description="largest change of each damping estimate from its first value [N·m·s/rad]",
    )
    coulomb_bound: float = Field(
        default=0.005, gt=0, description="largest change of each Coulomb estimate from its first value [N·m]"
    )
    reset_time: Diagonal = Field(
        default=_TUNED["reset_time"],
        description="T_t, time in which the constant torque gives way to a saturated motor [s]",
    )
    voltage_limit: float = Field(default=VOLTAGE_LIMIT, gt=0, description="at which a motor saturates [V]")


class AdaptiveTorque(ExpressionLaw[AdaptiveTorqueSettings]):
    """The law of the module's text, with θ̂ integrated over a period by Euler's rule."""

    Settings = AdaptiveTorqueSettings
    gains = ("k1", "C1", "C2", "Gamma_torque", "Gamma_damping", "Gamma_coulomb")
    units: ClassVar = {"torque_estimate": "N·m", "damping_estimate": "N·m·s/rad", "coulomb_estimate": "N·m"}

    def initial(self) -> Mapping[str, Sequence[float]]:
        p = self.settings
        estimates = {"damping_estimate": p.damping_estimate, "coulomb_estimate": p.coulomb_estimate}
        return {"sign": (0.0,), "torque_estimate": (0.0, 0.0, 0.0), **estimates}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """The voltages, and the next estimates."""
        p, gains, state = self.settings, now.gains, now.state
        sign = nearer(now.attitude_error[0], state["sign"], p.hysteresis)
        eta_e, eps_e, omega_e = sign * now.attitude_error[0], sign * now.attitude_error[1:4], now.rate_error
        z2 = omega_e + gains["C1"] * eps_e
        alpha_dot = -gains["C1"] / 2 * ((eta_e * ca.SX.eye(3) + S(eps_e)) @ omega_e)  # (C.46)
        omega_r = now.rate - z2
        Phi_v, Phi_c = -omega_r, -tanh(omega_r / p.friction_width)  # diagonals

        learned = state["torque_estimate"] + Phi_c * state["coulomb_estimate"]
        learned += Phi_v * (state["damping_estimate"] - ca.SX(p.damping_estimate))
        feedback = -gains["k1"] * eps_e - gains["C2"] * z2 + ca.SX(p.inertia) * alpha_dot
        u = voltages_for(p, feedforward(p, now) + feedback - learned, self.actuators)

        saturated = ca.fmax(-p.voltage_limit, ca.fmin(p.voltage_limit, u))
        B = ca.SX(check_allocation(p, self.actuators)[:, -self.actuators :])
        missing = (gains["Gamma_torque"] > 0) * (B @ (u - saturated))  # a gain of 0 learns nothing
        step = self.period * z2
        slow = step * (ca.mmax(ca.fabs(u)) < p.voltage_limit)
        share = ca.fmin(1, self.period / ca.SX(p.reset_time))

        def within(estimate: ca.SX, first: Vector, bound: float) -> ca.SX:
            """Proj: friction within a bound of its first estimate, and never negative."""
            return ca.fmax(ca.fmax(0, ca.SX(first) - bound), ca.fmin(ca.SX(first) + bound, estimate))

        torque = state["torque_estimate"] + gains["Gamma_torque"] * step + share * missing
        damping = state["damping_estimate"] + gains["Gamma_damping"] * Phi_v * slow
        coulomb = state["coulomb_estimate"] + gains["Gamma_coulomb"] * Phi_c * slow
        reach = ca.SX(p.torque_bound)
        return u, {
            "sign": sign,
            "torque_estimate": ca.fmax(-reach, ca.fmin(reach, torque)),
            "damping_estimate": within(damping, p.damping_estimate, p.damping_bound),
            "coulomb_estimate": within(coulomb, p.coulomb_estimate, p.coulomb_bound),
        }
