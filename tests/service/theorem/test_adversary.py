"""Adversary of the certificate: the worst loops that this file can build stay within what is proven of the plant.

A second closed loop in NumPy, all configurations and all rows at once. It takes numbers from the configuration and
the bounds to compare with, and nothing else of the project: body (C.1), (C.2), also with a held roll; the paper's law
(C.37), PD and PID as one sum; projection (C.38); rotors, encoders with their filter, a gyro; commands that are held,
late or lost.

The adversary chooses θ, θ̂(t₀) and an instant of the first hundred days of the reference; at every tick the vertex of
(C.13) of ε, ω and u, the errors of sensors, τ_d, and which of the commands that may be in force is. It takes what pushes
most along a costate of the linear error equations, and learns over a few generations where a push goes furthest.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from math import hypot, sin
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import expm

from aeroloop.service.config import Settings, load_over
from aeroloop.service.theorem.certificate import certify, evaluate, largest_voltage
from aeroloop.service.theorem.invariant import reach

Array = npt.NDArray[np.float64]
ROWS: Final = 32
GENERATIONS: Final = 4
TICKS: Final = 700
DAYS: Final = 100
QUANTITIES: Final = ("‖z‖", "‖ε̃‖", "‖ω_e‖", "|ω_k|", "|ε_k|", "|u_k|")


class Case(NamedTuple):
    """A configuration; `late` ticks that a command may be late, `loss` if by lost frames; τ_d; ‖x(t₀)‖ over the radius."""

    changes: tuple[str, ...]
    late: int = 0
    loss: bool = False
    disturbance: float = 0.0
    start: float = 0.0


def bits(attitude: int | str, rate: int | str, voltage: int | str) -> tuple[str, ...]:
    return f"wire.attitude.bits={attitude}", f"wire.rate.bits={rate}", f"wire.voltage.bits={voltage}"


def swing(amplitude: str, frequency: str) -> tuple[str, ...]:
    return f"reference.amplitude=[{amplitude}]", f"reference.frequency=[{frequency}]"


PARTS: Final = tuple(f"plant.{part}" for part in (
    "friction.viscous=[]", "friction.coulomb=[]", "rotor.lag_up_s=0", "rotor.lag_down_s=0", "sensors.attitude=perfect",
    "sensors.rate=perfect",
))  # fmt: skip
BODY: Final = (
    "loop.lockstep=true", "law.allocation=[[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]", "law.centre_of_mass=[0, 0, 0]",
    "law.damping_bound=0.0119", "wire.actuators=3", "plant.kind=rigid_body", "plant.rigid_body.damping=[0, 0.006, 0.006]",
    "loop.rate_hz=250", *PARTS,
)  # fmt: skip
AERO: Final = (
    "loop.lockstep=true", "law.damping_bound=0.0135", "plant.ideal=true", "loop.rate_hz=250",
    *swing("0, 10, 60", "0, 0.1, 0.07"),
)
FREE = BODY
BENCH: Final = (
    "loop.lockstep=true", *PARTS, "law.damping_estimate=[0.022, 0.0071, 0.022]", "law.damping_bound=0.003",
    "plant.friction.viscous=[0.0071, 0.022]", "plant.aero.centre_of_mass=[0, 0, -0.0038]", "wire.voltage.limit=60",
    "plant.voltage_limit=60", "loop.rate_hz=500", *swing("0, 10, 40", "0, 0.1, 0.07"),
)
ENCODERS: Final = ("plant.sensors.attitude=encoders", "plant.sensors.rate=derivative")


def lag(up: float, down: float) -> tuple[str, ...]:
    return f"plant.rotor.lag_up_s={up}", f"plant.rotor.lag_down_s={down}"


PID: Final = ("law.kind=pid",)
CASES: Final = {
    "8/8/6 bits": Case((*FREE, *bits(8, 8, 6))),
    "10/6/6 bits, from afar": Case((*FREE, *bits(10, 6, 6)), start=0.3),
    "12 bits": Case((*FREE, *bits(12, 12, 12))),
    "16 bits, 500 Hz": Case((*FREE, *bits(16, 16, 16), "loop.rate_hz=500")),
    "12 bits, a body of three moments, with a weight": Case((
        *FREE, *bits(12, 12, 12), "law.inertia=[0.02, 0.03, 0.01]", "plant.rigid_body.inertia=[0.02, 0.03, 0.01]",
        "law.centre_of_mass=[0.002, 0.001, -0.0038]", "plant.rigid_body.centre_of_mass=[0.002, 0.001, -0.0038]",
    )),
    "10 bits, unequal C1 and C2": Case((*FREE, *bits(10, 10, 10), "law.C1=[0.3, 1.0, 0.5]", "law.C2=[0.3, 0.15, 0.25]")),
    "12 bits, unequal Γ": Case((*FREE, *bits(12, 12, 12), "law.Gamma=[0.2, 0.02, 0.05]")),
    "no bits, 1 kHz, three axes": Case((
        *FREE, *bits("cont", "cont", "cont"), *swing("60, 50, 80", "0.04, 0.04006, 0.04002"), "law.C1=[1, 1, 1]",
        "law.C2=[0.3, 0.3, 0.3]", "loop.rate_hz=500",
    )),
    "12 bits, 10 ms late": Case((*FREE, *bits(12, 12, 12), "loop.rate_hz=500"), late=5),
    "10 bits, 24 ms late": Case((*FREE, *bits(10, 10, 10), "loop.rate_hz=500"), late=12),
    "12 bits, real time, pushed": Case((*FREE, *bits(12, 12, 12), "loop.lockstep=false"), late=1, disturbance=0.001),
    "12 bits, Coulomb friction": Case((*FREE, *bits(12, 12, 12), "plant.friction.coulomb=[0.0005, 0.0003, 0.0002]")),
    "12 bits, nonadaptive": Case((*FREE, *bits(12, 12, 12), "law.kind=nonadaptive")),
    "10 bits, nonadaptive, late": Case((*FREE, *bits(10, 10, 10), "law.kind=nonadaptive"), late=3, start=0.5),
    "12 bits, PD": Case((*FREE, *bits(12, 12, 12), "law.kind=pd")),
    "10/8/8 bits, PD, late, pushed": Case((*FREE, *bits(10, 8, 8), "law.kind=pd"), late=2, disturbance=0.001),
    "12 bits, PID": Case((*FREE, *bits(12, 12, 12), *PID, "loop.rate_hz=100")),
    "10 bits, PID, late, pushed": Case((*FREE, *bits(10, 10, 10), *PID, "loop.rate_hz=100"), late=2, disturbance=0.002),
    "10 bits, PID, frames lost": Case((*FREE, *bits(10, 10, 10), *PID, "loop.rate_hz=250"), late=8, loss=True),
    "12 bits, rotors": Case((*FREE, *bits(12, 12, 12), *lag(0.02, 0.02))),
    "12 bits, rotors up and down": Case((*FREE, *bits(12, 12, 12), *lag(0.02, 0.03))),
    "12 bits, slow rotors": Case((
        *FREE, *bits(12, 12, 12), *lag(0.1, 0.11), "law.damping_bound=0.002", "law.damping_estimate=[0, 0.006, 0.006]",
        "law.C2=[0.25, 0.25, 0.25]",
    )),
    "10 bits, PID, rotors": Case((*FREE, *bits(10, 10, 10), *PID, *lag(0.02, 0.03), "loop.rate_hz=100")),
    "12 bits, gyro": Case((
        *FREE, *bits(12, 12, 12), "plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.001",
        "plant.sensors.gyro_bias=[0.002, 0, -0.001]",
    )),
    "12 bits, Aero": Case((*AERO, *bits(12, 12, 12))),
    "10 bits, Aero, nonadaptive, late": Case((*AERO, *bits(10, 10, 10), "law.kind=nonadaptive"), late=1),
    "12 bits, Aero, rotors, PD": Case((*BENCH, *bits(12, 12, 12), *lag(0.03, 0.032), "law.kind=pd")),
    "12 bits, Aero, encoders, PD": Case((*BENCH, *bits(12, 12, 12), *ENCODERS, "law.kind=pd")),
    "12 bits, Aero, encoders": Case((*BENCH, *bits(12, 12, 12), *ENCODERS, "law.C2=[0.25, 0.25, 0.25]")),
}  # fmt: skip


def cross(a: Array, b: Array) -> Array:
    x, y, z = (a[..., i] for i in range(3))
    u, v, w = (b[..., i] for i in range(3))
    found: Array = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)
    return found


def to_body(q: Array, v: Array) -> Array:
    """Rᵀ(q) v."""
    t = 2 * cross(q[..., 1:], v)
    found: Array = v - q[..., :1] * t + cross(q[..., 1:], t)
    return found


def product_of(p: Array, q: Array) -> Array:
    """p ∘ q."""
    scalar = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdims=True)
    return np.concatenate([scalar, p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + cross(p[..., 1:], q[..., 1:])], -1)


def norm(v: Array) -> Array:
    length: Array = np.sqrt((v * v).sum(axis=-1))
    return length


def unit(v: Array) -> Array:
    return v / np.maximum(norm(v)[..., None], 1e-300)


def attitude_of(angle: Array) -> Array:
    """q of roll, pitch, yaw: yaw first."""
    (a, b, c), (r, p, y) = np.moveaxis(np.cos(angle / 2), -1, 0), np.moveaxis(np.sin(angle / 2), -1, 0)
    return np.stack([a * b * c + r * p * y, r * b * c - a * p * y, a * p * c + r * b * y, a * b * y - r * p * c], -1)


def desired(c: Any, t: Array) -> tuple[Array, Array, Array]:
    """q_d, and ω_d and its derivative in the desired body frame."""
    turn = c.frequency * t[:, None]
    angle, rate = c.amplitude * np.sin(turn), c.amplitude * c.frequency * np.cos(turn)
    (r, p, _), (dr, dp, dy), (ddr, ddp, ddy) = angle.T, rate.T, (-(c.frequency**2) * angle).T
    sr, cr, sp, cp = np.sin(r), np.cos(r), np.sin(p), np.cos(p)
    b = np.stack([dr - dy * sp, dp * cr + dy * cp * sr, dy * cp * cr - dp * sr], axis=-1)
    yaw = ddy * cp - dy * dp * sp
    turned = np.stack(
        [ddr - ddy * sp - dy * dp * cp, ddp * cr + yaw * sr + dr * b[:, 2], yaw * cr - ddp * sr - dr * b[:, 1]], axis=-1
    )
    return attitude_of(angle), b, turned


def constants(case: Case) -> dict[str, Any]:
    """All numbers of a configuration that the loop needs; matrices of shape (3, 3), else (3,) or (1,)."""
    s = load_over(Settings(), list(case.changes))
    law, wire, sensors, gyro = s.law, s.wire, s.plant.sensors, s.plant.sensors.rate == "gyro"
    paper, held, one = law.kind in ("adaptive", "nonadaptive"), wire.actuators == 2, np.ones(3)
    viscous, friction = np.zeros(3), s.plant.friction
    encoders = held and not s.plant.ideal and sensors.rate == "derivative"
    reference: Any = s.reference
    return {
        "J": law.inertia,
        "B": np.array(law.allocation) * np.array([not held, 1, 1]),
        "B_inverse": np.linalg.inv(np.array(law.allocation)) * np.array([[not held], [1], [1]]),
        "r_g": law.centre_of_mass,
        "weight": [0, 0, -law.mass * law.gravity],
        "C1": law.C1 if paper else 0 * one,
        "C2": law.C2 if paper else 0 * one,
        "kp": one if paper else law.kp,
        "kd": 0 * one if paper else law.kd,
        "ki": law.ki if law.kind == "pid" else 0 * one,
        "share": law.C1 if paper else law.attitude_share if law.kind == "pid" else 0 * one,
        "Gamma": law.Gamma if law.kind == "adaptive" else 0 * one,
        "centre": law.damping_estimate,
        "radius": [law.damping_bound],
        "moves": [law.kind == "adaptive"],
        "T": [s.loop.period],
        "delta_eps": [wire.attitude.quantizer().bound],
        "delta_omega": [wire.rate.quantizer().bound + gyro * 6 * sensors.gyro_noise],
        "delta_u": [wire.voltage.quantizer().bound],
        "bias": np.array(sensors.gyro_bias) * gyro,
        "torque": [case.disturbance + hypot(*friction.coulomb) * (not s.plant.ideal)],
        "up": [s.plant.rotor.lag_up_s * (not s.plant.ideal)],
        "down": [s.plant.rotor.lag_down_s * (not s.plant.ideal)],
        "held": [held],
        "encoders": [encoders],
        "step": 2 * np.pi / np.array([np.inf, *sensors.counts]) * encoders,
        "filter": [sensors.bandwidth],
        "ratio": [sensors.damping_ratio],
        "late": [case.late],
        "loss": [case.loss],
        "amplitude": np.radians(reference.amplitude),
        "frequency": reference.frequency,
    }


def errors(c: Any, q: Array, omega: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
    """η̃, ε̃, ω_e, and ω_d and its derivative in the body's frame."""
    e = product_of(now[0] * [1, -1, -1, -1], q)
    omega_d, omega_d_dot = to_body(e, now[1]), to_body(e, now[2])
    return e[..., :1], e[..., 1:], omega - omega_d, omega_d, omega_d_dot


def drift(c: Any, q: Array, omega: Array) -> Array:
    """Ψ: what the body turns by without command and damping."""
    return cross(c.r_g, to_body(q, c.weight)) - cross(omega, c.J * omega)


def torque_of(c: Any, q: Array, omega: Array, now: tuple[Array, Array, Array], theta: Array, integral: Array) -> tuple[Array, Array, Array]:
    """B u, z₂ of the paper's law, and the integral's rate. C₁ = C₂ = 0 leave PD and PID, k_d = k_i = 0 the paper's."""
    eta_e, eps_e, omega_e, omega_d, omega_d_dot = errors(c, q, omega, now)
    z2 = omega_e + c.C1 * eps_e
    alpha_dot = -c.C1 / 2 * (eta_e * omega_e + cross(eps_e, omega_e))
    feedback = -c.kp * eps_e - c.C2 * z2 - c.kd * omega_e - c.ki * integral
    feedforward = omega * theta - drift(c, q, omega) - c.J * (cross(omega, omega_d) - omega_d_dot - alpha_dot)
    return feedback + feedforward, z2, omega_e + c.share * eps_e


def adapted(c: Any, theta: Array, omega: Array, z2: Array) -> Array:
    """θ̂ a period later: projected, then clipped to the outer ball."""
    moved, tau, outer = theta - c.centre, -c.Gamma * omega * z2, c.radius / 0.95
    passed = ((moved**2).sum(-1, keepdims=True) - c.radius**2) / (outer**2 - c.radius**2)
    outward = (moved * tau).sum(-1, keepdims=True)
    along = c.Gamma * moved / np.maximum((moved * c.Gamma * moved).sum(-1, keepdims=True), 1e-300)
    moved = moved + c.T * (tau - (passed > 0) * (outward > 0) * np.minimum(passed, 1) * outward * along)
    return c.centre + moved * np.minimum(1, outer / np.maximum(norm(moved)[:, None], 1e-300))


def advance(c: Any, q: Array, omega: Array, V: Array, u: Array, theta: Array, push: Array) -> tuple[Array, Array, Array]:
    """Body and rotors after a period, by one Runge–Kutta step; the rotors' voltages are exact."""
    lag = np.where((u - V) * V >= 0, c.up, c.down)
    half = np.where(lag > 0, np.exp(-c.T / 2 / np.maximum(lag, 1e-9)), 0.0)
    voltages = [u + (V - u) * (half > 0), u + (V - u) * half, u + (V - u) * half**2]
    torques = [push + np.einsum("rij,rj->ri", c.B, each) for each in voltages]

    def slope(q: Array, omega: Array, torque: Array) -> tuple[Array, Array]:
        q_dot = np.concatenate([-(q[:, 1:] * omega).sum(1, keepdims=True), q[:, :1] * omega + cross(q[:, 1:], omega)], 1)
        omega_dot = (drift(c, q, omega) - theta * omega + torque) / c.J
        # A held roll: the mechanism's torque acts along n = y × the vertical, and keeps n·ω = 0.
        up = to_body(q, np.array([0.0, 0.0, 1.0]))
        n, n_dot = np.zeros_like(up), np.zeros_like(up)
        n[:, 0], n[:, 2] = up[:, 2], -up[:, 0]
        n_dot[:, 0], n_dot[:, 2] = up[:, 0] * omega[:, 1], up[:, 2] * omega[:, 1]
        lacks = ((n * omega_dot + n_dot * omega).sum(1) / (n * n / c.J).sum(1))[:, None]
        return q_dot / 2, omega_dot - c.held * lacks * n / c.J

    h = c.T
    a, a_ = slope(q, omega, torques[0])
    b, b_ = slope(q + h / 2 * a, omega + h / 2 * a_, torques[1])
    d, d_ = slope(q + h / 2 * b, omega + h / 2 * b_, torques[1])
    e, e_ = slope(q + h * d, omega + h * d_, torques[2])
    return unit(q + h / 6 * (a + 2 * b + 2 * d + e)), omega + h / 6 * (a_ + 2 * b_ + 2 * d_ + e_), voltages[2]


def costates(c: Any, target: Array, count: int) -> Array:
    """∂(target · (ε̃, ω_e) at the end)/∂x at each tick, x = (ε̃, ω_e, ∫, filtered angle and rate, torque) of each axis.

    Shape (TICKS + 1, count, rows, 3, 6).
    """
    first = SimpleNamespace(**{name: each.reshape(count, -1, *each.shape[1:])[:, 0] for name, each in vars(c).items()})
    A, zero = np.zeros((count, 3, 6, 6)), np.zeros((count, 3))
    lag = (first.up + first.down) / 2 + zero
    J, theta, has_lag, encoders = first.J, first.centre, lag > 0, first.encoders + zero
    f = np.stack([
        -(first.kp + first.C1 * first.C2), -(first.C2 + first.kd + J * first.C1 / 2 - theta) * (1 - encoders), -first.ki,
        zero, -(first.C2 + first.kd + J * first.C1 / 2 - theta) * encoders, zero,
    ], -1)  # fmt: skip
    A[..., 0, 1] = 0.5
    A[..., 1, :] = np.where(has_lag[..., None], 0, f) / J[..., None]
    A[..., 1, 1] -= theta / J
    A[..., 1, 5] = has_lag / J
    A[..., 2, :2] = np.stack([first.share, 1 + zero], -1) * (first.ki > 0)[..., None]
    A[..., 2, 2] = -1.0 * (first.ki == 0)
    A[..., 3, 4] = 1
    A[..., 4, 0] = 2 * first.filter**2
    A[..., 4, 3], A[..., 4, 4] = -(first.filter**2), -2 * first.filter * first.ratio
    A[..., 5, :] = f / np.maximum(lag, 1e-2)[..., None]
    A[..., 5, 5] -= 1 / np.maximum(lag, 1e-2)
    step = np.swapaxes(expm(A * first.T[..., None, None]), -1, -2)
    found = np.zeros((TICKS + 1, count, 3, 6, len(target) // count))
    found[TICKS, :, :, :2] = np.moveaxis(target.reshape(count, -1, 2, 3), 1, 3).swapaxes(1, 2)
    for i in reversed(range(TICKS)):
        found[i] = step @ found[i + 1]
    return np.moveaxis(found, 4, 2).reshape(TICKS + 1, len(target), 3, 6)


def run(c: Any, count: int, end: Array, theta: Array, theta_hat: Array, target: Array, start: Array) -> tuple[Array, Array]:
    """All rows once. Returns the largest of QUANTITIES (rows, 6) and for each ∂/∂(ε̃, ω_e) there, (rows, 6, 6)."""
    rows = np.arange(len(end))
    wide = SimpleNamespace(**{name: each[:, None] for name, each in vars(c).items()})  # for several errors at once
    signs = np.concatenate([np.zeros((1, 6)), np.identity(6)])
    p = costates(c, target, count)
    F = expm(np.stack([np.stack([0 * c.filter, 1 + 0 * c.filter], -1), np.stack([-(c.filter**2), -2 * c.ratio * c.filter], -1)], -2)[:, 0] * c.T[..., None])

    t = end - TICKS * c.T[:, 0]
    now = desired(c, t)
    slow = -now[1] * (theta - theta_hat)
    eps = np.where(c.ki > 0, 0, slow / (c.kp + c.C1 * c.C2)) + start[:, :3]
    integral = np.where(c.ki > 0, slow / np.maximum(c.ki, 1e-9), 0)
    eps = np.where(c.held, eps * [0, 1, 1], eps)
    e = np.concatenate([np.sqrt(1 - norm(eps)[:, None] ** 2), eps], 1)
    q = product_of(now[0], e)
    omega = start[:, 3:] - c.share * start[:, :3] + to_body(e, now[1])
    # a held roll: only pitch and yaw
    yaw, pitch = 2 * np.arctan2(q[:, 3], q[:, 0]), 2 * np.arctan2(q[:, 2], q[:, 0])
    q = np.where(c.held, attitude_of(np.stack([0 * yaw, pitch, yaw], 1)), q)
    up = to_body(q, np.array([0.0, 0.0, 1.0]))
    n = np.stack([up[:, 2], 0 * yaw, -up[:, 0]], 1)
    omega = omega - c.held * n * (n * omega).sum(1, keepdims=True)
    turn = omega[:, 2] / np.cos(pitch)
    joints = np.stack([0 * yaw, pitch, yaw], 1)
    filtered = np.stack([0 * yaw, omega[:, 1], turn], 1)
    angle = joints - 2 * c.ratio / c.filter * filtered
    V = np.einsum("rij,rj->ri", c.B_inverse, torque_of(c, q, omega, now, theta_hat, integral)[0])
    waiting = [V] * (int(c.late.max()) + 1)
    in_force, streak = np.zeros(len(rows)), np.zeros(len(rows))
    best, where = np.zeros((len(rows), 6)), np.zeros((len(rows), 6, 6))
    for i in range(TICKS):
        now = desired(c, t + i * c.T[:, 0])
        eta_e, eps_e, omega_e, *_ = errors(c, q, omega, now)
        z2 = omega_e + c.share * eps_e
        of_command = p[i + 1, :, :, 1] / c.J * (c.up == 0) + p[i + 1, :, :, 5] / np.maximum(c.up, 1e-2) * (c.up > 0)
        # encoders and their filter
        q_seen, omega_seen = q, omega + c.bias
        if c.encoders.any():
            joints = np.stack([0 * yaw, 2 * np.arctan2(q[:, 2], q[:, 0]), 2 * np.arctan2(q[:, 3], q[:, 0])], 1)
            gain = p[i + 1, :, :, 3] * (1 - F[:, None, 0, 0]) - p[i + 1, :, :, 4] * F[:, None, 1, 0] - c.T * of_command * c.kp / 2
            joints = joints + c.step / 2 * np.sign(gain)
            gap = angle - joints
            angle, filtered = joints + F[:, None, 0, 0] * gap + F[:, None, 0, 1] * filtered, F[:, None, 1, 0] * gap + F[:, None, 1, 1] * filtered
            seen = np.stack([-np.sin(joints[:, 1]) * filtered[:, 2], filtered[:, 1], np.cos(joints[:, 1]) * filtered[:, 2]], 1)
            q_seen, omega_seen = np.where(c.encoders, attitude_of(joints), q), np.where(c.encoders, seen, omega_seen)

        def received(signs: Array) -> tuple[Array, Array]:
            eps_Q = q_seen[:, None, 1:] + wide.delta_eps * signs[..., :3]
            rest = np.sqrt(np.maximum(0.0, 1 - (eps_Q * eps_Q).sum(-1, keepdims=True)))
            q_Q = np.concatenate([np.where(q_seen[:, None, :1] < 0, -rest, rest), eps_Q], axis=2)
            return unit(q_Q), omega_seen[:, None] + wide.delta_omega * signs[..., 3:]

        each = tuple(part[:, None] for part in now)
        torques, _, rates = torque_of(wide, *received(signs[None]), each, theta_hat[:, None], integral[:, None])
        score = (torques * of_command[:, None]).sum(2) + (rates * p[i + 1, :, None, :, 2] * wide.ki.clip(0, 1e-9) * 1e9).sum(2)
        vertex = np.sign(score[:, 1:] - score[:, :1])[:, None]
        q_Q, omega_Q = received(vertex)
        torque, z2_Q, rate = (found[:, 0] for found in torque_of(wide, q_Q, omega_Q, each, theta_hat[:, None], integral[:, None]))
        u = np.einsum("rij,rj->ri", c.B_inverse, torque)
        theta_hat = adapted(c, theta_hat, omega_Q[:, 0], z2_Q)
        push = np.einsum("rij,ri->rj", c.B, of_command)
        lost = c.loss[:, 0] * ((rate * p[i + 1, :, :, 2]).sum(1) < 0) * (streak < c.late[:, 0])
        streak = np.where(lost, streak + 1, 0)
        integral = integral + c.T * rate * (c.ki > 0) * (1 - lost[:, None])
        waiting = [*waiting[1:], np.where(lost[:, None], waiting[-1], u + c.delta_u * np.sign(push))]
        ages = np.arange(len(waiting))[::-1, None]
        allowed = (ages <= c.late[:, 0]) & ((i - ages >= in_force) | (ages == 0))
        chosen = np.where(allowed, (np.array(waiting) * push).sum(2), -np.inf).argmax(0)
        in_force = i - ages[chosen, 0]
        q, omega, V = advance(c, q, omega, V, np.array(waiting)[chosen, rows], theta, c.torque * unit(p[i + 1, :, :, 1] / c.J))

        z = np.sqrt((1 - eta_e[:, 0]) ** 2 + norm(eps_e) ** 2 + norm(z2) ** 2)
        voltage = np.abs(np.einsum("rij,rj->ri", c.B_inverse, torque))
        found = np.stack([z, norm(eps_e), norm(omega_e), np.abs(omega).max(1), np.abs(q[:, 1:]).max(1), voltage.max(1)], 1)
        most = np.identity(3)[np.abs(omega).argmax(1)] * np.sign(omega)
        motor = c.B_inverse[rows, voltage.argmax(1)] * np.sign(u[rows, voltage.argmax(1)])[:, None]
        nil = 0 * eps_e
        directions = np.stack([np.concatenate(each, 1) for each in (
            (eps_e + c.share * z2, z2), (eps_e, nil), (nil, omega_e), (nil, most), (eps_e, nil),
            (-motor * (c.kp + c.C1 * c.C2), -motor * (c.C2 + c.kd)),
        )], 1)  # fmt: skip
        better = found > best
        best, where = np.where(better, found, best), np.where(better[..., None], directions, where)
    return best, where


@lru_cache
def shares() -> dict[str, Array]:
    """What the adversary reaches in each case, each of QUANTITIES as a share of its bound."""
    rng, count = np.random.default_rng(1), len(CASES)
    bounds, known = list[list[float]](), list[dict[str, Any]]()
    for name, case in CASES.items():
        settings = load_over(Settings(), list(case.changes))
        late_s = case.late * settings.loop.period if settings.loop.lockstep else 0.0
        e = evaluate(settings, disturbance=case.disturbance, late_s=late_s)
        assert certify(settings, disturbance=case.disturbance, late_s=late_s, margins=False).holds, name
        assert e.plant_reach is not None
        at = reach(e.plant, case.start * e.plant_reach.radius)
        assert at is not None, name
        bounds.append([at.radius, at.eps_e, at.omega_e, at.axis_rate, sin(at.half_angle), largest_voltage(settings, e.desired, at)])
        known.append(constants(case) | {"start": [case.start * e.plant_reach.radius]})
    c = SimpleNamespace(**{
        name: np.repeat(np.array([one[name] for one in known], dtype=float), ROWS, axis=0) for name in known[0]
    })  # fmt: skip
    limits = np.repeat(np.array(bounds), ROWS, axis=0)
    total = count * ROWS

    # Instants at which the reference turns fastest about an axis, every fourth anywhere.
    end = rng.uniform(0, DAYS * 86400, (400, total))
    turns = np.array([np.abs(desired(c, t)[1]).max(1) for t in end])
    pick = turns.argmax(0)
    pick[::4] = 0
    end = end[pick, np.arange(total)]
    rates = desired(c, end)[1]
    theta = np.identity(3)[np.abs(rates).argmax(1)] * rng.choice([-1.0, 1.0], (total, 1))
    theta[::3] = unit(rng.standard_normal((total, 3)))[::3]
    hat = -theta
    slow = -rates * (theta - hat)
    target = unit(np.concatenate([slow, slow], 1) + 0.3 * np.abs(slow).max() * rng.standard_normal((total, 6)))
    best = np.zeros((count, 6))
    for generation in range(GENERATIONS):
        start = c.start * unit(rng.standard_normal((total, 6)))
        found, where = run(c, count, end, c.centre + c.radius * theta, c.centre + c.moves * c.radius / 0.95 * hat, target, start)
        share = (found / limits).reshape(count, ROWS, 6)
        best = np.maximum(best, share.max(1))
        print(generation, np.round(share.max(1)[:, 0], 3))
        # The next generation: children of the best rows for each quantity, most of them for ‖z‖.
        quantity = np.tile(([0, 1, 2, 0, 3, 5] * ROWS)[:ROWS], count)
        order = np.argsort(-share, axis=1)
        rank = rng.integers(0, 3, (count, ROWS))
        group = np.arange(count)[:, None]
        parent = (order[group, rank, quantity.reshape(count, ROWS)] + group * ROWS).ravel()
        target = unit(where[parent, quantity]) + 0.15 * rng.standard_normal((total, 6)) * (rng.random((total, 1)) < 0.5)
        end = end[parent] + rng.standard_normal(total) * rng.choice([0, 0.3, 2], total)
        theta = theta[parent] + 0.2 * rng.standard_normal((total, 3)) * (rng.random((total, 1)) < 0.5)
        hat = hat[parent] + 0.2 * rng.standard_normal((total, 3)) * (rng.random((total, 1)) < 0.5)
        theta, hat = unit(theta), unit(hat)
    return dict(zip(CASES, best, strict=True))


if __name__ == "__main__":
    for name, found in shares().items():
        print(f"{name:50s}", " ".join(f"{each:.3f}" for each in found))
