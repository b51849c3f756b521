"""Invariant set of z: a bound at every instant, from the error equations with Φ θ̃ as a bounded disturbance.

V of (C.73) contains θ̃, which need not decrease, so that V's level sets bound ‖z‖ poorly. Here the ball around θ̂(t₀)
alone bounds θ̃, and the linear part of the error equations (`linear`) is solved instead. README.md derives every step.

The disturbances D₁ to D₅ are bounds for all states within some sizes, and grow with them; the sizes follow from the
disturbances by the linear gains. Where the least fixed point exists it holds at all times: it is the set that the error
approaches and never leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import asin, cos, hypot, inf, isfinite, pi, sin, sqrt, tan
from typing import Final

import numpy as np

from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.control.reference import Floats
from aeroloop.service.theorem.bounds import Coordinates, norm
from aeroloop.service.theorem.feedback import Feedback
from aeroloop.service.theorem.linear import Axis, Responses, responses
from aeroloop.service.theorem.plant_bounds import NO_ENCODER, EncoderRate

_MOST_ITERATIONS: Final = 400
_INFLATED: Final = 1.001
"""Each guess of the fixed point is raised by this, so that one that holds is found soon; the bound is as much wider."""
_MOST: Final = 1e6
"""Disturbance beyond which no bound is sought."""


@dataclass(frozen=True)
class Premises:
    """What the set is computed from. Letters as in `bounds`; vectors are diagonals.

    Attributes:
        law: The law near its reference.
        J: Inertia [kg·m²].
        weight: ‖r_g‖ m g [N·m].
        weight_roll: |r_g,y| m g: the weight's torque about the held roll [N·m].
        norm_B: ‖B‖ [N·m/V].
        delta_omega: Largest ‖ω^Q − ω‖, without a rate's errors by encoders [rad/s].
        delta_u: Largest ‖u^Q − u‖ [V].
        k_omega_d: Largest ‖ω_d‖ [rad/s].
        k_omega_d_dot: Largest ‖ω̇_d‖ [rad/s²].
        k_omega_d_ddot: Largest ‖ω̈_d‖ [rad/s³].
        axis_rate: Largest element of ω_d in the desired body frame [rad/s].
        half_angle_d: Half the largest angle of q_d [rad].
        delta_q: Largest ‖q^Q − q‖ where the attitude errs by half an angle [rad].
        period: Of the loop [s].
        age: Longest time from a measurement to the end of its command's effect, without the rotors' lag [s].
        k_tau_d: Largest disturbance torque [N·m].
        steady: Largest torque beside it that changes only as the body turns [N·m].
        tilt: Largest pitch of the reference if the body's roll is held by a mechanism; None if three motors act [rad].
        lag: Time constant of the rotors [s]; 0 without.
        uneven: Of a lag that differs up and down: share of a torque's lagging part by which the rotors err [1].
        encoder: Errors of a rate by encoders.
    """

    law: Feedback
    J: Vector
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
    period: float
    age: float
    k_tau_d: float
    steady: float
    tilt: float | None
    lag: float = 0.0
    uneven: float = 0.0
    encoder: EncoderRate = NO_ENCODER

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Each axis that differs; with a held roll x and z mix, and their means stand for both."""
        law = self.law
        gains = np.array([law.kp, law.kd, law.alpha, law.ki, law.share, law.centre, self.J]).T.tolist()
        if self.tilt is not None:
            x, y, z = gains
            gains = [y, [*((a + b) / 2 for a, b in zip(x[:-1], z[:-1], strict=True)), max(self.J)]]
        late = self.lag, self.encoder.bandwidth, self.encoder.ratio
        shares = [1.0, self.phi, 1.0] if self.tilt is not None else [1.0] * 3
        return tuple(dict.fromkeys(Axis(*[*gain, share, *late]) for gain, share in zip(gains, shares, strict=False)))

    @property
    def phi(self) -> float:
        """φ: the mean share of a yaw torque that the motors produce along the reference [1]."""
        return 1.0 if self.tilt is None else (1 + cos(self.tilt) ** 2) / 2


@dataclass(frozen=True)
class Reach:
    """What the errors and the command reach, at all times after a start with ‖x‖ ≤ r.

    Attributes:
        D: Bounds of the disturbances d₁ to d₅.
        radius: Largest ‖z‖ [1, rad/s].
        eps_e: Largest ‖ε̃‖ [1].
        omega_e: Largest ‖ω_e‖ [rad/s].
        axis_rate: Largest |ω_k| [rad/s].
        half_angle: Half the body's largest angle [rad].
        slow: Largest ‖w_s‖ [N·m].
        fast: Largest torque of age, friction, wind and θ̃ on the error's rate [N·m].
        noise: Largest torque by which the command errs, by quantization and sensors [N·m].
        hold: The part of it that comes from the age of the command [N·m].
        deviation: Largest torque of the command beyond that of the reference [N·m].
        integral: Largest torque of the integral, or estimate of a constant torque [N·m].
    """

    D: tuple[float, ...] = (0.0,) * 7
    radius: float = 0.0
    eps_e: float = 0.0
    omega_e: float = 0.0
    axis_rate: float = 0.0
    half_angle: float = 0.0
    slow: float = 0.0
    fast: float = 0.0
    noise: float = 0.0
    hold: float = 0.0
    deviation: float = 0.0
    integral: float = 0.0


def without_error(p: Premises) -> Reach:
    """What is reached along the reference if quantization is the only error: a part of every set."""
    torque = p.delta_q(0.0) * max(p.law.kp) + max(p.law.kd) * (p.delta_omega + p.encoder.ripple)
    return Reach(axis_rate=p.axis_rate, half_angle=p.half_angle_d, noise=torque, deviation=torque)


def reach(p: Premises, start: float = 0.0) -> Reach | None:
    """The least bounds that hold at all times after ‖x‖ ≤ `start`; None where none is proven."""
    linear = responses(p.axes)
    if linear is None:
        return None
    D: tuple[float, ...] = (0.0,) * 7
    eps_e = 0.0
    for _ in range(_MOST_ITERATIONS):  # bounds grow with D, and D with the bounds: from 0 to the least
        sizes = {name: gain(start, D) for name, gain in linear.gains.items()}
        found = _bounds_after(p, linear, sizes, eps_e)
        if found is None or not all(isfinite(d) and d < _MOST for d in found.D):
            return None
        if found.eps_e <= eps_e and all(new <= old for new, old in zip(found.D, D, strict=True)):
            return found
        D, eps_e = tuple(_INFLATED * d for d in found.D), _INFLATED * found.eps_e
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
    """‖x‖ at n instants, or a bound of it where the roll is held: how far (ε̃, z₂) is from balancing the slow torque.

    Rotors, filter and integral are taken as in balance.

    Args:
        p: Premises.
        c: The error coordinates.
        sign: ±1, the equilibrium approached. Shape (n,).
        theta_error: θ̃ [N·m·s/rad]. Shape (n, 3).
        desired_rate: ω_d in the desired body frame [rad/s]. Shape (n, 3).
    """
    eps, share, linear = sign[:, None] * c.eps_e, np.array(p.law.share), responses(p.axes)
    if p.tilt is None:
        balance = -desired_rate * theta_error / np.array(p.law.kp) * (np.array(p.law.ki) == 0)
        steady = 0.0 if linear is None else linear.z * p.steady  # balanced in a direction that is not known
        return norm(np.hstack([eps - balance, c.z2 - share * balance])) + steady
    farthest = reach(p, largest_start(p))
    return norm(np.hstack([eps, c.z2])) + (inf if farthest is None or linear is None else linear.z * farthest.slow)


def _bounds_after(p: Premises, linear: Responses, at: dict[str, float], eps_e: float) -> Reach | None:
    """D₁ to D₅ while the outputs of the error equations are within these sizes; None beyond what is proven.

    Args:
        p: Premises.
        linear: The error equations' gains.
        at: Sizes of the outputs of `linear`, about the point where the slow torque is balanced.
        eps_e: ‖ε̃‖ of the last guess [1].
    """
    law, held = p.law, p.tilt is not None
    omega_e, omega_e_dot = at["omega"], at["omega_dot"]
    j, spread = max(p.J), max(p.J) - min(p.J)
    kp, kd, alpha, ki, share = (max(gain) for gain in (law.kp, law.kd, law.alpha, law.ki, law.share))

    if not eps_e < sin(pi / 4):
        return None
    pitch = 0.0 if p.tilt is None else p.tilt + 2 * asin(eps_e)  # a held roll: the pitch errs by no more than this
    if not pitch < pi / 2:
        return None
    phi, sine = cos(pitch) ** 2, sin(pitch)
    # The slow torque: −diag(R_d ω_d) θ̃, what is steady, and with a held roll what u₁ should have added to the yaw.
    roll = (law.estimate * p.k_omega_d + j * p.k_omega_d_dot + p.weight_roll) if held else 0.0
    push = law.theta_error * p.axis_rate + p.steady + sine * roll
    slow = push / phi
    needed = at["eps"] + linear.eps * slow
    eps_e = max(eps_e, needed)
    if not eps_e < sin(pi / 4):
        return None
    zeta = 2 * sin(asin(eps_e) / 2)  # ‖z₁‖
    turned = 2 * eps_e * p.k_omega_d  # ‖R ω_d − R_d ω_d‖
    axis = p.axis_rate + turned
    omega, axis_omega = p.k_omega_d + omega_e, axis + omega_e
    omega_dot = omega_e_dot + p.k_omega_d_dot + omega_e * p.k_omega_d
    z2 = omega_e + share * eps_e
    half_angle = min(pi / 2, p.half_angle_d + asin(eps_e))
    d1 = zeta * omega_e / 2

    # Errors of what is received, and what they do to the command.
    delta_q = p.delta_q(asin(eps_e))
    delta_R = 2 * delta_q
    delta_omega = p.delta_omega + p.encoder.turn * omega
    delta_omega += p.encoder.angle * axis_omega
    delta_omega += p.encoder.lag * (p.k_omega_d_dot + omega_e * p.k_omega_d + axis_omega * omega)
    filtered = p.encoder.lag * omega_e_dot  # the linear equations have the filter for k_d, c and θ̂(t₀) only
    delta_omega_e = delta_omega + delta_R * p.k_omega_d
    if len(set(law.kp)) == len(set(law.kd)) == 1:  # parts of one error at right angles to each other
        of_state = delta_q * hypot(kp, kp * eps_e + 2 * kd * p.k_omega_d)
        of_state += delta_q**2 * (kp * eps_e / 2 + 2 * kd * p.k_omega_d)
    else:
        of_state = delta_q * (kp + 2 * kd * p.k_omega_d)
    noise = (
        of_state + kd * delta_omega
        + law.estimate * delta_omega  # Φ^Q θ̂
        + p.weight * delta_R + spread * (2 * omega * delta_omega + delta_omega**2)  # Ψ
        + j * ((omega * delta_R + delta_omega) * p.k_omega_d + delta_R * p.k_omega_d_dot)
        + alpha * (delta_omega_e + delta_q * omega_e)  # ᾱ
        + p.norm_B * p.delta_u
        + (law.reach + j * p.k_omega_d + 2 * spread * omega + alpha * zeta) * (filtered + p.encoder.ripple)
    )  # fmt: skip

    late = p.lag > 0 or p.encoder.bandwidth > 0  # then the linear equations have θ̂(t₀)
    # A command is old: its feedback by the age, the rest of it by the rotors' lag, too.
    errs = delta_omega + filtered + p.encoder.ripple
    theta_dot = max(law.Gamma) * (axis_omega + errs) * (z2 + errs + delta_R * p.k_omega_d + share * delta_q)
    if theta_dot and not law.virtual:  # the norm of the ball's projection
        theta_dot *= sqrt(max(law.Gamma) / min(law.Gamma))
    rest_dot = (
        (law.reach if late else law.estimate) * omega_dot + theta_dot * axis_omega
        + hypot(*law.centre) * (p.k_omega_d_dot + omega_e * p.k_omega_d) * late
        + p.weight * omega + 2 * spread * omega * omega_dot
        + j * (omega_e_dot * p.k_omega_d + omega_e * (p.k_omega_d_dot + omega_e * p.k_omega_d))
        + j * (p.k_omega_d_ddot + omega * p.k_omega_d_dot)
        + alpha * (zeta * omega_e_dot + omega_e**2 / 2)
    )  # fmt: skip
    hold = p.age * at["feedback_dot"] + (p.age + p.lag) * rest_dot
    steady = kd + alpha + hypot(*law.centre)  # gain of the rate that stays, so that encoders' ripple passes as an angle
    fast = law.theta_error * turned + p.k_tau_d + law.coulomb
    if law.virtual:  # −diag(ω_e)(θ − θ̂(t₀)) − c diag(ε̃)(θ̂ − θ̂(t₀)) of θ̃, and the errors and the rate of ω − z₂
        fast += law.reach * share * eps_e
        noise += law.reach * (delta_R * p.k_omega_d + share * delta_q)
        hold += (p.age + p.lag) * law.reach * share * omega_e / 2

    # What drives the linear equations.
    push_dot = law.theta_error * p.k_omega_d_dot + p.axis_rate * theta_dot + p.steady * omega
    d2 = fast + (law.radius if law.virtual else law.theta_error) * omega_e  # θ̃ acts on ω_e
    d4 = delta_omega_e + share * delta_q + p.period * (omega_e_dot + share * at["eps_dot"])
    hold += ki * p.encoder.angle  # an integral of the encoders' ripple is that angle
    gap = at["gap"] + p.lag * rest_dot + 2 * noise + hold + steady * p.encoder.ripple
    gap += 2 * steady * p.encoder.angle / p.lag if p.lag else 0.0
    d5 = noise + hold + p.uneven * gap
    if p.tilt is not None:
        fast, d2, push_dot = _with_held_roll(p, at, fast, d2, push_dot, roll, push, pitch, eps_e, zeta, theta_dot)
        d2 += (j / min(p.J) - 1) * (d5 + steady * p.encoder.ripple)
    deviation = (
        at["feedback"] + slow + noise + law.coulomb + steady * p.encoder.ripple + law.estimate * axis_omega
        + p.weight * 2 * eps_e + spread * omega**2 + alpha * zeta * omega_e
        + j * (omega_e * p.k_omega_d + 2 * eps_e * p.k_omega_d_dot)
    )  # fmt: skip
    size = linear.z * slow + at["z"]
    return Reach(
        D=(d1, d2, push_dot, d4 if ki else 0.0, d5, steady * p.encoder.angle, steady * p.encoder.ripple),
        radius=sqrt(size**2 + zeta**2 - eps_e**2),
        eps_e=needed,
        omega_e=omega_e,
        axis_rate=axis_omega,
        half_angle=half_angle,
        slow=slow,
        fast=fast,
        noise=noise,
        hold=hold,
        deviation=deviation,
        integral=ki * at["integral"] + slow,
    )


def _with_held_roll(
    p: Premises, at: dict[str, float], fast: float, d2: float, push_dot: float,
    roll: float, push: float, pitch: float, eps_e: float, zeta: float, theta_dot: float,
) -> tuple[float, float, float]:  # fmt: skip
    """The fast torque, D₂ and the slow torque's derivative where a mechanism holds the roll; README, step 5."""
    law, phi, sine = p.law, cos(pitch) ** 2, sin(pitch)
    j, jmin, spread = max(p.J), min(p.J), max(p.J) - min(p.J)
    total = [a + b for a, b in zip(law.kd, law.alpha, strict=True)]
    omega_e, kd, alpha = at["omega"], max(total), max(law.alpha)
    omega = p.k_omega_d + omega_e
    pitch_rate = axis_omega = p.axis_rate + 2 * eps_e * p.k_omega_d + omega_e
    # what u₁ should have added to the yaw, beyond the slow part and the feedback that φ counts
    rest = law.estimate * omega_e + j * omega_e * p.k_omega_d + alpha * zeta * omega_e + spread * omega**2
    fast += sine * rest
    applied = at["applied"]
    d2 += sine * rest + max(1 - p.phi, p.phi - phi) * applied
    roll_dot = (
        law.estimate * (p.k_omega_d_dot + omega_e * p.k_omega_d)
        + theta_dot * (axis_omega - omega_e)
        + j * (p.k_omega_d_ddot + omega * p.k_omega_d_dot)
        + p.weight_roll * omega
    )
    push_dot += sine * roll_dot + pitch_rate * roll
    push_dot = push_dot / phi + push * pitch_rate * (2 * tan(pitch) + 2) / phi
    second = eps_e**2 / (2 * (1 - eps_e**2))  # |n·ε̃|, n the axis that the mechanism holds
    turned = 2 * eps_e * p.k_omega_d  # |n·ω_e|
    across = (
        j * (p.k_omega_d_dot * 2 * eps_e + (p.k_omega_d + omega) * omega_e)
        + max(law.kp) * second + kd * turned + alpha * zeta * omega_e
        + max(law.ki) * at["integral"]
        + p.lag * pitch_rate * at["feedback"]  # of the rotors' lag: n turns meanwhile
    )  # fmt: skip
    d2 = hypot(d2, across) + (j / jmin - 1) * (applied + law.theta_error * omega_e + fast)
    uneven = (
        _spread(law.kp) * eps_e + _spread(total) * omega_e + _spread(law.ki) * at["integral"]
        + _spread(law.centre) * (p.lag + p.encoder.lag) * at["omega_dot"]
    )  # fmt: skip
    return fast, d2 + uneven, push_dot


def _spread(gain: Sequence[float]) -> float:
    """By what x and z differ."""
    return abs(gain[2] - gain[0])
