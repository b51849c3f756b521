"""A second closed loop in NumPy, of many configurations at once, whose errors an adversary chooses.

It takes numbers from a configuration and the reference from the twin, and nothing else of the project: body (C.1),
(C.2), free or with a held roll; the paper's law (C.37), PD and PID as one sum; projection (C.38); rotors that lag;
commands that are held, late or lost; a plant that trips beyond its limits of tilt and rate, and by its watchdog, and
then has 0 V for good.

At every tick the adversary takes the vertex of (C.13) of ε, ω and u, the direction of τ_d and one of the commands that
may be in force: each the one that pushes most along a costate of the linear error equations. Beside these it chooses θ,
θ̂(t₀), the instant of the reference's first hundred days at which an experiment ends, and where it drives the error:
first by what the reference does then, later as children of the worst experiments so far.

Every row is an experiment. Constants `c` have shape (rows, 3), (rows, 1) or (rows, 3, 3), vectors (rows, 3), and
quaternions (rows, 4) with the scalar first; the law also takes an axis of alternatives, (rows, n, 3).
"""

from __future__ import annotations

from math import hypot
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from tests.support.numpy_twin import attitude_of, motion_of

Array = npt.NDArray[np.float64]
Motion = tuple[Array, ...]  # q_d, and ω_d and its derivative in the desired body frame
QUANTITIES: Final = ("‖z‖", "‖ε̃‖", "‖ω_e‖", "|ω_k|", "|ε_k|", "|u_k|", "tilt", "‖ω‖", "ticks without a command")
VERTICAL: Final = np.array([0.0, 0.0, 1.0])
END_S: Final = 100 * 86_400.0
_AT_ONCE: Final = 1e-3  # lag of rotors in the costates of a body without any [s]


def constants(settings: Any, late: int = 0, *, loss: bool = False, disturbance: float = 0.0) -> dict[str, Any]:
    """The numbers of a configuration; `late` ticks that a command may be late, by lost frames or else by delay."""
    law, wire, plant = settings.law, settings.wire, settings.plant
    paper, held, nil = law.kind in ("adaptive", "nonadaptive"), wire.actuators == 2, np.zeros(3)
    return {
        "J": law.inertia, "B": np.array(law.allocation) * [not held, 1, 1],
        "B_inverse": np.linalg.inv(np.array(law.allocation)) * [[not held], [1], [1]],
        "r_g": law.centre_of_mass, "weight": -law.mass * law.gravity * VERTICAL,
        "C1": law.C1 if paper else nil, "C2": law.C2 if paper else nil, "kp": nil + 1 if paper else law.kp,
        "kd": nil if paper else law.kd, "ki": law.ki if law.kind == "pid" else nil,
        "share": law.C1 if paper else law.attitude_share if law.kind == "pid" else nil,
        "Gamma": law.Gamma if law.kind == "adaptive" else nil, "adapts": [law.kind == "adaptive"],
        "centre": law.damping_estimate, "radius": [law.damping_bound], "T": [settings.loop.period],
        "delta_eps": [wire.attitude.quantizer().bound], "delta_u": [wire.voltage.quantizer().bound],
        "delta_omega": [wire.rate.quantizer().bound],
        "push": [disturbance + hypot(*plant.friction.coulomb)],
        "up": [plant.rotor.lag_up_s], "down": [plant.rotor.lag_down_s], "held": [held],
        "late": [late], "loss": [loss], "watchdog": [round(plant.watchdog_s / settings.loop.period)],
        "max_tilt": [np.radians(plant.limits.max_tilt_deg)], "max_rate": [plant.limits.max_rate],
        "amplitude": np.radians(settings.reference.amplitude), "frequency": settings.reference.frequency,
    }  # fmt: skip


def rows_of(known: list[dict[str, Any]], rows: int = 1) -> Any:
    together = {name: np.array([one[name] for one in known], dtype=float) for name in known[0]}
    return SimpleNamespace(**{name: np.repeat(each, rows, axis=0) for name, each in together.items()})


def cross(a: Array, b: Array) -> Array:
    (x, y, z), (u, v, w) = ((each[..., 0], each[..., 1], each[..., 2]) for each in (a, b))
    return np.asarray(np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1))


def dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum(axis=-1, keepdims=True))


def norm(v: Array) -> Array:
    return np.asarray(np.sqrt((v * v).sum(axis=-1)))


def unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(norm(v)[..., None], 1e-300))


def by(matrix: Array, v: Array) -> Array:
    return np.asarray(np.einsum("rij,rj->ri", matrix, v))


def to_body(q: Array, v: Array) -> Array:
    t = 2 * cross(q[..., 1:], v)
    return np.asarray(v - q[..., :1] * t + cross(q[..., 1:], t))


def times(p: Array, q: Array) -> Array:
    (a, b), (s, v) = (p[..., :1], p[..., 1:]), (q[..., :1], q[..., 1:])
    return np.concatenate([a * s - dot(b, v), a * v + s * b + cross(b, v)], axis=-1)


def desired(c: Any, t: Array) -> Motion:
    turn = c.frequency * t[:, None]
    angle, rate = c.amplitude * np.sin(turn), c.amplitude * c.frequency * np.cos(turn)
    return motion_of(angle, rate, -(c.frequency**2) * angle)


def errors(q: Array, omega: Array, now: Motion) -> tuple[Array, ...]:
    """η̃, ε̃, ω_e, and ω_d and its derivative seen from the body."""
    e = times(now[0] * [1, -1, -1, -1], q)
    omega_d = to_body(e, now[1])
    return e[..., :1], e[..., 1:], omega - omega_d, omega_d, to_body(e, now[2])


def drift(c: Any, q: Array, omega: Array) -> Array:
    return cross(c.r_g, to_body(q, c.weight)) - cross(omega, c.J * omega)


def torque_of(c: Any, q: Array, omega: Array, now: Motion, theta: Array, integral: Array) -> tuple[Array, ...]:
    """B u, z₂ and the integral's rate: C₁ = C₂ = 0 leave PD and PID, k_d = k_i = 0 the paper's law."""
    eta_e, eps_e, omega_e, omega_d, omega_d_dot = errors(q, omega, now)
    z2 = omega_e + c.C1 * eps_e
    alpha_dot = -c.C1 / 2 * (eta_e * omega_e + cross(eps_e, omega_e))
    feedback = -c.kp * eps_e - c.C2 * z2 - c.kd * omega_e - c.ki * integral
    ahead = omega * theta - drift(c, q, omega) - c.J * (cross(omega, omega_d) - omega_d_dot - alpha_dot)
    return feedback + ahead, z2, omega_e + c.share * eps_e


def adapted(c: Any, theta: Array, omega: Array, z2: Array) -> Array:
    """θ̂ a period later: projected, then clipped to the outer ball."""
    moved, tau, outer = theta - c.centre, -c.Gamma * omega * z2, c.radius / 0.95
    passed, outward = (dot(moved, moved) - c.radius**2) / (outer**2 - c.radius**2), dot(moved, tau)
    along = c.Gamma * moved / np.maximum(dot(moved, c.Gamma * moved), 1e-300)
    moved = moved + c.T * (tau - (passed > 0) * (outward > 0) * np.minimum(passed, 1) * outward * along)
    return np.asarray(c.centre + moved * np.minimum(1, outer / np.maximum(norm(moved)[:, None], 1e-300)))


def rotor_lag(c: Any, V: Array, u: Array) -> Array:
    return np.asarray(np.where((u - V) * V >= 0, c.up, c.down))


def held_axis(q: Array) -> Array:
    """The axis that is at right angles to the body's y and to the vertical."""
    up = to_body(q, VERTICAL)
    return np.stack([up[:, 2], 0 * up[:, 1], -up[:, 0]], axis=1)


class State(NamedTuple):
    """q, ω and the rotors' voltages; θ̂ and the integral."""

    q: Array
    omega: Array
    V: Array
    theta: Array
    integral: Array


def advance(c: Any, x: State, u: Array, theta: Array, push: Array) -> State:
    """Body and rotors after a period, by one Runge–Kutta step."""
    half = np.exp(-c.T / 2 / np.maximum(rotor_lag(c, x.V, u), 1e-9))
    V = [u + (x.V - u) * (c.up > 0), u + (x.V - u) * half, u + (x.V - u) * half**2]
    torques = [push + by(c.B, each) for each in V]

    def slope(q: Array, omega: Array, torque: Array) -> tuple[Array, Array]:
        q_dot = np.concatenate([-dot(q[:, 1:], omega), q[:, :1] * omega + cross(q[:, 1:], omega)], axis=1) / 2
        omega_dot = (drift(c, q, omega) - theta * omega + torque) / c.J
        n = held_axis(q)  # along it a mechanism's torque keeps n·ω = 0
        n_dot = omega[:, 1:2] * np.stack([-n[:, 2], n[:, 1], n[:, 0]], axis=1)
        return q_dot, omega_dot - c.held * (dot(n, omega_dot) + dot(n_dot, omega)) / dot(n, n / c.J) * n / c.J

    h, q, omega = c.T, x.q, x.omega
    k1, a1 = slope(q, omega, torques[0])
    k2, a2 = slope(q + h / 2 * k1, omega + h / 2 * a1, torques[1])
    k3, a3 = slope(q + h / 2 * k2, omega + h / 2 * a2, torques[1])
    k4, a4 = slope(q + h * k3, omega + h * a3, torques[2])
    q = unit(q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return x._replace(q=q, omega=omega + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4), V=V[2])


def in_balance(c: Any, now: Motion, theta: Array, theta_hat: Array, start: Array) -> State:
    """The state in which the feedback balances the slow torque, moved by `start` in (ε̃, z₂); shape (rows, 6)."""
    slow = -now[1] * (theta - theta_hat)
    eps = np.where(c.ki > 0, 0, slow / (c.kp + c.C1 * c.C2)) + start[:, :3]
    e = np.concatenate([np.sqrt(1 - dot(eps, eps)), eps], axis=1)
    q, omega = times(now[0], e), start[:, 3:] - c.share * start[:, :3] + to_body(e, now[1])
    pitch, yaw = (2 * np.arctan2(q[:, i], q[:, 0]) for i in (2, 3))
    q, n = np.where(c.held, attitude_of(np.stack([0 * yaw, pitch, yaw], axis=1)), q), held_axis(q)
    omega = omega - c.held * dot(n, omega) * n
    integral = np.where(c.ki > 0, slow / np.maximum(c.ki, 1e-9), 0)
    V = by(c.B_inverse, torque_of(c, q, omega, now, theta_hat, integral)[0])
    return State(q, omega, V, theta_hat, integral)


def costates(c: Any, target: Array, ticks: int) -> Array:
    """∂(target · (ε̃, ω_e) at the end)/∂x of ε̃, ω_e, the integral, the rotors at each tick. (ticks + 1, 4, rows, 3)."""
    A = np.zeros((*c.J.shape, 4, 4))
    lag, stiff = np.maximum((c.up + c.down) / 2, _AT_ONCE), c.kp + c.C1 * c.C2
    damp = c.C2 + c.kd + c.J * c.C1 / 2 - c.centre
    feedback = np.stack([-stiff, -damp, -c.ki, 0 * damp], axis=-1)
    A[..., 0, 1] = 0.5
    A[..., 1, :] = np.where((c.up > 0)[..., None], np.eye(4)[3], feedback) / c.J[..., None]
    A[..., 1, 1] -= c.centre / c.J
    A[..., 2, 0], A[..., 2, 1], A[..., 2, 2] = c.share * (c.ki > 0), c.ki > 0, -1.0 * (c.ki == 0)
    A[..., 3, :] = (feedback - np.eye(4)[3]) / lag[..., None]
    # Rows of the same configuration follow each other and share A.
    first = np.unique(c.case, return_index=True)[1]
    step = np.swapaxes(expm(A[first] * c.T[first, :, None, None]), -1, -2)
    found = np.zeros((ticks + 1, len(first), 3, 4, len(target) // len(first)))
    found[ticks, :, :, :2] = target.reshape(len(first), -1, 2, 3).transpose(0, 3, 2, 1)
    for i in reversed(range(ticks)):
        found[i] = step @ found[i + 1]
    return found.transpose(0, 3, 1, 4, 2).reshape(ticks + 1, 4, len(target), 3)


def run(
    c: Any, end: Array, theta: Array, theta_hat: Array, target: Array, start: Array, ticks: int
) -> tuple[Array, Array]:
    """All experiments, until the reference's time `end`, with `target` over (ε̃, ω_e) to be as large as can be then.

    Returns the largest of each of QUANTITIES, shape (rows, 9), and the target that ‖z‖ would have where it was largest.
    """
    rows, p = np.arange(len(end)), costates(c, target, ticks)
    wide = SimpleNamespace(**{name: each[:, None] for name, each in vars(c).items()})
    alone = np.concatenate([np.zeros((1, 6)), np.identity(6)])[None]
    x = in_balance(c, desired(c, end - ticks * c.T[:, 0]), theta, theta_hat, start)
    commands, in_force, lost_before = [x.V] * (int(c.late.max()) + 1), 0 * rows - 1, 0 * rows
    silent, tripped = 0 * rows, np.zeros(len(rows), dtype=bool)
    best, where = np.zeros((len(rows), len(QUANTITIES))), np.zeros((len(rows), 6))
    for i in range(ticks):
        now, costate = desired(c, end - (ticks - i) * c.T[:, 0]), p[i + 1]
        eta_e, eps_e, omega_e, *_ = errors(x.q, x.omega, now)
        z2 = omega_e + c.share * eps_e
        push = np.where(c.up > 0, costate[3] / np.maximum(c.up, _AT_ONCE), costate[1] / c.J)

        # Vertices of the quantizers: each sign by what that error alone does.
        def received(signs: Array, q: Array = x.q, omega: Array = x.omega) -> tuple[Array, Array]:
            eps_Q = q[:, None, 1:] + wide.delta_eps * signs[..., :3]
            rest = np.sqrt(np.maximum(0.0, 1 - dot(eps_Q, eps_Q)))
            q_Q = np.concatenate([np.where(q[:, None, :1] < 0, -rest, rest), eps_Q], axis=2)
            return unit(q_Q), omega[:, None] + wide.delta_omega * signs[..., 3:]

        motion, theta_hat, integral = tuple(part[:, None] for part in now), x.theta[:, None], x.integral[:, None]
        torques, _, rates = torque_of(wide, *received(alone), motion, theta_hat, integral)
        score = dot(torques, push[:, None]) + dot(rates, (costate[2] * (c.ki > 0))[:, None])
        q_Q, omega_Q = received(np.sign(score[:, 1:, 0] - score[:, :1, 0])[:, None])
        torque, z2_Q, rate = (found[:, 0] for found in torque_of(wide, q_Q, omega_Q, motion, theta_hat, integral))
        u, per_volt = by(c.B_inverse, torque), by(c.B.swapaxes(1, 2), push)

        # A measurement that is lost gives no command, no step of θ̂ and none of the integral.
        lost = c.loss[:, 0] * (dot(rate, costate[2])[:, 0] <= 0) * (lost_before < c.late[:, 0]) > 0
        lost_before = np.where(lost, lost_before + 1, 0)
        after = adapted(c, x.theta, omega_Q[:, 0], z2_Q), x.integral + c.T * rate * (c.ki > 0)
        theta_hat, integral = (
            np.where(lost[:, None], old, new) for old, new in zip((x.theta, x.integral), after, strict=True)
        )
        commands = [*commands[1:], np.where(lost[:, None], commands[-1], u + c.delta_u * np.sign(per_volt))]
        ages = np.arange(len(commands))[::-1, None]
        allowed = (ages <= (c.late * (1 - c.loss))[:, 0]) & ((i - ages >= in_force) | (ages == 0))
        chosen = np.where(allowed, (np.array(commands) * per_volt).sum(axis=2), -np.inf).argmax(axis=0)
        silent = np.where((i - ages[chosen, 0] > in_force) & ~lost, 0, silent + 1)
        in_force = i - ages[chosen, 0]
        tilt = np.arccos(np.clip(1 - 2 * (x.q[:, 1:3] ** 2).sum(axis=1), -1, 1))
        speed = norm(x.omega)
        tripped |= (silent >= c.watchdog[:, 0]) | (tilt > c.max_tilt[:, 0]) | (speed > c.max_rate[:, 0])
        applied = np.where(tripped[:, None], 0, np.array(commands)[chosen, rows])
        omega_max, eps_max = np.abs(x.omega).max(1), np.abs(x.q[:, 1:]).max(1)
        x = x._replace(theta=theta_hat, integral=integral)
        x = advance(c, x, applied, theta, c.push * unit(costate[1] / c.J))

        z = np.sqrt((1 - eta_e[:, 0]) ** 2 + norm(eps_e) ** 2 + norm(z2) ** 2)
        most = [norm(omega_e), omega_max, eps_max, np.abs(u).max(1), tilt, speed, silent]
        where = np.where((z > best[:, 0])[:, None], np.concatenate([eps_e + c.share * z2, z2], axis=1), where)
        best = np.maximum(best, np.stack([z, norm(eps_e), *most], axis=1))
    return best, where


def worst(known: list[dict[str, Any]], rows: int, generations: int, ticks: int) -> Array:
    """The largest of each of QUANTITIES that the adversary reaches in each configuration, of these `constants`.

    Beside the constants, `start` is the largest ‖x(t₀)‖ and `case` the configuration's number. Shape (cases, 9).
    """
    rng, cases, total = np.random.default_rng(1), len(known), len(known) * rows
    c = rows_of(known, rows)

    # Ends at which the reference turns fastest about an axis, or changes that most, or anywhere; θ̃ against it.
    ends = rng.uniform(0, END_S, (300, total))
    moves = np.abs([desired(c, t)[1:] for t in ends]).max(axis=3)
    kind = np.arange(total) % 4
    pick = np.where(kind < 2, moves[:, 0].argmax(axis=0), moves[:, 1].argmax(axis=0)) * (kind < 3)
    end = ends[pick, np.arange(total)]
    rates = desired(c, end)[1]
    theta = np.identity(3)[np.abs(rates).argmax(axis=1)] * rng.choice([-1.0, 1.0], (total, 1))
    theta[::3] = unit(rng.standard_normal((total, 3)))[::3]
    estimate, best = -theta, np.zeros((cases, len(QUANTITIES)))
    target = np.tile(unit(-rates * theta), 2) + 0.3 * rng.standard_normal((total, 6))
    for _ in range(generations):
        theta, estimate, start = unit(theta), unit(estimate), c.start * unit(rng.standard_normal((total, 6)))
        first = c.centre + c.adapts * c.radius / 0.95 * estimate
        reached, where = run(c, end, c.centre + c.radius * theta, first, unit(target), start, ticks)
        found = reached.reshape(cases, rows, -1)
        best = np.maximum(best, found.max(axis=1))
        # Children of the three experiments in which ‖z‖ was largest.
        worst_of = np.argsort(-found[..., 0], axis=1)[np.arange(cases)[:, None], rng.integers(0, 3, (cases, rows))]
        parent = (worst_of + np.arange(cases)[:, None] * rows).ravel()
        target = unit(where[parent]) + 0.1 * rng.standard_normal((total, 6))
        end = end[parent] + rng.choice([0, 0.3, 2], total) * rng.standard_normal(total)
        theta, estimate = (each[parent] + 0.15 * rng.standard_normal((total, 3)) for each in (theta, estimate))
    return best
