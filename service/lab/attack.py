"""Attack on a certificate: an adversary's search for a run, or an instant, that breaks what is proven.

A run begins at x(t₀) with ‖x(t₀)‖ ≤ r and is compared with `reach` of the same r: ‖z‖, |ω_k|, |ε_k| and |u_k| at every
tick, and for r = 0 the mean square of (C.77). An instant is compared with Lemma 1. The adversary chooses θ, θ̂(t₀) and
x(t₀) in their balls, the reference's phase, direction and course of τ_d, and either a shift of each quantizer's grid
or, within their bounds, the errors themselves. First it draws at random, then it mutates the best of each kind of run.

A run is judged until it leaves the wire's ranges, as they are premises; |ω_k|, |ε_k| and |u_k| show whether it had to
stay within them. Each round is a line of a file, from which a search resumes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from math import log, pi, sin
from pathlib import Path
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings
from aeroloop.service.control.laws.adaptive import ESTIMATE_REACH
from aeroloop.service.control.reference import Floats
from aeroloop.service.lab.attack_rounds import Round, Rounds, WorstInstants
from aeroloop.service.lab.attacked_lemma import SIZE as INSTANT_SIZE
from aeroloop.service.lab.attacked_lemma import Instants
from aeroloop.service.lab.attacked_loops import WAVES, Experiments, Loops, Outcome, Wave
from aeroloop.service.lab.search_points import ball, proposals
from aeroloop.service.lab.workers import Workers
from aeroloop.service.theorem.configured import with_theorem
from aeroloop.service.theorem.evaluation import Evaluated, evaluate, largest_voltage
from aeroloop.service.theorem.invariant import largest_start, reach

BATCH: Final = 128
"""Loops that run at once in a process: most ticks a second."""
BATCHES: Final = 2
ROUND: Final = BATCH * BATCHES
_INSTANTS: Final = 2000
_PARENTS: Final = 8
_START: Final = 0.25
"""Share of the largest start that is proven to come back."""
_FREQUENCIES: Final = (0.3, 60.0)
"""Of waves: a tenth to ten times the loop's own, about [rad/s]."""
DIVERGED: Final = 1e9
"""Stands for every value beyond it, and for NaN."""
_SECTIONS: Final = ("loop", "wire", "reference", "law", "controller", "plant")
"""Sections of the configuration that an attack depends on."""
_LAYOUT: Final = {"theta": 3, "theta_hat": 3, "start": 6, "phase": 1, "torque": 6, "error": 6, "offset": 9}
"""Coordinates of an experiment, each −1…1. A wave has a vector, kind, frequency and angle."""
Errors: TypeAlias = Literal["quantizers", "any"]


class Statement(BaseModel):
    """Something proven, and the most that was found against it."""

    model_config = ConfigDict(frozen=True)

    what: str = Field(description="‖z‖, mean square, |ω_k|, |ε_k|, |u_k|, or the number of an inequality of Lemma 1")
    errors: Errors | None = Field(
        default=None, description="quantizers: the wire's, shifted; any: within their bounds; null for Lemma 1"
    )
    start: float | None = Field(default=None, description="largest ‖x(t₀)‖; null for Lemma 1 [1, rad/s]")
    unit: str
    found: float = Field(description="the largest value found [unit]")
    bound: float | None = Field(description="the proven bound [unit]; null where nothing is proven")
    share: float | None = Field(description="found/bound [1]; above 1 the certificate is wrong")
    experiment: int | None = Field(default=None, description="number of the experiment in the file, from 0")

    @property
    def beaten(self) -> bool:
        """Whether the bound is exceeded, beyond rounding."""
        return self.share is not None and self.share > 1 + 1e-9


class Attack(BaseModel):
    """Result of a search."""

    model_config = ConfigDict(frozen=True)

    runs: int = Field(description="experiments so far, those resumed from included")
    instants: int = Field(description="instants at which Lemma 1 was evaluated")
    duration_s: float = Field(description="length of an experiment [s]")
    seed: int
    seconds: float = Field(description="time that the search took, this time [s]")
    ticks_per_s: float = Field(description="ticks of all loops in a second of it")
    left_ranges: int = Field(description="experiments in which a value left the wire's range")
    path: Literal["compiled"] = Field(default="compiled", description="how the loops ran: as one function, in columns")
    beaten: bool = Field(description="whether anything exceeds what is proven")
    statements: list[Statement]


def largest_norm(found: Attack) -> float:
    """The largest ‖z‖ of runs that began at x = 0, by any errors within the quantizers' bounds [1, rad/s]."""
    return max(s.found for s in found.statements if s.what == "‖z‖" and not s.start)


class _Group(NamedTuple):
    """Experiments with the same bounds, by the names of _UNITS; without those that are not proven."""

    errors: Errors
    start: float
    bounds: dict[str, float]


_UNITS: Final = {
    "z": ("‖z‖", "1, rad/s"),
    "mean_square": ("mean square", "1"),
    "omega": ("|ω_k|", "rad/s"),
    "eps": ("|ε_k|", "1"),
    "u": ("|u_k|", "V"),
}
"""Name and unit of what is judged; the mean square as a share of what (C.77) allows."""


def attack(
    settings: Settings,
    runs: int,
    *,
    seed: int = 0,
    duration_s: float = 8.0,
    disturbance: float | None = None,
    seconds: float | None = None,
    out: Path | None = None,
    workers: Workers | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Attack:
    """Search for runs and instants that break the certificate of a configuration.

    Args:
        settings: The configuration.
        runs: Experiments, at least; they are run in rounds of `ROUND`.
        seed: Of the search; the same seed finds the same.
        duration_s: Length of an experiment [s].
        disturbance: Largest ‖τ_d‖ [N·m]; None is 0.
        seconds: End after the round in which this time has passed [s]; None for no limit.
        out: File of the rounds; if it exists, they are not repeated.
        workers: Processes to run in; None runs in this one.
        progress: Called with experiments done and experiments in all.

    Raises:
        AttackError: The file is of another search, or cannot be read or written.
        BoundlessError: A stream, which cannot be certified.
    """
    began = time.monotonic()
    e = evaluate(settings, disturbance=disturbance)
    groups = _groups(settings, e)
    ticks = settings.loop.ticks(duration_s)
    instants = Instants(settings, e)
    whole = settings.description()
    config = json.dumps({name: whole[name] for name in _SECTIONS})
    file = Rounds(out, {"seed": seed, "ticks": ticks, "disturbance": disturbance or 0.0, "config": config})
    rounds, before = file.rounds, len(file.rounds)
    while len(rounds) * ROUND < runs and (seconds is None or time.monotonic() - began < seconds or not rounds):
        if progress:
            progress(len(rounds) * ROUND, runs)
        rng = np.random.default_rng([seed, len(rounds)])
        points = _points(rng, rounds, groups)
        jobs = [(config, ticks, disturbance or 0.0, groups, batch) for batch in np.split(points, BATCHES)]
        parts = workers.each(_run, jobs) if workers else [_run(*job) for job in jobs]
        reached = {name: np.concatenate([getattr(part, name) for part in parts]).tolist() for name in Outcome._fields}
        file.append(Round(points=points.tolist(), reached=reached, instants=_instants(rng, rounds, instants)))
    took = time.monotonic() - began
    if progress:
        progress(len(rounds) * ROUND, runs)
    reached_by_all = {name: np.concatenate([each.reached[name] for each in rounds]) for name in Outcome._fields}
    done = [*_of_runs(reached_by_all, e, groups), *_of_lemma(rounds)]
    return Attack(
        runs=len(rounds) * ROUND,
        instants=len(rounds) * _INSTANTS,
        duration_s=duration_s,
        seed=seed,
        seconds=took,
        ticks_per_s=(len(rounds) - before) * ROUND * ticks / took if len(rounds) > before else 0.0,
        left_ranges=int((reached_by_all["lasted"] < (ticks - 0.5) * settings.loop.period).sum()),
        beaten=any(each.beaten for each in done),
        statements=done,
    )


def _groups(settings: Settings, e: Evaluated) -> list[_Group]:
    """Quantizers and any errors, each from r = 0 and from a start that is proven to come back, if one is."""
    uniform = all(getattr(settings.wire, name).kind == "uniform" for name in ("attitude", "rate", "voltage"))
    kinds: tuple[Errors, ...] = ("quantizers", "any") if uniform else ("any",)
    starts = [0.0, *([_START * largest_start(e.body)] if e.body_reach else [])]
    found = list[_Group]()
    for start in starts:
        at = reach(e.body, start)
        bounds = (
            {}
            if at is None
            else {
                "z": at.radius,
                "omega": at.axis_rate,
                "eps": sin(at.half_angle),
                "u": largest_voltage(settings, e.desired, at),
                **({"mean_square": 1.0} if e.theorem.k and not start else {}),
            }
        )
        found += [_Group(errors, start, bounds) for errors in kinds]
    return found


def _group_of(rows: int, groups: Sequence[_Group]) -> NDArray[np.intp]:
    """The group of each row of a round: in turns, so that every batch has all of them. Shape (rows,)."""
    return np.arange(rows) % len(groups)


def _points(rng: np.random.Generator, rounds: Sequence[Round], groups: Sequence[_Group]) -> Floats:
    """The next round: mutations of each group's best, and random points."""
    size = sum(_LAYOUT.values())
    group_of = _group_of(ROUND, groups)
    points = np.empty((ROUND, size))
    for g in range(len(groups)):
        mine = np.flatnonzero(group_of == g)
        tried = [(each.reached["z"][i], each.points[i]) for each in rounds for i in mine]
        best = sorted(tried, key=lambda pair: -pair[0])[:_PARENTS]
        points[mine] = proposals(rng, np.array([point for _, point in best]), len(mine), size)
    return points


@lru_cache(maxsize=1)
def _loops(config: str, ticks: int) -> Loops:
    return Loops(Settings.model_validate_json(config), BATCH, ticks)


def _run(config: str, ticks: int, disturbance: float, groups: Sequence[_Group], points: Floats) -> Outcome:
    """A batch of experiments; in any process."""
    loops = _loops(config, ticks)
    group_of = _group_of(len(points), groups)
    start = np.array([groups[g].start for g in group_of])
    quantized = np.array([groups[g].errors == "quantizers" for g in group_of], float)
    loops.begin(experiments(points, with_theorem(loops.settings).law.damping_bound, disturbance, start, quantized))
    return Outcome(*(np.minimum(np.nan_to_num(part, nan=DIVERGED), DIVERGED) for part in loops.advance(ticks)))


def experiments(points: Floats, k_theta: float, k_tau_d: float, start: Floats, quantized: Floats) -> Experiments:
    """The experiments that points of the cube stand for.

    Args:
        points: Shape (n, 34).
        k_theta: k_θ, for θ; θ̂ may be as large as the projection lets it be [N·m·s/rad].
        k_tau_d: Largest ‖τ_d‖ [N·m].
        start: Largest ‖x(t₀)‖ of each. Shape (n,).
        quantized: 1 where the quantizers act. Shape (n,).
    """
    theta, theta_hat, x, phase, torque, error, offset = np.split(points, np.cumsum(list(_LAYOUT.values()))[:-1], axis=1)
    return Experiments(
        start=ball(x) * start[:, None],
        theta=ball(theta) * k_theta,
        theta_hat=ball(theta_hat) * k_theta * ESTIMATE_REACH,
        phase=(phase[:, 0] + 1) / 2,
        torque=_wave(ball(torque[:, :3]) * k_tau_d, torque),
        error=_wave(error[:, :3] * (1 - quantized[:, None]), error),
        offset=offset / 2,
        quantized=quantized,
    )


def _wave(along: Floats, cube: Floats) -> Wave:
    kind, frequency, angle = (cube[:, 3:] + 1).T / 2
    low, high = map(log, _FREQUENCIES)
    return Wave(
        along=along,
        kind=np.minimum((kind * len(WAVES)).astype(int), len(WAVES) - 1),
        frequency=np.exp(low + (high - low) * frequency),
        angle=2 * pi * angle,
    )


def _instants(
    rng: np.random.Generator, rounds: Sequence[Round], instants: Instants
) -> dict[str, tuple[float, list[float]]]:
    """The worst instant of each inequality among new ones, some of them mutations of the worst so far."""
    worst = _worst_instants(rounds)
    parents = np.array([point for _, point in worst.values()])
    points = proposals(rng, parents, _INSTANTS, INSTANT_SIZE)
    shares = instants.shares(points)
    found = {
        name: (float(min(share.max(), DIVERGED)), points[share.argmax()].tolist()) for name, share in shares.items()
    }
    return {name: max(pair, worst.get(name, pair), key=lambda each: each[0]) for name, pair in found.items()}


def _worst_instants(rounds: Sequence[Round]) -> WorstInstants:
    return rounds[-1].instants if rounds else {}


def _of_runs(reached: dict[str, Floats], e: Evaluated, groups: Sequence[_Group]) -> Iterator[Statement]:
    allowed = (reached["V"] + e.theorem.delta_Qdist * reached["lasted"]) / (e.theorem.k or np.nan)  # (C.77)
    values = reached | {"mean_square": reached["square"] / allowed}
    group_of = np.arange(len(allowed)) % ROUND % len(groups)
    for g, group in enumerate(groups):
        for name, (what, unit) in _UNITS.items():
            bound = group.bounds.get(name)
            if name == "mean_square" and bound is None:
                continue
            experiment = int(np.argmax(np.where(group_of == g, values[name], -1.0)))
            found = float(values[name][experiment])
            yield Statement(
                what=what,
                errors=group.errors,
                start=group.start,
                unit=unit,
                found=found,
                bound=bound,
                share=None if bound is None else found / bound,
                experiment=experiment,
            )


def _of_lemma(rounds: Sequence[Round]) -> Iterator[Statement]:
    for name, (share, _) in _worst_instants(rounds).items():
        yield Statement(what=name, unit="1", found=share, bound=1.0, share=share)
