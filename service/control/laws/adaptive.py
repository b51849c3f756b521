"""The adaptive control law, (C.16)–(C.49), written beside the paper.

    symbol   name in code   meaning                                        unit        shape
    q^Q      q              attitude as received, body relative to i       1           4
    ω^Q      omega          angular velocity as received, body frame       rad/s       3
    q_d      q_d            desired attitude                               1           4
    ω_d      omega_d        desired angular velocity, *inertial* frame     rad/s       3
    ω̇_d      omega_d_dot    its derivative                                 rad/s²      3
    θ̂        theta          estimate of the damping θ                      N·m·s/rad   3
    ±        s              sign of η̃(t0): +1 for z₁₊, −1 for z₁₋          1           1
    C₁ C₂ Γ  C1, C2, Gamma  gains, diagonal; symbols, so that they may     see below   3
                            change while the loop runs
    e^Q      eta_e, eps_e   tracking error, scalar and vector part         1           1, 3
    ω_e^Q    omega_e        angular velocity error                         rad/s       3
    u        u              command before quantization                    V           3

The equations without quantization, (C.16)–(C.23), are the same expressions with unquantized arguments; where the paper
repeats an equation for its quantized form, the line carries both numbers; (C.25) follows from them. Received values are
within the bounds (C.28) and (C.29) of the true ones; errors are (C.31), (C.33) and (C.34). (C.36) is the quantizer at
the controller's exit, with the error (C.35) in the bound (C.30).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, Literal

import casadi as ca
from pydantic import Field

from aeroloop.protocol.wire.attitude import R, S
from aeroloop.service.control.laws.interface import (
    EstimateSettings,
    ExpressionLaw,
    MatrixGain,
    Now,
    gravity_torque,
    voltages_for,
)

ESTIMATE_REACH: Final = 1 / 0.95
"""‖θ̂‖ may reach this times k_θ: Remark 5's inequality needs every θ of Assumption 2 in the projection's inner ball."""


class AdaptiveSettings(EstimateSettings):
    """Model of the plant and gains of the law. The default is the paper's experiment, Table C.1."""

    kind: Literal["adaptive"] = Field(default="adaptive", description="which law")
    C1: MatrixGain = Field(default=(0.3, 0.3, 0.3), description="gain of the attitude error [1/s]")
    C2: MatrixGain = Field(default=(0.15, 0.15, 0.15), description="gain of the rate error [N·m·s/rad]")
    Gamma: MatrixGain = Field(default=(0.02, 0.02, 0.02), description="adaptation gain [N·m·s²/rad² per s]")


_GIVEN: Final = ("q", "omega", "q_d", "omega_d", "omega_d_dot", "theta", "s", "C1", "C2", "Gamma")


def equations(p: AdaptiveSettings, actuators: int, given: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """The law for these parameters, as CasADi expressions: eta_e, eps_e, omega_e, z1, z2, u, tau, theta_dot by name.

    `given` is what to build them from: those of the module's table down to C1, C2 and Gamma. Raises as `voltages_for`.
    """
    q, omega, q_d, omega_d, omega_d_dot, theta, s, *gains = (given[name] for name in _GIVEN)
    C1, C2, Gamma = (ca.diag(gain) for gain in gains)
    J = ca.diag(ca.SX(p.inertia))
    I = ca.SX.eye(3)  # noqa: E741  # the paper's identity matrix
    eta, eps, eta_d, eps_d = q[0], q[1:4], q_d[0], q_d[1:4]

    eta_e = eta_d * eta + ca.dot(eps_d, eps)  # (C.16), (C.32)
    eps_e = eta_d * eps - eta * eps_d - S(eps_d) @ eps  # (C.16), (C.32)
    R_ib = R(q).T  # (C.48): inertial to body, of the attitude as received
    omega_e = omega - R_ib @ omega_d  # (C.18), (C.47); e moves by (C.17)

    z1 = ca.vertcat(1 - s * eta_e, eps_e)  # (C.19), (C.39)
    G = ca.vertcat(s * eps_e.T, eta_e * I + S(eps_e)).T  # (C.21), (C.41)
    alpha = -C1 @ G @ z1  # (C.20), (C.42); G z1 = ±ε̃ by (C.49)
    z2 = omega_e - alpha  # (C.19), (C.40)
    alpha_bar = -s / 2 * C1 @ (eta_e * I + S(eps_e)) @ omega_e  # (C.46), for α̇ (Remark 6)

    g = -gravity_torque(p, q)  # (C.45)
    Psi = -S(omega) @ (J @ omega) - g  # (C.43)
    Phi = ca.diag(-omega)  # (C.44)
    u = voltages_for(
        p,
        -G @ z1 - C2 @ z2 - Phi @ theta - Psi - J @ (S(omega) @ R_ib @ omega_d - R_ib @ omega_d_dot - alpha_bar),
        actuators,
    )  # (C.22), (C.37)
    tau = Gamma @ Phi @ z2  # (C.23)
    theta_dot = projection(tau, theta - ca.SX(p.damping_estimate), Gamma, p.damping_bound)  # (C.38)

    names = ("eta_e", "eps_e", "omega_e", "z1", "z2", "u", "tau", "theta_dot")
    return dict(zip(names, (eta_e, eps_e, omega_e, z1, z2, u, tau, theta_dot), strict=True))


def projection(tau: ca.SX, moved: ca.SX, Gamma: ca.SX, bound: float) -> ca.SX:
    """Proj{τ} of (C.38): the smooth projection of Krstić, Kanellakopoulos and Kokotović (Remark 5).

    The convex set of Assumption 2 is the ball of radius k_θ around θ̂(t₀). Within it Proj{τ} is τ itself; from there to
    k_θ/0.95 a growing share of the outward component is removed. So −θ̃ᵀΓ⁻¹Proj{τ} ≤ −θ̃ᵀΓ⁻¹τ for every θ in the ball:
    what is removed is along Γ(θ̂ − θ̂(t₀)), and θ̃ᵀ(θ̂ − θ̂(t₀)) < 0 where any is.

    `tau` is Γ Φ z₂, the update without projection, shape (3,); `moved` θ̂ − θ̂(t₀); `bound` k_θ [N·m·s/rad].
    """
    outer = ESTIMATE_REACH * bound
    outside = (ca.dot(moved, moved) - bound**2) / (outer**2 - bound**2)
    outward = ca.dot(moved, tau)
    weight = ca.fmin(1, outside) / ca.fmax(ca.dot(moved, Gamma @ moved), 1e-300)
    return tau - ca.if_else(ca.logic_and(outside > 0, outward > 0), weight * outward, 0) * Gamma @ moved


class Adaptive(ExpressionLaw[AdaptiveSettings]):
    """The adaptive law, with θ̂ integrated over a period by Euler's rule.

    State: damping_estimate, θ̂ [N·m·s/rad]; sign, 0 before the first tick, which chooses that of η̃ (Assumption 3).
    """

    Settings = AdaptiveSettings
    gains = ("C1", "C2", "Gamma")
    units: ClassVar = {"damping_estimate": "N·m·s/rad"}

    def initial(self) -> Mapping[str, Sequence[float]]:
        return {"damping_estimate": self.settings.damping_estimate, "sign": (0.0,)}

    def expressions(self, now: Now[ca.SX]) -> tuple[ca.SX, Mapping[str, ca.SX]]:
        """(C.37), and the next θ̂ by (C.38)."""
        theta, s, bound = now.state["damping_estimate"], now.state["sign"], self.settings.damping_bound
        s = s + (s == 0) * (2 * (now.attitude_error[0] >= 0) - 1)
        motion = now.attitude, now.rate, now.desired_attitude, now.desired_rate, now.desired_acceleration
        given = dict(zip(_GIVEN, (*motion, theta, s, *(now.gains[name] for name in self.gains)), strict=True))
        law = equations(self.settings, self.actuators, given)
        theta_next = theta + self.period * law["theta_dot"]
        # Euler's step leaves the outer ball along its tangent; the projection keeps θ̂ within in continuous time only.
        moved = theta_next - ca.SX(self.settings.damping_estimate)
        theta_next -= ca.fmax(0, 1 - ESTIMATE_REACH * bound / ca.fmax(ca.norm_2(moved), 1e-300)) * moved
        return law["u"], {"damping_estimate": theta_next, "sign": s}
