"""Feedback: a law near its reference, as the error equations of `invariant` see it: (T.1) of README.md.

c of a law without an integral is C₁, or 0: the share of ε̃ in z₂. What `adaptive-torque` makes of Coulomb friction is
a disturbance.
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, inf, sqrt
from typing import NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.attitude import Vector
from aeroloop.service.control.laws.adaptive import ESTIMATE_REACH, AdaptiveSettings
from aeroloop.service.control.laws.adaptive_torque import AdaptiveTorqueSettings
from aeroloop.service.control.laws.baselines import NonadaptiveSettings, PDSettings, PIDSettings
from aeroloop.service.control.laws.interface import LawSettings

_NONE: Vector = (0.0, 0.0, 0.0)


class NoTheoremError(AeroloopError):
    """Nothing is proven of a configuration's law; one line."""


class Feedback(NamedTuple):
    """A law near its reference; vectors are diagonals."""

    kp: Vector  # gain of ε̃ [N·m]
    kd: Vector  # gain of ω_e, without α [N·m·s/rad]
    alpha: Vector  # α, part of the gain of ω_e that acts through (η̃ I + S(ε̃)) [N·m·s/rad]
    ki: Vector  # gain of the integral [N·m/rad]; 0 where there is none
    share: Vector  # c, of ε̃ in z₂ = ω_e + c ε̃ and in the integral [1/s]
    centre: Vector  # θ̂(t₀), the centre of the ball that holds θ [N·m·s/rad]
    radius: float  # k_θ, the radius of that ball [N·m·s/rad]
    reach: float = 0.0  # largest ‖θ̂ − θ̂(t₀)‖: k_θ/0.95 by the projection, 0 where nothing adapts [N·m·s/rad]
    Gamma: Vector = _NONE  # adaptation gain; 0 where nothing adapts
    volts: float = inf  # |u| from which the law itself saturates [V]
    torque: float = inf  # |θ̂_d| from which the estimate of a constant torque is kept back [N·m]
    coulomb: float = 0.0  # largest ‖θ̂_c‖, an estimate of Coulomb friction, which counts as a disturbance [N·m]
    virtual: bool = False  # whether θ̂ − θ̂(t₀) acts at the virtual rate ω − z₂ in place of ω

    @property
    def theta_error(self) -> float:
        """Largest ‖θ̃‖ [N·m·s/rad]."""
        return self.radius + self.reach

    @property
    def estimate(self) -> float:
        """Largest ‖θ̂‖ [N·m·s/rad]."""
        return hypot(*self.centre) + self.reach


def feedback_of(law: LawSettings) -> Feedback:
    """The feedback of a law's settings. Raises NoTheoremError for a law of which nothing is proven."""
    known = AdaptiveSettings, NonadaptiveSettings, PDSettings, PIDSettings, AdaptiveTorqueSettings
    if isinstance(law, known) and {len(row) for row in law.allocation} != {3}:
        raise NoTheoremError("no theorem for this vehicle, whose law.allocation is not 3 × 3")
    match law:
        case AdaptiveSettings() | NonadaptiveSettings():
            return Feedback(
                kp=_each(lambda c1, c2: 1 + c1 * c2, law.C1, law.C2),
                kd=law.C2,
                alpha=_each(lambda j, c1: j * c1 / 2, law.inertia, law.C1),
                ki=_NONE,
                share=law.C1,
                centre=law.damping_estimate,
                radius=law.damping_bound,
                reach=law.damping_bound * ESTIMATE_REACH if isinstance(law, AdaptiveSettings) else 0.0,
                Gamma=law.Gamma if isinstance(law, AdaptiveSettings) else _NONE,
            )
        case PDSettings() | PIDSettings():
            pid = law if isinstance(law, PIDSettings) else None
            return Feedback(
                kp=law.kp,
                kd=law.kd,
                alpha=_NONE,
                ki=pid.ki if pid else _NONE,
                share=pid.attitude_share if pid else _NONE,
                centre=law.damping_estimate,
                radius=law.damping_bound,
                volts=pid.voltage_limit if pid else inf,
            )
        case AdaptiveTorqueSettings():

            def bounded(first: float, gain: float) -> float:
                return first + law.coulomb_bound * (gain > 0)

            return Feedback(
                kp=_each(lambda k, c: k + c, law.k1, _each(lambda c1, c2: c1 * c2, law.C1, law.C2)),
                kd=law.C2,
                alpha=_each(lambda j, c1: j * c1 / 2, law.inertia, law.C1),
                ki=law.Gamma_torque,
                share=law.C1,
                centre=law.damping_estimate,
                radius=law.damping_bound,
                reach=sqrt(3) * law.damping_bound if any(law.Gamma_damping) else 0.0,  # a box, not a ball
                Gamma=law.Gamma_damping,
                volts=law.voltage_limit,
                torque=min(law.torque_bound),
                coulomb=hypot(*_each(bounded, law.coulomb_estimate, law.Gamma_coulomb)),
                virtual=True,
            )
    raise NoTheoremError(f"no theorem for this law, {law.kind}")


def _each(of: Callable[[float, float], float], first: Vector, second: Vector) -> Vector:
    a, b, c = (of(x, y) for x, y in zip(first, second, strict=True))
    return a, b, c
