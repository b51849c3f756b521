"""Theorem 1 and Lemma 1 held against a session: what was promised, what the run did, each inequality where truth is.

‖z‖ and V are those that the controller computed, from quantized signals, at every tick; and the true ones at the ticks
of which an emulator told the true state. A truth says which tick's measurement was taken of it, so nothing that is
judged is interpolated. The transient lasts three times the law's slower time constant, by when an error has fallen to
5 %. All is judged from when the reference is followed, which a session that begins far from it first goes to, until an
operator first changes gains or reference: before and after, another certificate would hold.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import ceil, degrees, inf, nan
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.service.control.law import LawSettings
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array, Integers
from aeroloop.service.review.certificate_cache import CertifiedBounds
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
ERROR_PREMISE: Final = "Assumption 3"
"""That the attitude error is within what the certificate assumes."""

WAITING: Final = 8192
"""Truths that may wait for the ticks that they are of."""


class Truths(NamedTuple):
    """What was true at ticks, a row each. Shapes (n,), (n, 4), (n, 3)."""

    k: Integers
    attitude: Array
    rate: Array


class InequalityCount:
    """One inequality: how often it was judged, how often broken, and how close it came."""

    def __init__(self, inequality: Inequality) -> None:
        self.equation, self.what = inequality.equation, inequality.what
        self.samples = self.broken = 0
        self.closest = 0.0
        self.closest_s = self.broken_s = nan

    def add(self, inequality: Inequality, judged: Flags, time: Array) -> None:
        """More samples, and which of them count. Shapes (n,)."""
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
        """What has been found."""
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
    """Holds one session against the theorem.

    Args:
        grounds: What it is held against.
        period: Time between ticks [s].
        damping: θ of the plant, if that is known [N·m·s/rad].

    Attributes:
        damping_known: Whether it is.
    """

    def __init__(self, grounds: CertifiedBounds, period: float, damping: Vector | None) -> None:
        self._grounds = grounds
        self._period = period
        self._damping = damping
        self.damping_known = damping is not None
        self._changes: list[Change] = []  # the first few
        self._since, self._until = 0, inf
        self._truths: deque[tuple[int, Quaternion, Vector]] = deque(maxlen=WAITING)
        self._before: Ticks | None = None  # the last block: a truth may come a little late
        self._drawn = np.empty((0, 4))  # the last true state: its tick, ‖z‖, V and the angle of its error [deg]
        self._tallies: dict[str, InequalityCount] = {}
        self._outside = dict.fromkeys((*PREMISES, ERROR_PREMISE), 0)
        self._samples = self._judged = 0
        self._settled = transient(grounds.law) / period  # tick from which the transient is over
        self._seen: tuple[float, float] | None = None  # largest ‖z‖ and largest attitude error [rad] from then on
        self._true: tuple[float, float] | None = None  # the same of the true state

    # ── what it is told ──

    def changed(self, changes: Sequence[Change]) -> None:
        """What the controller followed from which tick on, in order, before those ticks are given.

        The first is what the session began with, unless the log lacks that.
        """
        self._changes = [*self._changes, *changes][:3]
        self._since, self._until = _judged_ticks(self._changes, self._period)
        self._settled = self._since + transient(self._grounds.law) / self._period

    def truth(self, tick: int | None, attitude: Quaternion, rate: Vector) -> None:
        """What was true as a tick's measurement was taken; None of a state that none was taken of."""
        if tick is not None and (not self._truths or tick > self._truths[-1][0]):
            self._truths.append((tick, attitude, rate))

    def ticks(self, ticks: Ticks) -> tuple[Array, Array]:
        """A block of ticks.

        Returns:
            What is drawn of them, NaN where there is none: the true attitude error [deg], shape (n,); measured and true
            ‖z‖, measured and true V, shape (n, 4).
        """
        z, V = measured_norm(ticks, self._grounds.law)
        self._settle(ticks, z)
        true = np.full((3, len(z)), nan)
        before, self._before = self._before, ticks
        if self._truths and self._truths[0][0] <= ticks.k[-1]:
            late = [] if before is None or before.k[-1] < self._truths[0][0] else [before]
            if (found := self._judge_truths(Ticks.joined([*late, ticks]))) is not None:
                known = np.vstack([self._drawn, found])
                self._drawn = known[-1:]
                # A line is drawn from one to the next.
                true = np.array([np.interp(ticks.k, known[:, 0], values, left=nan) for values in known.T[1:]])
        return true[2], np.column_stack([z, true[0], V, true[1]])

    def finish(self) -> None:
        """Judge the last block's true states that came after it."""
        if self._truths and self._before is not None:
            self._judge_truths(self._before)

    def _judge_truths(self, ticks: Ticks) -> Array | None:
        """Judge the true states of these ticks.

        Returns:
            Tick, true ‖z‖, V and error [deg] of each, shape (n, 4); None without one.
        """
        truths = self._take_truths(int(ticks.k[0]), int(ticks.k[-1]))
        place = np.searchsorted(ticks.k, truths.k)
        there = ticks.k[place] == truths.k
        if not there.any():
            return None
        at = ticks.where(place[there])
        return np.column_stack([at.k, *self._try(at, Truths(*(column[there] for column in truths)))])

    def _settle(self, ticks: Ticks, z: Array) -> None:
        """The largest ‖z‖ and attitude error after the transient."""
        after = (ticks.k >= self._settled) & (ticks.k < self._until)
        if after.any():
            square = (ticks.attitude_error[after] ** 2).sum(axis=1)
            self._seen = _larger(self._seen, z[after], 2 * np.arcsin(np.sqrt(np.minimum(1.0, square))))

    def _take_truths(self, first: int, last: int) -> Truths:
        """Those of these ticks; earlier ones are forgotten, later ones wait."""
        taken = []
        while self._truths and self._truths[0][0] <= last:
            if (truth := self._truths.popleft())[0] >= first:
                taken.append(truth)
        k, attitude, rate = zip(*taken, strict=True) if taken else ((), (), ())
        return Truths(np.array(k, np.int64), np.array(attitude).reshape(-1, 4), np.array(rate).reshape(-1, 3))

    def _try(self, at: Ticks, truths: Truths) -> tuple[Array, Array, Array]:
        """Judge the lemma at ticks of which the truth is known. Returns true ‖z‖, V and error [deg]. Shapes (n,)."""
        grounds = self._grounds
        law = grounds.law
        inertial = times(rotation(at.attitude), at.desired_rate)
        samples = Samples(truths.attitude, truths.rate, at.attitude, at.rate, at.desired, inertial, at.sign)
        q = samples.q * np.where((samples.q * samples.q_Q).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        b = coordinates(q, samples.omega, samples.q_d, inertial, at.sign, at.gain)
        theta_error = np.zeros((1, 3)) if self._damping is None else self._damping - at.damping_estimate
        counts = (at.k >= self._since) & (at.k < self._until)
        half_angle = np.arcsin(np.minimum(1.0, np.linalg.norm(b.eps_e, axis=1)))
        if (after := counts & (at.k >= self._settled)).any():
            self._true = _larger(self._true, b.norm[after], 2 * half_angle[after])
        self._samples += int(counts.sum())
        if (bounds := grounds.bounds) is not None and counts.any():
            small = half_angle <= bounds.known.half_angle_e * (1 + 1e-9)
            time: Array = np.asarray(at.k * self._period, dtype=np.float64)
            self._judge(lemma_inequalities(samples, law, bounds.known, bounds.lemma), counts, small, time)
        return b.norm, lyapunov(b, theta_error, law), np.degrees(2 * half_angle)

    def _judge(self, inequalities: Sequence[Inequality], counts: Flags, small: Flags, time: Array) -> None:
        """Count each inequality where every premise is met: where it counts, and the error is as small as assumed."""
        self._outside[ERROR_PREMISE] += int((counts & ~small).sum())
        judged = counts & small
        for inequality in inequalities:
            if inequality.equation in PREMISES:
                self._outside[inequality.equation] += int((counts & inequality.broken).sum())
                judged &= ~inequality.broken
        self._judged += int(judged.sum())
        for inequality in inequalities:
            if inequality.equation not in PREMISES:
                self._tallies.setdefault(inequality.equation, InequalityCount(inequality)).add(inequality, judged, time)

    # ── what it has found ──

    @property
    def radius(self) -> float | None:
        """Where ‖z‖ ends, as is guaranteed."""
        return self._grounds.radius

    def findings(self) -> tuple[TheoremFindings, dict[str, str]]:
        """What is promised, what the run did, and why what is null could not be had."""
        grounds, radius, seen, true = self._grounds, self.radius, self._seen, self._true
        certificate = grounds.certificate
        checks = [tally.check() for tally in self._tallies.values()]
        found = TheoremFindings(
            verdict=grounds.verdict,
            holds=None if certificate is None else certificate.holds,
            radius=radius,
            radius_deg=None if radius is None or certificate is None else certificate.radius_deg,
            transient_s=transient(grounds.law),
            since_s=round(self._since * self._period, 9),
            until_s=None if self._until == inf else round(self._until * self._period, 9),
            z_norm=seen and seen[0],
            z_norm_share=seen[0] / radius if seen and radius else None,
            error_deg=seen and degrees(seen[1]),
            true_z_norm=true and true[0],
            true_error_deg=true and degrees(true[1]),
            damping_known=self.damping_known,
            samples=self._samples,
            outside=self._outside if self._samples else {},
            judged=self._judged,
            lemma=checks,
            broken=sum(check.broken for check in checks) if self._judged else None,
        )
        return found, {f"theorem.{name}": why for name, why in self._reasons(found).items()}

    def _reasons(self, found: TheoremFindings) -> dict[str, str]:
        reasons = dict[str, str]()
        no_truth = "the log has no true state of a tick that is judged"
        changed = f"gains or reference changed at {found.until_s} s"
        end = "the session ended before" if found.until_s is None else changed
        short = f"the transient lasts {found.transient_s:.3g} s, and {end}"
        if found.z_norm is None:
            reasons |= dict.fromkeys(("z_norm", "z_norm_share", "error_deg"), short)
        if found.true_z_norm is None:
            why = short if found.z_norm is None and found.samples else no_truth
            reasons |= dict.fromkeys(("true_z_norm", "true_error_deg"), why)
        if found.broken is None:
            reasons["broken"] = "no true state satisfies the lemma's premises" if found.samples else no_truth
        if found.radius is None:
            nothing = found.verdict.rstrip(".") if found.holds is None else "the theorem does not hold"
            reasons |= dict.fromkeys(("radius", "radius_deg", "z_norm_share"), nothing)
            if self._grounds.bounds is None:
                reasons["broken"] = nothing
        return reasons


def transient(law: LawSettings) -> float:
    """Three times the slower time constant: ε̃ falls by C₁/2, as (C.12) has it near 0, and z₂ by J⁻¹C₂ (C.22) [s]."""
    return 3 * max(2 / min(law.C1), max(law.inertia) / min(law.C2))


def _judged_ticks(changes: Sequence[Change], period: float) -> tuple[int, float]:
    """From which tick on, and until which, a session follows the reference and gains that it began with."""
    if not changes or changes[0].tick:  # a log that begins within a session lacks what that began with
        return 0, changes[0].tick if changes else inf
    since, later = 0, list(changes[1:])
    if later and later[0].start is not None:  # on the way there, which may be faster than the reference
        way = later.pop(0)
        since = way.tick + ceil((way.ease_s + way.within_s) / period)
    return since, later[0].tick if later else inf


def _larger(known: tuple[float, float] | None, norms: Array, angles: Array) -> tuple[float, float]:
    norm, angle = known or (0.0, 0.0)
    return max(norm, float(norms.max())), max(angle, float(angles.max()))


def measured_norm(ticks: Ticks, law: LawSettings) -> tuple[Array, Array]:
    """‖z^Q‖ and V of it without θ̃ (C.24), as the controller computed the errors. Shapes (n,)."""
    sign, eps_e = ticks.sign[:, np.newaxis], ticks.attitude_error
    eta_e = (ticks.attitude * ticks.desired).sum(axis=1)  # (C.32)
    z1 = (1 - ticks.sign * eta_e) ** 2 + (eps_e**2).sum(axis=1)  # (C.39), its square
    z2 = (ticks.rate_error + sign * ticks.gain * eps_e) ** 2  # (C.40); G z₁ = ±ε̃ by (C.49)
    norm: Array = np.sqrt(z1 + z2.sum(axis=1))
    V: Array = z1 + z2 @ np.array(law.inertia) / 2
    return norm, V
