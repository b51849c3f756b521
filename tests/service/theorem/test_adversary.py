"""Adversary of the certificate: the worst loops that this file can build stay within what is proven.

A second closed loop in NumPy, many rows at once: body (C.1), (C.2), law (C.37), projection (C.38), θ̂ by Euler's rule,
commands held for a period and delayed. Of the project it uses the configuration, and the bounds to compare with.

The adversary chooses θ, θ̂(t₀), x(t₀) and the phase of the reference; and at every tick the errors of ε, ω and u, each
at a vertex of (C.13), and τ_d. It computes the law for every vertex and takes the one whose torque pushes most along a
costate of the linear error equations, so that (ε̃, z₂) is large at the end, or along z₂.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from math import sin
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import expm

from aeroloop.service.config import Settings, load_over
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import evaluate, largest_voltage
from aeroloop.service.theorem.invariant import largest_start, reach
from tests.support import numpy_twin as twin
from tests.support.certified import FREE, bits
from tests.support.twin_body import body_of

Array = npt.NDArray[np.float64]
ROWS: Final = 32
DURATION_S: Final = 2.0
"""Of an experiment: the error equations decay by e⁻⁷."""
VERTICES: Final = np.array(list(product((-1.0, 1.0), repeat=6)))
"""Signs of the errors of ε and ω. Shape (64, 6)."""
CONFIGURATIONS: Final[dict[str, tuple[tuple[str, ...], int, float]]] = {
    "the paper's body at 8/6 bits": (("law.damping_bound=0.0119", *bits(8, 6)), 0, 0.0),
    "a free body at 12/12 bits": ((*FREE, *bits(12, 12)), 0, 0.0),
    "a free body at 10/8 bits, two ticks late, pushed": ((*FREE, *bits(10, 8)), 2, 0.0005),
}
"""Overrides, delay [ticks], largest disturbance [N·m]."""
QUANTITIES: Final = ("‖z‖", "|ω_k|", "|ε_k|", "|u_k|", "∫k‖z‖² dt over what (C.77) allows")
STARTS: Final = (0.0, 0.25)
"""Largest ‖x(t₀)‖, as a share of the largest that is proven to come back."""


def to_body(q: Array, v: Array) -> Array:
    """Rᵀ(q) v: from the inertial frame to the body's, without a matrix."""
    eps = q[..., 1:]
    t = 2 * np.cross(eps, v)
    found: Array = v - q[..., :1] * t + np.cross(eps, t)
    return found


def norm(v: Array) -> Array:
    length: Array = np.sqrt((v * v).sum(axis=-1))
    return length


class Loop:
    """Body and law of a configuration; every quantity may have any leading shape."""

    def __init__(self, settings: Settings) -> None:
        law = with_theorem(settings).law
        self.J, self.C1, self.C2, self.Gamma = (np.array(v) for v in (law.inertia, law.C1, law.C2, law.Gamma))
        self.B, self.k_theta = np.array(law.allocation), law.damping_bound
        self.B_inverse: Array = np.linalg.inv(self.B)
        self.r_g, self.weight = np.array(law.centre_of_mass), np.array([0.0, 0.0, -law.mass * law.gravity])
        self.K = np.concatenate([1 / (1 + self.C1 * self.C2), self.C1 / (1 + self.C1 * self.C2)])
        self.period = settings.loop.period

    def errors(self, q: Array, omega: Array, q_d: Array, omega_d: Array) -> tuple[Array, Array, Array, Array]:
        """η̃, ε̃, ω_e and z₂ of the equilibrium η̃ = 1."""
        eta, eps, eta_d, eps_d = q[..., :1], q[..., 1:], q_d[..., :1], q_d[..., 1:]
        eta_e: Array = eta_d * eta + (eps_d * eps).sum(axis=-1, keepdims=True)
        eps_e = eta_d * eps - eta * eps_d - np.cross(eps_d, eps)
        omega_e = omega - to_body(q, omega_d)
        return eta_e, eps_e, omega_e, omega_e + self.C1 * eps_e

    def drift(self, q: Array, omega: Array) -> Array:
        """Ψ: what the body turns by without command and damping."""
        return np.cross(self.r_g, to_body(q, self.weight)) - np.cross(omega, self.J * omega)

    def torque(self, q: Array, omega: Array, desired: tuple[Array, Array, Array], theta: Array) -> tuple[Array, Array]:
        """B u and z₂ by the law; θ̂ as `theta`."""
        q_d, omega_d, omega_d_dot = desired
        eta_e, eps_e, omega_e, z2 = self.errors(q, omega, q_d, omega_d)
        alpha_dot = -self.C1 / 2 * (eta_e * omega_e + np.cross(eps_e, omega_e))
        feedforward = np.cross(omega, to_body(q, omega_d)) - to_body(q, omega_d_dot) - alpha_dot
        return -eps_e - self.C2 * z2 + omega * theta - self.drift(q, omega) - self.J * feedforward, z2

    def adapted(self, theta: Array, omega: Array, z2: Array) -> Array:
        """θ̂ a period later: projected, then clipped to the outer ball."""
        tau, outer = -self.Gamma * omega * z2, self.k_theta / 0.95
        passed = (norm(theta) ** 2 - self.k_theta**2) / (outer**2 - self.k_theta**2)
        outward = (theta * tau).sum(axis=-1)
        along = self.Gamma * theta / np.maximum((theta * self.Gamma * theta).sum(axis=-1), 1e-300)[:, None]
        acts = (passed > 0) & (outward > 0)
        after = theta + self.period * (tau - (acts * np.minimum(passed, 1) * outward)[:, None] * along)
        clipped: Array = after * np.minimum(1, outer / np.maximum(norm(after), 1e-300))[:, None]
        return clipped

    def advance(self, x: Array, torque: Array, theta: Array) -> Array:
        """The body after a period, by one Runge–Kutta step; x is (q, ω)."""

        def slope(x: Array) -> Array:
            q, omega = x[:, :4], x[:, 4:]
            q_dot = np.hstack([-(q[:, 1:] * omega).sum(1, keepdims=True), q[:, :1] * omega + np.cross(q[:, 1:], omega)])
            return np.hstack([q_dot / 2, (self.drift(q, omega) - theta * omega + torque) / self.J])

        h = self.period
        b = slope(x + h / 2 * (a := slope(x)))
        c = slope(x + h / 2 * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c))
        x[:, :4] /= norm(x[:, :4])[:, None]
        return x

    def costates(self, target: Array, ticks: int) -> Array:
        """Effect of the torque of each tick on target · (ε̃, z₂) at the end. Shape (ticks, rows, 3)."""
        found = np.empty((ticks, len(target), 3))
        for k, (c1, c2, j) in enumerate(zip(self.C1, self.C2, self.J, strict=True)):
            step = expm(np.array([[-c1 / 2, 0.5], [-1 / j, -c2 / j]]) * self.period)
            impulse = np.array([0.0, 1 / j])
            for i in reversed(range(ticks)):
                found[i, :, k] = target[:, k] * impulse[0] + target[:, 3 + k] * impulse[1]
                impulse = step @ impulse
        return found


def unit(rng: np.random.Generator, size: int) -> Array:
    v = rng.standard_normal((ROWS, size))
    return v / norm(v)[:, None]


def attack(settings: Settings, *, start: float, delay: int, disturbance: float, k: float, delta: float) -> Array:
    """Run all rows; k and δ_Q are those of (C.77). Returns the largest of each of QUANTITIES."""
    rng, loop, wire = np.random.default_rng(1), Loop(settings), settings.wire
    ticks = settings.loop.ticks(DURATION_S)
    deltas = [signal.quantizer().bound for signal in (wire.attitude, wire.rate, wire.voltage)]
    acts = np.arange(3) >= 3 - wire.actuators  # with two motors u₁ is not quantized
    reference: Any = settings.reference
    path = twin.Sinusoids(np.radians(reference.amplitude), np.array(reference.frequency))
    cycle = np.arange(0, 40, loop.period)
    desired = [np.array(part) for part in zip(*map(path.desired, cycle), strict=True)]
    rates = to_body(desired[0], desired[1])

    # θ̃ as large as it can be, along an axis of the fastest turn at the end; every fourth row takes any phase.
    end = np.argsort(-np.abs(rates).max(axis=1))[rng.integers(0, 200, ROWS)]
    end[::4] = rng.integers(0, len(cycle), len(end[::4]))
    first = (end - ticks) % len(cycle)
    theta = np.identity(3)[np.abs(rates[end]).argmax(axis=1)] * rng.choice([-1.0, 1.0], (ROWS, 1))
    theta[::3] = unit(rng, 3)[::3]
    theta_hat = -theta * loop.k_theta / 0.95
    theta *= loop.k_theta

    def now(i: int) -> tuple[Array, Array, Array]:
        at = (first + i) % len(cycle)
        return desired[0][at], desired[1][at], desired[2][at]

    q_d, omega_d, _ = now(0)
    slow = -rates[first] * (theta - theta_hat)
    eps_e, z2 = np.hsplit(start * unit(rng, 6) + loop.K * np.hstack([slow, slow]), 2)
    e = np.hstack([np.sqrt(1 - norm(eps_e)[:, None] ** 2), eps_e])
    eta = q_d[:, :1] * e[:, :1] - (q_d[:, 1:] * eps_e).sum(axis=1, keepdims=True)
    q = np.hstack([eta, q_d[:, :1] * eps_e + e[:, :1] * q_d[:, 1:] + np.cross(q_d[:, 1:], eps_e)])
    x = np.hstack([q, z2 - loop.C1 * eps_e + to_body(q, omega_d)])
    V = ((1 - e[:, 0]) ** 2 + norm(eps_e) ** 2) + (z2**2 @ loop.J + (theta - theta_hat) ** 2 @ (1 / loop.Gamma)) / 2

    # Where to drive the error: on along the slow disturbance at the end, or anywhere.
    pushed = np.sign(-rates[end] * (theta - theta_hat))
    target = np.tile(pushed * (np.abs(rates[end]) > 1e-3), 2) * rng.uniform(0, 1, (ROWS, 6))
    target[::2] = unit(rng, 6)[::2]
    costates = loop.costates(target, ticks)
    greedy = np.arange(ROWS) % 6 == 5
    found, square, waiting = np.zeros(5), np.zeros(ROWS), list[Array]()
    for i in range(ticks):
        desired_now, q, omega = now(i), x[:, :4], x[:, 4:]
        eta_e, eps_e, _, z2 = loop.errors(q, omega, *desired_now[:2])
        z = np.sqrt((1 - eta_e[:, 0]) ** 2 + norm(eps_e) ** 2 + norm(z2) ** 2)
        square += loop.period * z**2
        p = np.where(greedy[:, None], z2, costates[i])

        eps_Q = q[:, None, 1:] + deltas[0] * VERTICES[:, :3]
        rest = np.sqrt(np.maximum(0.0, 1 - norm(eps_Q) ** 2))[..., None]
        q_Q = np.concatenate([np.where(q[:, None, :1] < 0, -rest, rest), eps_Q], axis=2)
        q_Q /= norm(q_Q)[..., None]  # Remark 2, where ‖ε^Q‖ > 1
        omega_Q = omega[:, None] + deltas[1] * VERTICES[:, 3:]
        each = tuple(part[:, None] for part in desired_now)
        torques, z2_Q = loop.torque(q_Q, omega_Q, (each[0], each[1], each[2]), theta_hat[:, None])
        best = (np.arange(ROWS), (torques * p[:, None]).sum(axis=2).argmax(axis=1))
        u = torques[best] @ loop.B_inverse.T
        theta_hat = loop.adapted(theta_hat, omega_Q[best], z2_Q[best])
        waiting.append((u + deltas[2] * acts * np.sign(p @ loop.B)) @ loop.B.T)
        tau_d = disturbance * p / np.maximum(norm(p), 1e-300)[:, None]
        x = loop.advance(x, waiting[max(0, i - delay)] + tau_d, theta)

        mean_square = k * square / (V + delta * loop.period * (i + 1))
        now_found = (z, np.abs(omega), np.abs(q[:, 1:]), np.abs(u[:, acts]), mean_square)
        found = np.maximum(found, [each.max() for each in now_found])
    return found


@lru_cache
def shares(name: str, start_share: float) -> dict[str, float]:
    """What the adversary reaches, each as a share of its bound."""
    overrides, delay, disturbance = CONFIGURATIONS[name]
    settings = load_over(Settings(), overrides)
    late_s = delay * settings.loop.period
    e = evaluate(settings, disturbance=disturbance, late_s=late_s)
    start = start_share * largest_start(e.body)
    at, k, delta = reach(e.body, start), e.theorem.k, e.theorem.delta_Qdist
    assert at is not None
    assert k is not None
    if not start:
        assert certify(settings, disturbance=disturbance, late_s=late_s).pointwise_radius == at.radius
    found = attack(settings, start=start, delay=delay, disturbance=disturbance, k=k, delta=delta)
    bounds = (at.radius, at.axis_rate, sin(at.half_angle), largest_voltage(settings, e.desired, at), 1.0)
    return dict(zip(QUANTITIES, found / bounds, strict=True))


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_no_loop_of_an_adversary_exceeds_what_is_proven(name: str, start: float) -> None:
    assert max(shares(name, start).values()) <= 1


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_an_adversary_exceeds_half_of_what_is_proven(name: str) -> None:
    assert max(shares(name, start)["‖z‖"] for start in STARTS) > 0.5


def test_the_adversary_s_law_is_the_paper_s() -> None:
    """Against the other twin, which the project's law is compared with: states of any size, θ̂ beyond k_θ."""
    rng, settings = np.random.default_rng(2), load_over(Settings(), ["law.inertia=[0.02, 0.03, 0.01]"])
    loop, body = Loop(settings), body_of(with_theorem(settings).law)
    q, q_d, (omega, omega_d, omega_d_dot, theta) = unit(rng, 4), unit(rng, 4), rng.standard_normal((4, ROWS, 3))
    theta *= loop.k_theta * 1.02 / norm(theta)[:, None]
    torques, z2 = loop.torque(q, omega, (q_d, omega_d, omega_d_dot), theta)
    adapted = loop.adapted(theta, omega, z2)
    for i in range(ROWS):
        other = twin.law(body, q[i], omega[i], q_d[i], omega_d[i], omega_d_dot[i], theta[i], 1.0)
        assert torques[i] == pytest.approx(body.B @ other.u)
        after = theta[i] + loop.period * other.theta_dot
        assert adapted[i] == pytest.approx(after * min(1, body.bound / 0.95 / norm(after)))
