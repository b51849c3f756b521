"""Certificate: whether bits, gains and reference satisfy Theorem 1 and Corollary 1, and by how much.

All is computed from the effective configuration, by the equations of `bounds`. The theorem's other premises are
assumed: the damping (law.damping_bound), the disturbance, that no command saturates, and the largest attitude error,
because q's error grows without bound as η nears 0. That error is controller.start_within_deg by default, within which a
session begins; where the guaranteed final error is larger, it is widened until the two agree, so that no certificate
contradicts itself. The theorem assumes the law's J, B and g for the plant, and continuous time; friction, lag and
sensor errors are disturbances to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, degrees, inf, pi, radians, sin, sqrt
from typing import Any, Final, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.messages.operator import Reference
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.control.law import LawSettings
from aeroloop.service.settings import ControllerSettings
from aeroloop.service.theorem.bounds import Known, Lemma, Term, Theorem, lemma_1, theorem_1
from aeroloop.service.theorem.extremes import Extremes, extremes
from aeroloop.service.theorem.remedies import Remedy, remedies

_ROUNDS: Final = 500
_AGREED: Final = 1e-9


class CertificateTerm(BaseModel):
    """One quantity of the theorem, by its symbol in the paper."""

    model_config = ConfigDict(frozen=True)

    symbol: str
    equation: str = Field(description="number in the paper, or assumption or remark")
    value: float | None = Field(description="null where it does not exist because condition (C.66) fails")
    unit: str
    meaning: str


class Certificate(BaseModel):
    """The theorem evaluated for a configuration."""

    model_config = ConfigDict(frozen=True)

    holds: bool = Field(description="whether (C.66) is satisfied and the reference stays within the wire's ranges")
    margin: float = Field(description="c₀/2 − δ_V1 [N·m·s/rad]")
    c0: float = Field(description="c₀, as corrected [N·m·s/rad]")
    delta_V1: float = Field(description="δ_V1 of (C.67) [N·m·s/rad]")
    delta_V2: float = Field(description="δ_V2 of (C.71) [N·m]")
    delta_Q: float = Field(description="δ_Q of (C.69); δ_Qdist of (C.80) with a disturbance [W]")
    k: float | None = Field(description="the largest k of (C.66) [N·m·s/rad]; null where it fails")
    radius: float | None = Field(description="√(δ_Q/k), the final bound of ‖z‖ [1, rad/s]; null where (C.66) fails")
    radius_deg: float | None = Field(description="the attitude error at that bound [deg]; null where (C.66) fails")
    terms: list[CertificateTerm]
    blame: str | None = Field(description="why it does not hold; null where it does")
    remedies: list[Remedy] = Field(description="changes with which it would hold, the least of each kind")

    @property
    def verdict(self) -> str:
        """The certificate in a sentence."""
        disturbance = self.value("k_τ_d")
        name = f"Corollary 1, with ‖τ_d‖ ≤ {disturbance:g} N·m," if disturbance else "Theorem 1"
        if self.blame is not None:
            return f"{name} does not hold: {self.blame}."
        assert self.radius_deg is not None
        holds = (
            f"{name} holds: c₀/2 = {self.c0 / 2:.4g} exceeds δ_V1 = {self.delta_V1:.4g} by {self.margin:.4g} N·m·s/rad"
        )
        if self.radius == 0:
            return f"{holds}; the error goes to 0."
        if self.radius_deg >= 180:
            return f"{holds}; but ‖z‖ ≤ {self.radius:.4g} bounds no attitude error."
        assumed = 2 * degrees(self.value("max ∡e/2") or 0.0)
        return (
            f"{holds}; in the end ‖z‖ ≤ {self.radius:.4g}, an attitude error of {self.radius_deg:.2f}°, "
            f"provided that it never exceeds {assumed:.2f}°."
        )

    def value(self, symbol: str) -> float | None:
        """The value of the term with this symbol. Raises KeyError if there is none."""
        return {term.symbol: term.value for term in self.terms}[symbol]


@dataclass(frozen=True)
class Evaluated:
    """The quantities of a certificate."""

    known: Known
    lemma: Lemma
    theorem: Theorem


def certify(
    wire: WireSpec,
    law: LawSettings,
    reference: Reference,
    controller: ControllerSettings,
    *,
    disturbance: float = 0.0,
    attitude_error_deg: float | None = None,
) -> Certificate:
    """The certificate of a configuration.

    Args:
        wire: The quantizers.
        law: The model and the gains.
        reference: The reference.
        controller: How a session begins.
        disturbance: k_τ_d, the largest assumed ‖τ_d‖ [N·m].
        attitude_error_deg: Assumed bound on the attitude error at all times; controller.start_within_deg if None.

    Raises:
        BoundlessError: A stream, as its set-points have no bounds, or a reference too fast for floats.
        ValueError: A disturbance that is no number, or negative.
    """
    inputs_of = _inputs_of(reference, controller, disturbance, attitude_error_deg)
    bounds = evaluate(inputs_of(wire, law))
    t = bounds.theorem
    reasons, ways = _beyond_range(wire, bounds.known)
    if t.k is None:
        reasons.append(_blame(bounds.lemma, t))
        ways += remedies(wire, law, lambda wire, law: evaluate(inputs_of(wire, law)).theorem.k is not None)
    return Certificate(
        holds=not reasons,
        margin=t.margin,
        c0=t.c0,
        delta_V1=t.delta_V1,
        delta_V2=t.delta_V2,
        delta_Q=t.delta_Qdist,
        k=t.k,
        radius=t.radius,
        radius_deg=None if t.end_angle is None else degrees(t.end_angle),
        terms=[term for part in (bounds.known, bounds.lemma, t) for term in _terms(part)],
        blame="; and ".join(reasons) or None,
        remedies=ways,
    )


def bounds_of(
    wire: WireSpec,
    law: LawSettings,
    reference: Reference,
    controller: ControllerSettings,
    *,
    disturbance: float = 0.0,
    attitude_error_deg: float | None = None,
) -> Evaluated:
    """The quantities of a certificate, to check a run against; arguments and errors as of `certify`."""
    return evaluate(_inputs_of(reference, controller, disturbance, attitude_error_deg)(wire, law))


def _inputs_of(
    reference: Reference, controller: ControllerSettings, disturbance: float, attitude_error_deg: float | None
) -> Callable[[WireSpec, LawSettings], Known]:
    if not 0 <= disturbance < inf:
        raise ValueError(f"a disturbance is 0 or more, in N·m, not {disturbance}")
    start_deg = controller.start_within_deg if attitude_error_deg is None else attitude_error_deg
    return partial(known, desired=extremes(reference), disturbance=disturbance, error=radians(min(180.0, start_deg)))


def known(wire: WireSpec, law: LawSettings, *, desired: Extremes, disturbance: float, error: float) -> Known:
    """Inputs of the theorem for a configuration.

    Args:
        wire: The quantizers; a signal without one has the error 0.
        law: The model and the gains.
        desired: The reference's extremes.
        disturbance: k_τ_d [N·m].
        error: Largest attitude error [rad].
    """
    # With two motors the mechanism holds the roll, and the first row and column of B are fictitious.
    B = np.array(law.allocation)[3 - wire.actuators :, 3 - wire.actuators :]
    return Known(
        lambda_J=max(law.inertia),
        weight=float(np.linalg.norm(law.centre_of_mass)) * law.mass * law.gravity,
        norm_B=float(np.linalg.norm(B, 2)),
        C1_min=min(law.C1),
        C1_max=max(law.C1),
        C2_min=min(law.C2),
        C2_max=max(law.C2),
        delta_eps=_error(wire.attitude, 3),
        delta_omega=_error(wire.rate, 3),
        delta_u=_error(wire.voltage, wire.actuators),
        k_omega_d=desired.rate,
        k_omega_d_dot=desired.acceleration,
        half_angle_d=desired.half_angle,
        half_angle_e=error / 2,
        k_theta=law.damping_bound,
        k_tau_d=disturbance,
        omega_limit=wire.rate.limit,
        u_limit=wire.voltage.limit,
    )


def evaluate(p: Known) -> Evaluated:
    """The bounds, with the assumed attitude error widened to the guaranteed one if that is larger; at most 180°.

    Both grow together: from the assumed error the iteration ends at the least fixed point.
    """
    for _ in range(_ROUNDS):
        lemma = lemma_1(p)
        theorem = theorem_1(p, lemma)
        if theorem.end_angle is None or theorem.end_angle <= 2 * p.half_angle_e * (1 + _AGREED):
            return Evaluated(p, lemma, theorem)
        p = replace(p, half_angle_e=theorem.end_angle / 2)
    p = replace(p, half_angle_e=pi / 2)
    lemma = lemma_1(p)
    return Evaluated(p, lemma, theorem_1(p, lemma))


def _error(signal: SignalSpec, elements: int) -> float:
    """‖δ_y‖ of (C.15) for a vector with equal quantizers for all elements [signal's unit]."""
    return sqrt(elements) * signal.quantizer().bound


def _terms(part: Known | Lemma | Theorem) -> Iterator[CertificateTerm]:
    hints: dict[str, Any] = get_type_hints(type(part), include_extras=True)
    for name, hint in hints.items():
        term: Term = hint.__metadata__[0]
        yield CertificateTerm(value=getattr(part, name), **term._asdict())


def _blame(d: Lemma, t: Theorem) -> str:
    parts = {"δ_ᾱ2 λ_max(J)": t.alpha, "δ_Ψ2": d.delta_Psi2, "δ_S2 λ_max(J) k_ω_d": t.coriolis}
    symbol, value = max(parts.items(), key=lambda part: part[1])
    origin = "the gain C₁, whatever the bits" if value == t.alpha else "quantization"
    return (
        f"c₀/2 = {t.c0 / 2:.4g} does not exceed δ_V1 = {t.delta_V1:.4g} N·m·s/rad; its largest term is "
        f"{symbol} = {value:.4g}, which comes from {origin}"
    )


def _beyond_range(wire: WireSpec, p: Known) -> tuple[list[str], list[Remedy]]:
    """Where the reference leaves a quantizer's range, so that (C.28) or (C.29) fails: reasons and remedies."""
    reasons, ways = list[str](), list[Remedy]()
    eps = sin(min(pi / 2, p.half_angle_d + p.half_angle_e))
    for name, reached, limit, unit in (
        ("wire.rate", p.k_omega_d, wire.rate.limit, " rad/s"),
        ("wire.attitude", eps, wire.attitude.limit, ""),
    ):
        if reached > limit:
            reasons.append(f"the reference reaches {reached:.4g}{unit}, beyond {name}.limit = {limit:g}{unit}")
            enough = f"{name}.limit={ceil(100 * reached) / 100:g}"
            ways.append(Remedy(text=f"a range that holds the reference, {name}", overrides=[enough]))
    return reasons, ways
