"""Theorem 1 on a log: what is certified of a session, and whether its true states keep to what is proven.

A true state has the tick of its measurement, so nothing that is judged is interpolated. Judging begins when the
reference is followed and ends when gains or reference first change: before and after, another certificate holds.

    Lemma 1    at each true state with (C.28), (C.29), (C.30) for its command, and Assumption 3
    the set    if the certificate holds: ‖z(t)‖ ≤ `reach`(r), where r is the least ‖x(t₀)‖ so far

A command that is missing or not within (C.30) ends what the true states before it prove.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil, inf, nan
from typing import Any, NamedTuple

import numpy as np

from aeroloop.protocol.messages.operator import Change, in_force
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.logs.session import Array, Integers
from aeroloop.service.logs.ticks import Flags, Ticks
from aeroloop.service.review.events import Truths, error_deg, of_nearer_sign
from aeroloop.service.review.report import LemmaCheck, TheoremFindings
from aeroloop.service.theorem import bounds as lemma
from aeroloop.service.theorem.certificate import promise
from aeroloop.service.theorem.invariant import Premises, distance, reach


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
    """Check a session, with its changes in order and its description's certificate; with faults only Lemma 1."""
    begin, period = int(ticks.k[0]) if len(ticks.k) else 0, settings.loop.period
    begun = [change for change in changes if change.tick <= begin]
    promised, certificate, e, verdict = promise(settings, begun, described)
    law = promised if isinstance(promised, AdaptiveSettings) else None  # the paper's, which Lemma 1 and V are about
    since, until = judged_ticks([*in_force(begun), *(one for one in changes if one.tick > begin)], period)

    _, place, its = np.intersect1d(ticks.k, truths.k, assume_unique=True, return_indices=True)
    at, omega, q = ticks.where(place), truths.rate[its], truths.attitude[its]
    if law is not None:  # by the order of `Adaptive.initial` and `Adaptive.gains`
        sign, gain, estimate = at.state_next[:, 3], at.gains[:, :3], at.state[:, :3]
    else:
        sign = np.where((at.attitude * at.desired).sum(axis=1) < 0, -1.0, 1.0)
        gain, estimate = np.full((2, 3), nan) if e is None else np.array([e.plant.law.share, e.plant.law.centre])
    omega_d = lemma.times(lemma.rotation(at.attitude), at.desired_rate)
    x = lemma.Samples(of_nearer_sign(q, at.attitude), omega, at.attitude, at.rate, at.desired, omega_d, sign)
    b = lemma.coordinates(x.q, omega, x.q_d, omega_d, sign, gain)
    theta = None if e is None else e.plant.plant.theta
    theta_error = np.zeros((1, 3)) if theta is None else theta - estimate
    true = np.vstack([b.norm, error_deg(b.eps_e), of_nearer_sign(q, at.desired).T])

    time, within = np.asarray(at.k * period, np.float64), (at.k >= since) & (at.k < until)
    found: dict[str, Any] = {"samples": int(within.sum())}
    if certificate is not None:
        within_it = {"pointwise_radius": certificate.plant_radius, "pointwise_deg": certificate.plant_deg}
        found |= {"holds": certificate.holds, **(within_it if certificate.holds else {})}
    if e is not None and within.any():
        acts = np.clip(ticks.voltages, -settings.plant.voltage_limit, settings.plant.voltage_limit)
        error = lemma.norm(acts - ticks.unquantized[:, -acts.shape[1] :])
        refused = ~(error <= e.plant.delta_u * (1 + 1e-9) + 1e-12)  # NaN: no command
        if law is not None and e.paper is not None:
            known, bounds, _ = e.paper
            sides = {one.equation: one for one in lemma.lemma_inequalities(x, law, known, bounds)}
            unmet = {name: sides.pop(name).broken for name in ("C.28", "C.29")} | {"C.30": refused[place]}
            unmet["Assumption 3"] = true[1] > np.degrees(2 * known.half_angle_e) * (1 + 1e-9)
            found["outside"] = {name: int((within & where).sum()) for name, where in unmet.items()}
            if (met := within & ~np.any(list(unmet.values()), axis=0)).any():
                checks = [_lemma_check(one, met, time) for one in sides.values()]
                found |= {"judged": int(met.sum()), "lemma": checks, "broken": sum(one.broken for one in checks)}
        if found["holds"] and not faults:
            failed = np.cumsum(refused | (np.diff(ticks.k, prepend=begin) > 1), dtype=np.int64)
            # In real time the command that acts is of the tick before: ‖x‖ must be so small at two states in a row.
            lockstep, rate_d = settings.loop.lockstep, lemma.times(np.swapaxes(lemma.rotation(x.q_d), 1, 2), omega_d)
            size = distance(e.plant, b, sign, theta_error, rate_d)
            size = size if lockstep else np.maximum(size, np.append(inf, size)[:-1])
            acting = np.append(np.full(1 if lockstep else 2, -1), failed)[place]
            starts = np.where(within & (acting == failed[place]), size, inf)
            found |= _once_entered(e.plant, starts, failed[place], b.norm, within, time)
    kept = [found[name] <= most for name, most in (("broken", 0), ("pointwise_share", 1)) if name in found]
    found |= {"since_s": round(since * period, 9), "until_s": None if until == inf else round(until * period, 9)}
    findings = TheoremFindings(verdict=verdict, held=all(kept) if kept else None, **found)
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


def _lemma_check(one: lemma.Inequality, judged: Flags, time: Array) -> LemmaCheck:
    """One inequality at the true states that are judged, of which there is one at least. Shapes (m,)."""
    left, right, time, broken = one.left[judged], one.right[judged], time[judged], one.broken[judged]
    ratio = np.where(left > 1e-12, left / np.maximum(right, 1e-300), 0.0)
    most, first = int(np.argmax(ratio)), float(time[np.argmax(broken)])
    return LemmaCheck(
        equation=one.equation, what=one.what, samples=len(left), broken=int(broken.sum()),
        broken_s=round(first, 9) if broken.any() else None,
        closest=float(ratio[most]), closest_s=round(float(time[most]), 9),
    )  # fmt: skip


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
    another = "the lemma is about the paper's law" if found.holds is not None and not found.outside else None
    lemma_1 = no_truth or another or "no true state satisfies the lemma's premises"
    the_set = "faults acted at the plant" if faults else no_truth or "no true state is near enough to the invariant set"
    if found.holds is None:
        lemma_1 = the_set = found.verdict.rstrip(".")
    elif not found.holds:
        the_set = "the certificate does not hold"
    names = [name for name, value in found if value is None and name.startswith(("broken", "held", "pointwise_"))]
    return {f"theorem.{name}": the_set if name.startswith("pointwise_") else lemma_1 for name in names}
