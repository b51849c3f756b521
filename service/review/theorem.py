"""Theorem 1 and Lemma 1 on a log: what is promised of a session, and whether its true states keep to it.

A true state has the tick of its measurement, so nothing that is judged is interpolated. Judging begins when the
reference is followed and ends when gains or reference first change: before and after, another certificate holds.

    Lemma 1        at each true state with (C.28), (C.29), (C.30) for its command, and Assumption 3
    mean square    ∫ k ‖z‖² dt ≤ V(t₀) + ∫ δ dt        k, δ of `mean_square.decay`; the integral by trapezoids
    every instant  ‖z(t)‖ ≤ `reach`(r)                  r the least ‖x(t₀)‖ of the piece so far

The last two hold along a *piece*: true states in a row with all of these premises, none further from the next than
`plant.truth_rate_hz` says, with a command within (C.30) at every tick between them. Each piece has its own t₀. δ at a
tick is of the largest ‖z^Q‖ since the command that acts was computed; k, and δ where rotors lag, of the largest so far.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf, nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from aeroloop.protocol.messages.operator import Change, in_force
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.logs.session import Array, Integers
from aeroloop.service.logs.ticks import Flags, Ticks
from aeroloop.service.review.events import Truths, judged_ticks
from aeroloop.service.review.observations import error_deg, of_nearer_sign
from aeroloop.service.review.report import LemmaCheck, TheoremFindings
from aeroloop.service.theorem import lemma
from aeroloop.service.theorem.any_law import Promise, promise
from aeroloop.service.theorem.evaluation import Evaluated
from aeroloop.service.theorem.invariant import distance, reach
from aeroloop.service.theorem.mean_square import decay


class TheoremCheck(NamedTuple):
    """Findings, why each that is null is so, ‖z^Q‖ and its V without θ̃ [N·m] of the n ticks, and m true states.

    Of these the ticks, and ‖z‖, V [N·m], error [deg] and q. Shapes (n,), (n,), (m,), (7, m).
    """

    findings: TheoremFindings
    reasons: dict[str, str]
    norm: Array
    V: Array
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
    """Check a session, with its changes of gains and reference in order, and its description's certificate, if any.

    With `faults` at the plant nothing but Lemma 1 can be judged.
    """
    begin, period = int(ticks.k[0]) if len(ticks.k) else 0, settings.loop.period
    begun = [change for change in changes if change.tick <= begin]
    promised = promise(settings, begun, described)
    law, certificate, e, verdict = promised
    since, until = judged_ticks([*in_force(begun), *(one for one in changes if one.tick > begin)], period)
    settled = since + promised.transient_s / period
    z, V = _measured_norm(ticks, law)
    after = (ticks.k >= settled) & (ticks.k < until)

    _, place, its = np.intersect1d(ticks.k, truths.k, assume_unique=True, return_indices=True)
    at, q, omega = ticks.where(place), truths.attitude[its], truths.rate[its]
    sign, gain, estimate = _signals(at, law)
    omega_d = lemma.times(lemma.rotation(at.attitude), at.desired_rate)
    samples = lemma.Samples(of_nearer_sign(q, at.attitude), omega, at.attitude, at.rate, at.desired, omega_d, sign)
    b = lemma.coordinates(samples.q, omega, at.desired, omega_d, sign, gain)
    theta = None if e is None else e.bounds.theta
    theta_error = np.zeros((1, 3)) if theta is None else theta - estimate
    lyapunov = b.norm if law is None else lemma.lyapunov(b, theta_error, law)
    true = np.vstack([b.norm, lyapunov, error_deg(b.eps_e), of_nearer_sign(q, at.desired).T])
    within = (at.k >= since) & (at.k < until)
    true_after = within & (at.k >= settled)

    checks, outside, judged, run = list[LemmaCheck](), dict[str, int](), 0, dict[str, Any]()
    why, undecided = "faults acted at the plant" if faults and e is not None else promised.unjudged, None
    if law is not None and e is not None and within.any():
        refused = _refused(settings, e, ticks)
        large = true[2] > np.degrees(2 * e.known.half_angle_e) * (1 + 1e-9)
        unmet = {"C.30": refused[place], "Assumption 3": large}
        checks, outside, judged = _judged_lemma(
            lemma.lemma_inequalities(samples, law, e.known, e.lemma),
            within,
            unmet,
            np.asarray(at.k * period, np.float64),
        )
        if why is None:
            own_rate = lemma.times(np.swapaxes(lemma.rotation(at.desired), 1, 2), omega_d)
            x = distance(e.plant, b, sign, theta_error, own_rate)
            bounds = _bounds(settings, e, ticks.k, refused, np.where(ticks.k >= since, z, 0.0), place)
            off = lemma.norm((samples.q_Q - samples.q)[:, 1:]), lemma.norm(samples.omega_Q - samples.omega)
            good = within & ~large & ~refused[place] & bounds.assume(*off)
            states = _States(at.k, good, true[0], true[1], x)
            run, undecided = _guaranteed(settings, e, states, bounds)
    broken = sum(one.broken for one in checks) if judged else None
    shares = [run[name] for name in ("mean_square_share", "pointwise_share") if name in run]
    radius = certificate.plant_radius if certificate is not None and certificate.holds else None
    findings = TheoremFindings(
        verdict=verdict,
        holds=None if certificate is None else certificate.holds,
        held=None if broken is None and not shares else not broken and all(share <= 1 for share in shares),
        pointwise_radius=radius,
        pointwise_deg=certificate.plant_deg if certificate is not None and radius is not None else None,
        **run,
        transient_s=promised.transient_s,
        since_s=round(since * period, 9),
        until_s=None if until == inf else round(until * period, 9),
        z_norm=float(z[after].max()) if law is not None and after.any() else None,
        error_deg=float(error_deg(ticks.attitude_error[after]).max()) if after.any() else None,
        true_z_norm=float(true[0, true_after].max()) if law is not None and true_after.any() else None,
        true_error_deg=float(true[2, true_after].max()) if true_after.any() else None,
        damping_known=theta is not None,
        samples=int(within.sum()),
        outside=outside,
        judged=judged,
        lemma=checks,
        broken=broken,
    )
    return TheoremCheck(findings, _reasons(findings, promised, why, undecided), z, V, at.k, true)


def _refused(settings: Settings, e: Evaluated, ticks: Ticks) -> Flags:
    """Ticks whose command is missing or not within (C.30). Shape (n,)."""
    acts = np.clip(ticks.voltages, -settings.plant.voltage_limit, settings.plant.voltage_limit)
    error = lemma.norm(acts - ticks.unquantized[:, -acts.shape[1] :])
    return np.asarray(~(error <= e.plant.delta_u * (1 + 1e-9) + 1e-12))  # NaN: no command


class _Bounds(NamedTuple):
    """What is proven at ticks with a true state.

    These are k [1/s], ∫ δ dt so far [N·m], and the errors of ε and ω [1, rad/s] that both assume.
    `failed` counts the ticks so far that are after a gap, have no command within (C.30) or no δ; `over`, as many of
    them as do not act any more. Shapes (m,).
    """

    rate: Array
    delta: Array
    most_eps: Array
    most_omega: Array
    failed: Integers
    over: Integers

    def assume(self, eps: Array, omega: Array) -> Flags:
        """Whether errors of ε and ω are as assumed."""
        within = np.asarray(eps <= self.most_eps * (1 + 1e-9) + 1e-12)
        return within & (omega <= self.most_omega * (1 + 1e-9) + 1e-12)


class _States(NamedTuple):
    """True states: tick, whether the premises hold, ‖z‖, V [N·m], and ‖x‖ as `reach` has it. Shapes (m,)."""

    k: Integers
    good: Flags
    z: Array
    V: Array
    x: Array


def _bounds(settings: Settings, e: Evaluated, k: Integers, refused: Flags, z: Array, place: Integers) -> _Bounds:
    """Bounds at some places of ticks k with this ‖z^Q‖; some commands are `refused` by (C.30). Shapes (n,)."""
    period, late = settings.loop.period, _late(settings)
    largest, recent = np.maximum.accumulate(z), z.copy()
    for ticks in range(1, 2 + late):  # since the command that acts was computed
        recent[ticks:] = np.maximum(recent[ticks:], z[:-ticks])
    lags = e.plant.age > (1 + late) * period * (1 + 1e-9)
    delta = period * _by_size(
        largest if lags else recent, 8, lambda size: found.delta if (found := decay(e, size)) else nan
    )
    failed = np.cumsum(refused | (np.diff(k, prepend=-1) != 1) | np.isnan(delta))
    over = np.concatenate([np.zeros(1 + late, dtype=np.int64), failed])[place]
    rate, _, most_eps, most_omega = _by_size(largest[place], 8, lambda size: decay(e, size) or (nan,) * 4)
    return _Bounds(rate, np.cumsum(np.nan_to_num(delta))[place], most_eps, most_omega, failed[place], over)


def _late(settings: Settings) -> int:
    """In real time the command that acts is of the tick before."""
    return 0 if settings.loop.lockstep else 1


def _guaranteed(
    settings: Settings, e: Evaluated, states: _States, bounds: _Bounds
) -> tuple[dict[str, Any], str | None]:
    """Findings on the mean square and the invariant set, by the bounds at the true states; or none, and why."""
    period, late, rate = settings.loop.period, _late(settings), bounds.rate
    time, apart = period * states.k.astype(np.float64), np.diff(states.k) * period
    most_apart = period + (1.5 / settings.plant.truth_rate_hz if settings.plant.truth_rate_hz else 0.0)
    good = states.good & (states.k >= late)
    joined = good[1:] & good[:-1] & (apart <= most_apart) & (bounds.failed[1:] == bounds.over[:-1])
    if not joined.any():
        if not np.isnan(rate[-1]):
            return {}, "no two true states in a row satisfy the premises, with every command between them within (C.30)"
        age = f"commands up to {e.plant.age * 1e3:.3g} ms old (rotor lag, period, transport): V need not decrease"
        return {}, "condition (C.66) fails" if e.theorem.k is None else age
    area, grown = apart * rate[1:] * (states.z[:-1] ** 2 + states.z[1:] ** 2) / 2, np.diff(bounds.delta)
    left, right, start = np.zeros((3, len(apart)))
    for a, b in np.flatnonzero(np.diff(joined, prepend=False, append=False)).reshape(-1, 2):  # states a to b
        left[a:b], right[a:b] = np.cumsum(area[a:b]), states.V[a] + np.cumsum(grown[a:b])
        # In real time ‖x‖ counts which was so small twice, as the command that acts is of the tick before.
        x = states.x
        starts = np.append(inf, np.maximum(x[a : b - 1], x[a + 1 : b])) if late else x[a:b]
        start[a:b] = np.minimum.accumulate(starts)
    last, bound = np.flatnonzero(joined)[-1], np.full(len(apart), inf)
    if e.plant_reach is not None and (near := joined & (start < inf)).any():
        bound[near] = _by_size(start[near], 4, lambda size: at.radius if (at := reach(e.plant, size)) else inf)
    found = {
        "radius": sqrt(grown[last] / apart[last] / rate[last + 1]),
        "spacing_s": float(apart[joined].max()),
        **_closest("mean_square", left[joined], right[joined], time[1:][joined]),
    }
    if (proven := bound < inf).any():
        found |= {"pointwise_since_s": float(time[:-1][proven][0]), "pointwise_bound": float(bound.min())}
        found |= _closest("pointwise", states.z[1:][proven], bound[proven], time[1:][proven])
    return found, None


def _by_size(sizes: Array, per_octave: int, of: Callable[[float], float | Sequence[float]]) -> Array:
    """What `of` gives for each size, rounded up to so many an octave. Shape (n,) or (values, n)."""
    steps, where = np.unique(np.ceil(per_octave * np.log2(np.maximum(sizes, 1e-6))), return_inverse=True)
    return np.array([of(2.0 ** (step / per_octave)) for step in steps.tolist()])[where].T


def _closest(statement: str, left: Array, right: Array, time: Array) -> dict[str, Any]:
    """How many states judged a statement, the largest left-hand side as a share of the right one, and when."""
    share = np.divide(left, right, out=np.where(left > 0, inf, 0.0), where=right > 0)
    most, names = int(np.argmax(share)), (f"{statement}_{name}" for name in ("judged", "share", "at_s"))
    return dict(zip(names, (len(left), float(share[most]), round(float(time[most]), 9)), strict=True))


def _judged_lemma(
    inequalities: Sequence[lemma.Inequality], within: Flags, unmet: dict[str, Flags], time: Array
) -> tuple[list[LemmaCheck], dict[str, int], int]:
    """Checks of Lemma 1, by premise how many true states do not satisfy it, and how many satisfy all. Shapes (m,)."""
    sides = {one.equation: one for one in inequalities}
    unmet = {name: sides.pop(name).broken for name in ("C.28", "C.29")} | unmet
    met = within & ~np.any(list(unmet.values()), axis=0)
    outside = {name: int((within & where).sum()) for name, where in unmet.items()}
    return [_lemma_check(one, met, time) for one in sides.values()], outside, int(met.sum())


def _lemma_check(one: lemma.Inequality, judged: Flags, time: Array) -> LemmaCheck:
    """One inequality at the true states that are judged. Shapes (m,)."""
    left, right, time, broken = one.left[judged], one.right[judged], time[judged], one.broken[judged]
    found = LemmaCheck(equation=one.equation, what=one.what, samples=len(left), broken=int(broken.sum()))
    if not len(left):
        return found
    ratio = np.where(left > 1e-12, left / np.maximum(right, 1e-300), 0.0)
    most, broken_s = int(np.argmax(ratio)), round(float(time[np.argmax(broken)]), 9) if broken.any() else None
    closest = {"closest": float(ratio[most]), "closest_s": round(float(time[most]), 9), "broken_s": broken_s}
    return found.model_copy(update=closest)


def _reasons(found: TheoremFindings, promised: Promise, why: str | None, undecided: str | None) -> dict[str, str]:
    """Why each finding that is null is so, by its name; `why`, and where the mean square is `undecided`, if known."""
    verdict, no_truth = found.verdict.rstrip("."), "the log has no true state of a tick that is judged"
    end = "the session ended before" if found.until_s is None else f"gains or reference changed at {found.until_s} s"
    short = f"the transient lasts {found.transient_s:.3g} s, and {end}"
    true = short if found.error_deg is None and found.samples else no_truth
    e, another = promised.bounds, verdict if promised.law is None else None
    unmet = verdict if e is None else "no true state satisfies the lemma's premises" if found.samples else no_truth
    far = "no true state is near enough to the invariant set" if found.samples else no_truth
    if e is not None and e.plant_reach is None:
        far = "no invariant set is proven of the configured plant"
    texts = {
        ("error_deg",): short,
        ("z_norm",): another or short,
        ("true_error_deg",): true,
        ("true_z_norm",): another or true,
        ("broken", "held"): unmet,
        ("radius", "mean_square_share", "mean_square_at_s", "spacing_s"): why or undecided or no_truth,
        ("pointwise_radius", "pointwise_deg"): verdict if found.holds is None else "the certificate does not hold",
        ("pointwise_share", "pointwise_at_s", "pointwise_since_s", "pointwise_bound"): why or far,
    }
    return {f"theorem.{name}": text for names, text in texts.items() for name in names if getattr(found, name) is None}


def _signals(ticks: Ticks, law: AdaptiveSettings | None) -> tuple[Array, Array, Array]:
    """±1 of the equilibrium approached, C₁'s diagonal [1/s], θ̂ as used [N·m·s/rad]; NaN of another law. (n, …)."""
    if law is not None:  # by the order of `Adaptive.initial` and `Adaptive.gains`
        return ticks.state_next[:, 3], ticks.gains[:, :3], ticks.state[:, :3]
    nearer = np.where((ticks.attitude * ticks.desired).sum(axis=1) < 0, -1.0, 1.0)
    return nearer, *np.full((2, len(ticks.k), 3), nan)


def _measured_norm(ticks: Ticks, law: AdaptiveSettings | None) -> tuple[Array, Array]:
    """‖z^Q‖ and its V without θ̃ (C.24), from the errors that the controller computed; NaN of another law. (n,)."""
    sign, gain, _ = _signals(ticks, law)
    eta_e = (ticks.attitude * ticks.desired).sum(axis=1)  # (C.32)
    z1 = (1 - sign * eta_e) ** 2 + (ticks.attitude_error**2).sum(axis=1)  # (C.39), its square
    z2 = (ticks.rate_error + sign[:, None] * gain * ticks.attitude_error) ** 2  # (C.40); G z₁ = ±ε̃ by (C.49)
    return np.sqrt(z1 + z2.sum(axis=1)), z1 + z2 @ np.array((law or AdaptiveSettings()).inertia) / 2
