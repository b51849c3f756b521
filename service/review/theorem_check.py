"""Check of a session against Theorem 1 and Lemma 1: what the run did, and every inequality at true states.

‖z‖ and V are computed from the controller's quantized signals at every tick, and from the true states at the ticks for
which an emulator published one. A truth has the tick of its measurement, so nothing that is judged is interpolated. The
transient lasts three times the law's slower time constant, after which an error has fallen to 5 %; the largest error
after it is reported, and judged by nothing, since θ̃ may take much longer. `guarantees` judges what holds at any length;
Lemma 1 is judged at each true state that satisfies its premises, (C.30) for its command among them. Judging begins when
the reference is followed, since a session that begins far from it approaches it first, and ends when an operator first
changes gains or reference. Why: before and after, another certificate holds.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from math import ceil, degrees, inf, nan
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array, Integers
from aeroloop.service.review.angles import of_nearer_sign
from aeroloop.service.review.certified_bounds import CertifiedBounds, PaperSignals
from aeroloop.service.review.guarantees import Conditions, Guarantees
from aeroloop.service.review.report import LemmaCheck, TheoremFindings
from aeroloop.service.theorem.lemma import (
    Inequality,
    Samples,
    coordinates,
    lemma_inequalities,
    lyapunov,
    rotation,
    times,
)

Flags = npt.NDArray[np.bool_]

PREMISES: Final = ("C.28", "C.29")
COMMAND_PREMISE: Final = "C.30"
"""Premise: the command is within its quantization error of what the law computed, so not saturated."""
ERROR_PREMISE: Final = "Assumption 3"
"""Premise: the attitude error is within the certificate's assumption."""

WAITING: Final = 8192
"""Truths that may wait for their ticks."""


class Truths(NamedTuple):
    """True states at ticks, a row each. Shapes (n,), (n, 4), (n, 3)."""

    k: Integers
    attitude: Array
    rate: Array


class Drawn(NamedTuple):
    """Values of the ticks of a block to draw, NaN where there is none.

    Attributes:
        true_error: The true attitude error [deg]. Shape (n,).
        true_attitude: The true attitude, of ±q the nearer to the desired one, up to its length. Shape (n, 4).
        norms: Measured and true ‖z‖, measured and true V. Shape (n, 4).
    """

    true_error: Array
    true_attitude: Array
    norms: Array


class InequalityCount:
    """Counts of one inequality: samples, violations, and the closest approach to its bound."""

    def __init__(self, inequality: Inequality) -> None:
        self.equation, self.what = inequality.equation, inequality.what
        self.samples = self.broken = 0
        self.closest = 0.0
        self.closest_s = self.broken_s = nan

    def add(self, inequality: Inequality, judged: Flags, time: Array) -> None:
        """Add samples, of which those in `judged` count. Shapes (n,)."""
        left, right, broken = inequality.left[judged], inequality.right[judged], inequality.broken[judged]
        self.samples += len(left)
        if not len(left):
            return
        ratio = np.where(left > 1e-12, left / np.maximum(right, 1e-300), 0.0)
        most = int(np.argmax(ratio))
        if ratio[most] > self.closest or self.closest_s != self.closest_s:
            self.closest, self.closest_s = float(ratio[most]), float(time[judged][most])
        if broken.any() and not self.broken:
            self.broken_s = float(time[judged][np.argmax(broken)])
        self.broken += int(broken.sum())

    def check(self) -> LemmaCheck:
        """Result of all samples so far."""
        return LemmaCheck(
            equation=self.equation,
            what=self.what,
            samples=self.samples,
            broken=self.broken,
            closest=self.closest if self.samples else None,
            closest_s=round(self.closest_s, 9) if self.samples else None,
            broken_s=round(self.broken_s, 9) if self.broken else None,
        )


class TheoremCheck:
    """Checks one session against the theorem.

    Args:
        certified: Certificate and bounds to check against.
        settings: Configuration of the session's controller.

    Attributes:
        damping_known: Whether θ is known.
    """

    def __init__(self, certified: CertifiedBounds, settings: Settings) -> None:
        self._certified = certified
        self._period = settings.loop.period
        self._damping = None if certified.bounds is None else certified.bounds.bounds.theta
        self.damping_known = self._damping is not None
        self._guarantees = Guarantees(certified, settings.loop, settings.plant)
        self._changes: list[Change] = []  # the first few
        self._since, self._until = 0, inf
        self._truths: deque[tuple[int, Quaternion, Vector]] = deque()
        self._before: tuple[Ticks, Conditions] | None = None  # the last block, for late truths
        self._drawn = np.empty((0, 8))  # the last true state, as of `_judge_truths`
        self._counts: dict[str, InequalityCount] = {}
        self._outside = dict.fromkeys((*PREMISES, COMMAND_PREMISE, ERROR_PREMISE), 0)
        self._samples = self._judged = 0
        self._settled = transient(certified.law) / self._period  # tick from which the transient is over
        self._seen: tuple[float, float] | None = None  # largest ‖z‖ and largest attitude error [rad] from then on
        self._true: tuple[float, float] | None = None  # the same of the true state

    # ── input ──

    def changed(self, changes: Sequence[Change]) -> None:
        """Add changes of gains and reference, in order, before their ticks; first those in force at the first tick."""
        self._changes = [*self._changes, *changes][:4]
        self._since, self._until = _judged_ticks(self._changes, self._period)
        self._settled = self._since + transient(self._certified.law) / self._period

    def truth(self, tick: int | None, attitude: Quaternion, rate: Vector) -> None:
        """Add the true state at a tick's measurement, in any order; one without a tick, or repeated, is dropped."""
        if tick is None:
            return
        truths, one = self._truths, (tick, attitude, rate)
        at = len(truths) if not truths or tick > truths[-1][0] else bisect_left(truths, tick, key=itemgetter(0))
        if at == len(truths) or truths[at][0] != tick:
            truths.insert(at, one)
        if len(truths) > WAITING:
            truths.popleft()

    @property
    def judged_s(self) -> tuple[float, float]:
        """The span of the law's clock within which the guarantee holds, its transient left out [s]."""
        return self._settled * self._period, self._until * self._period

    def ticks(self, ticks: Ticks) -> Drawn:
        """Check a block of ticks, and return what is drawn of it."""
        z, V = measured_norm(ticks, self._certified)
        if (after := (ticks.k >= self._settled) & (ticks.k < self._until)).any():
            square = (ticks.attitude_error[after] ** 2).sum(axis=1)
            self._seen = _larger(self._seen, z[after], 2 * np.arcsin(np.sqrt(np.minimum(1.0, square))))
        true = np.full((7, len(z)), nan)
        conditions = self._guarantees.conditions(ticks, z, self._since)
        before, self._before = self._before, (ticks, conditions)
        if self._truths and self._truths[0][0] <= ticks.k[-1]:
            whole = self._before
            if before is not None and before[0].k[-1] >= self._truths[0][0]:
                whole = Ticks.joined([before[0], ticks]), before[1].joined(conditions)
            if (found := self._judge_truths(*whole)) is not None:
                known = np.vstack([self._drawn, found])
                self._drawn = known[-1:]
                # Interpolated for drawing only.
                true = np.array([np.interp(ticks.k, known[:, 0], values, left=nan) for values in known.T[1:]])
        return Drawn(true[2], true[3:].T, np.column_stack([z, true[0], V, true[1]]))

    def finish(self) -> None:
        """Judge true states of the last block that were received after it."""
        if self._truths and self._before is not None:
            self._judge_truths(*self._before)

    def _judge_truths(self, ticks: Ticks, conditions: Conditions) -> Array | None:
        """Judge the true states of these ticks: tick, ‖z‖, V, error [deg] and q of each, (n, 8); None without one."""
        truths = self._take_truths(int(ticks.k[0]), int(ticks.k[-1]))
        place = np.searchsorted(ticks.k, truths.k)
        there = ticks.k[place] == truths.k
        if not there.any():
            return None
        at, truths = ticks.where(place[there]), Truths(*(column[there] for column in truths))
        judged = self._judge_states(at, conditions.where(place[there]), truths)
        return np.column_stack([at.k, *judged, of_nearer_sign(truths.attitude, at.desired)])

    def _take_truths(self, first: int, last: int) -> Truths:
        """Truths of these ticks; earlier ones are dropped, later ones wait."""
        taken = []
        while self._truths and self._truths[0][0] <= last:
            if (truth := self._truths.popleft())[0] >= first:
                taken.append(truth)
        k, attitude, rate = zip(*taken, strict=True) if taken else ((), (), ())
        return Truths(np.array(k, np.int64), np.array(attitude).reshape(-1, 4), np.array(rate).reshape(-1, 3))

    def _judge_states(self, at: Ticks, conditions: Conditions, truths: Truths) -> tuple[Array, Array, Array]:
        """Judge the true states of ticks. Returns true ‖z‖, V and error [deg]. Shapes (n,)."""
        certified, law = self._certified, self._certified.law
        inertial = times(rotation(at.attitude), at.desired_rate)
        q = truths.attitude * np.where((truths.attitude * at.attitude).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        paper = PaperSignals.of(at, certified)
        samples = Samples(q, truths.rate, at.attitude, at.rate, at.desired, inertial, paper.sign)
        b = coordinates(q, samples.omega, samples.q_d, inertial, paper.sign, paper.gain)
        theta_error = np.zeros((1, 3)) if self._damping is None else self._damping - paper.damping_estimate
        within = (at.k >= self._since) & (at.k < self._until)
        half_angle = np.arcsin(np.minimum(1.0, np.linalg.norm(b.eps_e, axis=1)))
        if (after := within & (at.k >= self._settled)).any():
            self._true = _larger(self._true, b.norm[after], 2 * half_angle[after])
        self._samples += int(within.sum())
        if law is None:
            return b.norm, b.norm, np.degrees(2 * half_angle)  # NaN, without C₁
        if (bounds := certified.bounds) is not None and within.any():
            small = half_angle <= bounds.known.half_angle_e * (1 + 1e-9)
            time: Array = np.asarray(at.k * self._period, dtype=np.float64)
            inequalities = lemma_inequalities(samples, law, bounds.known, bounds.lemma)
            self._judge_lemma(inequalities, within, {ERROR_PREMISE: ~small, COMMAND_PREMISE: conditions.refused}, time)
            self._guarantees.judge(at, conditions, samples, b, within & small)
        return b.norm, lyapunov(b, theta_error, law), np.degrees(2 * half_angle)

    def _judge_lemma(
        self, inequalities: Sequence[Inequality], within: Flags, unmet: dict[str, Flags], time: Array
    ) -> None:
        """Count each inequality at samples within the judged span that meet every premise."""
        unmet |= {one.equation: one.broken for one in inequalities if one.equation in PREMISES}
        judged = within.copy()
        for name, where in unmet.items():
            self._outside[name] += int((within & where).sum())
            judged &= ~where
        self._judged += int(judged.sum())
        for inequality in inequalities:
            if inequality.equation not in PREMISES:
                self._counts.setdefault(inequality.equation, InequalityCount(inequality)).add(inequality, judged, time)

    # ── results ──

    @property
    def pointwise_radius(self) -> float | None:
        """Within which ‖z‖ stays in the end; None where no such bound is proven of the plant."""
        return self._certified.pointwise_radius

    @property
    def radius(self) -> float | None:
        """√(δ_Q/k) at the last true state judged: the root of the mean of ‖z‖² in the long run; None before."""
        return self._guarantees.radius

    def findings(self, *, faults: bool = False) -> tuple[TheoremFindings, dict[str, str]]:
        """Findings, and the reason of each that is null, by name.

        Args:
            faults: Whether faults acted at the plant, with which nothing but Lemma 1 can be judged.
        """
        certified, seen, true, run = self._certified, self._seen, self._true, self._guarantees
        certificate = certified.certificate
        if faults:
            run.forget("faults acted at the plant")
        square, point = run.mean_square, run.pointwise
        checks = [count.check() for count in self._counts.values()]
        broken = sum(check.broken for check in checks) if self._judged else None
        shares = (broken, square.share, point.share)
        found = TheoremFindings(
            verdict=certified.verdict,
            holds=None if certificate is None else certificate.holds,
            held=None
            if shares == (None, None, None)
            else not broken and all((share or 0) <= 1 for share in shares[1:]),
            radius=self.radius,
            pointwise_radius=self.pointwise_radius,
            pointwise_deg=certificate.plant_deg if certificate and self.pointwise_radius is not None else None,
            mean_square_share=square.share,
            mean_square_at_s=square.at_s,
            mean_square_judged=square.samples,
            spacing_s=run.spacing_s,
            pointwise_share=point.share,
            pointwise_at_s=point.at_s,
            pointwise_judged=point.samples,
            pointwise_since_s=run.entered_s,
            pointwise_bound=run.bound,
            transient_s=transient(certified.law),
            since_s=round(self._since * self._period, 9),
            until_s=None if self._until == inf else round(self._until * self._period, 9),
            z_norm=seen[0] if seen and certified.law else None,
            error_deg=seen and degrees(seen[1]),
            true_z_norm=true[0] if true and certified.law else None,
            true_error_deg=true and degrees(true[1]),
            damping_known=self.damping_known,
            samples=self._samples,
            outside=self._outside if self._samples else {},
            judged=self._judged,
            lemma=checks,
            broken=broken,
        )
        return found, {f"theorem.{name}": why for name, why in self._reasons(found).items()}

    def _reasons(self, found: TheoremFindings) -> dict[str, str]:
        reasons, unjudged = dict[str, str](), self._guarantees.unjudged
        no_truth = "the log has no true state of a tick that is judged"
        changed = f"gains or reference changed at {found.until_s} s"
        end = "the session ended before" if found.until_s is None else changed
        short = f"the transient lasts {found.transient_s:.3g} s, and {end}"
        if found.error_deg is None:
            reasons |= dict.fromkeys(("z_norm", "error_deg"), short)
        if found.true_error_deg is None:
            why = short if found.error_deg is None and found.samples else no_truth
            reasons |= dict.fromkeys(("true_z_norm", "true_error_deg"), why)
        if self._certified.law is None:
            reasons |= dict.fromkeys(("z_norm", "true_z_norm"), found.verdict.rstrip("."))
        if found.broken is None:
            reasons["broken"] = "no true state satisfies the lemma's premises" if found.samples else no_truth
            if self._certified.bounds is None:
                reasons["broken"] = found.verdict.rstrip(".")
        if found.mean_square_share is None:
            few = "no two true states in a row satisfy the premises, with every command between them within (C.30)"
            why = unjudged or (self._guarantees.undecided if found.samples else no_truth) or few
            reasons |= dict.fromkeys(("radius", "mean_square_share", "mean_square_at_s", "spacing_s"), why)
        if found.pointwise_radius is None:
            why = found.verdict.rstrip(".") if found.holds is None else "the certificate does not hold"
            reasons |= dict.fromkeys(("pointwise_radius", "pointwise_deg"), why)
        if found.pointwise_share is None:
            none = "no invariant set is proven of the configured plant"
            far = "no true state is near enough to the invariant set"
            bounds = self._certified.bounds
            why = unjudged or (
                none if bounds is None or bounds.plant_reach is None else far if found.samples else no_truth
            )
            reasons |= dict.fromkeys(("pointwise_share", "pointwise_at_s", "pointwise_since_s", "pointwise_bound"), why)
        if found.held is None:
            reasons["held"] = reasons["broken"]
        return reasons


def transient(law: AdaptiveSettings | None) -> float:
    """Three times the slower time constant: ε̃ falls by C₁/2, as (C.12) has it near 0, and z₂ by J⁻¹C₂ (C.22) [s].

    Of another law, whose constants are not known, that of the paper's gains.
    """
    law = law or AdaptiveSettings()
    return 3 * max(2 / min(law.C1), max(law.inertia) / min(law.C2))


def _judged_ticks(changes: Sequence[Change], period: float) -> tuple[int, float]:
    """The first tick, and the end, of the span in which a session follows its first reference with its first gains."""
    since, begun = 0, set[str]()
    for change in changes:
        # An approach from the attitude found belongs to the beginning; it may be faster than the reference.
        if change.start is None and begun == {"gains", "reference"}:
            return since, change.tick
        begun |= {name for name in ("gains", "reference") if getattr(change, name) is not None}
        since = max(since, change.tick + ceil(change.within_s / period))
    return since, inf


def _larger(known: tuple[float, float] | None, norms: Array, angles: Array) -> tuple[float, float]:
    norm, angle = known or (0.0, 0.0)
    return max(norm, float(norms.max())), max(angle, float(angles.max()))


def measured_norm(ticks: Ticks, certified: CertifiedBounds) -> tuple[Array, Array]:
    """‖z^Q‖ and its V without θ̃ (C.24), from the errors that the controller computed; NaN of another law. (n,)."""
    law = certified.law or AdaptiveSettings()
    paper, eps_e = PaperSignals.of(ticks, certified), ticks.attitude_error
    sign = paper.sign[:, np.newaxis]
    eta_e = (ticks.attitude * ticks.desired).sum(axis=1)  # (C.32)
    z1 = (1 - paper.sign * eta_e) ** 2 + (eps_e**2).sum(axis=1)  # (C.39), its square
    z2 = (ticks.rate_error + sign * paper.gain * eps_e) ** 2  # (C.40); G z₁ = ±ε̃ by (C.49)
    norm: Array = np.sqrt(z1 + z2.sum(axis=1))
    V: Array = z1 + z2 @ np.array(law.inertia) / 2
    return norm, V
