"""Evaluation: every quantity of a certificate, for the paper's body and for the configured plant.

The mean square of (C.77) is evaluated for the paper's body, the set of `invariant` for both. The assumed attitude error
is widened to that of the sets if it is smaller, so that no certificate contradicts itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import asin, inf, radians, sin, sqrt

import numpy as np

from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.control.laws.adaptive import ESTIMATE_REACH
from aeroloop.service.theorem.bounds import Known, Lemma, Theorem, lemma_1, theorem_1
from aeroloop.service.theorem.configured import Configured, Sections, with_theorem
from aeroloop.service.theorem.extremes import Extremes, chords, extremes, motors
from aeroloop.service.theorem.invariant import Premises, Reach, reach
from aeroloop.service.theorem.plant_bounds import PlantBounds, paper_body, plant_bounds


@dataclass(frozen=True)
class Evaluated:
    """The quantities of a certificate.

    Attributes:
        desired: The reference's extremes.
        known: Inputs.
        lemma: The bounds of Lemma 1.
        theorem: The bounds of Theorem 1.
        body: Premises of the paper's body.
        plant: Premises of the configured plant.
        body_reach: What the paper's body reaches; None where nothing is proven.
        plant_reach: What the configured plant reaches; likewise.
        bounds: What the plant does beyond the paper's equations.
    """

    desired: Extremes
    known: Known
    lemma: Lemma
    theorem: Theorem
    body: Premises
    plant: Premises
    body_reach: Reach | None
    plant_reach: Reach | None
    bounds: PlantBounds


def evaluate(
    settings: Sections,
    *,
    disturbance: float | None = None,
    attitude_error_deg: float | None = None,
    late_s: float = 0.0,
    only_plant: bool = False,
    desired: Extremes | None = None,
) -> Evaluated:
    """The quantities of a certificate, to check a run against; arguments and errors as of `certify`.

    With `only_plant` the paper's body is left out, which does not decide whether a certificate holds; `desired` are the
    reference's extremes if they are known.
    """
    settings = with_theorem(settings)
    stated = disturbance or 0.0
    if not 0 <= stated < inf:
        raise ValueError(f"a disturbance is 0 or more, in N·m, not {stated}")
    desired = desired or extremes(settings)
    bounds = plant_bounds(settings, disturbance is not None)
    if bounds.held_roll and desired.rolls:
        bounds = replace(bounds, unproven=[*bounds.unproven, "reference: it rolls, and the plant's roll is held"])
    body = premises(settings, desired, paper_body(settings), stated, late_s)
    plant = premises(settings, desired, bounds, stated, late_s)
    body_reach = None if only_plant else reach(body)
    plant_reach = reach(plant)
    start_deg = settings.controller.start_within_deg if attitude_error_deg is None else attitude_error_deg
    error = max([radians(min(180.0, start_deg)), *(2 * asin(at.eps_e) for at in (body_reach, plant_reach) if at)])
    p = _known(settings, desired, body, body_reach, error)
    lemma = lemma_1(p)
    if body_reach is not None:  # the noise, too, is of a state that has changed since
        noise = theorem_1(p, lemma).delta_V1 * body.age * body_reach.z_dot
        p = replace(p, hold=p.hold + noise)
    theorem = theorem_1(p, lemma)
    if body_reach is None:  # what sampling adds is bounded within a set only
        theorem = replace(theorem, radius=None)
    return Evaluated(desired, p, lemma, theorem, body, plant, body_reach, plant_reach, bounds)


def premises(
    settings: Sections, desired: Extremes, plant: PlantBounds, disturbance: float = 0.0, late_s: float = 0.0
) -> Premises:
    """Premises of the invariant set.

    Args:
        settings: The configuration.
        desired: The reference's extremes.
        plant: What the plant does beyond the paper's equations.
        disturbance: Further torque [N·m].
        late_s: Further age of a command [s].
    """
    settings = with_theorem(settings)
    wire, law = settings.wire, settings.law
    gravity = law.mass * law.gravity
    return Premises(
        C1=law.C1,
        C2=law.C2,
        Gamma=law.Gamma,
        J=law.inertia,
        k_theta=law.damping_bound,
        k_theta_hat=law.damping_bound * ESTIMATE_REACH,
        weight=float(np.linalg.norm(law.centre_of_mass)) * gravity,
        weight_roll=abs(law.centre_of_mass[1]) * gravity,
        norm_B=float(np.linalg.norm(motors(settings), 2)),
        delta_omega=_error(wire.rate, 3) + plant.delta_omega,
        delta_u=_error(wire.voltage, wire.actuators),
        k_omega_d=desired.rate,
        k_omega_d_dot=desired.acceleration,
        k_omega_d_ddot=desired.jerk,
        axis_rate=desired.axis_rate,
        half_angle_d=desired.half_angle,
        delta_q=chords(desired, _error(wire.attitude, 1) + plant.delta_eps),
        age=plant.age + late_s,
        rate_lag=plant.rate_lag,
        k_tau_d=plant.torque + disturbance,
        tilt=desired.tilt if plant.held_roll else None,
    )


def _known(settings: Configured, desired: Extremes, body: Premises, within: Reach | None, error: float) -> Known:
    wire, law = settings.wire, settings.law
    return Known(
        lambda_J=max(law.inertia),
        weight=body.weight,
        norm_B=body.norm_B,
        C1_min=min(law.C1),
        C1_max=max(law.C1),
        C2_min=min(law.C2),
        C2_max=max(law.C2),
        delta_eps=_error(wire.attitude, 3),
        delta_omega=_error(wire.rate, 3),
        delta_u=body.delta_u,
        k_omega_d=desired.rate,
        k_omega_d_dot=desired.acceleration,
        half_angle_d=desired.half_angle,
        half_angle_e=error / 2,
        k_theta=body.k_theta,
        k_theta_hat=body.k_theta_hat,
        k_tau_d=body.k_tau_d,
        hold=within.hold if within else 0.0,
        power=within.power if within else 0.0,
        omega_limit=wire.rate.limit,
        u_limit=wire.voltage.limit,
    )


@lru_cache(maxsize=64)
def _error(signal: SignalSpec, elements: int) -> float:
    """‖δ_y‖ of (C.15) for a vector with equal quantizers for all elements [signal's unit]."""
    return sqrt(elements) * signal.quantizer().bound


def largest_voltage(settings: Sections, desired: Extremes, at: Reach) -> float:
    """The largest |u_k| that the law commands within a set [V]."""
    inverse = np.linalg.inv(motors(settings))
    return float((desired.voltages + np.linalg.norm(inverse, axis=1) * at.deviation).max())


def beyond(settings: Sections, desired: Extremes, p: Premises, at: Reach) -> list[tuple[str, float, str, float, str]]:
    """Ranges that a set exceeds: symbol, what it reaches, unit, range, and what fails, with its key."""
    settings = with_theorem(settings)
    wire = settings.wire
    volts, limit = largest_voltage(settings, desired, at), min(wire.voltage.limit, settings.plant.voltage_limit)
    ranges = (
        ("|ω_k|", at.axis_rate + p.delta_omega, "rad/s", wire.rate.limit, "range: wire.rate.limit"),
        ("|ε_k|", sin(at.half_angle), "", wire.attitude.limit, "range: wire.attitude.limit"),
        ("|u_k|", volts, "V", limit, "saturation: wire.voltage.limit"),
    )
    return [each for each in ranges if each[1] > each[3]]
