"""Invariant set of z: a pointwise bound, from the error equations with Φ θ̃ as a bounded disturbance.

V of (C.73) contains θ̃, which need not decrease, so that V's level sets bound ‖z‖ poorly. Here the projection alone
bounds θ̃, and the linear part of the error equations is solved instead. README.md derives every step.

With ε̃, z₂ of the nearer equilibrium, w_s the slow disturbance −diag(R_d ω_d) θ̃ and K w_s the error at which the law
balances it, x = (ε̄, z̄) = (ε̃, z₂) − K w_s obeys, for each axis,

    ε̄' = −C₁/2 ε̄ + z̄/2 + d₁              ‖d₁‖ ≤ D₁
    J z̄' = −φ (ε̄ + C₂ z̄) + d₂            ‖d₂‖ ≤ D₂

and φ is 1, or for a body whose roll is held the mean share of the yaw's torque that two motors produce. By variation
of constants, every x that starts from ‖x(t₀)‖ ≤ r obeys at all t ≥ t₀, for h = (1, 0), (0, 1), (−C₁, 1), (1, C₂),

    ‖h x(t)‖ ≤ r sup ‖h e^{As}‖ + D₁ ∫‖h e^{As} E₁‖ ds + D₂ ∫‖h e^{As} E₂‖ ds

D₁ and D₂ are bounds for all x within these limits, and grow with them; where the least fixed point exists, it holds for
all times. With r = 0 it is the set that x approaches and never leaves: the states reachable from 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import asin, cos, hypot, inf, isfinite, pi, sin, sqrt, tan
from typing import Final

import numpy as np

from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.theorem.lemma import Coordinates, Floats, norm
from aeroloop.service.theorem.linear import gains_of

_MOST_ITERATIONS: Final = 300
_INFLATED: Final = 1.001
"""Each guess of the fixed point is raised by this, so that one that holds is found soon; the bound is as much wider."""


@dataclass(frozen=True)
class Premises:
    """What the set is computed from. Letters as in `bounds`; vectors are diagonals.

    Attributes:
        C1: Gain of the attitude error [1/s].
        C2: Gain of the rate error [N·m·s/rad].
        Gamma: Adaptation gain.
        J: Inertia [kg·m²].
        k_theta: Bound of ‖θ‖ [N·m·s/rad].
        k_theta_hat: Bound of ‖θ̂‖ [N·m·s/rad].
        weight: ‖r_g‖ m g [N·m].
        weight_roll: |r_g,y| m g: the weight's torque about the held roll [N·m].
        norm_B: ‖B‖ [N·m/V].
        delta_omega: Largest ‖ω^Q − ω‖, without the sensor's lag [rad/s].
        delta_u: Largest ‖u^Q − u‖ [V].
        k_omega_d: Largest ‖ω_d‖ [rad/s].
        k_omega_d_dot: Largest ‖ω̇_d‖ [rad/s²].
        k_omega_d_ddot: Largest ‖ω̈_d‖ [rad/s³].
        axis_rate: Largest element of ω_d in the desired body frame [rad/s].
        half_angle_d: Half the largest angle of q_d [rad].
        delta_q: Largest ‖q^Q − q‖ where the attitude errs by half an angle [rad].
        age: Longest time from a measurement to the end of its command's effect [s].
        rate_lag: Mean delay of the rate sensor's filter [s].
        k_tau_d: Largest disturbance torque [N·m].
        tilt: Largest pitch of the reference if the body's roll is held by a mechanism; None if three motors act [rad].
    """

    C1: Vector
    C2: Vector
    Gamma: Vector
    J: Vector
    k_theta: float
    k_theta_hat: float
    weight: float
    weight_roll: float
    norm_B: float
    delta_omega: float
    delta_u: float
    k_omega_d: float
    k_omega_d_dot: float
    k_omega_d_ddot: float
    axis_rate: float
    half_angle_d: float
    delta_q: Callable[[float], float]
    age: float
    rate_lag: float
    k_tau_d: float
    tilt: float | None

    @property
    def theta_error(self) -> float:
        """Largest ‖θ̃‖ [N·m·s/rad]."""
        return self.k_theta + self.k_theta_hat

    @property
    def axes(self) -> tuple[Vector, ...]:
        """(C₁, C₂, J) of each axis that differs; with a held roll the axes mix, and their means stand for all."""
        if self.tilt is None:
            return tuple(dict.fromkeys(zip(self.C1, self.C2, self.J, strict=True)))
        return ((_mean(self.C1), _mean(self.C2), max(self.J)),)

    @property
    def share(self) -> float:
        """φ: the mean share of a yaw torque that the motors produce along the reference [1]."""
        return 1.0 if self.tilt is None else (1 + cos(self.tilt) ** 2) / 2


@dataclass(frozen=True)
class Reach:
    """What z and the command reach, at all times after a start with ‖x‖ ≤ r.

    Attributes:
        start: r [1, rad/s].
        radius: Largest ‖z‖ [1, rad/s].
        eps_bar: Largest ‖ε̄‖ [1].
        torque: Largest ‖ε̄ + C₂ z̄‖ [N·m].
        eps_e: Largest ‖ε̃‖ [1].
        z2: Largest ‖z₂‖ [rad/s].
        omega_e: Largest ‖ω_e‖ [rad/s].
        axis_rate: Largest |ω_k| [rad/s].
        half_angle: Half the body's largest angle [rad].
        slow: Largest ‖w_s‖ [N·m].
        fast: Largest torque of quantization, hold, lag, sensors and disturbance [N·m].
        hold: The part of it that comes from the age of the command [N·m].
        power: Power by which the adaptation, held for a period, is out of date [W].
        z_dot: Largest ‖ż‖ [1/s, rad/s²].
        D1: Bound of d₁ [1/s].
        D2: Bound of d₂ [N·m].
        deviation: Largest torque of the command beyond that of the reference [N·m].
    """

    start: float = 0.0
    radius: float = 0.0
    eps_bar: float = 0.0
    torque: float = 0.0
    eps_e: float = 0.0
    z2: float = 0.0
    omega_e: float = 0.0
    axis_rate: float = 0.0
    half_angle: float = 0.0
    slow: float = 0.0
    fast: float = 0.0
    hold: float = 0.0
    power: float = 0.0
    z_dot: float = 0.0
    D1: float = 0.0
    D2: float = 0.0
    deviation: float = 0.0


def without_error(p: Premises) -> Reach:
    """What is reached along the reference if quantization is the only error: a part of every set."""
    c1, c2 = max(p.C1), max(p.C2)
    torque = p.delta_q(0.0) * (1 + c1 * c2) + c2 * p.delta_omega
    return Reach(axis_rate=p.axis_rate, half_angle=p.half_angle_d, fast=torque, deviation=torque)


def reach(p: Premises, start: float = 0.0) -> Reach | None:
    """The least bounds that hold at all times after ‖x‖ ≤ `start`; None where none is proven."""
    gains = gains_of(p.axes, p.share)
    if gains is None:
        return None
    D1 = D2 = eps_e = 0.0
    for _ in range(_MOST_ITERATIONS):  # bounds grow with D₁ and D₂, and those with the bounds: from 0 to the least
        sizes = [g.start * start + g.d1 * D1 + g.d2 * D2 for g in gains]
        found = _disturbances(p, start, eps_e, *sizes)
        if found is None:
            return None
        now = found.D1, found.D2, found.eps_e
        if all(new <= old for new, old in zip(now, (D1, D2, eps_e), strict=True)):
            return found
        D1, D2, eps_e = (_INFLATED * value for value in now)
    return None


def largest_start(p: Premises) -> float:
    """The largest ‖x(t₀)‖ from which the set is reached, within one percent; 0 if there is no set."""
    if reach(p) is None:
        return 0.0
    low, high = 0.0, 1e-3
    while high < 10 and reach(p, high) is not None:
        low, high = high, 2 * high
    while high - low > 0.01 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if reach(p, middle) is not None else (low, middle)
    return low


def distance(p: Premises, c: Coordinates, sign: Floats, theta_error: Floats, desired_rate: Floats) -> Floats:
    """‖x‖ at n instants, or a bound of it where the roll is held.

    Args:
        p: Premises.
        c: The error coordinates.
        sign: ±1, the equilibrium approached. Shape (n,).
        theta_error: θ̃ [N·m·s/rad]. Shape (n, 3).
        desired_rate: ω_d in the desired body frame [rad/s]. Shape (n, 3).
    """
    eps, C1, C2 = sign[:, None] * c.eps_e, np.array(p.C1), np.array(p.C2)
    if p.tilt is None:
        balance = -desired_rate * theta_error / (1 + C1 * C2)
        return norm(np.hstack([eps - balance, c.z2 - C1 * balance]))
    farthest = reach(p, largest_start(p))
    shift = max(hypot(1, c1) / (1 + c1 * c2) for c1, c2, _ in p.axes)
    return norm(np.hstack([eps, c.z2])) + (inf if farthest is None else shift * farthest.slow)


def _disturbances(
    p: Premises, start: float, eps_e: float, eps_bar: float, z_bar: float, omega_e: float, torque: float, x: float
) -> Reach | None:
    """D₁ and D₂ while ε̄, z̄, ω_e, ε̄ + C₂ z̄ and x are within these sizes; None beyond what is proven."""
    axes, theta = p.axes, p.theta_error
    j, jmin = max(p.J), min(p.J)
    c1, c2, spread = max(p.C1), max(p.C2), j - jmin
    kappa1 = max(1 / (1 + a * b) for a, b, _ in axes)
    kappa2 = max(a / (1 + a * b) for a, b, _ in axes)

    if not eps_e < sin(pi / 4):
        return None
    held = p.tilt is not None
    pitch = 0.0 if p.tilt is None else p.tilt + 2 * asin(eps_e)  # a held roll: the pitch errs by no more than this
    if not pitch < pi / 2:
        return None
    phi, sine = cos(pitch) ** 2, sin(pitch)
    # The slow disturbance: w_s = −diag(R_d ω_d) θ̃, and with a held roll what u₁ should have added to the yaw.
    roll = (p.k_theta_hat * p.k_omega_d + j * p.k_omega_d_dot + p.weight_roll) if held else 0.0
    push = theta * p.axis_rate + sine * roll
    slow = push / phi
    needed = eps_bar + kappa1 * slow
    eps_e = max(eps_e, needed)
    if not eps_e < sin(pi / 4):
        return None
    turned = 2 * eps_e * p.k_omega_d  # ‖R ω_d − R_d ω_d‖
    axis = p.axis_rate + turned
    z2 = z_bar + kappa2 * slow
    zeta = 2 * sin(asin(eps_e) / 2)  # ‖z₁‖
    omega, axis_omega = p.k_omega_d + omega_e, axis + omega_e
    half_angle = min(pi / 2, p.half_angle_d + asin(eps_e))
    delta_q = p.delta_q(asin(eps_e))
    delta_R = 2 * delta_q

    z2_dot = 0.0
    for _ in range(_MOST_ITERATIONS):
        omega_e_dot = z2_dot + c1 * omega_e / 2
        omega_dot = omega_e_dot + p.k_omega_d_dot + omega_e * p.k_omega_d
        delta_omega = p.delta_omega + p.rate_lag * omega_dot
        delta_omega_e = delta_omega + delta_R * p.k_omega_d
        delta_z2 = delta_omega_e + c1 * delta_q
        if (c1, c2) == (min(p.C1), min(p.C2)):  # ε̃ and C₂ z₂; parts of one error at right angles to each other
            of_state = delta_q * hypot(1 + c1 * c2, (1 + c1 * c2) * eps_e + 2 * c2 * p.k_omega_d)
            of_state += delta_q**2 * ((1 + c1 * c2) * eps_e / 2 + 2 * c2 * p.k_omega_d)
        else:
            of_state = delta_q * (1 + c1 * c2 + 2 * c2 * p.k_omega_d)
        noise = (
            of_state + c2 * delta_omega
            + p.k_theta_hat * delta_omega  # Φ^Q θ̂
            + p.weight * delta_R + spread * (2 * omega * delta_omega + delta_omega**2)  # Ψ
            + j * ((omega * delta_R + delta_omega) * p.k_omega_d + delta_R * p.k_omega_d_dot)
            + j * c1 / 2 * (delta_omega_e + delta_q * omega_e)  # ᾱ
            + p.norm_B * p.delta_u
        )  # fmt: skip
        theta_dot = fastest_estimate(p, axis_omega + delta_omega, z2 + delta_z2)
        hold = stale_torque(p, omega, axis_omega, omega_e, z2_dot, theta_dot)
        fast = noise + hold + theta * turned + p.k_tau_d
        if held:  # what u₁ should have added to the yaw, beyond the slow part and the feedback that φ counts
            rest = p.k_theta_hat * omega_e + j * (omega_e * p.k_omega_d + c1 * omega_e / 2) + spread * omega**2
            fast += sine * rest
        next_dot = (torque + theta * omega_e + fast) / jmin
        if next_dot <= z2_dot:
            break
        z2_dot = _INFLATED * next_dot
        if not isfinite(z2_dot) or z2_dot > 1e6:
            return None
    else:
        return None

    power = stale_power(p, z2_dot, omega_dot, omega + delta_omega, z2 + delta_z2, delta_z2)
    push_dot = theta * p.k_omega_d_dot + p.axis_rate * theta_dot
    D2 = fast + theta * omega_e + max(1 - p.share, p.share - phi) * torque  # θ̃ acts on ω_e; φ beside its mean
    if held:
        pitch_rate = axis_omega
        roll_dot = (
            p.k_theta_hat * (p.k_omega_d_dot + omega_e * p.k_omega_d)
            + theta_dot * axis
            + j * (p.k_omega_d_ddot + omega * p.k_omega_d_dot)
            + p.weight_roll * omega
        )
        push_dot += sine * roll_dot + pitch_rate * roll
        push_dot = push_dot / phi + push * pitch_rate * (2 * tan(pitch) + 2) / phi
        second = eps_e**2 / (2 * (1 - eps_e**2))  # |n·ε̃|, n the axis that the mechanism holds
        across = (
            j * (p.k_omega_d_dot * 2 * eps_e + (p.k_omega_d + omega) * omega_e)
            + j * c1 / 2 * (p.k_omega_d * 2 * eps_e + zeta * omega_e)
            + second
            + c2 * (p.k_omega_d * 2 * eps_e + c1 * second)
        )
        D2 = hypot(D2, across) + (j / jmin - 1) * (torque + theta * omega_e + fast)
        D2 += (max(p.C2) - min(p.C2)) * z2
    D1 = zeta * omega_e / 2 + kappa1 * push_dot
    if held:
        D1 += (max(p.C1) - min(p.C1)) / 2 * eps_e
    D2 += j * kappa2 * push_dot
    deviation = (
        torque + slow + fast + p.k_theta_hat * axis_omega + p.weight * 2 * eps_e
        + j * (c1 * omega_e / 2 + omega_e * p.k_omega_d + 2 * eps_e * p.k_omega_d_dot)
        + spread * omega**2
    )  # fmt: skip
    largest = max(hypot(1.0, a) / (1 + a * b) for a, b, _ in axes) * slow + x
    return Reach(
        start=start,
        radius=sqrt(largest**2 + zeta**2 - eps_e**2),
        eps_bar=eps_bar,
        torque=torque,
        eps_e=needed,
        z2=z2,
        omega_e=omega_e,
        axis_rate=axis_omega,
        half_angle=half_angle,
        slow=slow,
        fast=fast,
        hold=hold,
        power=power,
        z_dot=hypot(omega_e / 2, z2_dot),
        D1=D1,
        D2=D2,
        deviation=deviation,
    )


def stale_torque(
    p: Premises, omega: float, axis_omega: float, omega_e: float, z2_dot: float, theta_dot: float
) -> float:
    """The torque by which a command is out of date: its age times the largest rate at which the law's torque changes.

    Args:
        p: Premises.
        omega: Largest ‖ω‖ [rad/s].
        axis_omega: Largest |ω_k| [rad/s].
        omega_e: Largest ‖ω_e‖ [rad/s].
        z2_dot: Largest ‖ż₂‖ [rad/s²].
        theta_dot: Largest rate of θ̂ [N·m/rad].

    Returns:
        [N·m].
    """
    j, c1, spread = max(p.J), max(p.C1), max(p.J) - min(p.J)
    omega_e_dot = z2_dot + c1 * omega_e / 2
    omega_dot = omega_e_dot + p.k_omega_d_dot + omega_e * p.k_omega_d
    return p.age * (
        omega_e / 2
        + max(p.C2) * z2_dot
        + p.k_theta_hat * omega_dot + theta_dot * axis_omega
        + p.weight * omega + 2 * spread * omega * omega_dot
        + j * (omega_e_dot * p.k_omega_d + omega_e * (p.k_omega_d_dot + omega_e * p.k_omega_d))
        + j * (p.k_omega_d_ddot + omega * p.k_omega_d_dot)
        + j * c1 / 2 * (omega_e_dot + omega_e**2 / 2)
    )  # fmt: skip


def fastest_estimate(p: Premises, omega: float, z2: float) -> float:
    """The largest ‖θ̂'‖, by the projection's norm √cond Γ; largest |ω_k^Q| [rad/s] and ‖z₂^Q‖ [rad/s]."""
    return max(p.Gamma) * sqrt(max(p.Gamma) / min(p.Gamma)) * omega * z2


def stale_power(p: Premises, z2_dot: float, omega_dot: float, omega: float, z2: float, delta_z2: float) -> float:
    """Power by which the adaptation, held for a period, is out of date [W].

    θ̂ steps by T Γ Φ^Q z₂^Q with the values at a tick, while z₂ᵀ Φ θ̃ acts all the while; the second term is the step's
    square. A step that ends s beyond the ball of k_θ/0.95 =: R is clipped to it, at its nearest point. For unequal Γ
    that is not the nearest in θ̃ᵀΓ⁻¹θ̃, which then grows by at most s Θ/λ_min(Γ). The projection leaves of the outward
    part o of a step from within the ball at most (1 − σ) o, σ the share of R² − k_θ² that ‖θ̂‖² has passed: so
    s ≤ ‖step‖²/2R + o − (R² − k_θ²)/2R, or without its last two terms where they are negative.

    Args:
        p: Premises.
        z2_dot: Largest ‖ż₂‖ [rad/s²].
        omega_dot: Largest ‖ω̇‖ [rad/s²].
        omega: Largest ‖ω^Q‖ [rad/s].
        z2: Largest ‖z₂^Q‖ [rad/s].
        delta_z2: Largest ‖z₂^Q − z₂‖ [rad/s].
    """
    gamma, least, R = max(p.Gamma), min(p.Gamma), p.k_theta_hat
    power = p.age * p.theta_error * (z2_dot * omega + delta_z2 * omega_dot) + p.age / 2 * gamma * (omega * z2) ** 2
    if gamma > least and p.age and R:
        step, outward = p.age * fastest_estimate(p, omega, z2), p.age * gamma * omega * z2
        beyond = step**2 / (2 * R) + max(0.0, outward - (R**2 - p.k_theta**2) / (2 * R))
        power += beyond * p.theta_error / (least * p.age)
    return power


def _mean(values: Vector) -> float:
    return (max(values) + min(values)) / 2
