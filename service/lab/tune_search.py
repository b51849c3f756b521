"""Search for gains by differential evolution.

A candidate is the configured gains times factors, searched in their logarithm (R. Storn and K. Price, Differential
Evolution, Journal of Global Optimization 11, 1997; SciPy's). It runs under the training cases, each a seed and a wind;
`tune_costs` ranks it.
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
from pydantic import ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.lab.tune_costs import Limits, limits_of, rank, summary
from aeroloop.service.lab.tune_runs import Case, LawValues, Ran, run_cases, with_law
from aeroloop.service.lab.workers import Workers

DURATION_S: Final = 10.0
WEIGHT: Final = 1e-7
BUDGET: Final = 1000
REACH: Final = 10.0
WITHIN_DEG: Final = 10.0
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


class _Dimension(NamedTuple):
    """A direction of the search: a gain, or one element of it, and the range of the logarithm of its factor."""

    name: str
    gain: str
    element: int | None
    low: float
    high: float


class Search:
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
        self.training = plan.training(settings.plant.emulated)
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
        [before] = self.evaluate([self.configured])
        self.limits = limits_of(summary(before, plan.weight), self.limits)
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
        gains, rans = min(self.found.items(), key=lambda item: (self._rank(item[1]), item[0]))
        if reasons := [ran.reason for ran in rans if ran.reason]:
            raise TuneError(f"no gains were found that do not trip; with the best of them, {reasons[0]}")
        return dict(zip(self.configured, gains, strict=True))

    def _rank(self, rans: Sequence[Ran]) -> float:
        return rank(rans, self.limits, self._plan.weight)

    def law(self, gains: dict[str, Gain]) -> LawValues:
        """`[law]` with these gains."""
        return {**self._settings.law.model_dump(mode="json"), **gains}

    def _leave_out(self, before: list[Ran]) -> None:
        """Leave out what changes no figure, such as gains about an axis without a motor: it would be left at random."""
        factors = np.eye(len(self.dimensions)) * [one.high or one.low for one in self.dimensions] / 2
        changed = self.evaluate([self._gains(row) for row in factors])
        still = [runs == before for runs in changed]
        self.without_effect = [one.name for one, same in zip(self.dimensions, still, strict=True) if same]
        self.dimensions = [one for one, same in zip(self.dimensions, still, strict=True) if not same]

    def _ranks(self, columns: Floats) -> Floats:
        """Ranks of candidates, as the optimiser asks for them. Shapes (dimensions, n) and (n,)."""
        return np.array([self._rank(rans) for rans in self.evaluate([self._gains(row) for row in columns.T])])

    def evaluate(self, candidates: Sequence[dict[str, Gain]]) -> list[list[Ran]]:
        """Runs of candidates, each under every training case; those found already do not run again."""
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
