"""Tuning rule of the baselines: each gets the bandwidth and the damping ratio that the paper's gains give.

Near the reference, without quantization and with the model exact, the paper's law (C.22) gives every axis of the
attitude error φ = 2ε̃ the equation

    J φ̈ + (C₂ + J C₁/2) φ̇ + ½ (1 + C₁C₂) φ = 0,

from z₂ = ω_e + C₁ε̃ and ᾱ = −½ C₁ω_e to first order, for η̃ near ±1. So its bandwidth is ωₙ = √((1 + C₁C₂)/(2J)) and
its damping ratio ζ = (C₂/J + C₁/2)/(2ωₙ): with Table C.1, 4.9 rad/s and 0.72. What a law has beyond these two:

- PID: a third pole at −ωₙ/10, c = ωₙ/2, and a reset time of anti-windup of 1/ωₙ.
- Sliding mode: two real poles, so both at −ωₙ (ζ = 1); K is half of the torque that the motors have at the limit of
  the voltages, and the layer as thick as the poles demand.
- LQR: the weights for which the continuous-time regulator has these poles. They exist for ζ ≥ 1/√2.

All know the same body, and feed the same first estimate of the damping forward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import sqrt
from typing import Final, NamedTuple

from aeroloop.service.control.laws.interface import LawSettings, Vector

VOLTAGE_LIMIT: Final = 24.0
"""Largest voltage of the Aero's supply [V]."""
_THIRD_POLE: Final = 0.1
"""Of the PID law, as a part of the bandwidth."""
_TORQUE_SHARE: Final = 0.5


class Response(NamedTuple):
    """Linearised attitude error, an element an axis: bandwidth ωₙ [rad/s] and damping ratio ζ [1]."""

    bandwidth: Vector
    damping: Vector


Fields = dict[str, Vector]
"""Settings of a law, by name."""


def response_of(inertia: Vector, C1: Vector, C2: Vector) -> Response:
    """What the paper's gains give a body with this inertia [kg·m²]."""
    axes = list(zip(inertia, C1, C2, strict=True))
    bandwidth = [sqrt((1 + c1 * c2) / (2 * J)) for J, c1, c2 in axes]
    damping = [(c2 / J + c1 / 2) / (2 * wn) for (J, c1, c2), wn in zip(axes, bandwidth, strict=True)]
    return Response(*(_vector(values, digits=15) for values in (bandwidth, damping)))


def tune_pd(body: LawSettings, response: Response) -> Fields:
    """J(s² + 2ζωₙs + ωₙ²) with kp on ε̃ = φ/2."""
    return _each(body, response, lambda J, wn, zeta: {"kp": 2 * J * wn**2, "kd": 2 * J * zeta * wn})


def tune_pid(body: LawSettings, response: Response) -> Fields:
    """J(s² + 2ζωₙs + ωₙ²)(s + a) = Js³ + kd s² + (kp/2 + ki)s + ki c/2, with a = ωₙ/10 and c = ωₙ/2."""

    def one(J: float, wn: float, zeta: float) -> Mapping[str, float]:
        a, c = _THIRD_POLE * wn, wn / 2
        ki = 2 * J * a * wn**2 / c
        kp = 2 * J * (wn**2 + 2 * zeta * wn * a) - 2 * ki
        return {"kp": kp, "kd": J * (2 * zeta * wn + a), "ki": ki, "attitude_share": c, "reset_time": 1 / wn}

    return _each(body, response, one)


def tune_sliding(body: LawSettings, response: Response) -> Fields:
    """Poles at −λ/2 and −K/(JΦ), both ωₙ; K half of the torque."""
    torques = [_TORQUE_SHARE * VOLTAGE_LIMIT * sum(map(abs, row)) for row in body.allocation]
    rows = zip(torques, body.inertia, response.bandwidth, strict=True)
    found = [{"slope": 2 * wn, "strength": K, "layer": K / (J * wn)} for K, J, wn in rows]
    return _columns(found)


def tune_lqr(body: LawSettings, response: Response) -> Fields:
    """Weights against the square of torque, so that τ = −Jωₙ²φ − 2ζωₙJφ̇ is optimal in continuous time."""
    return _each(
        body,
        response,
        lambda J, wn, zeta: {
            "attitude_weight": (J * wn**2) ** 2,
            "rate_weight": max(0.0, (2 * zeta * wn * J) ** 2 - 2 * J**2 * wn**2),
        },
    )


RULES: Final[Mapping[str, Callable[[LawSettings, Response], Fields]]] = {
    "pd": tune_pd,
    "pid": tune_pid,
    "sliding": tune_sliding,
    "lqr": tune_lqr,
}
"""By the kind of law. The law without adaptation has the paper's own gains."""


def tuned(kind: str, body: LawSettings, response: Response) -> Fields:
    """The settings that give a law of this kind a response with this body; none for a kind without a rule."""
    return RULES[kind](body, response) if kind in RULES else {}


def _each(body: LawSettings, response: Response, one: Callable[[float, float, float], Mapping[str, float]]) -> Fields:
    return _columns([one(*axis) for axis in zip(body.inertia, *response, strict=True)])


def _columns(axes: list[Mapping[str, float]] | list[dict[str, float]]) -> Fields:
    return {name: _vector([axis[name] for axis in axes]) for name in axes[0]}


def _vector(values: list[float], digits: int = 5) -> Vector:
    """Rounded, so that a reader can copy it."""
    x, y, z = (float(f"{value:.{digits}g}") for value in values)
    return x, y, z


PAPER_BODY: Final = LawSettings(kind="Table C.1")
PAPER: Final = response_of(PAPER_BODY.inertia, (0.3, 0.3, 0.3), (0.15, 0.15, 0.15))
"""Of Table C.1."""
