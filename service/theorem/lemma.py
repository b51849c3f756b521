"""Lemma 1, (C.50)–(C.57), sample by sample: both sides of each inequality, for true and received states.

With the true state, from an emulator's log or a simulation, this shows whether the bounds hold; all sides are computed
for thousands of samples at once. The premises (C.28) and (C.29) are evaluated too: a log breaks those first if its
sensors err by more than the quantizers. The Lyapunov function is here because it uses the same coordinates.

    symbol   name in code     unit, shape        symbol   name in code     unit, shape
    q, ω     q, omega         1, rad/s; (n, 4)   z₁, z₂   z1, z2           1 (n, 4), rad/s (n, 3)
    q^Q, ω^Q q_Q, omega_Q     the same           ω_e      omega_e          rad/s (n, 3)
    q_d, ω_d q_d, omega_d     ω_d inertial       R_i^b    R                1 (n, 3, 3)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.theorem.bounds import Known, Lemma

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """True states of the body and the states as received, at n instants.

    Attributes:
        q: True attitude, unit length, of either sign. Shape (n, 4).
        omega: True angular velocity, body frame [rad/s]. Shape (n, 3).
        q_Q: Attitude as received, scaled by Remark 2, with the sign chosen by the law. Shape (n, 4).
        omega_Q: Angular velocity as received [rad/s]. Shape (n, 3).
        q_d: Desired attitude. Shape (n, 4).
        omega_d: Desired angular velocity, inertial frame [rad/s]. Shape (n, 3).
        sign: ±1, the equilibrium approached. Shape (n,).
    """

    q: Floats
    omega: Floats
    q_Q: Floats
    omega_Q: Floats
    q_d: Floats
    omega_d: Floats
    sign: Floats


@dataclass(frozen=True)
class Inequality:
    """One inequality at n instants.

    Attributes:
        equation: Its number.
        what: Its left-hand side, in the paper's symbols.
        left: Shape (n,).
        right: Shape (n,).
    """

    equation: str
    what: str
    left: Floats
    right: Floats

    @property
    def broken(self) -> NDArray[np.bool_]:
        """Where it does not hold, beyond rounding. Shape (n,)."""
        return self.left > self.right * (1 + 1e-9) + 1e-12


@dataclass(frozen=True)
class Coordinates:
    """The error coordinates of the law at n instants; see the module's table. `A` is η̃ I + S(ε̃)."""

    R: Floats
    omega_e: Floats
    eps_e: Floats
    A: Floats
    z1: Floats
    z2: Floats

    @property
    def norm(self) -> Floats:
        """‖z‖. Shape (n,)."""
        return norm(np.concatenate([self.z1, self.z2], axis=1))


def coordinates(q: Floats, omega: Floats, q_d: Floats, omega_d: Floats, sign: Floats, C1: Floats) -> Coordinates:
    """z₁, z₂ and their parts; arguments as in `Samples`, C1 the gain's diagonal. Shape (3,)."""
    s = sign[:, None]
    eta, eps, eta_d, eps_d = q[:, :1], q[:, 1:], q_d[:, :1], q_d[:, 1:]
    eta_e = eta_d * eta + (eps_d * eps).sum(axis=1, keepdims=True)  # (C.16), (C.32)
    eps_e = eta_d * eps - eta * eps_d - np.cross(eps_d, eps)  # (C.16), (C.32)
    R = np.swapaxes(rotation(q), 1, 2)  # (C.48)
    omega_e = omega - times(R, omega_d)  # (C.18), (C.47)
    z1 = np.concatenate([1 - s * eta_e, eps_e], axis=1)  # (C.19), (C.39)
    z2 = omega_e + s * C1 * eps_e  # (C.19), (C.40); G z₁ = ±ε̃ by (C.49)
    return Coordinates(R, omega_e, eps_e, eta_e[:, :, None] * np.identity(3) + skew(eps_e), z1, z2)


def lemma_inequalities(samples: Samples, law: AdaptiveSettings, p: Known, d: Lemma) -> list[Inequality]:
    """Both sides of the premises (C.28), (C.29), of (C.26), (C.27) and of every inequality of Lemma 1."""
    C1, J = np.array(law.C1), np.array(law.inertia)
    r_g, f_g = np.array(law.centre_of_mass), np.array([0.0, 0.0, -law.mass * law.gravity])
    x = samples
    q = x.q * np.where((x.q * x.q_Q).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)  # q and −q are the same attitude
    b = coordinates(q, x.omega, x.q_d, x.omega_d, x.sign, C1)
    Q = coordinates(x.q_Q, x.omega_Q, x.q_d, x.omega_d, x.sign, C1)
    z = b.norm
    one = np.ones_like(z)

    def Psi(omega: Floats, R: Floats) -> Floats:  # noqa: N802  # the paper's letter
        Psi: Floats = -np.cross(omega, J * omega) + np.cross(r_g, times(R, f_g))  # (C.43), (C.45)
        return Psi

    def alpha_bar(c: Coordinates) -> Floats:
        alpha_dot: Floats = -x.sign[:, None] / 2 * C1 * times(c.A, c.omega_e)  # (C.46); of the true state it is α̇
        return alpha_dot

    Psi_error = Psi(x.omega, b.R) - Psi(x.omega_Q, Q.R)
    S_error = skew(x.omega) @ b.R - skew(x.omega_Q) @ Q.R
    return [
        Inequality("C.28", "‖ε^Q − ε‖", norm((x.q_Q - q)[:, 1:]), p.delta_eps * one),  # (C.28)
        Inequality("C.29", "‖ω^Q − ω‖", norm(x.omega_Q - x.omega), p.delta_omega * one),  # (C.29)
        Inequality("C.26", "‖ω_e‖", norm(b.omega_e), d.k_omega_e * z),  # (C.26)
        Inequality("C.27", "‖ω‖", norm(x.omega), d.k_omega_e * z + p.k_omega_d),  # (C.27)
        Inequality("C.50", "‖ω_e^Q − ω_e‖", norm(Q.omega_e - b.omega_e), d.delta_omega_e * one),  # (C.50)
        Inequality("C.51", "‖z₂^Q − z₂‖", norm(Q.z2 - b.z2), d.delta_z2 * one),  # (C.51)
        Inequality("C.52", "‖G z₁ − G^Q z₁^Q‖", norm(b.eps_e - Q.eps_e), d.delta_z1 * one),  # (C.52)
        Inequality("C.53", "‖R_i^Q − R_i^b‖", norm(Q.R - b.R), d.delta_R * one),  # (C.53)
        Inequality("C.54", "‖Ψ − Ψ^Q‖", norm(Psi_error), d.delta_Psi1 + d.delta_Psi2 * z),  # (C.54)
        Inequality("C.55", "‖S(ω)R_i^b − S(ω^Q)R_i^Q‖", norm(S_error), d.delta_S1 + d.delta_S2 * z),  # (C.55)
        Inequality(
            "C.56", "‖ᾱ^Q − α̇‖", norm(alpha_bar(Q) - alpha_bar(b)), d.delta_alpha1 + d.delta_alpha2 * z
        ),  # (C.56)
        Inequality("C.57", "‖Φ − Φ^Q‖", np.abs(x.omega_Q - x.omega).max(axis=1), d.delta_Phi * one),  # (C.57)
    ]


def lyapunov(c: Coordinates, theta_error: Floats, law: AdaptiveSettings) -> Floats:
    """V of the true state.

    Args:
        c: The error coordinates.
        theta_error: θ̃ = θ − θ̂ [N·m·s/rad]. Shape (n, 3).
        law: The model and the gains.

    Returns:
        V, with z₁ weighed by an implied 1 N·m [N·m]. Shape (n,).
    """
    J, Gamma = np.array(law.inertia), np.array(law.Gamma)
    V: Floats = (c.z1**2).sum(axis=1) + (c.z2**2 @ J + theta_error**2 @ (1 / Gamma)) / 2  # (C.24), (C.73)
    return V


def skew(v: Floats) -> Floats:
    """S(v) of (C.7) for each row. Shape (n, 3, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)


def rotation(q: Floats) -> Floats:
    """R(q) of (C.8) for each row: body to inertial. Shape (n, 3, 3)."""
    S = skew(q[:, 1:])
    R: Floats = np.identity(3) + 2 * q[:, :1, None] * S + 2 * S @ S
    return R


def times(matrices: Floats, vectors: Floats) -> Floats:
    """The matrix of each row times its vector, or times one common vector. Shape (n, 3)."""
    product: Floats = np.einsum("nij,nj->ni", matrices, np.broadcast_to(vectors, matrices.shape[:2]))
    return product


def norm(errors: Floats) -> Floats:
    """Length of each vector, or induced norm of each matrix. Shape (n,)."""
    axes = tuple(range(1, errors.ndim))
    lengths: Floats = np.linalg.norm(errors, 2, axis=axes if len(axes) > 1 else 1)
    return lengths
