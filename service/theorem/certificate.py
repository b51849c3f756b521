"""Certificate: what is proven of a configuration, with its assumptions, and what fails.

Two statements stand side by side. The mean square of (C.77) follows from condition (C.66), by the paper's own terms in
`bounds`. A bound at every instant follows from `invariant`, for the paper's body and for the configured plant. The
certificate holds if both are proven of the configured plant and the set lies within everything that the proof
presumes: the wire's ranges, the voltages within reach, half a turn, the bound of the damping.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from math import asin, degrees, floor, hypot
from typing import Any, Final, get_type_hints

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.messages.operator import Hold
from aeroloop.service.theorem.bounds import Known, Lemma, Term, Theorem
from aeroloop.service.theorem.configured import Configured, Sections, with_theorem
from aeroloop.service.theorem.evaluation import Evaluated, beyond, evaluate
from aeroloop.service.theorem.invariant import Reach, reach, without_error
from aeroloop.service.theorem.margins import largest_delay


class CertificateTerm(BaseModel):
    """One quantity of the theorem, by its symbol in the paper."""

    model_config = ConfigDict(frozen=True)

    symbol: str
    equation: str = Field(description="number in the paper, or assumption or remark")
    value: float | None = Field(description="null where it does not exist: without a set, or as (C.66) fails")
    unit: str
    meaning: str


class Certificate(BaseModel):
    """What is proven of a configuration."""

    model_config = ConfigDict(frozen=True)

    holds: bool = Field(description="whether everything below is proven of the configured plant")
    margin: float = Field(description="c₀/2 − δ_V1 [N·m·s/rad]")
    c0: float = Field(description="c₀, as corrected [N·m·s/rad]")
    delta_V1: float = Field(description="δ_V1 of (C.67) [N·m·s/rad]")
    delta_V2: float = Field(description="δ_V2 of (C.71) [N·m]")
    delta_Q: float = Field(
        description="δ_Q of (C.69); δ_Qdist of (C.80) with a disturbance; of continuous time without a set [W]"
    )
    k: float | None = Field(description="the largest k of (C.66) [N·m·s/rad]; null where it fails")
    radius: float | None = Field(description="√(δ_Q/k) of (C.79); null where (C.66) fails or no set is proven")
    rms_radius: float | None = Field(
        description="bounds the root of the mean of ‖z‖² in the long run: radius, or pointwise_radius if that is less "
        "[1, rad/s]; null where radius is"
    )
    pointwise_radius: float | None = Field(
        description="bound of ‖z‖ at every instant, in the end, for the paper's body under this wire, law and period "
        "[1, rad/s]; null where none is proven"
    )
    pointwise_deg: float | None = Field(description="the attitude error within that bound [deg]")
    plant_radius: float | None = Field(
        description="the same for the configured plant: its mechanism, lag, friction, wind, sensors and transport"
    )
    plant_deg: float | None = Field(description="the attitude error within that bound [deg]")
    delay_ms: float | None = Field(
        description="largest further delay of commands with which it still holds [ms]; null where it does not hold"
    )
    lost_frames: int | None = Field(
        description="most frames lost in a row, if none is delayed, with which it still holds; null likewise"
    )
    assumptions: list[str] = Field(description="what is assumed, each with the key or the option that states it")
    violated: list[str] = Field(description="what fails, each with the key that would mend it; empty where it holds")
    terms: list[CertificateTerm]

    @property
    def verdict(self) -> str:
        """The certificate in a sentence."""
        if self.violated:
            more = len(self.violated) - 1
            return f"The certificate does not hold: {self.violated[0]}{f' (and {more} more)' if more else ''}."
        assert self.plant_radius is not None
        assert self.plant_deg is not None
        return (
            f"The certificate holds: once there, ‖z‖ stays within {self.plant_radius:.4g}, the attitude within "
            f"{self.plant_deg:.2f}°."
        )

    def value(self, symbol: str) -> float | None:
        """The value of the term with this symbol. Raises KeyError if there is none."""
        return {term.symbol: term.value for term in self.terms}[symbol]


def certify(
    settings: Sections,
    *,
    disturbance: float | None = None,
    attitude_error_deg: float | None = None,
    late_s: float = 0.0,
) -> Certificate:
    """The certificate of a configuration.

    Args:
        settings: The configuration.
        disturbance: The largest ‖τ_d‖ beyond what the plant's settings say [N·m]; None is 0, and not stated.
        attitude_error_deg: Assumed bound on the attitude error, for Lemma 1; controller.start_within_deg if None.
        late_s: Further age of a command, by delay or lost frames [s].

    Raises:
        BoundlessError: A stream, as its set-points have no bounds, or a reference too fast for floats.
        ValueError: A disturbance that is no number, or negative.
    """
    settings = with_theorem(settings)
    evaluated = partial(evaluate, disturbance=disturbance, attitude_error_deg=attitude_error_deg, late_s=late_s)
    e = evaluated(settings)
    t = e.theorem
    violated = _violated(settings, e)

    def fails_after(delay: float) -> bool:
        later = evaluated(settings, late_s=late_s + delay, only_plant=True, desired=e.desired)
        return bool(_violated(settings, later))

    delay = None if violated else largest_delay(fails_after)
    return Certificate(
        holds=not violated,
        margin=t.margin,
        c0=t.c0,
        delta_V1=t.delta_V1,
        delta_V2=t.delta_V2,
        delta_Q=t.delta_Qdist,
        k=t.k,
        radius=t.radius,
        rms_radius=None if t.radius is None or e.body_reach is None else min(t.radius, e.body_reach.radius),
        pointwise_radius=_radius(e.body_reach),
        pointwise_deg=_degrees(e.body_reach),
        plant_radius=_radius(e.plant_reach),
        plant_deg=_degrees(e.plant_reach),
        delay_ms=None if delay is None else floor(delay * 1e5) / 100,
        lost_frames=None if delay is None else floor(delay / settings.loop.period),
        assumptions=_assumptions(settings, e, disturbance),
        violated=violated,
        terms=[*(term for part in (e.known, e.lemma, t) for term in _terms(part)), *_reach_terms(e.plant_reach)],
    )


def _violated(settings: Configured, e: Evaluated) -> list[str]:
    """What fails, the gravest first."""
    found = list(e.bounds.unproven)
    law = settings.law
    if e.theorem.k is None:
        found.append(_condition(e.lemma, e.theorem))
    if e.bounds.theta is not None and (norm := hypot(*e.bounds.theta)) > law.damping_bound:
        found.append(f"the plant's damping, ‖θ‖ = {norm:.3g}, exceeds law.damping_bound = {law.damping_bound:g}")
    found += _beyond(settings, e, e.plant_reach or without_error(e.plant))
    if e.plant_reach is None:
        found.append(_unproven(e))
    return found


def _beyond(settings: Configured, e: Evaluated, at: Reach) -> list[str]:
    where = "the set" if e.plant_reach else "what the quantizers alone do along the reference"
    return [
        f"{name} = {most:g} {unit}".rstrip() + f", and {symbol} may reach {value:.3g} {unit}".rstrip() + f" by {where}"
        for symbol, value, unit, most, name in beyond(settings, e.desired, e.plant, at)
    ]


def _unproven(e: Evaluated) -> str:
    """Which properties of the plant, removed one after the other, leave a set that is proven."""
    p, body = e.plant, e.body
    without: tuple[tuple[str, dict[str, Any]], ...] = (
        (f"commands {p.age * 1e3:.3g} ms old (rotor lag, period, transport)", {"age": 0.0}),
        ("the held roll (u₁ is never applied)", {"tilt": None}),
        (f"a rate sensor that errs by {p.delta_omega:.2g} rad/s", {"delta_omega": body.delta_omega, "rate_lag": 0.0}),
        (f"a torque of {p.k_tau_d:.2g} N·m", {"k_tau_d": body.k_tau_d}),
        ("the attitude sensor's error", {"delta_q": body.delta_q} if e.bounds.delta_eps else {}),
        (f"‖θ̃‖ up to {p.theta_error:.3g} N·m·s/rad (law.damping_bound)", {"k_theta": 0.0, "k_theta_hat": 0.0}),
        ("quantization", {"delta_q": lambda _: 0.0, "delta_omega": 0.0, "delta_u": 0.0}),
    )
    names = list[str]()
    for name, change in without:
        changed = replace(p, **change)
        if changed != p:
            p = changed
            names.append(name)
            if reach(p) is not None:
                break
    return f"pointwise: no invariant set is proven with {'; with '.join(names)}"


def _condition(d: Lemma, t: Theorem) -> str:
    parts = {"δ_ᾱ2 λ_max(J)": t.alpha, "δ_Ψ2": d.delta_Psi2, "δ_S2 λ_max(J) k_ω_d": t.coriolis}
    symbol, value = max(parts.items(), key=lambda part: part[1])
    return (
        f"condition (C.66): c₀/2 = {t.c0 / 2:.4g} does not exceed δ_V1 = {t.delta_V1:.4g} N·m·s/rad; its largest term "
        f"is {symbol} = {value:.4g}, which comes from quantization"
    )


def _assumptions(settings: Configured, e: Evaluated, disturbance: float | None) -> list[str]:
    law = settings.law
    start = degrees(2 * e.known.half_angle_e)
    found = isinstance(settings.reference, Hold) and settings.reference.attitude is None
    torque = f"no torque beyond the plant's settings and {disturbance or 0:g} N·m (--disturbance)"
    return [
        f"‖θ‖ ≤ {law.damping_bound:g} N·m·s/rad, and θ is constant (law.damping_bound)",
        torque,
        f"for the mean square: the attitude error stays below {start:g}° (--attitude-error)",
        "for the bound at every instant: a state near enough to the set, once (`log review` finds it), and for the age "
        "of a command before",
        "the reference itself is followed: no approach to it is certified, at a start or after an operator's change",
        "the law's J, B, m and r_g are the plant's ([law])",
        *(["the attitude that it finds and holds is level (reference.attitude)"] if found else []),
        *e.bounds.assumed,
    ]


def _terms(part: Known | Lemma | Theorem) -> Iterator[CertificateTerm]:
    hints: dict[str, Any] = get_type_hints(type(part), include_extras=True)
    for name, hint in hints.items():
        term: Term = hint.__metadata__[0]
        yield CertificateTerm(value=getattr(part, name), **term._asdict())


_REACH: Final = {
    "eps_e": ("max ‖ε̃‖", "1", "attitude error within the configured plant's set"),
    "omega_e": ("max ‖ω_e‖", "rad/s", "rate error within it"),
    "axis_rate": ("max |ω_k| reached", "rad/s", "rate about an axis within it"),
    "slow": ("‖w_s‖", "N·m", "slow disturbance: θ̃ along the reference"),
    "fast": ("‖w_f‖", "N·m", "fast disturbance: quantization, age, sensors, friction, wind"),
    "hold": ("τ_h of the plant", "N·m", "the part of it by which commands are out of date"),
    "deviation": ("max ‖B u − B u_d‖", "N·m", "command beyond that of the reference"),
}


def _reach_terms(at: Reach | None) -> Iterator[CertificateTerm]:
    for name, (symbol, unit, meaning) in _REACH.items():
        value = None if at is None else getattr(at, name)
        yield CertificateTerm(symbol=symbol, equation="invariant set", value=value, unit=unit, meaning=meaning)


def _radius(at: Reach | None) -> float | None:
    return None if at is None else at.radius


def _degrees(at: Reach | None) -> float | None:
    return None if at is None else degrees(2 * asin(at.eps_e))
