"""One tick of a law, and the body that it acts on: (C.2) and the errors (C.16), (C.18), from the twin's parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from aeroloop.plant_emulator.model.bodies import RigidBodySettings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.laws.registry import configured_gains, initial_state, law_function, law_of
from tests.support import numpy_twin as twin
from tests.support.adversary_loop import times as product
from tests.support.numpy_twin import Array


class Tick:
    """One tick of a law, whose outputs it returns by name; `first` is the state before the first one."""

    def __init__(self, settings: LawSettings, period: float = 0.002, actuators: int = 3) -> None:
        self.law: Any = law_of(settings, period, actuators)
        self._function = law_function(self.law)
        self._gains = [x for gain in configured_gains(self.law).values() for x in gain]
        self.first = np.array([x for part in initial_state(self.law).values() for x in part])

    def __call__(
        self, state: Array, q: Array, omega: Array, q_d: Array, omega_d: Array, omega_d_dot: Array
    ) -> dict[str, Array]:
        eps = q[1:] if q[0] >= 0 else -q[1:]  # as sent: of whichever of ±q has η ≥ 0
        motion = {"omega": omega, "q_d": q_d, "omega_d": omega_d, "omega_d_dot": omega_d_dot}
        found = self._function(last=q, state=state, gains=self._gains, eps=eps, **motion)
        return {name: np.array(value, dtype=np.float64).ravel() for name, value in found.items()}


def unit(rng: np.random.Generator, size: int = 4) -> Array:
    v = rng.normal(size=size)
    return np.asarray(v / np.linalg.norm(v), dtype=np.float64)


def weight_torque(p: LawSettings | RigidBodySettings, q: Array) -> Array:
    """Torque of the weight about the origin, body frame [N·m]."""
    return np.cross(p.centre_of_mass, twin.rotation(q).T @ np.array([0, 0, -p.mass * p.gravity]))


def acceleration(p: LawSettings | RigidBodySettings, q: Array, omega: Array, torque: Array) -> Array:
    """ω̇ of a body by (C.2); `torque` is all but the weight's and the gyroscopic one."""
    J = np.array(p.inertia)
    return np.asarray((torque + weight_torque(p, q) - np.cross(omega, J * omega)) / J)


def errors(q: Array, omega: Array, q_d: Array, omega_d: Array) -> tuple[Array, Array]:
    return product(q_d * [1, -1, -1, -1], q), omega - twin.rotation(q).T @ omega_d


def errors_at(
    t: float, q: Array, omega: Array, omega_dot: Array, q_d: Array, omega_d: Array, omega_d_dot: Array
) -> tuple[Array, Array]:
    """e and ω_e a little later; (C.1) and (C.12) turn q and q_d, whose lengths stay 1 but for t²."""
    here = q + t / 2 * product(q, np.append(0, omega))
    there = q_d + t / 2 * product(np.append(0, omega_d), q_d)
    return errors(here, omega + t * omega_dot, there, omega_d + t * omega_d_dot)


def body_of(p: AdaptiveSettings) -> twin.Body:
    """The twin's body and gains, of the project's settings."""
    J, B, centre = np.diag(p.inertia), np.array(p.allocation), np.array(p.damping_estimate)
    gains = {name: np.diag(getattr(p, name)) for name in ("C1", "C2", "Gamma")}
    return twin.Body(
        J=J, m=p.mass, g=p.gravity, r_g=np.array(p.centre_of_mass), B=B, bound=p.damping_bound, centre=centre, **gains
    )
