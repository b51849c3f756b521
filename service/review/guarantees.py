"""Judges true states against what is true at any length: the mean square of ‖z‖, and the invariant set once entered.

Both hold along a *piece*: true states in a row, none further from the next than `plant.truth_rate_hz` says, between
which every tick has a command that is within (C.30), and which satisfy (C.28), (C.29) and Assumption 3 for the
configured plant. Each piece begins anew, with its own V(t₀).

    mean square    ∫ k ‖z‖² dt ≤ V(t₀) + ∫ δ dt        k, δ of `mean_square.decay`; the integral by trapezoids
    every instant  ‖z(t)‖ ≤ `reach`(r)                  r the least ‖x(t₀)‖ of the piece so far

δ at a tick is of the largest ‖z^Q‖ since the command that acts was computed; k, and δ where rotors lag, of the largest
‖z^Q‖ so far. Where θ is not known, the last term of V(t₀) is its bound, and so is the part of x that depends on it.
"""

from __future__ import annotations

from math import hypot, inf, sqrt
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array
from aeroloop.service.review.certified_bounds import CertifiedBounds, PaperSignals
from aeroloop.service.theorem.evaluation import Evaluated
from aeroloop.service.theorem.invariant import Premises, largest_start, reach
from aeroloop.service.theorem.lemma import Coordinates, Samples, lyapunov, norm, rotation, times
from aeroloop.service.theorem.mean_square import Decay, decay

Flags = npt.NDArray[np.bool_]

_PER_OCTAVE: Final = 8
"""Sizes of ‖z‖ for which k and δ are computed; between them, those of the next larger one count."""
_STARTS: Final = 40
_STARTS_PER_OCTAVE: Final = 4
_LEAST: Final = 1e-6


class Conditions(NamedTuple):
    """What holds up to each tick of a block.

    Attributes:
        refused: Whether its command is missing or breaks (C.30). Shape (n,).
        until: How many of these, of ticks after a gap, and of ticks without a δ there are up to the tick. Shape (n,).
        before: How many of them no longer act at the tick. Shape (n,).
        seen: Largest ‖z^Q‖ up to the tick. Shape (n,).
        delta: ∫ δ dt up to the tick [W·s]. Shape (n,).
    """

    refused: Flags
    until: Array
    before: Array
    seen: Array
    delta: Array

    def joined(self, other: Conditions) -> Conditions:
        """These ticks, followed by others."""
        return Conditions(*map(np.concatenate, zip(self, other, strict=True)))  # type: ignore[arg-type]  # likewise

    def where(self, chosen: npt.NDArray[np.int64]) -> Conditions:
        """The ticks at these places."""
        return Conditions(*(column[chosen] for column in self))  # type: ignore[arg-type]  # as they were


class Judged:
    """What one statement came to: how many states judged it, and how near it came to its bound.

    Attributes:
        samples: True states that judged it.
        share: Largest left-hand side as a share of its bound; None before the first.
        at_s: When that was [s]; likewise.
    """

    def __init__(self) -> None:
        self.samples = 0
        self.share: float | None = None
        self.at_s: float | None = None

    def add(self, left: float, right: float, time_s: float) -> None:
        """Add one true state."""
        self.samples += 1
        share = left / right if right else inf if left else 0.0
        if self.share is None or share > self.share:
            self.share, self.at_s = share, round(time_s, 9)


class TrueState(NamedTuple):
    """A true state, the conditions of its tick, and its measurement's errors; see `Guarantees.judge`."""

    time: float
    seen: float
    until: float
    before: float
    delta: float
    good: bool
    delta_eps: float
    delta_omega: float
    norm: float
    V: float
    x: float


class Piece(NamedTuple):
    """A piece up to its last state: that state, both sides of the mean square, the least ‖x‖."""

    at: TrueState
    left: float
    right: float
    start: float


class InvariantSet:
    """‖z‖ after a start, from `reach`, for starts in steps.

    Args:
        p: Premises of a plant with an invariant set.
    """

    def __init__(self, p: Premises) -> None:
        most = largest_start(p)
        starts = [0.0, *(most * 2 ** ((n - _STARTS) / _STARTS_PER_OCTAVE) for n in range(_STARTS + 1))]
        found = [(start, at) for start in starts if (at := reach(p, start)) is not None]
        self._starts, self._radii = np.array([s for s, _ in found]), [at.radius for _, at in found]
        self.held_roll = p.tilt is not None
        shift = max(hypot(1, a) / (1 + a * b) for a, b, _ in p.axes)
        self.offset = shift * found[-1][1].slow
        """Largest ‖K w_s‖ [1, rad/s]."""

    def radius(self, start: float) -> float:
        """Bound of ‖z‖ at all times after ‖x‖ = `start`; infinite where none is proven."""
        place = int(np.searchsorted(self._starts, start))
        return self._radii[place] if place < len(self._radii) else inf


class Guarantees:
    """Judges one session's true states.

    Args:
        certified: Certificate and bounds to check against.
        loop: Tick grid of the session.
        plant: The plant: how often it publishes its state, and its supply.

    Attributes:
        unjudged: Why nothing can be judged; None where true states may.
        mean_square: The mean square.
        pointwise: The invariant set.
        spacing_s: Longest time between two true states of a piece [s]; None before the first two.
        entered_s: When the invariant set's bound began to judge [s]; None before.
        bound: The least bound of ‖z‖ that has judged [1, rad/s]; None before.
        decay: k and δ of the largest ‖z^Q‖ at the last true state; None where there are none.
        radius: √(δ/k) at the last true state that judged [1, rad/s]; None before.
    """

    def __init__(self, certified: CertifiedBounds, loop: LoopSettings, plant: PlantSettings) -> None:
        e = certified.bounds
        self._certified, self._law = certified, certified.law or AdaptiveSettings()
        self._evaluated, self._period = e, loop.period
        self.unjudged = certified.verdict.rstrip(".") if e is None else _unjudged(e)
        self._supply = plant.voltage_limit
        self._theta = None if e is None else e.bounds.theta
        self._most_apart = (1.5 / plant.truth_rate_hz if plant.truth_rate_hz else 0.0) + loop.period
        self._late = 0 if loop.lockstep else 1  # ticks before a command acts
        self._set = None if e is None or self.unjudged or e.plant_reach is None else InvariantSet(e.plant)
        self._decays: dict[int, Decay | None] = {}
        held = (1 + self._late) * loop.period
        self._remembers = e is not None and e.plant.age > held * (1 + 1e-9)  # rotors that lag
        self._failed = [0.0] * (1 + self._late)  # `Conditions.until` of the last ticks
        self._norms = [0.0] * (1 + self._late)  # ‖z^Q‖ of the last ticks
        self._seen, self._last_k, self._delta = 0.0, -1, 0.0
        self._piece: Piece | None = None
        self.decay: Decay | None = None
        self.forget(self.unjudged)

    def forget(self, unjudged: str | None) -> None:
        """Drop what was judged. `unjudged`: why nothing can be, if nothing can."""
        self.unjudged = unjudged
        self.mean_square, self.pointwise = Judged(), Judged()
        self.spacing_s: float | None = None
        self.radius: float | None = None
        self.entered_s: float | None = None
        self.bound: float | None = None

    @property
    def undecided(self) -> str | None:
        """Why there is no k and δ at the last true state; None where there are, or no true state."""
        e = self._evaluated
        if e is None or self.decay is not None or not self._decays:
            return None
        if e.theorem.k is None:
            return "condition (C.66) fails"
        return f"commands up to {e.plant.age * 1e3:.3g} ms old (rotor lag, period, transport): V need not decrease"

    def conditions(self, ticks: Ticks, measured: Array, since: int) -> Conditions:
        """Conditions of a block of ticks.

        Args:
            ticks: The block; blocks come in order.
            measured: ‖z^Q‖. Shape (n,).
            since: Tick from which ‖z^Q‖ counts.
        """
        delta_u = inf if self._evaluated is None else self._evaluated.plant.delta_u
        refused = refused_commands(ticks, delta_u, self._supply)
        apart = np.diff(ticks.k, prepend=self._last_k) != 1
        norms = np.array([*self._norms, *np.where(ticks.k >= since, measured, 0.0)])
        n, m = len(ticks.k), len(self._norms)
        seen = np.maximum(self._seen, np.maximum.accumulate(norms[m:]))
        recent = seen if self._remembers else np.max([norms[i : i + n] for i in range(m + 1)], axis=0)
        delta = self._deltas(recent) * self._period
        failed = refused | apart | ~np.isfinite(delta)
        until = np.array([*self._failed, *(self._failed[-1] + np.cumsum(failed))])
        total = self._delta + np.cumsum(np.where(np.isfinite(delta), delta, 0.0))
        self._failed, self._norms = until[-len(self._failed) :].tolist(), norms[-m:].tolist()
        self._seen, self._last_k, self._delta = float(seen[-1]), int(ticks.k[-1]), float(total[-1])
        return Conditions(refused, until[-n:], until[:n], seen, total)

    def judge(self, at: Ticks, of: Conditions, samples: Samples, b: Coordinates, good: Flags) -> None:
        """Judge true states, in order.

        Args:
            at: Their ticks.
            of: Conditions of their ticks.
            samples: True and received states, q and q^Q of like sign.
            b: Error coordinates of the true ones.
            good: Which are in the judged span and satisfy Assumption 3. Shape (n,).
        """
        if self.unjudged:
            return
        columns = (
            at.k * self._period, of.seen, of.until, of.before, of.delta, good & ~of.refused & (at.k >= self._late),
            norm((samples.q_Q - samples.q)[:, 1:]), norm(samples.omega_Q - samples.omega),
            b.norm, self._lyapunov(b, at), self._x(b, at),
        )  # fmt: skip
        for row in zip(*(column.tolist() for column in columns), strict=True):
            self._judge(TrueState(*row))

    def _judge(self, now: TrueState) -> None:
        """Judge a true state by the piece that it continues; or begin one with it."""
        last, self.decay = self._piece, self._decay(now.seen)
        if self.decay is None or not now.good or not self.decay.counts_on(now.delta_eps, now.delta_omega):
            self._piece = None
            return
        start = now.x
        if last is None or now.time - last.at.time > self._most_apart or now.until != last.at.before:
            self._piece = Piece(now, 0.0, now.V, start if not self._late else inf)
            return
        apart = now.time - last.at.time
        left = last.left + apart * self.decay.k * (last.at.norm**2 + now.norm**2) / 2
        right = last.right + now.delta - last.at.delta
        self.radius = sqrt((now.delta - last.at.delta) / apart / self.decay.k)
        self.mean_square.add(left, right, now.time)
        self.spacing_s = max(self.spacing_s or 0.0, apart)
        if self._set is not None and (radius := self._set.radius(last.start)) < inf:
            self.pointwise.add(now.norm, radius, now.time)
            self.entered_s = last.at.time if self.entered_s is None else self.entered_s
            self.bound = radius if self.bound is None else min(self.bound, radius)
        if self._late:  # the command that acts is of the tick before
            start = max(start, last.at.x)
        self._piece = Piece(now, left, right, min(last.start, start))

    def _decay(self, seen: float) -> Decay | None:
        """k and δ for a size of ‖z‖, rounded up."""
        return self._decay_at(int(_sizes(seen)))

    def _deltas(self, seen: Array) -> Array:
        """δ for sizes of ‖z‖, rounded up; infinite where there is none [W]. Shape (n,)."""
        if self.unjudged:
            return np.zeros(len(seen))
        sizes, where = np.unique(_sizes(seen), return_inverse=True)
        found = [self._decay_at(int(size)) for size in sizes]
        return np.array([inf if one is None else one.delta for one in found])[where]

    def _decay_at(self, size: int) -> Decay | None:
        if size not in self._decays:
            assert self._evaluated is not None
            self._decays[size] = decay(self._evaluated, 2.0 ** (size / _PER_OCTAVE))
        return self._decays[size]

    def _lyapunov(self, b: Coordinates, at: Ticks) -> Array:
        """V, or a bound of it where θ is not known. Shape (n,)."""
        if self._theta is not None:
            estimate = PaperSignals.of(at, self._certified).damping_estimate
            return lyapunov(b, self._theta - estimate, self._law)
        assert self._evaluated is not None
        p = self._evaluated.plant
        unknown: Array = lyapunov(b, np.zeros((1, 3)), self._law) + p.theta_error**2 / min(p.Gamma) / 2
        return unknown

    def _x(self, b: Coordinates, at: Ticks) -> Array:
        """‖x‖ of `invariant`, or a bound of it where θ is not known or the roll is held. Shape (n,)."""
        if self._set is None:
            return np.full(len(at.k), inf)
        paper = PaperSignals.of(at, self._certified)
        eps, z2 = paper.sign[:, None] * b.eps_e, b.z2
        if self._theta is None or self._set.held_roll:
            whole: Array = norm(np.hstack([eps, z2])) + self._set.offset
            return whole
        C1, C2 = np.array(self._law.C1), np.array(self._law.C2)
        balance = -self._desired_rate(at) * (self._theta - paper.damping_estimate) / (1 + C1 * C2)
        return norm(np.hstack([eps - balance, z2 - C1 * balance]))

    @staticmethod
    def _desired_rate(at: Ticks) -> Array:
        """ω_d in the desired body frame [rad/s]. Shape (n, 3)."""
        inertial = times(rotation(at.attitude), at.desired_rate)
        return times(np.swapaxes(rotation(at.desired), 1, 2), inertial)


def _sizes(seen: Array | float) -> Array:
    """Number of the next larger size for which k and δ are computed."""
    sizes: Array = np.ceil(_PER_OCTAVE * np.log2(np.maximum(seen, _LEAST)))
    return sizes


def refused_commands(ticks: Ticks, delta_u: float, supply: float) -> Flags:
    """Ticks whose command is missing, or not within (C.30) of what the law computed, as at saturation. Shape (n,).

    Args:
        ticks: The ticks.
        delta_u: Largest ‖u^Q − u‖ [V].
        supply: Largest voltage that the motors get [V].
    """
    acts = np.clip(ticks.voltages, -supply, supply)
    error = norm(acts - ticks.unquantized[:, -acts.shape[1] :])
    return ~(error <= delta_u * (1 + 1e-9) + 1e-12)  # NaN: no command


def _unjudged(e: Evaluated) -> str | None:
    if e.bounds.unproven:
        return "; ".join(e.bounds.unproven)
    if e.bounds.theta is not None and hypot(*e.bounds.theta) > e.plant.k_theta:
        return f"the plant's ‖θ‖ exceeds law.damping_bound = {e.plant.k_theta:g}"
    return None
