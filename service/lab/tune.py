"""Search for the gains of a law in lockstep experiments: the lowest cost that keeps to limits; nothing runs but these.

A candidate is the configured gains times factors, searched in their logarithm by differential evolution (R. Storn and
K. Price, Differential Evolution, Journal of Global Optimization 11, 1997; SciPy's). Its cost is the mean of z_track +
weight · u_total over the training cases, each a seed and a wind. Candidates are ranked by cost/(1 s + cost), which is
below 1. One that trips or exceeds a limit in any case ranks behind all others, at 1 + 1 for each run that trips + the
part of the time that it did not last + the excess over each limit as a part of it. Held-out cases, of other seeds and
winds, have no part in the search: before and after it they show what it found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from json import dumps
from math import exp, isfinite, log
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides
from aeroloop.service.config_text import toml
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.lab.experiment import PATH, paths
from aeroloop.service.lab.law_margins import PUSHED_S, survives
from aeroloop.service.lab.tune_runs import Case, LawValues, Ran, run_cases, with_case, with_law
from aeroloop.service.lab.workers import Workers
from aeroloop.service.theorem.any_law import certify_any
from aeroloop.service.theorem.configured import NoTheoremError
from aeroloop.service.theorem.extremes import BoundlessError

DURATION_S: Final = 10.0
WEIGHT: Final = 1e-7
BUDGET: Final = 1000
REACH: Final = 10.0
WITHIN_DEG: Final = 10.0
MORE: Final = 1.25
"""A limit that is not given is so many times what the configured gains have."""
_DIGITS: Final = 4
"""Of every candidate's gains: what is printed is what ran."""
_SPREAD: Final = 3.0
"""The first candidates scatter about the configured gains by the reach in decades over this."""
_LEAST: Final = 8
"""Candidates of a generation; so many for each dimension beyond two: 4."""

Floats = npt.NDArray[np.float64]
Progress = Callable[[int, int], None]
Gain = float | tuple[float, ...]


class TuneError(AeroloopError):
    """Nothing can be searched, or nothing was found; one line."""


class Limits(BaseModel):
    """What a candidate must keep to in every training case; null is no limit."""

    model_config = ConfigDict(frozen=True)

    saturated: float | None = Field(description="largest part of the ticks with a voltage at its limit [1]")
    changes_per_s: float | None = Field(description="most changes of a commanded voltage [1/s]")


class Summary(BaseModel):
    """Runs with the same gains under several cases. Figures are null where all trip; costs where any does."""

    model_config = ConfigDict(frozen=True)

    cost: float | None = Field(description="mean of z_track + weight · u_total; null where a run trips [s]")
    z_track: float | None = Field(description="mean [s]")
    u_total: float | None = Field(description="mean [V²·s]")
    settled_deg: float | None = Field(description="largest attitude error in the second half, of all runs [deg]")
    saturated: float | None = Field(description="largest part of the ticks with a voltage at its limit [1]")
    changes_per_s: float | None = Field(description="most changes of a commanded voltage [1/s]")
    trips: int = Field(description="runs that ended early")
    reason: str | None = Field(description="why the first of them did")


class Tuned(BaseModel):
    """A law with some gains."""

    model_config = ConfigDict(frozen=True)

    gains: dict[str, Gain]
    training: Summary
    held_out: Summary
    delay_ms: float | None = Field(description="largest further delay of commands within the bound [ms]; null: none is")
    lost_frames: int | None = Field(description="most commands lost in a row, again and again; null: none may be")
    certificate: str = Field(description="verdict of the certificate, or why the law has none")


class Tuning(BaseModel):
    """A search for gains, and what it found."""

    model_config = ConfigDict(frozen=True)

    law: str
    weight: float = Field(description="of u_total beside z_track [1/V²]")
    limits: Limits
    duration_s: float = Field(description="length of an experiment [s]")
    training: list[Case]
    held_out: list[Case] = Field(description="cases that the search has not seen")
    within_deg: float = Field(description="bound of the attitude error in the second half, for the margins [deg]")
    margin_duration_s: float = Field(default=PUSHED_S, description="length of a run with delay or lost frames [s]")
    searched: list[str] = Field(description="gains that were searched, and element where they are several")
    without_effect: list[str] = Field(description="gains that change no figure of the training cases; they stay")
    before: Tuned
    after: Tuned
    overrides: list[str] = Field(description="what has changed, as `--set` takes it")
    experiments: int = Field(description="run by the search")
    candidates: int
    seed: int = Field(description="of the search")
    interrupted: bool
    path: str = Field(description=PATH)
    worse: str | None = Field(description="in what the held-out set is worse than before; null where it is not")
    exceeded: list[str] = Field(description="limits that the gains after exceed in the held-out set")


class Plan(NamedTuple):
    """What to search, and by what.

    Attributes:
        names: Fields of the law's settings; its gains if empty.
        scale: Whether a gain keeps the ratio between its elements.
        weight: Of u_total [1/V²].
        max_saturated, max_chatter: Limits of the constraints; None is MORE times what the configured gains have.
        seeds: Training seeds, from 0 up.
        winds: Parts of plant.wind.torque in training, each with every seed.
        held_out: Cases held out: further seeds, each with a wind of its own.
        budget: Experiments of the search, at most.
        reach: Largest factor by which a gain may change, either way.
        seed: The same seed finds the same.
    """

    names: Sequence[str] = ()
    scale: bool = False
    weight: float = WEIGHT
    max_saturated: float | None = None
    max_chatter: float | None = None
    seeds: int = 2
    winds: Sequence[float] = (0.0, 1.0)
    held_out: int = 4
    budget: int = BUDGET
    duration_s: float = DURATION_S
    reach: float = REACH
    seed: int = 0
    within_deg: float = WITHIN_DEG

    def training(self, emulated: bool) -> list[Case]:
        """Training cases; one for a plant that no seed and no wind changes."""
        if not emulated:
            return [Case(seed=0, wind=0.0)]
        return [Case(seed=seed, wind=wind) for wind in self.winds for seed in range(self.seeds)]

    def held_out_cases(self, emulated: bool) -> list[Case]:
        """Held-out cases: seeds after those of training, winds evenly between calm and the largest of training."""
        if not emulated:
            return []
        strongest = max(self.winds, key=abs)
        parts = [round((2 * i + 1) / (2 * self.held_out) * strongest, 6) for i in range(self.held_out)]
        return [Case(seed=self.seeds + i, wind=wind) for i, wind in enumerate(parts)]


def parse_winds(text: str) -> tuple[float, ...]:
    """Winds as an option gives them, `0,1`. Raises TuneError."""
    try:
        winds = tuple(float(word) for word in text.split(","))
    except ValueError:
        winds = ()
    if not winds or not all(isfinite(wind) for wind in winds):
        raise TuneError(f"--winds must be numbers such as 0,1, not {text!r}")
    return tuple(dict.fromkeys(winds))


def toml_of(tuning: Tuning) -> str:
    """The gains found as a section of a configuration file, after the command's own words on what they are."""
    worse = f"# Not to be used: in the held-out set {tuning.worse}.\n" if tuning.worse else ""
    return f"{worse}{toml({'law': {'kind': tuning.law, **_plain(tuning.after.gains)}})}"


def _plain(gains: dict[str, Gain]) -> dict[str, Any]:
    return {name: list(gain) if isinstance(gain, tuple) else gain for name, gain in gains.items()}


def tune(settings: Settings, plan: Plan, workers: Workers, progress: Progress | None = None) -> Tuning:
    """Search gains. ^C ends the search, not this: what it has found so far is the result.

    Args:
        settings: The configuration, with the law's own settings.
        plan: What to search.
        workers: Where experiments run.
        progress: Called with experiments done and experiments in all, at most.

    Raises:
        TuneError: There is nothing to search, or every candidate trips.
        ModuleNotFoundError: SciPy is not installed.
    """
    search = _Search(settings, plan, workers, progress or (lambda _done, _total: None))
    interrupted = False
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted = True
    best = search.best()
    before, after = search.sides(search.configured, best)
    return Tuning(
        law=settings.law.kind,
        weight=plan.weight,
        limits=search.limits,
        duration_s=plan.duration_s,
        training=search.training,
        held_out=search.held_out,
        within_deg=plan.within_deg,
        searched=[dimension.name for dimension in search.dimensions],
        without_effect=search.without_effect,
        before=before,
        after=after,
        overrides=as_overrides({name: gain for name, gain in best.items() if gain != search.configured[name]}, "law."),
        experiments=search.experiments,
        candidates=len(search.found),
        seed=plan.seed,
        interrupted=interrupted,
        path=paths(ran.path for rans in search.found.values() for ran in rans),
        worse=_worse(before.held_out, after.held_out),
        exceeded=[
            name
            for name, limit in search.limits
            if limit is not None and (getattr(after.held_out, name) or 0.0) > limit
        ],
    )


class _Dimension(NamedTuple):
    """A direction of the search: a gain, or one element of it, and the range of the logarithm of its factor."""

    name: str
    gain: str
    element: int | None
    low: float
    high: float


class _Search:
    """Candidates and their runs.

    Attributes:
        configured: The configured gains.
        found: Runs of every candidate so far, by its gains.
        limits: Of the constraints.
    """

    def __init__(self, settings: Settings, plan: Plan, workers: Workers, progress: Progress) -> None:
        self._settings, self._plan, self._workers, self._progress = settings, plan, workers, progress
        self.config = dumps(settings.description())
        self.configured = _searchable(settings, plan.names)
        self.dimensions = list(self._dimensions())
        if not self.dimensions:
            raise TuneError("there is nothing to search: these gains are 0, or at a bound; name others: --gain NAME")
        emulated = settings.plant.emulated
        self.training, self.held_out = plan.training(emulated), plan.held_out_cases(emulated)
        self.found = dict[tuple[Gain, ...], list[Ran]]()
        self.experiments = 0
        self.without_effect = list[str]()
        self.limits = Limits(saturated=plan.max_saturated, changes_per_s=plan.max_chatter)

    def run(self) -> None:
        """Search until the budget is spent, or the candidates are alike."""
        from scipy.optimize import differential_evolution  # an extra, and slow to import

        plan, each = self._plan, len(self.training)
        least = (1 + len(self.dimensions) + 2 * self._population(len(self.dimensions))) * each
        if plan.budget < least:
            raise TuneError(
                f"--budget must be at least {least}: two generations of candidates, {each} experiments each"
            )
        self._progress(0, plan.budget)
        [before] = self._evaluate([self.configured])
        self._set_limits(_summary(before, plan.weight))
        self._leave_out(before)
        if not self.dimensions:
            return
        population = self._population(len(self.dimensions))
        generations = (plan.budget // each - len(self.found)) // population
        random = np.random.default_rng(plan.seed)
        low, high = (np.array([getattr(one, side) for one in self.dimensions]) for side in ("low", "high"))
        first = random.standard_normal((population, len(self.dimensions))) * log(plan.reach) / _SPREAD
        first[0] = 0.0
        differential_evolution(
            self._ranks,
            list(zip(low, high, strict=True)),
            init=np.clip(first, low, high),
            maxiter=generations - 1,
            popsize=1,  # the first candidates say how many
            rng=random,
            polish=False,
            updating="deferred",
            vectorized=True,
            tol=1e-3,
        )

    @staticmethod
    def _population(dimensions: int) -> int:
        return max(_LEAST, 4 * dimensions)

    def best(self) -> dict[str, Gain]:
        """The gains of the first rank so far. Raises TuneError if every candidate trips."""
        if not self.found:
            return self.configured
        gains, rans = min(self.found.items(), key=lambda item: (self.rank(item[1]), item[0]))
        if reasons := [ran.reason for ran in rans if ran.reason]:
            raise TuneError(f"no gains were found that do not trip; with the best of them, {reasons[0]}")
        return dict(zip(self.configured, gains, strict=True))

    def sides(self, before: dict[str, Gain], after: dict[str, Gain]) -> tuple[Tuned, Tuned]:
        """What the search has not seen, of two sets of gains: held-out cases, late commands, certificate."""
        plan, both = self._plan, (self.law(before), self.law(after))
        held = [(self.config, law, [case], plan.duration_s) for law in both for case in self.held_out]
        pushed = [with_case(with_law(self.config, law), self.training[0]).description() for law in both]
        late = [(config, lost, plan.within_deg) for config in pushed for lost in (False, True)]
        done, total = self.experiments, self.experiments + len(held) + len(late)
        rans = self._workers.each(run_cases, held, lambda count: self._progress(done + count, total))
        done += len(held)
        survived = self._workers.each(survives, late, lambda count: self._progress(done + count, total))
        trained = self._evaluate([before, after])
        found = list[Tuned]()
        for side, gains in enumerate((before, after)):
            delay, lost = survived[2 * side : 2 * side + 2]
            n = len(self.held_out)
            of_held_out = [ran for runs in rans[side * n : (side + 1) * n] for ran in runs]
            tuned = Tuned(
                gains=gains,
                training=_summary(trained[side], plan.weight),
                held_out=_summary(of_held_out, plan.weight),
                delay_ms=None if delay is None else round(delay * self._settings.loop.period * 1e3, 6),
                lost_frames=lost,
                certificate=verdict(with_law(self.config, both[side])),
            )
            found.append(tuned)
        return found[0], found[1]

    def rank(self, rans: Sequence[Ran]) -> float:
        """What is minimised: as the module says, below 1 unless a run trips or exceeds a limit [1]."""
        exceeded = sum(2 - ran.lasted for ran in rans if ran.reason)
        for limit, values in (
            (self.limits.saturated, [ran.saturated for ran in rans]),
            (self.limits.changes_per_s, [ran.changes_per_s for ran in rans]),
        ):
            if limit is not None:
                exceeded += max(0.0, max(values) - limit) / max(limit, 1e-3)
        if exceeded:
            return 1 + exceeded
        cost = float(np.mean([ran.z_track + self._plan.weight * ran.u_total for ran in rans]))
        return cost / (1 + cost)

    def law(self, gains: dict[str, Gain]) -> LawValues:
        """`[law]` with these gains."""
        return {**self._settings.law.model_dump(mode="json"), **gains}

    def _set_limits(self, before: Summary) -> None:
        """Limits that were not given are those of the configured gains, and a part more."""
        configured = {"saturated": before.saturated, "changes_per_s": before.changes_per_s}
        given = {name: None if value is None or before.trips else MORE * value for name, value in configured.items()}
        self.limits = Limits(**given | self.limits.model_dump(exclude_none=True))

    def _leave_out(self, before: list[Ran]) -> None:
        """Leave out what changes no figure, such as gains about an axis without a motor: it would be left at random."""
        factors = np.eye(len(self.dimensions)) * [one.high or one.low for one in self.dimensions] / 2
        changed = self._evaluate([self._gains(row) for row in factors])
        still = [runs == before for runs in changed]
        self.without_effect = [one.name for one, same in zip(self.dimensions, still, strict=True) if same]
        self.dimensions = [one for one, same in zip(self.dimensions, still, strict=True) if not same]

    def _ranks(self, columns: Floats) -> Floats:
        """Ranks of candidates, as the optimiser asks for them. Shapes (dimensions, n) and (n,)."""
        return np.array([self.rank(rans) for rans in self._evaluate([self._gains(row) for row in columns.T])])

    def _evaluate(self, candidates: Sequence[dict[str, Gain]]) -> list[list[Ran]]:
        keys = [tuple(gains.values()) for gains in candidates]
        missing = dict(zip(keys, candidates, strict=True))
        missing = {key: gains for key, gains in missing.items() if key not in self.found}
        jobs = [(self.config, self.law(gains), self.training, self._plan.duration_s) for gains in missing.values()]
        new = [*missing]
        for number, rans in self._workers.stream(run_cases, jobs):
            self.found[new[number]] = rans  # as they come: ^C keeps them
            self.experiments += len(rans)
            self._progress(self.experiments, self._plan.budget)
        return [self.found[key] for key in keys]

    def _gains(self, factors: Floats) -> dict[str, Gain]:
        """The configured gains times the factors whose logarithms are given."""
        gains = dict(self.configured)
        for one, factor in zip(self.dimensions, factors, strict=True):
            gains[one.gain] = _times(gains[one.gain], one.element, exp(factor))
        return gains

    def _dimensions(self) -> Iterator[_Dimension]:
        for name, gain in self.configured.items():
            values = (gain,) if isinstance(gain, float) else gain
            elements = [None] if self._plan.scale or isinstance(gain, float) else range(len(gain))
            for element in elements:
                if not any(values if element is None else [values[element]]):
                    continue  # no factor changes 0
                bound = partial(self._bound, name, element)
                low, high = bound(-log(self._plan.reach)), bound(log(self._plan.reach))
                if low < high:
                    yield _Dimension(name if element is None else f"{name}[{element}]", name, element, low, high)

    def _bound(self, name: str, element: int | None, furthest: float) -> float:
        """How far the logarithm of a factor may go in a direction, by the bounds of the law's settings."""

        def allowed(factor: float) -> bool:
            changed = {**self.configured, name: _times(self.configured[name], element, exp(factor))}
            with suppress(ValidationError, AeroloopError):
                with_law(self.config, self.law(changed))
                return True
            return False

        if allowed(furthest):
            return furthest
        inside, outside = 0.0, furthest
        for _ in range(20):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if allowed(middle) else (inside, middle)
        return inside


def _times(gain: Gain, element: int | None, factor: float) -> Gain:
    if factor == 1:
        return gain  # to the last digit
    if isinstance(gain, float):
        return float(f"{gain * factor:.{_DIGITS}g}")
    scaled = (float(f"{value * factor:.{_DIGITS}g}") for value in gain)
    return tuple(new if element in (None, i) else old for i, (old, new) in enumerate(zip(gain, scaled, strict=True)))


def _searchable(settings: Settings, names: Sequence[str]) -> dict[str, Gain]:
    """The gains, or other fields of the law's settings, that are named. Raises TuneError if they are no numbers."""
    law = settings.law
    fields = {name: _as_gain(getattr(law, name)) for name in type(law).model_fields}
    chosen = list(names) or list(law_class(law).gains)
    if not chosen or (wrong := [name for name in chosen if fields.get(name) is None]):
        known = ", ".join(name for name, value in fields.items() if value is not None) or "none of numbers"
        what = f"has no gain {wrong[0]!r}" if chosen else "names no gains of its own: give --gain NAME"
        raise TuneError(f"law {law.kind} {what}; its settings are {known}")
    return {name: gain for name in dict.fromkeys(chosen) if (gain := fields[name]) is not None}


def _as_gain(value: Any) -> Gain | None:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, Sequence) and value and all(isinstance(each, int | float) for each in value):
        return tuple(float(each) for each in value)
    return None


def _summary(rans: Sequence[Ran], weight: float) -> Summary:
    reasons = [ran.reason for ran in rans if ran.reason]
    whole = [ran for ran in rans if not ran.reason]
    z_track, u_total = (
        float(np.mean([getattr(ran, name) for ran in whole])) if whole else None for name in ("z_track", "u_total")
    )
    settled, saturated, changes = (
        max((getattr(ran, name) for ran in whole), default=None)
        for name in ("settled_deg", "saturated", "changes_per_s")
    )
    complete = z_track is not None and u_total is not None and not reasons
    return Summary(
        cost=z_track + weight * u_total if complete else None,  # type: ignore[operator]  # they are numbers
        z_track=z_track,
        u_total=u_total,
        settled_deg=settled,
        saturated=saturated,
        changes_per_s=changes,
        trips=len(reasons),
        reason=reasons[0] if reasons else None,
    )


def _worse(before: Summary, after: Summary) -> str | None:
    """In what one set of runs is worse than another."""
    if after.trips > before.trips:
        return f"{after.trips} runs trip, before {before.trips}: {after.reason}"
    if before.cost is not None and after.cost is not None and after.cost > before.cost:
        return f"the cost rises from {before.cost:.4g} to {after.cost:.4g}"
    return None


def verdict(settings: Settings) -> str:
    """The verdict of the configuration's certificate, or why its law has none."""
    try:
        return certify_any(settings, seek_remedies=False).verdict
    except (NoTheoremError, BoundlessError) as error:
        return str(error)
