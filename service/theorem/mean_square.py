"""Decay of V along a run of the configured plant: k and δ of V̇ ≤ −k ‖z‖² + δ, while ‖z‖ stays within a size.

The paper's δ_Qdist (C.80) is of a body with three motors, perfect sensors and a law in continuous time. Here sensors
err beyond the quantizers, commands are of age T, and a mechanism may hold the roll; what grows with ‖z‖ is bounded by
the size of ‖z‖ that a log shows. Then, for every run that keeps the premises from t₀ to t,

    ∫ k ‖z‖² dt ≤ V(t₀) + ∫ δ dt

Age: the torque differs by `stale_torque`, and the noise by δ_V1 T ‖ż‖, since z grew by as much; `stale_power` adds what
the adaptation's steps do.

Held roll: `mechanism_torque`.
"""

from __future__ import annotations

from dataclasses import replace
from math import asin, hypot, isfinite, pi, sin, sqrt
from typing import Final, NamedTuple

from aeroloop.service.theorem.bounds import lemma_1, theorem_1
from aeroloop.service.theorem.evaluation import Evaluated
from aeroloop.service.theorem.invariant import Premises, fastest_estimate, stale_power, stale_torque

_MOST_ITERATIONS: Final = 1000
_AGREED: Final = 1e-9
_FASTEST: Final = 1e6
"""ż₂ beyond which no bound is sought [rad/s²]."""


class Decay(NamedTuple):
    """V̇ ≤ −k ‖z‖² + δ, and the errors of the measurements that it counts on.

    Attributes:
        k: [N·m·s/rad].
        delta: δ [W].
        delta_eps: Largest ‖ε^Q − ε‖ [1].
        delta_omega: Largest ‖ω^Q − ω‖ [rad/s].
    """

    k: float
    delta: float
    delta_eps: float
    delta_omega: float


def decay(e: Evaluated, seen: float) -> Decay | None:
    """k and δ of the configured plant while ‖z^Q‖ ≤ `seen` at every tick; None where V need not decrease.

    Without noise ‖z‖ would be `seen`. It is at most that, the quantization's part of z, and what z changes by within
    the age of a command; the last depends on ‖ż‖, and that on the torques, so all are iterated to their fixed point.

    Args:
        e: The quantities of the certificate.
        seen: Largest ‖z^Q‖ [1, rad/s].
    """
    p = e.plant
    c1, c2 = max(p.C1), max(p.C2)
    size, z2_dot = seen, 0.0
    for _ in range(_MOST_ITERATIONS):
        omega_e = hypot(1, c1) * size  # (C.26)
        omega = p.k_omega_d + omega_e  # (C.27)
        z_dot = hypot(omega_e / 2, z2_dot)
        omega_dot = z2_dot + c1 * omega_e / 2 + p.k_omega_d_dot + omega_e * p.k_omega_d
        delta_omega = p.delta_omega + p.rate_lag * omega_dot
        delta_eps = e.known.delta_eps + sqrt(3) * e.bounds.delta_eps
        known = replace(e.known, delta_eps=delta_eps, delta_omega=delta_omega, k_tau_d=p.k_tau_d)
        lemma = lemma_1(known)
        omega_Q, z2_Q = omega + delta_omega, size + lemma.delta_z2  # the paper's letters
        theta_dot = fastest_estimate(p, omega_Q, z2_Q)
        hold = stale_torque(p, omega, omega, omega_e, z2_dot, theta_dot)
        if p.tilt is not None:
            hold += mechanism_torque(p, size, omega_Q, z2_dot)
        margin = theorem_1(known, lemma)
        hold += margin.delta_V1 * p.age * z_dot
        theorem = theorem_1(replace(known, hold=hold), lemma)
        if theorem.k is None:
            return None
        noise = theorem.delta_V2 + theorem.delta_V1 * size + p.k_tau_d + hold
        next_dot = (hypot(1, c2) * size + p.theta_error * omega_Q + noise) / min(p.J)
        next_size = seen + hypot(lemma.delta_z1, lemma.delta_z2) + p.age * z_dot
        if next_dot <= z2_dot * (1 + _AGREED) and next_size <= size * (1 + _AGREED):
            power = stale_power(p, z2_dot, omega_dot, omega_Q, z2_Q, lemma.delta_z2)
            return Decay(theorem.k, theorem.delta_Qdist + power, delta_eps, delta_omega)
        z2_dot, size = next_dot, next_size
        if not isfinite(z2_dot) or z2_dot > _FASTEST:
            return None
    return None


def mechanism_torque(p: Premises, size: float, omega: float, z2_dot: float) -> float:
    """What a mechanism that holds the roll adds to the disturbance of (C.80), per ‖z‖, while ‖z‖ is within a size.

    The attitude is R_z(yaw) R_y(pitch), so ω = ṗ e₂ + ẏ m with m = (−sin p, 0, cos p). The mechanism's torque λ n acts
    along n = (cos p, 0, sin p), and instead of the law's torque τ only (0, τ₂, τ₃) is applied. With e the noise, and
    e₁ = cos p n − sin p m, the closed loop J ż₂ = −ε̃ − C₂ z₂ + Φ^Q θ̃ + e' has

        e'·m = cos p e₃ + sin p τ₁      e'·n = n·(J ż₂ + ε̃ + C₂ z₂ − Φ^Q θ̃)

    with τ₁ of the law without noise: what noise there is along e₁ is not applied. So V̇ has, beyond ‖z₂‖ ‖e‖, at most
    ‖z₂‖ sin p |τ₁| + |n·z₂| |e'·n|. As n·ω = 0, as ω_d has no roll, and with Δ the errors of pitch and yaw,

        n·ε̃ = ± sin(Δ_y/2) sin(Δ_p/2)         |n·ε̃| ≤ 1 − |η̃| = ‖z₁‖²/2
        n·ω_e = ± sin Δ_y ṗ_d                 |n·ω_e| ≤ 2 ‖ε̃‖ k_ω_d
        n·ω̇_e = −ṗ m·ω_e ± d/dt(sin Δ_y ṗ_d)  |n·ω̇_e| ≤ (‖ω‖ + k_ω_d) ‖ω_e‖ + 2 ‖ε̃‖ k_ω̇_d

    the first since a = sin²(Δ_y/2), b = sin²(Δ_p/2) have a + b − ab = ‖ε̃‖², where √(ab) is largest at a = b; the last
    as Δ̇_y = m·ω_e. So |n·z₂| ≤ κ ‖z‖, and n·J ż₂ follows from n·ω̇_e and n·C₁ ε̃' = C₁/2 (η̃ n·ω_e + n·(ε̃ × ω_e)). A
    diagonal D is not D_x I: ‖D n − D_x n‖ ≤ |D_z − D_x| sin p adds to each.

    Args:
        p: Premises, of a held roll.
        size: Largest ‖z‖ [1, rad/s].
        omega: Largest ‖ω^Q‖ [rad/s].
        z2_dot: Largest ‖ż₂‖ [rad/s²].

    Returns:
        [N·m].
    """
    assert p.tilt is not None
    sine = sin(min(pi / 2, p.tilt + 2 * asin(min(1.0, size))))
    j, c1, c2, spread = max(p.J), max(p.C1), max(p.C2), max(p.J) - min(p.J)
    uneven_J, uneven_C1, uneven_C2 = (sine * abs(D[2] - D[0]) for D in (p.J, p.C1, p.C2))
    omega_e = hypot(1, c1) * size
    roll = (
        hypot(1, c2) * size
        + p.k_theta_hat * omega
        + p.weight_roll + spread * omega**2
        + j * (p.k_omega_d_dot + p.k_omega_d * omega_e + c1 * omega_e / 2)
    )  # fmt: skip
    along = 2 * p.k_omega_d + c1 * size / 2 + uneven_C1  # κ
    across = (
        j * (2 * size * p.k_omega_d_dot + (p.k_omega_d + omega) * omega_e)
        + (j * c1 * size / 2) * (2 * p.k_omega_d + omega_e) + j * uneven_C1 * omega_e / 2
        + uneven_J * z2_dot
        + size**2 / 2
        + c2 * along * size + uneven_C2 * size
        + p.theta_error * omega
    )  # fmt: skip
    return sine * roll + min(1.0, along) * across
