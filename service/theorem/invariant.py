"""Invariant set of z: a bound at every instant, from the error equations with Φ θ̃ as a bounded disturbance.

The disturbances D₁ to D₇ are bounds for all states within some sizes, and grow with them; the sizes follow from the
disturbances by the linear gains (`linear`). Where the least fixed point exists it is the set that the error approaches
and never leaves. README.md derives every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, cos, degrees, hypot, inf, isfinite, pi, sin, sqrt, tan
from typing import Final

import numpy as np

from aeroloop.service.control.reference import Floats
from aeroloop.service.theorem.bounds import Coordinates, norm
from aeroloop.service.theorem.linear import Responses, responses
from aeroloop.service.theorem.premises import Premises

_MOST_ITERATIONS: Final = 400
_INFLATED: Final = 1.001
"""Each guess of the fixed point is raised by this, so that one that holds is found soon; the bound is as much wider."""
_MOST: Final = 1e6
"""Disturbance beyond which no bound is sought."""


@dataclass(frozen=True)
class Reach:
    """What the errors and the command reach, at all times after a start with ‖x‖ ≤ r."""

    D: tuple[float, ...] = (0.0,) * 7  # bounds of the disturbances d₁ to d₇
    radius: float = 0.0  # largest ‖z‖ [1, rad/s]
    eps_e: float = 0.0  # largest ‖ε̃‖ [1]
    omega_e: float = 0.0  # largest ‖ω_e‖ [rad/s]
    axis_rate: float = 0.0  # largest |ω_k| [rad/s]
    rate_error: float = 0.0  # largest ‖ω‖ by which the rate received errs [rad/s]
    estimate_rate: float = 0.0  # largest ‖θ̂'‖ [N·m·s/rad per s]
    half_angle: float = 0.0  # half the body's largest angle [rad]
    slow: float = 0.0  # largest ‖w_s‖ [N·m]
    fast: float = 0.0  # largest torque of age, friction, wind and θ̃ on the error's rate [N·m]
    noise: float = 0.0  # largest torque by which the command errs, by quantization and sensors [N·m]
    hold: float = 0.0  # the part of it that comes from the age of the command [N·m]
    deviation: float = 0.0  # largest torque of the command beyond that of the reference [N·m]
    integral: float = 0.0  # largest torque of the integral, or estimate of a constant torque [N·m]

    @property
    def degrees(self) -> float:
        """The attitude error within it [deg]."""
        return degrees(2 * asin(self.eps_e))


def without_error(p: Premises) -> Reach:
    """What is reached along the reference if quantization is the only error: a part of every set."""
    rate_error = p.delta_omega + p.plant.encoder.ripple
    torque = p.delta_q(0.0) * max(p.law.kp) + max(p.law.kd) * rate_error
    return Reach(
        axis_rate=p.desired.axis_rate,
        rate_error=rate_error,
        half_angle=p.desired.half_angle,
        noise=torque,
        deviation=torque,
    )


def reach(p: Premises, start: float = 0.0) -> Reach | None:
    """The least bounds that hold at all times after ‖x‖ ≤ `start`; None where none is proven."""
    linear = responses(p.axes)
    if linear is None:
        return None
    D: tuple[float, ...] = (0.0,) * 7
    eps_e = 0.0
    for _ in range(_MOST_ITERATIONS):  # bounds grow with D, and D with the bounds: from 0 to the least
        sizes = {name: float(gain @ (start, *D)) for name, gain in linear.gains.items()}
        found = _bounds_after(p, linear, sizes, eps_e)
        if found is None or not all(isfinite(d) and d < _MOST for d in found.D):
            return None
        if found.eps_e <= eps_e and all(new <= old for new, old in zip(found.D, D, strict=True)):
            return found
        D, eps_e = tuple(_INFLATED * d for d in found.D), _INFLATED * found.eps_e
    return None


def distance(p: Premises, c: Coordinates, sign: Floats, theta_error: Floats, desired_rate: Floats) -> Floats:
    """‖x‖ at n instants, or a bound of it where the roll is held: how far (ε̃, z₂) is from balancing the slow torque.

    Rotors, filter and integral are taken as in balance. `sign` is ±1, the equilibrium approached, (n,), `theta_error` θ̃
    [N·m·s/rad], and `desired_rate` ω_d in the desired body frame [rad/s], (n, 3).
    """
    eps, share, linear = sign[:, None] * c.eps_e, np.array(p.law.share), responses(p.axes)
    if linear is None:
        return np.full(len(eps), np.inf)
    if not p.plant.held_roll:
        balance = -desired_rate * theta_error / np.array(p.law.kp) * (np.array(p.law.ki) == 0)
        steady = linear.z * p.plant.steady  # balanced in a direction that is not known
        return norm(np.hstack([eps - balance, c.z2 - share * balance])) + steady
    slow = [_slow_torque(p, float(each))[0] for each in norm(eps)]
    return norm(np.hstack([eps, c.z2])) + [linear.z * most if most < inf else inf for most in slow]


def _slow_torque(p: Premises, eps_e: float) -> tuple[float, float, float, float]:
    """Bounds while ‖ε̃‖ ≤ `eps_e`: of the slow torque, balanced at x = K times it, and infinite beyond what is proven.

    Then of its parts, −diag(R_d ω_d) θ̃ and what is steady and, with a held roll, what u₁ should have added to the yaw;
    and of the pitch, which errs by no more than the attitude.
    """
    if not eps_e < sin(pi / 4):
        return inf, inf, inf, inf
    push, pitch, roll = p.law.theta_error * p.desired.axis_rate + p.plant.steady, 0.0, 0.0
    if p.plant.held_roll:
        pitch = p.desired.pitch + 2 * asin(eps_e)
        roll = p.law.estimate * p.desired.rate + max(p.J) * p.desired.acceleration + p.weight_roll
        push += sin(pitch) * roll
    return push / cos(pitch) ** 2 if pitch < pi / 2 else inf, push, roll, pitch


def _bounds_after(p: Premises, linear: Responses, at: dict[str, float], eps_e: float) -> Reach | None:
    """What is reached while the outputs of the error equations are within the sizes `at`; None beyond what is proven.

    The sizes are about the point where the slow torque is balanced, `eps_e` is ‖ε̃‖ of the last guess.
    """
    law, plant, encoder = p.law, p.plant, p.plant.encoder
    rate_d, rate_d_dot, rate_d_ddot = p.desired.rate, p.desired.acceleration, p.desired.jerk
    omega_e, omega_e_dot = at["omega"], at["omega_dot"]
    j, spread = max(p.J), max(p.J) - min(p.J)
    kp, kd, alpha, ki, share = (max(gain) for gain in (law.kp, law.kd, law.alpha, law.ki, law.share))

    slow, push, roll, pitch = _slow_torque(p, eps_e)
    needed = at["eps"] + linear.eps * slow
    eps_e = max(eps_e, needed)
    if not (slow < inf and eps_e < sin(pi / 4)):
        return None
    zeta = 2 * sin(asin(eps_e) / 2)  # ‖z₁‖
    turned = 2 * eps_e * rate_d  # ‖R ω_d − R_d ω_d‖
    omega, axis_omega = rate_d + omega_e, p.desired.axis_rate + turned + omega_e
    accelerated = rate_d_dot + omega_e * rate_d  # of R ω_d
    omega_dot = omega_e_dot + accelerated
    z2 = omega_e + share * eps_e
    half_angle = min(pi / 2, p.desired.half_angle + asin(eps_e))
    d1 = zeta * omega_e / 2

    # Errors of what is received, and what they do to the command.
    delta_q = p.delta_q(asin(eps_e))
    delta_R = 2 * delta_q
    delta_omega = p.delta_omega + encoder.turn * omega + encoder.angle * axis_omega
    delta_omega += encoder.lag * (accelerated + axis_omega * omega)
    filtered = encoder.lag * omega_e_dot  # the linear equations have the filter for k_d, c and θ̂(t₀) only
    delta_omega_e = delta_omega + delta_R * rate_d
    if len(set(law.kp)) == len(set(law.kd)) == 1:  # parts of one error at right angles to each other
        of_state = delta_q * hypot(kp, kp * eps_e + 2 * kd * rate_d)
        of_state += delta_q**2 * (kp * eps_e / 2 + 2 * kd * rate_d)
    else:
        of_state = delta_q * (kp + 2 * kd * rate_d)
    noise = (
        of_state + kd * delta_omega
        + law.estimate * delta_omega  # Φ^Q θ̂
        + p.weight * delta_R + spread * (2 * omega * delta_omega + delta_omega**2)  # Ψ
        + j * ((omega * delta_R + delta_omega) * rate_d + delta_R * rate_d_dot)
        + alpha * (delta_omega_e + delta_q * omega_e)  # ᾱ
        + p.norm_B * p.delta_u
        + (law.reach + j * rate_d + 2 * spread * omega + alpha * zeta) * (filtered + encoder.ripple)
    )  # fmt: skip

    late = plant.lag > 0 or encoder.bandwidth > 0  # then the linear equations have θ̂(t₀)
    # A command is old: its feedback by the age, the rest of it by the rotors' lag, too.
    rate_error = delta_omega + filtered + encoder.ripple
    z2_error = rate_error + delta_R * rate_d + share * delta_q
    estimate_at, estimate_at_error = axis_omega, rate_error  # the rate that multiplies θ̂: ω
    if law.virtual:  # ω_r = R ω_d − c ε̃
        estimate_at = p.desired.axis_rate + turned + share * eps_e
        estimate_at_error = delta_R * rate_d + share * delta_q
    # The projection is one in the norm of Γ^(-1/2), and the clip after Euler's step one in the Euclidean norm.
    theta_dot = max(law.Gamma) * (estimate_at + estimate_at_error) * (z2 + z2_error)
    rest_dot = (
        (law.reach if late else law.estimate) * omega_dot + theta_dot * estimate_at
        + hypot(*law.centre) * accelerated * late
        + p.weight * omega + 2 * spread * omega * omega_dot
        + j * (omega_e_dot * rate_d + omega_e * accelerated)
        + j * (rate_d_ddot + omega * rate_d_dot)
        + alpha * (zeta * omega_e_dot + omega_e**2 / 2)
    )  # fmt: skip
    hold = plant.age * at["feedback_dot"] + (plant.age + plant.lag) * rest_dot
    steady = kd + alpha + hypot(*law.centre)  # gain of the rate that stays, so that encoders' ripple passes as an angle
    fast = law.theta_error * turned + plant.torque + law.coulomb
    if law.virtual:  # −diag(ω_e)(θ − θ̂(t₀)) − c diag(ε̃)(θ̂ − θ̂(t₀)) of θ̃, and the errors and the rate of ω − z₂
        fast += law.reach * share * eps_e
        noise += law.reach * (delta_R * rate_d + share * delta_q)
        hold += (plant.age + plant.lag) * law.reach * share * omega_e / 2

    # What drives the linear equations.
    push_dot = law.theta_error * rate_d_dot + p.desired.axis_rate * theta_dot + plant.steady * omega
    d2 = fast + (law.radius if law.virtual else law.theta_error) * omega_e  # θ̃ acts on ω_e
    d4 = delta_omega_e + share * delta_q + p.period * (omega_e_dot + share * at["eps_dot"])
    hold += ki * encoder.angle  # an integral of the encoders' ripple is that angle
    gap = at["gap"] + plant.lag * rest_dot + 2 * noise + hold + steady * encoder.ripple
    gap += 2 * steady * encoder.angle / plant.lag if plant.lag else 0.0
    gap += 2 * law.coulomb  # θ̂_c's torque may have just changed its sign
    d5 = noise + hold + plant.uneven * gap
    if plant.held_roll:  # README, step 6; of what the motors do about the roll's axis only part acts
        phi, sine, total = cos(pitch) ** 2, sin(pitch), [a + b for a, b in zip(law.kd, law.alpha, strict=True)]
        # What u₁ should have added to the yaw, beyond the slow part and the feedback that φ counts.
        rest = law.estimate * omega_e + j * omega_e * rate_d + alpha * zeta * omega_e + spread * omega**2
        fast += sine * rest
        roll_dot = (
            law.estimate * accelerated + theta_dot * (axis_omega - omega_e)
            + j * (rate_d_ddot + omega * rate_d_dot) + p.weight_roll * omega
        )  # fmt: skip
        push_dot = (push_dot + sine * roll_dot + axis_omega * roll + push * axis_omega * (2 * tan(pitch) + 2)) / phi
        across = (  # along n, the axis that the mechanism holds, where |n·ε̃| is of second order and |n·ω_e| ≤ `turned`
            j * (rate_d_dot * 2 * eps_e + (rate_d + omega) * omega_e)
            + kp * eps_e**2 / (2 * (1 - eps_e**2)) + max(total) * turned + alpha * zeta * omega_e
            + ki * at["integral"]
            + plant.lag * axis_omega * at["feedback"]  # of the rotors' lag: n turns meanwhile
        )  # fmt: skip
        d2 = hypot(d2 + sine * rest + max(1 - p.phi, p.phi - phi) * at["applied"], across)
        d2 += (j / min(p.J) - 1) * (at["applied"] + law.theta_error * omega_e + fast + d5 + steady * encoder.ripple)
        d2 += (
            _spread(law.kp) * eps_e + _spread(total) * omega_e + _spread(law.ki) * at["integral"]
            + _spread(law.centre) * (plant.lag + encoder.lag) * at["omega_dot"]
        )  # fmt: skip
    deviation = (
        at["feedback"] + slow + noise + law.coulomb + steady * encoder.ripple + law.estimate * axis_omega
        + p.weight * 2 * eps_e + spread * omega**2 + alpha * zeta * omega_e
        + j * (omega_e * rate_d + 2 * eps_e * rate_d_dot)
    )  # fmt: skip
    size = linear.z * slow + at["z"]
    D = d1, d2, push_dot, d4 if ki else 0.0, d5, steady * encoder.angle, steady * encoder.ripple
    return Reach(
        D,
        radius=sqrt(size**2 + zeta**2 - eps_e**2),
        eps_e=needed,
        omega_e=omega_e,
        axis_rate=axis_omega,
        rate_error=rate_error,
        estimate_rate=theta_dot,
        half_angle=half_angle,
        slow=slow,
        fast=fast,
        noise=noise,
        hold=hold,
        deviation=deviation,
        integral=ki * at["integral"] + slow,
    )


def _spread(gain: Sequence[float]) -> float:
    """By what x and z differ."""
    return abs(gain[2] - gain[0])
