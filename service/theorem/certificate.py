"""Certificate: what is proven of a configuration, with its assumptions, and what fails.

For every law in `feedback`: a bound of the error at every instant, by `invariant`, for the paper's body and for
the configured plant. The certificate holds if the plant's set is proven and lies within all that the proof presumes:
the wire's ranges, the voltages within reach, half a turn, the bound of the damping; and within the limits beyond which
the plant trips, or the daemon refuses the reference. Of the paper's law also condition
(C.66) with its terms, by `bounds`: a law in continuous time, so nothing of a sampled loop is concluded from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import asin, degrees, floor, hypot, inf, pi, radians, sin
from typing import Any, Final, NamedTuple, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aeroloop.protocol.messages.operator import Change, Hold, in_force
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.interface import LawSettings
from aeroloop.service.control.motion import START_WITHIN_DEG
from aeroloop.service.control.reference import FollowError, Limits, Trajectory
from aeroloop.service.theorem.bounds import Known, Lemma, Term, Theorem, lemma_1, theorem_1
from aeroloop.service.theorem.extremes import BoundlessError, Extremes, extremes, motors
from aeroloop.service.theorem.invariant import Reach, reach, without_error
from aeroloop.service.theorem.premises import (
    NO_ENCODER,
    NoTheoremError,
    PlantBounds,
    Premises,
    feedback_of,
    plant_bounds,
    premises,
    quantization_error,
)

MOST_DELAY_S: Final = 1.0
RESOLUTION_S: Final = 1e-5
"""The search of the largest delay."""


class Certificate(BaseModel):
    """What is proven of a configuration."""

    model_config = ConfigDict(frozen=True)

    holds: bool = Field(description="whether the bound at every instant is proven of the configured plant")
    pointwise_radius: float | None = Field(
        description="bound of ‖z‖ at every instant, in the end, for the paper's body under this wire, law and period "
        "[1, rad/s]; null where none is proven"
    )
    pointwise_deg: float | None = Field(description="the attitude error within that bound [deg]")
    plant_radius: float | None = Field(
        description="the same for the configured plant: its mechanism, lag, friction, wind, sensors and transport"
    )
    plant_deg: float | None = Field(description="the attitude error within that bound [deg]")
    constant_radius: float | None = Field(
        description="plant_radius if θ̂ stayed at its first value (law.kind = 'nonadaptive'); null where none is proven"
    )
    delay_ms: float | None = Field(
        description="largest further delay of commands with which it still holds, and which the plant's watchdog lets "
        "pass [ms]; null where it does not hold"
    )
    lost_frames: int | None = Field(
        description="most frames lost in a row, if none is late, with which it still holds, and with which neither "
        "the plant nor the controller ends the session; null where it does not hold, and of a law with an integral, "
        "which does not advance without a measurement"
    )
    assumptions: list[str] = Field(description="what is assumed, each with the key or the option that states it")
    violated: list[str] = Field(description="what fails, each with the key that would mend it; empty where it holds")
    terms: list[Term]

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


class Paper(NamedTuple):
    """What the paper says of its law: inputs, Lemma 1, Theorem 1."""

    known: Known
    lemma: Lemma
    theorem: Theorem


@dataclass(frozen=True)
class Evaluated:
    """The quantities of a certificate, to check a run against; None where nothing is proven."""

    paper: Paper | None  # what the paper says of its law; None of another
    body: Premises  # of the paper's body
    plant: Premises  # of the configured plant
    body_reach: Reach | None
    plant_reach: Reach | None


def evaluate(settings: Settings, *, disturbance: float | None = None, late_s: float = 0.0) -> Evaluated:
    """The quantities of a certificate; arguments and errors as of `certify`."""
    stated = disturbance or 0.0
    if not 0 <= stated < inf:
        raise ValueError(f"a disturbance is 0 or more, in N·m, not {stated}")
    feedback_of(settings.law)  # raises before anything is computed
    desired = extremes(settings)
    bounds = plant_bounds(settings, disturbance is not None)
    limits = Limits.of(settings.controller, settings.wire.actuators)
    try:
        Trajectory.of(settings.reference).check(limits._replace(rolls=not bounds.held_roll))
    except FollowError as error:
        bounds = replace(bounds, unproven=[*bounds.unproven, str(error)])
    body = premises(settings, desired, PlantBounds(settings.loop.period), stated, late_s)
    plant = premises(settings, desired, bounds, stated, late_s)
    body_reach, plant_reach = reach(body), reach(plant)
    paper = None
    if isinstance(law := settings.law, AdaptiveSettings):
        # The assumed error is widened to that of the sets, so that no certificate contradicts itself.
        half_angle = max(radians(START_WITHIN_DEG) / 2, *(asin(at.eps_e) for at in (body_reach, plant_reach) if at), 0)
        known = Known(
            lambda_J=max(law.inertia), weight=body.weight, norm_B=body.norm_B,
            C1_min=min(law.C1), C1_max=max(law.C1), C2_min=min(law.C2), C2_max=max(law.C2),
            delta_eps=quantization_error(settings.wire.attitude, 3),
            delta_omega=quantization_error(settings.wire.rate, 3), delta_u=body.delta_u,
            k_omega_d=desired.rate, k_omega_d_dot=desired.acceleration,
            half_angle_d=desired.half_angle, half_angle_e=half_angle,
            k_theta=hypot(*law.damping_estimate) + law.damping_bound, k_theta_err=body.law.theta_error,
            k_tau_d=body.plant.torque,
        )  # fmt: skip
        lemma = lemma_1(known)
        paper = Paper(known, lemma, theorem_1(known, lemma))
    return Evaluated(paper, body, plant, body_reach, plant_reach)


def certify(
    settings: Settings, *, disturbance: float | None = None, late_s: float = 0.0, margins: bool = True
) -> Certificate:
    """The certificate of a configuration.

    Args:
        settings: The configuration.
        disturbance: The largest ‖τ_d‖ beyond what the plant's settings say [N·m]; None is 0, and not stated.
        late_s: Further age of a command, by delay, or by lost frames where the law has no integral [s].
        margins: Search delay_ms and lost_frames, too.

    Raises:
        NoTheoremError: Nothing is proven of the law.
        BoundlessError: A stream, as its set-points have no bounds, or a reference too fast for floats.
        ValueError: A disturbance that is no number, or negative.
    """
    e = evaluate(settings, disturbance=disturbance, late_s=late_s)
    return _certificate(settings, e, disturbance, margins, late_s)


def _certificate(
    settings: Settings, e: Evaluated, disturbance: float | None, margins: bool, late_s: float = 0.0
) -> Certificate:
    violated = _violated(settings, e, e.plant, e.plant_reach)
    patience = patience_of(settings)
    if late_s > patience.delay_s + RESOLUTION_S:
        violated.append(
            f"plant.watchdog_s = {settings.plant.watchdog_s:g} s, and commands come {late_s * 1e3:.4g} ms later"
        )
    delay = None
    lost_frames = None
    if margins and not violated:
        delay = _largest_delay(settings, e, max(patience.delay_s - late_s, 0.0))
        if not any(e.plant.law.ki):
            ticks = floor(delay / settings.loop.period + RESOLUTION_S)
            lost_frames = min(ticks // patience.heartbeat_ticks, patience.lost_frames)
    law = e.plant.law
    constant = replace(e.plant, law=law._replace(reach=0.0, Gamma=(0.0, 0.0, 0.0)))
    reached = (e.body_reach, e.plant_reach, reach(constant) if law.reach else e.plant_reach)
    (radius, deg), (plant_radius, plant_deg), (constant_radius, _) = (
        (at.radius, at.degrees) if at else (None, None) for at in reached
    )
    return Certificate(
        holds=not violated,
        pointwise_radius=radius,
        pointwise_deg=deg,
        plant_radius=plant_radius,
        plant_deg=plant_deg,
        constant_radius=constant_radius,
        delay_ms=None if delay is None else floor(delay * 1e5) / 100,
        lost_frames=lost_frames,
        assumptions=list(_assumptions(settings, e, disturbance)),
        violated=violated,
        terms=list(_terms(e)),
    )


def described_certificate(settings: Settings) -> dict[str, Any] | None:
    """The certificate as a controller's description carries it; None of a stream, or of a law without a theorem."""
    try:
        return certify(settings).model_dump(mode="json")
    except (NoTheoremError, BoundlessError):
        return None


class Promise(NamedTuple):
    """The law with the gains in force, its certificate, what that is made of, and the verdict in a sentence.

    Of a law without a theorem, or a reference without bounds, only the law and the verdict are known.
    """

    law: LawSettings
    certificate: Certificate | None
    bounds: Evaluated | None
    verdict: str


def promise(settings: Settings, changes: Sequence[Change] = (), described: Mapping[str, Any] | None = None) -> Promise:
    """What is promised with these changes of gains and reference in force.

    `described` is the certificate in the controller's description: it counts if both are as configured.
    """
    law, reference = settings.law, settings.reference
    for change in in_force(changes):
        reference = change.reference or reference
        if change.gains is not None:
            law = law.model_copy(update=change.gains.named)
    begun = settings.model_copy(update={"law": law, "reference": reference})
    try:
        bounds = evaluate(begun)
    except NoTheoremError as error:
        return Promise(law, None, None, f"{str(error)[:1].upper()}{str(error)[1:]}.")
    except BoundlessError as error:
        return Promise(law, None, None, f"Nothing is promised: {error}.")
    certificate = None
    if begun == settings and described is not None:
        with suppress(ValidationError):  # of another version
            certificate = Certificate.model_validate(described)
    certificate = certificate or _certificate(begun, bounds, None, margins=False)
    return Promise(law, certificate, bounds, certificate.verdict)


class Patience(NamedTuple):
    """What both ends wait for before they end a session."""

    delay_s: float  # longest further delay of all commands [s]
    lost_frames: int  # most frames lost in a row
    heartbeat_ticks: int  # ticks from one frame to the next, at the most: 1 unless frames are sent on change


def patience_of(settings: Settings) -> Patience:
    """What the plant's watchdog (`Freshness` of its endpoint) and `controller.stale_s` let pass.

    A plant trips at the tick that is its watchdog's time after the last fresh command.
    """
    loop, wire = settings.loop, settings.wire
    heartbeat_ticks = 1
    if "on_change" in (wire.transmit.measurement, wire.transmit.command) and not loop.lockstep:
        heartbeat_ticks = wire.transmit.heartbeat_ticks(loop.period_ns, wire.measurement.counters)
    watchdog_ticks = max(1, round(settings.plant.watchdog_s / loop.period))
    delay_s = max(0, watchdog_ticks - heartbeat_ticks) * loop.period
    stale_ticks = floor(settings.controller.stale_s / loop.period + RESOLUTION_S)
    frames = min(watchdog_ticks, stale_ticks) // heartbeat_ticks
    return Patience(delay_s, max(0, frames - 1), heartbeat_ticks)


def _largest_delay(settings: Settings, e: Evaluated, most_s: float) -> float:
    """The largest further age of a command, up to `most_s`, with which it holds, within `RESOLUTION_S` below [s].

    A command is as old as its measurement until the next one replaces it: hold + delay + frames lost · period. So one
    bisection gives both, the largest delay and the most frames lost in a row.
    """

    def holds(delay: float) -> bool:
        later = replace(e.plant, plant=replace(e.plant.plant, age=e.plant.plant.age + delay))
        return not _violated(settings, e, later, reach(later))

    low, high = 0.0, min(most_s, MOST_DELAY_S)
    if holds(high):
        return high
    while high - low > RESOLUTION_S:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _violated(settings: Settings, e: Evaluated, p: Premises, at: Reach | None) -> list[str]:
    """What fails, the gravest first."""
    found = list(p.plant.unproven)
    if p.plant.theta is not None:
        away = hypot(*(a - b for a, b in zip(p.plant.theta, p.law.centre, strict=True)))
        if away > p.law.radius:
            found.append(
                f"the plant's damping is {away:.3g} N·m·s/rad from law.damping_estimate, and law.damping_bound = "
                f"{p.law.radius:g}"
            )
    where = "the set" if at else "what the quantizers alone do along the reference"
    for symbol, value, unit, most, name in beyond(settings, p, at or without_error(p)):
        allowed, reached = f"{name} = {most:g} {unit}".rstrip(), f"{value:.3g} {unit}".rstrip()
        found.append(f"{allowed}, and {symbol} may reach {reached} by {where}")
    if at is None:
        return [*found, _unproven(p, e.body)]
    quantizer = settings.wire.voltage.quantizer()
    full = min(quantizer.outermost, settings.plant.voltage_limit)
    volts = largest_voltage(settings, p.desired, at)
    if volts + quantizer.bound > full and not any(reason.startswith("saturation") for reason in found):
        found.append(
            f"trip: at {full:g} V, full voltage, a motor counts as saturated (plant.limits.max_saturated_s), and |u_k| "
            f"of {volts:.3g} V may be quantized to it"
        )
    return found


def beyond(settings: Settings, p: Premises, at: Reach) -> list[tuple[str, float, str, float, str]]:
    """Ranges that a set exceeds: symbol, what it reaches, unit, range, and what fails, with its key."""
    wire = settings.wire
    limit = min(wire.voltage.limit, settings.plant.voltage_limit, p.law.volts)
    # The plant judges itself by its own sensors; an encoder's angle errs by twice as much as its ε_k.
    tilt = min(pi, p.desired.tilt + 2 * asin(at.eps_e) + 2 * p.plant.delta_eps)
    speed = p.desired.rate + at.omega_e + at.rate_error
    trips = settings.plant.limits
    ranges = (
        ("|ω_k|", at.axis_rate + at.rate_error, "rad/s", wire.rate.limit, "range: wire.rate.limit"),
        ("|ε_k|", sin(at.half_angle), "", wire.attitude.limit, "range: wire.attitude.limit"),
        ("|u_k|", largest_voltage(settings, p.desired, at), "V", limit, "saturation: wire.voltage.limit"),
        ("|θ̂_d|", at.integral, "N·m", p.law.torque, "law.torque_bound"),
        ("the tilt", degrees(tilt), "°", trips.max_tilt_deg, "trip: plant.limits.max_tilt_deg"),
        ("‖ω‖", speed, "rad/s", trips.max_rate, "trip: plant.limits.max_rate"),
    )
    return [reached for reached in ranges if reached[1] > reached[3]]


def largest_voltage(settings: Settings, desired: Extremes, at: Reach) -> float:
    """The largest |u_k| that the law commands within a set [V]."""
    inverse = np.linalg.inv(motors(settings))
    return float((desired.voltages + np.linalg.norm(inverse, axis=1) * at.deviation).max())


def _unproven(p: Premises, body: Premises) -> str:
    """Which properties of the plant, removed one after the other, leave a set that is proven."""
    plant, torque = p.plant, p.plant.torque + p.plant.steady
    of_body: dict[str, Any] = {"delta_q": body.delta_q} if plant.delta_eps else {}
    known_theta = p.law._replace(radius=0.0, reach=0.0, Gamma=(0.0, 0.0, 0.0))
    without: tuple[tuple[str, dict[str, Any], dict[str, Any]], ...] = (  # name, changed premises, changed plant
        (f"rotors that lag by {plant.lag:.3g} s", {}, {"lag": 0.0, "uneven": 0.0}),
        (f"commands {plant.age * 1e3:.3g} ms old", {}, {"age": 0.0}),
        ("the held roll (u₁ is never applied)", {}, {"held_roll": False}),
        ("the rate sensor's errors", {"delta_omega": body.delta_omega}, {"encoder": NO_ENCODER}),
        (f"a torque of {torque:.2g} N·m", {}, {"torque": body.plant.torque, "steady": 0.0}),
        ("the attitude sensor's error", of_body, {}),
        (f"‖θ̃‖ up to {p.law.theta_error:.3g} N·m·s/rad (law.damping_bound)", {"law": known_theta}, {}),
        ("quantization", {"delta_q": lambda _: 0.0, "delta_omega": 0.0, "delta_u": 0.0}, {}),
    )
    names = list[str]()
    for name, changes, of_it in without:
        changed = replace(p, plant=replace(p.plant, **of_it), **changes)
        if changed != p:
            p = changed
            names.append(name)
            if reach(p) is not None:
                break
    return f"no invariant set is proven with {'; with '.join(names)}"


def _assumptions(settings: Settings, e: Evaluated, disturbance: float | None) -> Iterator[str]:
    law = e.plant.law
    yield f"θ is constant, within {law.radius:g} N·m·s/rad of the first estimate (law.damping_bound)"
    yield f"no torque beyond the plant's settings and {disturbance or 0:g} N·m (--disturbance)"
    if e.paper:
        error = degrees(2 * e.paper.known.half_angle_e)
        yield f"for Lemma 1: the attitude error stays below {error:g}°"
    yield "a state near enough to the set, once, and for the age of a command before"
    if any(law.ki):
        yield "the integral in balance then, and no measurement lost: without one it does not advance"
    yield "the reference itself is followed: no approach to it is certified, at a start or after an operator's change"
    yield "the law's J, B, m and r_g are the plant's ([law])"
    if isinstance(settings.reference, Hold) and settings.reference.attitude is None:
        yield "the attitude that it finds and holds is level (reference.attitude)"
    yield from e.plant.plant.assumed


_REACH: Final = {
    "axis_rate": Term("max |ω_k| reached", "invariant set", "rad/s", "rate about an axis within it"),
    "slow": Term("‖w_s‖", "invariant set", "N·m", "slow torque: θ̃ along the reference, steady wind"),
    "fast": Term("‖w_f‖", "invariant set", "N·m", "fast torque: friction and gusts; θ̃ on the error's rate"),
    "noise": Term("‖w_q‖", "invariant set", "N·m", "error of the command by quantizers and sensors"),
    "hold": Term("τ_h of the plant", "invariant set", "N·m", "torque by which commands are out of date"),
}


def _terms(e: Evaluated) -> Iterator[Term]:
    """What the paper says of its law, then what the configured plant's set is made of."""
    for part in e.paper or ():
        for name, hint in get_type_hints(type(part), include_extras=True).items():
            yield replace(hint.__metadata__[0], value=getattr(part, name))
    for name, term in _REACH.items():
        yield replace(term, value=getattr(e.plant_reach, name, None))
