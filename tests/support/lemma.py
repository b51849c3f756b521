"""Lemma 1 sample by sample: both sides of each inequality, for true and received states."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.reference import Floats
from aeroloop.service.theorem.bounds import Known, Lemma, coordinates, norm, skew, times


class Samples(NamedTuple):
    """True states of the body and the states as received, at n instants; rates in rad/s."""

    q: Floats  # true attitude, of either sign, (n, 4)
    omega: Floats  # true ω, body frame, (n, 3)
    q_Q: Floats  # attitude as received, scaled by Remark 2, with the sign chosen by the law, (n, 4)
    omega_Q: Floats  # ω as received, (n, 3)
    q_d: Floats  # desired attitude, (n, 4)
    omega_d: Floats  # ω_d, inertial frame, (n, 3)
    sign: Floats  # ±1, the equilibrium approached, (n,)


class Inequality(NamedTuple):
    """One inequality at n instants: its number, its left-hand side in the paper's symbols, both sides (n,)."""

    equation: str
    what: str
    left: Floats
    right: Floats

    @property
    def broken(self) -> NDArray[np.bool_]:
        """Where it does not hold, beyond rounding. Shape (n,)."""
        return self.left > self.right * (1 + 1e-9) + 1e-12


def lemma_inequalities(samples: Samples, law: AdaptiveSettings, p: Known, d: Lemma) -> list[Inequality]:
    """Both sides of the premises (C.28), (C.29), of (C.26), (C.27) and of every inequality of Lemma 1."""
    C1, J = np.array(law.C1), np.array(law.inertia)
    r_g, f_g = np.array(law.centre_of_mass), np.array([0.0, 0.0, -law.mass * law.gravity])
    x = samples
    q = x.q * np.where((x.q * x.q_Q).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)  # q and −q are the same attitude
    b = coordinates(q, x.omega, x.q_d, x.omega_d, x.sign, C1)
    Q = coordinates(x.q_Q, x.omega_Q, x.q_d, x.omega_d, x.sign, C1)
    z = b.norm

    def Psi(omega: Floats, R: Floats) -> Floats:  # noqa: N802  # the paper's letter
        return np.asarray(-np.cross(omega, J * omega) + np.cross(r_g, times(R, f_g)))  # (C.43), (C.45)

    alpha_dot, alpha_bar = (-x.sign[:, None] / 2 * C1 * times(c.A, c.omega_e) for c in (b, Q))  # (C.46)
    S_error = skew(x.omega) @ b.R - skew(x.omega_Q) @ Q.R
    sides: dict[str, tuple[str, Floats, Floats | float]] = {  # premises (C.28), (C.29), then (C.26), (C.27) and Lemma 1
        "C.28": ("‖ε^Q − ε‖", (x.q_Q - q)[:, 1:], p.delta_eps),  # (C.28)
        "C.29": ("‖ω^Q − ω‖", x.omega_Q - x.omega, p.delta_omega),  # (C.29)
        "C.26": ("‖ω_e‖", b.omega_e, d.k_omega_e * z),  # (C.26)
        "C.27": ("‖ω‖", x.omega, d.k_omega_e * z + p.k_omega_d),  # (C.27)
        "C.50": ("‖ω_e^Q − ω_e‖", Q.omega_e - b.omega_e, d.delta_omega_e),  # (C.50)
        "C.51": ("‖z₂^Q − z₂‖", Q.z2 - b.z2, d.delta_z2),  # (C.51)
        "C.52": ("‖G z₁ − G^Q z₁^Q‖", b.eps_e - Q.eps_e, d.delta_z1),  # (C.52)
        "C.53": ("‖R_i^Q − R_i^b‖", Q.R - b.R, d.delta_R),  # (C.53)
        "C.54": ("‖Ψ − Ψ^Q‖", Psi(x.omega, b.R) - Psi(x.omega_Q, Q.R), d.delta_Psi1 + d.delta_Psi2 * z),  # (C.54)
        "C.55": ("‖S(ω)R_i^b − S(ω^Q)R_i^Q‖", S_error, d.delta_S1 + d.delta_S2 * z),  # (C.55)
        "C.56": ("‖ᾱ^Q − α̇‖", alpha_bar - alpha_dot, d.delta_alpha1 + d.delta_alpha2 * z),  # (C.56)
        "C.57": ("‖Φ − Φ^Q‖", np.abs(x.omega_Q - x.omega).max(axis=1, keepdims=True), d.delta_Phi),  # (C.57)
    }
    return [
        Inequality(n, what, norm(error), np.broadcast_to(most, z.shape)) for n, (what, error, most) in sides.items()
    ]
