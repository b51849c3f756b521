"""Theorem 1 on a log: what is certified of a session, and whether its true states keep to what is proven.

If the certificate holds, ‖z(t)‖ ≤ `reach`(r), where r is the least ‖x(t₀)‖ so far. A true state has the tick of its
measurement, so nothing that is judged is interpolated. Judging begins when the reference is followed and ends when
gains or reference first change: before and after, another certificate holds. A command that is missing or not within
(C.30) ends what the true states before it prove.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil, inf, nan
from typing import Any, NamedTuple

import numpy as np

from aeroloop.protocol.messages.operator import Change, in_force
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.logs.session import Array, Integers, Truths
from aeroloop.service.logs.ticks import Flags, Ticks
from aeroloop.service.review.events import error_deg, of_nearer_sign
from aeroloop.service.review.report import TheoremFindings
from aeroloop.service.theorem.bounds import coordinates, norm, rotation, times
from aeroloop.service.theorem.certificate import promise
from aeroloop.service.theorem.invariant import distance, reach
from aeroloop.service.theorem.premises import Premises


class TheoremCheck(NamedTuple):
    """Findings, why each that is null is so; of m true states the ticks, and ‖z‖, error [deg] and q: (m,), (6, m)."""

    findings: TheoremFindings
    reasons: dict[str, str]
    true_k: Integers
    true: Array


def check_theorem(
    settings: Settings,
    ticks: Ticks,
    truths: Truths,
    changes: Sequence[Change] = (),
    described: Mapping[str, Any] | None = None,
    *,
    faults: bool = False,
) -> TheoremCheck:
    """Check a session, with its changes in order and its description's certificate; nothing is proven with faults."""
    begin, period = int(ticks.k[0]) if len(ticks.k) else 0, settings.loop.period
    begun = [change for change in changes if change.tick <= begin]
    promised, certificate, e, verdict = promise(settings, begun, described)
    law = promised if isinstance(promised, AdaptiveSettings) else None  # the paper's, which V is about
    since, until = judged_ticks([*in_force(begun), *(one for one in changes if one.tick > begin)], period)

    _, place, its = np.intersect1d(ticks.k, truths.k, assume_unique=True, return_indices=True)
    at = ticks.where(place)
    q, omega = of_nearer_sign(truths.attitude[its], at.attitude), truths.rate[its]
    if law is not None:  # by the order of `Adaptive.initial` and `Adaptive.gains`
        sign, gain, estimate = at.state_next[:, 3], at.gains[:, :3], at.state[:, :3]
    else:
        sign = np.where((at.attitude * at.desired).sum(axis=1) < 0, -1.0, 1.0)
        gain, estimate = np.full((2, 3), nan) if e is None else np.array([e.plant.law.share, e.plant.law.centre])
    omega_d = times(rotation(at.attitude), at.desired_rate)
    b = coordinates(q, omega, at.desired, omega_d, sign, gain)
    theta = None if e is None else e.plant.plant.theta
    theta_error = np.zeros((1, 3)) if theta is None else theta - estimate
    true = np.vstack([b.norm, error_deg(b.eps_e), of_nearer_sign(q, at.desired).T])

    time, within = np.asarray(at.k * period, np.float64), (at.k >= since) & (at.k < until)
    found: dict[str, Any] = {"samples": int(within.sum())}
    if certificate is not None:
        within_it = {"pointwise_radius": certificate.plant_radius, "pointwise_deg": certificate.plant_deg}
        found |= {"holds": certificate.holds, **(within_it if certificate.holds else {})}
    if e is not None and found.get("holds") and not faults and within.any():
        acts = np.clip(ticks.voltages, -settings.plant.voltage_limit, settings.plant.voltage_limit)
        error = norm(acts - ticks.unquantized[:, -acts.shape[1] :])
        refused = ~(error <= e.plant.delta_u * (1 + 1e-9) + 1e-12)  # NaN: no command
        failed = np.cumsum(refused | (np.diff(ticks.k, prepend=begin) > 1), dtype=np.int64)
        # In real time the command that acts is of the tick before: ‖x‖ must be so small at two states in a row.
        lockstep, rate_d = settings.loop.lockstep, times(np.swapaxes(rotation(at.desired), 1, 2), omega_d)
        size = distance(e.plant, b, sign, theta_error, rate_d)
        size = size if lockstep else np.maximum(size, np.append(inf, size)[:-1])
        acting = np.append(np.full(1 if lockstep else 2, -1), failed)[place]
        starts = np.where(within & (acting == failed[place]), size, inf)
        found |= _once_entered(e.plant, starts, failed[place], b.norm, within, time)
    share = found.get("pointwise_share")
    found |= {"since_s": round(since * period, 9), "until_s": None if until == inf else round(until * period, 9)}
    findings = TheoremFindings(verdict=verdict, held=None if share is None else share <= 1, **found)
    return TheoremCheck(findings, _reasons(findings, faults), at.k, true)


def judged_ticks(changes: Sequence[Change], period: float) -> tuple[int, float]:
    """The first tick, and the end, of the span in which a session follows its first reference with its first gains."""
    since, begun = 0, set[str]()
    for change in changes:
        # An approach from the attitude found belongs to the beginning; it may be faster than the reference.
        if change.start is None and begun == {"gains", "reference"}:
            return since, change.tick
        begun |= {name for name in ("gains", "reference") if getattr(change, name) is not None}
        since = max(since, change.tick + ceil(change.within_s / period))
    return since, inf


def _once_entered(p: Premises, x: Array, failed: Integers, z: Array, within: Flags, time: Array) -> dict[str, Any]:
    """Findings on the set: ‖z‖ by its bound for the least ‖x‖ since a command `failed` last, in steps of 2^¼. (m,)."""
    least = np.full(len(x), inf)
    for piece in np.split(np.arange(len(x)), np.flatnonzero(np.diff(failed)) + 1):
        least[piece[1:]] = np.minimum.accumulate(x[piece])[:-1]
    steps, which = np.unique(np.ceil(4 * np.log2(np.clip(least, 1e-6, 1e3))), return_inverse=True)
    reached = [reach(p, 2.0 ** (step / 4)) for step in steps.tolist()]
    bound = np.array([inf if one is None else one.radius for one in reached])[which]
    if not (judged := within & (bound < inf)).any():
        return {}
    share, time = z[judged] / bound[judged], time[judged]
    at_s, since_s = (round(float(time[i]), 9) for i in (np.argmax(share), 0))
    found = {"share": float(share.max()), "at_s": at_s, "since_s": since_s, "bound": float(bound[judged].min())}
    return {"pointwise_judged": len(share), **{f"pointwise_{name}": value for name, value in found.items()}}


def _reasons(found: TheoremFindings, faults: bool) -> dict[str, str]:
    """Why each finding that is null is so, by its name."""
    no_truth = None if found.samples else "the log has no true state of a tick that is judged"
    why = "faults acted at the plant" if faults else no_truth or "no true state is near enough to the invariant set"
    if not found.holds:
        why = found.verdict.rstrip(".") if found.holds is None else "the certificate does not hold"
    return {
        f"theorem.{name}": why for name, value in found if value is None and name.startswith(("held", "pointwise_"))
    }
