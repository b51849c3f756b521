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
repeats an equation for its quantized form, the line carries both numbers. That (C.25) follows from them is proved in
tests/service/control/test_law.py. Received values are within the bounds (C.28) and (C.29) of the true ones; errors are
(C.31), (C.33) and (C.34). (C.36) is the quantizer at the controller's exit, with the error (C.35) in the bound (C.30).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Annotated, Any, Final, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from aeroloop.protocol.lazy import casadi as ca
from aeroloop.protocol.lazy import numpy as np
from aeroloop.protocol.messages.operator import Gain
from aeroloop.protocol.wire.attitude import R, S
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wire.symbolic import along_rows, in_columns


def _positive(gains: tuple[float, float, float]) -> tuple[float, float, float]:
    if min(gains) <= 0:
        raise ValueError("every element must be positive")
    return gains


ESTIMATE_REACH: Final = 1 / 0.95
"""‖θ̂‖ may reach this times k_θ: Remark 5's inequality needs every θ of Assumption 2 in the projection's inner ball."""

Diagonal = Annotated[tuple[float, float, float], AfterValidator(_positive)]
"""The diagonal of a positive definite matrix."""


class LawSettings(BaseModel):
    """Model of the plant and gains of the law. The default is the paper's experiment, Table C.1."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    inertia: Diagonal = Field(default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]")
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: tuple[float, float, float] = Field(
        default=(0.0, 0.0, -0.0038), description="r_g, origin to centre of mass, body frame [m]"
    )
    allocation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]] = Field(
        default=((1.0, 0.0, 0.0), (0.0, 0.0011, 0.0011), (0.0, -0.0014, 0.00176)),
        description="B, control allocation, invertible [N·m/V]; the Aero's first row is fictitious",
    )
    C1: Gain = Field(default=(0.3, 0.3, 0.3), description="gain of the attitude error [1/s]")
    C2: Gain = Field(default=(0.15, 0.15, 0.15), description="gain of the rate error [N·m·s/rad]")
    Gamma: Gain = Field(default=(0.02, 0.02, 0.02), description="adaptation gain [N·m·s²/rad² per s]")
    damping_estimate: tuple[float, float, float] = Field(
        default=(0.0, 0.0070, 0.0095), description="θ̂(t0), first estimate of the damping [N·m·s/rad]"
    )
    damping_bound: float = Field(
        default=0.05,
        gt=0,
        description="k_θ: ‖θ‖ is assumed to be below this, and ‖θ̂‖ is kept below k_θ/0.95 [N·m·s/rad]",
    )

    @model_validator(mode="after")
    def _estimate_within_bound(self) -> LawSettings:
        if hypot(*self.damping_estimate) > self.damping_bound:
            raise ValueError(f"the first damping estimate lies beyond damping_bound, {self.damping_bound}")
        return self


@dataclass(frozen=True)
class Law:
    """The law's expressions, each as named in the module's table, and their symbols."""

    q: ca.SX
    omega: ca.SX
    q_d: ca.SX
    omega_d: ca.SX
    omega_d_dot: ca.SX
    theta: ca.SX
    s: ca.SX
    C1: ca.SX
    C2: ca.SX
    Gamma: ca.SX
    eta_e: ca.SX
    eps_e: ca.SX
    omega_e: ca.SX
    z1: ca.SX
    z2: ca.SX
    u: ca.SX
    tau: ca.SX
    theta_dot: ca.SX


def build_law(p: LawSettings) -> Law:
    """The law for these parameters, as CasADi expressions; the gains are symbols among them.

    Raises:
        ValueError: B cannot be inverted.
    """
    check_invertible(np.array(p.allocation))
    J, B = ca.diag(ca.SX(p.inertia)), ca.SX(np.array(p.allocation))
    gains = ca.SX.sym("C1", 3), ca.SX.sym("C2", 3), ca.SX.sym("Gamma", 3)
    C1, C2, Gamma = (ca.diag(gain) for gain in gains)
    r_g = ca.SX(p.centre_of_mass)
    f_g = ca.vertcat(0, 0, -p.mass * p.gravity)
    I = ca.SX.eye(3)  # noqa: E741  # the paper's identity matrix

    q, omega = ca.SX.sym("q", 4), ca.SX.sym("omega", 3)
    q_d, omega_d, omega_d_dot = ca.SX.sym("q_d", 4), ca.SX.sym("omega_d", 3), ca.SX.sym("omega_d_dot", 3)
    theta, s = ca.SX.sym("theta", 3), ca.SX.sym("s")
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

    g = -S(r_g) @ R_ib @ f_g  # (C.45)
    Psi = -S(omega) @ (J @ omega) - g  # (C.43)
    Phi = ca.diag(-omega)  # (C.44)
    u = ca.solve(
        B,
        -G @ z1 - C2 @ z2 - Phi @ theta - Psi - J @ (S(omega) @ R_ib @ omega_d - R_ib @ omega_d_dot - alpha_bar),
    )  # (C.22), (C.37)
    tau = Gamma @ Phi @ z2  # (C.23)
    theta_dot = projection(tau, theta, Gamma, p.damping_bound)  # (C.38)

    return Law(q, omega, q_d, omega_d, omega_d_dot, theta, s, *gains, eta_e, eps_e, omega_e, z1, z2, u, tau, theta_dot)


def check_invertible(B: np.ndarray[Any, Any]) -> None:  # the paper's letter
    """Raise ValueError, with the key, if B or a part of it has no inverse. Shape (n, n)."""
    if np.linalg.cond(B) > 1e12:
        raise ValueError("law.allocation (B) has no inverse: every axis needs a motor that acts on it")


def projection(tau: ca.SX, theta: ca.SX, Gamma: ca.SX, bound: float) -> ca.SX:
    """Proj{τ} of (C.38): the smooth projection of Krstić, Kanellakopoulos and Kokotović (Remark 5).

    For ‖θ̂‖ ≤ k_θ it is τ itself; from there to k_θ/0.95 a growing share of the outward component is removed. So
    −θ̃ᵀΓ⁻¹Proj{τ} ≤ −θ̃ᵀΓ⁻¹τ for every ‖θ‖ ≤ k_θ: what is removed is along Γθ̂, and θ̃ᵀθ̂ = θᵀθ̂ − ‖θ̂‖² < 0 where any is.

    Args:
        tau: Γ Φ z₂, the update without projection. Shape (3,).
        theta: θ̂. Shape (3,).
        Gamma: Adaptation gain. Shape (3, 3).
        bound: k_θ [N·m·s/rad].
    """
    outer = ESTIMATE_REACH * bound
    outside = (ca.dot(theta, theta) - bound**2) / (outer**2 - bound**2)
    outward = ca.dot(theta, tau)
    weight = ca.fmin(1, outside) / ca.fmax(ca.dot(theta, Gamma @ theta), 1e-300)
    return tau - ca.if_else(ca.logic_and(outside > 0, outward > 0), weight * outward, 0) * Gamma @ theta


def received(eps: ca.SX, last: ca.SX) -> ca.SX:
    """q^Q of ε as received: `aeroloop.protocol.wire.attitude.received_quaternion`, as an expression. Shape (4,).

    Args:
        eps: ε. Shape (3,).
        last: The previous q^Q. Shape (4,).
    """
    square = ca.dot(eps, eps)
    eta = ca.sqrt(ca.fmax(0, 1 - square))  # (C.11)
    q = ca.vertcat(eta, eps / ca.sqrt(ca.fmax(1, square)))  # Remark 2
    return q * (1 - 2 * (ca.dot(q, last) < 0))


class Steps(NamedTuple):
    """A tick of the law in four parts; two carry state from tick to tick, the others can be evaluated for many ticks.

    Attributes:
        attitude: last, eps ↦ q. Carries state: `last` is the previous q.
        adaptation: q, omega, q_d, omega_d, s, C1, C2, Gamma ↦ tau.
        estimate: theta, tau, Gamma ↦ theta_next. Carries state.
        command: q, omega, q_d, omega_d, omega_d_dot, theta, s, C1, C2 ↦ u, eta_e, eps_e, omega_e.
    """

    attitude: ca.Function
    adaptation: ca.Function
    estimate: ca.Function
    command: ca.Function


def law_steps(p: LawSettings, period: float) -> Steps:
    """The law's parts, with θ̂ integrated over a period by Euler's rule.

    Args:
        p: Parameters; the gains are inputs.
        period: Time between ticks [s].

    Raises:
        ValueError: B cannot be inverted.
    """
    law = build_law(p)
    last, eps, tau = ca.SX.sym("last", 4), ca.SX.sym("eps", 3), ca.SX.sym("tau", 3)
    theta_next = law.theta + period * projection(tau, law.theta, ca.diag(law.Gamma), p.damping_bound)  # (C.38)
    # Euler's step leaves the outer ball along its tangent; the projection keeps θ̂ within in continuous time only.
    theta_next *= ca.fmin(1, ESTIMATE_REACH * p.damping_bound / ca.fmax(ca.norm_2(theta_next), 1e-300))
    errors = law.q, law.omega, law.q_d, law.omega_d
    return Steps(
        ca.Function("attitude", [last, eps], [received(eps, last)], ["last", "eps"], ["q"]),
        ca.Function("adaptation", [*errors, law.s, law.C1, law.C2, law.Gamma], [law.tau]),
        ca.Function("estimate", [law.theta, tau, law.Gamma], [theta_next]),
        ca.Function(
            "command",
            [*errors, law.omega_d_dot, law.theta, law.s, law.C1, law.C2],
            [law.u, law.eta_e, law.eps_e, law.omega_e],
        ),
    )


_SIZES: Final = {"eps": 3, "omega": 3, "q_d": 4, "omega_d": 3, "omega_d_dot": 3, "s": 1, "C1": 3, "C2": 3, "Gamma": 3}


def law_function(p: LawSettings, period: float) -> ca.Function:
    """One tick of the law, for the loop. Raises as `law_steps` does.

    Inputs: last, theta, and eps, omega, q_d, omega_d, omega_d_dot, s, C1, C2, Gamma. `last` is the
    previous q; of ±q the nearer one is taken. s = 0, before the first tick, becomes the sign of η̃ (Assumption 3).
    Outputs: q, u, theta_next, eta_e, eps_e, omega_e, s_next.
    """
    steps = law_steps(p, period)
    last, theta = ca.SX.sym("last", 4), ca.SX.sym("theta", 3)
    given = {name: ca.SX.sym(name, size) for name, size in _SIZES.items()}
    eps, omega, q_d, omega_d, omega_d_dot, s, C1, C2, Gamma = given.values()
    with as_written():
        q = steps.attitude(last, eps)
        _, eta_e, *_ = steps.command(q, omega, q_d, omega_d, omega_d_dot, theta, s, C1, C2)  # whatever s is
        s_next = s + (s == 0) * (2 * (eta_e >= 0) - 1)
        theta_next = steps.estimate(theta, steps.adaptation(q, omega, q_d, omega_d, s_next, C1, C2, Gamma), Gamma)
        u, *errors = steps.command(q, omega, q_d, omega_d, omega_d_dot, theta, s_next, C1, C2)
        return ca.Function(
            "law",
            [last, theta, *given.values()],
            [q, u, theta_next, *errors, s_next],
            ["last", "theta", *given],
            ["q", "u", "theta_next", "eta_e", "eps_e", "omega_e", "s_next"],
            {"cse": True},  # two parts need the errors
        )


def law_of_many(p: LawSettings, period: float, rows: int) -> ca.Function:
    """Many consecutive ticks of the law, for readers of logs. Raises as `law_steps` does.

    Args:
        p: Parameters; the gains are inputs.
        period: Time between ticks [s].
        rows: How many ticks; a multiple of `aeroloop.protocol.wire.symbolic.UNROLLED`.

    Returns:
        A function with the inputs of `law_function`, s being ±1, and its outputs without s_next. `last` and `theta` are
        those before the first tick; all others have a row per tick, shape (rows, …). One more output: theta_before, the
        θ̂ of each u.
    """
    steps = law_steps(p, period)
    last, first = ca.MX.sym("last", 4), ca.MX.sym("theta", 3)
    given = {name: ca.MX.sym(name, rows, size) for name, size in _SIZES.items()}
    eps, omega, q_d, omega_d, omega_d_dot, s, C1, C2, Gamma = given.values()
    q = along_rows(steps.attitude, last, eps)
    tau = in_columns(steps.adaptation, rows)(q, omega, q_d, omega_d, s, C1, C2, Gamma)
    theta_next = along_rows(steps.estimate, first, tau, Gamma)
    theta = ca.vertcat(first.T, theta_next[:-1, :])
    u, *errors = in_columns(steps.command, rows)(q, omega, q_d, omega_d, omega_d_dot, theta, s, C1, C2)
    return ca.Function(
        "law_of_many",
        [last, first, *given.values()],
        [q, u, theta_next, *errors, theta],
        ["last", "theta", *given],
        ["q", "u", "theta_next", "eta_e", "eps_e", "omega_e", "theta_before"],
    )
