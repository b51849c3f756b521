"""Bounds of Lemma 1 and of Theorem 1, (C.26)–(C.80), written beside the paper, and its error coordinates.

`Known`, `Lemma` and `Theorem` hold each quantity's symbol, equation, unit and meaning; a certificate prints them. The
paper weighs z₁ with an implied 1 N·m, and ‖z‖ adds z₁ [1] to z₂ [rad/s]; so do the units here. README.md says how the
paper is read where it cannot be evaluated as printed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import cos, pi, sin, sqrt
from typing import Annotated, NamedTuple

import numpy as np

from aeroloop.service.control.reference import Floats


@dataclass(frozen=True)
class Term:
    """One quantity of the theorem, by its symbol in the paper, its number there, or the assumption or remark."""

    symbol: str
    equation: str
    value: float | None = field(default=None, kw_only=True)  # None: without a set, or as (C.66) fails
    unit: str
    meaning: str


@dataclass(frozen=True)
class Known:
    """Inputs of the theorem: from the model, the gains, the wire and the reference, and assumptions."""

    lambda_J: Annotated[float, Term("λ_max(J)", "C.2", "kg·m²", "largest moment of inertia")]
    weight: Annotated[float, Term("‖r_g‖ m g", "C.6", "N·m", "largest torque of the weight")]
    norm_B: Annotated[float, Term("‖B‖", "C.2", "N·m/V", "of the motors present")]
    C1_min: Annotated[float, Term("λ_min(C₁)", "C.20", "1/s", "least gain of the attitude error")]
    C1_max: Annotated[float, Term("λ_max(C₁)", "C.20", "1/s", "largest gain of the attitude error")]
    C2_min: Annotated[float, Term("λ_min(C₂)", "C.22", "N·m·s/rad", "least gain of the rate error")]
    C2_max: Annotated[float, Term("λ_max(C₂)", "C.22", "N·m·s/rad", "largest gain of the rate error")]
    delta_eps: Annotated[float, Term("‖δ_ε‖", "C.28", "1", "quantization error of ε, from wire.attitude")]
    delta_omega: Annotated[float, Term("‖δ_ω‖", "C.29", "rad/s", "quantization error of ω, from wire.rate")]
    delta_u: Annotated[float, Term("‖δ_u‖", "C.30", "V", "quantization error of u, from wire.voltage")]
    k_omega_d: Annotated[float, Term("k_ω_d", "Assumption 1", "rad/s", "largest ‖ω_d‖ of the reference")]
    k_omega_d_dot: Annotated[float, Term("k_ω̇_d", "Assumption 1", "rad/s²", "largest ‖ω̇_d‖ of the reference")]
    half_angle_d: Annotated[float, Term("max ∡q_d/2", "C.16", "rad", "largest angle of the reference, halved")]
    half_angle_e: Annotated[float, Term("max ∡e/2", "Assumption 3", "rad", "assumed: 20° or that of the set, halved")]
    k_theta: Annotated[float, Term("max ‖θ‖", "Assumption 2", "N·m·s/rad", "assumed: by law.damping_bound")]
    k_theta_err: Annotated[float, Term("max ‖θ̃‖", "Remark 5", "N·m·s/rad", "θ by Assumption 2, θ̂ by the projection")]
    k_tau_d: Annotated[float, Term("k_τ_d", "C.78", "N·m", "largest ‖τ_d‖; 0 is Theorem 1")]


@dataclass(frozen=True)
class Lemma:
    """Right-hand sides of Lemma 1, (C.50)–(C.57), with (C.75) and their constants."""

    delta_q: Annotated[float, Term("k_ε‖δ_ε‖", "C.31", "1", "largest ‖q^Q − q‖")]
    k_eps: Annotated[float, Term("k_ε", "C.31", "1", "ratio of the errors of q and ε, at the body's largest angle")]
    k_omega_e: Annotated[float, Term("k_ω_e", "C.26", "1", "‖ω_e‖ ≤ k_ω_e ‖z‖")]
    delta_R: Annotated[float, Term("δ_R", "C.53, C.61", "1", "‖R_i^Q − R_i^b‖")]
    delta_omega_e: Annotated[float, Term("‖δ_ω_e‖", "C.50, C.58", "rad/s", "‖ω_e^Q − ω_e‖")]
    delta_z1: Annotated[float, Term("δ_z1", "C.52, C.60", "1", "‖G z₁ − G^Q z₁^Q‖, acting as N·m")]
    delta_z2: Annotated[float, Term("‖δ_z2‖", "C.51, C.59", "rad/s", "‖z₂^Q − z₂‖")]
    delta_Psi1: Annotated[float, Term("δ_Ψ1", "C.54, C.62", "N·m", "‖Ψ − Ψ^Q‖ at z = 0")]
    delta_Psi2: Annotated[float, Term("δ_Ψ2", "C.54, C.62", "N·m·s/rad", "its growth with ‖z‖")]
    delta_S1: Annotated[float, Term("δ_S1", "C.55, C.63", "rad/s", "‖S(ω)R_i^b − S(ω^Q)R_i^Q‖ at z = 0")]
    delta_S2: Annotated[float, Term("δ_S2", "C.55, C.63", "1", "its growth with ‖z‖")]
    delta_alpha1: Annotated[float, Term("δ_ᾱ1", "C.56, C.64", "rad/s²", "‖ᾱ^Q − α̇‖ at z = 0")]
    delta_alpha2: Annotated[float, Term("δ_ᾱ2", "C.56, C.64", "1/s", "its growth with ‖z‖")]
    delta_Phi: Annotated[float, Term("δ_ω", "C.57, C.65", "rad/s", "‖Φ − Φ^Q‖")]
    delta_Bu: Annotated[float, Term("δ_Bu", "C.75", "N·m", "torque of u's quantization error")]


@dataclass(frozen=True)
class Theorem:
    """Quantities of Theorem 1 and Corollary 1 by (C.77) for V of (C.24), (C.73); no `radius` where (C.66) fails."""

    c0: Annotated[float, Term("c₀", "C.66, as corrected", "N·m·s/rad", "min{λ_min(C₁)(1 + |η̃|)/2, λ_min(C₂)}")]
    delta_V1: Annotated[float, Term("δ_V1", "C.67", "N·m·s/rad", "loss of the damping c₀/2 by quantization")]
    delta_theta1: Annotated[float, Term("δ_θ1", "C.70, C.76", "W", "part of δ_Q due to θ̃")]
    delta_theta2: Annotated[float, Term("δ_θ2", "C.72, C.76", "N·m", "part of δ_V2 due to θ and θ̃")]
    delta_V2: Annotated[float, Term("δ_V2", "C.71", "N·m", "quantization's effect as a torque")]
    delta_Q: Annotated[float, Term("δ_Q", "C.69", "W", "constant of V̇ ≤ −k ‖z‖² + δ_Q without a disturbance")]
    delta_Qdist: Annotated[float, Term("δ_Qdist", "C.80", "W", "the same with the disturbance")]
    margin: Annotated[float, Term("c₀/2 − δ_V1", "C.66", "N·m·s/rad", "k, positive where the theorem holds")]
    radius: Annotated[float | None, Term("√(δ_Q/k)", "C.68, C.79", "1, rad/s", "mean ‖z‖ in continuous time, with τ_d")]


def lemma_1(p: Known) -> Lemma:
    """The δ of Lemma 1."""
    delta_q = attitude_error(p.delta_eps, min(pi / 2, p.half_angle_d + p.half_angle_e))  # (C.31), (C.33)
    k_omega_e = sqrt(1 + p.C1_max**2)  # (C.26), (C.27)
    delta_R = 2 * (delta_q + delta_q**2)  # (C.53), (C.61)
    delta_omega_e = delta_R * p.k_omega_d + p.delta_omega  # (C.50), (C.58)
    return Lemma(
        delta_q=delta_q,
        k_eps=delta_q / p.delta_eps if p.delta_eps else 1.0,
        k_omega_e=k_omega_e,
        delta_R=delta_R,
        delta_omega_e=delta_omega_e,
        delta_z1=delta_q,  # (C.52), (C.60)
        delta_z2=delta_omega_e + p.C1_max * delta_q,  # (C.51), (C.59)
        delta_Psi1=p.lambda_J * (2 * p.k_omega_d * p.delta_omega + p.delta_omega**2)
        + p.weight * delta_R,  # (C.54), (C.62)
        delta_Psi2=2 * p.lambda_J * p.delta_omega * k_omega_e,  # (C.62)
        delta_S1=p.k_omega_d * delta_R + p.delta_omega,  # (C.55), (C.63)
        delta_S2=k_omega_e * delta_R,  # (C.63)
        delta_alpha1=p.C1_max * delta_omega_e / 2,  # (C.56), (C.64)
        delta_alpha2=p.C1_max * delta_q * k_omega_e / 2,  # (C.64)
        delta_Phi=p.delta_omega,  # (C.57), (C.65)
        delta_Bu=p.delta_u * p.norm_B,  # (C.75)
    )


def attitude_error(delta_eps: float, half_angle: float) -> float:
    """The largest ‖q^Q − q‖, a bound of d_ε of (C.31) and of d_ε̃ of (C.33), for a body turned at most 2 `half_angle`.

    η = √(1 − ‖ε‖²) is steepest at large ‖ε‖, so its error is largest where ‖ε‖ is largest and ε^Q lies outside of it.
    Scaling to unit length (Remark 2) brings ε^Q nearer to ε.
    """
    outer = min(1.0, sin(half_angle) + delta_eps)
    inner = max(0.0, outer - delta_eps)
    return sqrt(delta_eps**2 + (sqrt(1 - inner**2) - sqrt(1 - outer**2)) ** 2)


def theorem_1(p: Known, d: Lemma) -> Theorem:
    """Condition and bounds of Theorem 1; with a disturbance, of Corollary 1."""
    least_share = (1 + cos(p.half_angle_e)) / 2  # ‖ε̃‖²/‖z₁‖²: 1 where e is small, ½ where η̃ = 0
    c0 = min(p.C1_min * least_share, p.C2_min)  # (C.66)
    delta_V1 = d.delta_Psi2 + d.delta_S2 * p.lambda_J * p.k_omega_d + d.delta_alpha2 * p.lambda_J  # (C.67)
    delta_theta1 = p.k_theta_err * d.delta_z2 * (p.delta_omega + p.k_omega_d)  # (C.70), (C.76)
    delta_theta2 = p.k_theta * p.delta_omega + p.k_theta_err * d.k_omega_e * d.delta_z2  # (C.72), (C.76)
    delta_V2 = (
        p.C2_max * d.delta_z2 + d.delta_z1 + d.delta_Psi1 + d.delta_S1 * p.lambda_J * p.k_omega_d
        + d.delta_R * p.lambda_J * p.k_omega_d_dot + d.delta_alpha1 * p.lambda_J + delta_theta2 + d.delta_Bu
    )  # (C.71)  # fmt: skip
    delta_Q = delta_theta1 + delta_V2**2 / (2 * c0)  # (C.69)
    delta_Qdist = delta_theta1 + (delta_V2 + p.k_tau_d) ** 2 / (2 * c0)  # (C.80)
    margin = c0 / 2 - delta_V1  # (C.66)
    radius = sqrt(delta_Qdist / margin) if margin > 0 else None  # (C.68), (C.79)
    return Theorem(c0, delta_V1, delta_theta1, delta_theta2, delta_V2, delta_Q, delta_Qdist, margin, radius)


# ── error coordinates at n instants ──


class Coordinates(NamedTuple):
    """The error coordinates of the law at n instants. `A` is η̃ I + S(ε̃)."""

    R: Floats  # R_i^b, (n, 3, 3)
    omega_e: Floats  # (n, 3)
    eps_e: Floats  # (n, 3)
    A: Floats  # (n, 3, 3)
    z1: Floats  # (n, 4)
    z2: Floats  # (n, 3)

    @property
    def norm(self) -> Floats:
        """‖z‖. Shape (n,)."""
        return norm(np.concatenate([self.z1, self.z2], axis=1))


def coordinates(q: Floats, omega: Floats, q_d: Floats, omega_d: Floats, sign: Floats, C1: Floats) -> Coordinates:
    """z₁, z₂ and their parts.

    Args:
        q: Attitude. Shape (n, 4).
        omega: ω, body frame [rad/s]. Shape (n, 3).
        q_d: Desired attitude. Shape (n, 4).
        omega_d: ω_d, inertial frame [rad/s]. Shape (n, 3).
        sign: ±1, the equilibrium that is approached. Shape (n,).
        C1: The gain's diagonal. Shape (3,) or (n, 3).
    """
    s = sign[:, None]
    eta, eps, eta_d, eps_d = q[:, :1], q[:, 1:], q_d[:, :1], q_d[:, 1:]
    eta_e = eta_d * eta + (eps_d * eps).sum(axis=1, keepdims=True)  # (C.16), (C.32)
    eps_e = eta_d * eps - eta * eps_d - np.cross(eps_d, eps)  # (C.16), (C.32)
    R = np.swapaxes(rotation(q), 1, 2)  # (C.48)
    omega_e = omega - times(R, omega_d)  # (C.18), (C.47)
    z1 = np.concatenate([1 - s * eta_e, eps_e], axis=1)  # (C.19), (C.39)
    z2 = omega_e + s * C1 * eps_e  # (C.19), (C.40); G z₁ = ±ε̃ by (C.49)
    return Coordinates(R, omega_e, eps_e, eta_e[:, :, None] * np.identity(3) + skew(eps_e), z1, z2)


def skew(v: Floats) -> Floats:
    """S(v) of (C.7) for each row. Shape (n, 3, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)


def rotation(q: Floats) -> Floats:
    """R(q) of (C.8) for each row: body to inertial. Shape (n, 3, 3)."""
    S = skew(q[:, 1:])
    return np.asarray(np.identity(3) + 2 * q[:, :1, None] * S + 2 * S @ S)


def times(matrices: Floats, vectors: Floats) -> Floats:
    """The matrix of each row times its vector, or times one common vector. Shape (n, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", matrices, np.broadcast_to(vectors, matrices.shape[:2])))


def norm(errors: Floats) -> Floats:
    """Length of each vector, or induced norm of each matrix. Shape (n,)."""
    return np.asarray(np.linalg.norm(errors, 2, axis=1 if errors.ndim == 2 else (1, 2)))
