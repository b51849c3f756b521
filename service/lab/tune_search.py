"""Search for gains by differential evolution: experiments of a candidate, its cost and rank, the search itself.

A candidate is the configured gains times factors, searched in their logarithm (R. Storn and K. Price, Journal of Global
Optimization 11, 1997; SciPy's). It runs under the training cases, each a seed and a wind; its cost is the mean of
z_track + weight · u_total. Candidates are ranked by cost/(1 s + cost), which is below 1. One that trips or exceeds a
limit in any case ranks behind all others, at 1 + 1 for each run that trips + the part of the time that it did not last
+ the excess over each limit as a part of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from math import exp, inf, isfinite, log
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.lab.experiment import experiment
from aeroloop.service.lab.law_margins import survived
from aeroloop.service.lab.sweep import Progress
from aeroloop.service.lab.workers import Workers, run_of, with_seed
from aeroloop.service.theorem.any_law import certify_any
from aeroloop.service.theorem.extremes import BoundlessError
from aeroloop.service.theorem.feedback import NoTheoremError

MORE: Final = 1.25
"""A limit that is not given is so many times what the configured gains have."""
_DIGITS: Final = 4
"""Of every candidate's gains: what is printed is what ran."""
_SPREAD: Final = 3.0
"""The first candidates scatter about the configured gains by the reach in decades over this."""
_LEAST: Final = 8
"""Candidates of a generation; so many for each dimension beyond two: 4."""

Floats = npt.NDArray[np.float64]
Gain = float | tuple[float, ...]
Gains = dict[str, Gain]


class TuneError(AeroloopError):
    """Nothing can be searched, or nothing was found; one line."""


# ── runs ──


class Case(BaseModel):
    """What an experiment is repeated under; a plant without our wind and sensors takes no notice."""

    model_config = ConfigDict(frozen=True)

    seed: int = Field(description="of wind and sensors")
    wind: float = Field(description="part of plant.wind.torque that blows; 0 is calm [1]")


class Ran(NamedTuple):
    """Figures of a run."""

    z_track: float  # as of `Figures` [s]
    u_total: float  # [V²·s]
    saturated: float  # part of the ticks with a voltage at its limit [1]
    changes_per_s: float  # of a commanded voltage [1/s]
    settled_deg: float  # largest error in the second half [deg]
    lasted: float = 1.0  # part of the time that it ran, less than 1 where it tripped [1]
    reason: str | None = None  # why it ended early


def with_case(settings: Settings, case: Case) -> Settings:
    """The configuration with the seed and the wind of a case."""
    settings = with_seed(settings, case.seed)
    if not settings.plant.emulated:
        return settings
    torque = tuple(case.wind * value for value in settings.plant.wind.torque)
    wind = settings.plant.wind.model_copy(update={"blowing": case.wind != 0, "torque": torque})
    return settings.model_copy(update={"plant": settings.plant.model_copy(update={"wind": wind})})


def run_cases(settings: Settings, cases: Sequence[Case], duration_s: float) -> list[Ran]:
    """Run a candidate under each case, in any process."""
    settings = with_law_settings(settings)
    return [run_case(with_case(settings, case), duration_s) for case in cases]


def run_case(settings: Settings, duration_s: float) -> Ran:
    """Run an experiment."""
    ticks, quantizer = settings.loop.ticks(duration_s), settings.wire.voltage.quantizer()
    full = min(settings.plant.voltage_limit, quantizer.outermost)
    largest = [0.0]

    def watch(_k: int, _measurement: bytes, command: bytes) -> None:  # frame by frame only
        read = settings.wire.command.unpack(command)
        largest.append(
            max(abs(quantizer.level(code)) for code in read[1]) if read else largest[-1]
        )  # held without a frame

    try:
        figures, course = experiment(settings, duration_s, watch=watch)
    except (ValueError, AeroloopError) as error:
        return Ran(0, 0, 0, 0, 0, (len(largest) - 1) / ticks, reason=str(error).splitlines()[0])
    voltages = np.abs(course.voltages).max(axis=1) if course else np.array(largest)
    saturated = float(np.count_nonzero(voltages >= full)) / ticks
    found = figures.z_track, figures.u_total, saturated, figures.command_changes_per_s, figures.second_half_error_deg
    z_track, u_total, saturated, changes, settled = (inf if value is None else value for value in found)
    if not all(map(isfinite, (z_track, u_total, changes, settled))):
        return Ran(0, 0, 0, 0, 0, 0, "it has no figures: it answers nothing, or no number")
    return Ran(z_track, u_total, saturated, changes, settled)


# ── costs ──


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

    gains: Gains
    training: Summary
    held_out: Summary
    delay_ms: float | None = Field(description="largest further delay of commands within the bound [ms]; null: none is")
    lost_frames: int | None = Field(description="most commands lost in a row, again and again; null: none may be")
    certificate: str = Field(description="verdict of the certificate, or why the law has none")


def limits_of(before: Summary, given: Limits) -> Limits:
    """The limits given; others are MORE times what the configured gains have, if none of their runs trips."""
    configured = {"saturated": before.saturated, "changes_per_s": before.changes_per_s}
    own = {name: None if value is None or before.trips else MORE * value for name, value in configured.items()}
    return Limits(**own | given.model_dump(exclude_none=True))


def rank(rans: Sequence[Ran], limits: Limits, weight: float) -> float:
    """What is minimised: as the module says, below 1 unless a run trips or exceeds a limit [1]."""
    exceeded = sum(2 - ran.lasted for ran in rans if ran.reason)
    for limit, values in (
        (limits.saturated, [ran.saturated for ran in rans]),
        (limits.changes_per_s, [ran.changes_per_s for ran in rans]),
    ):
        if limit is not None:
            exceeded += max(0.0, max(values) - limit) / max(limit, 1e-3)
    if exceeded:
        return 1 + exceeded
    cost = float(np.mean([ran.z_track + weight * ran.u_total for ran in rans]))
    return cost / (1 + cost)


def summary(rans: Sequence[Ran], weight: float) -> Summary:
    """Runs with the same gains in sum; the weight is of u_total [1/V²]."""
    reasons = [ran.reason for ran in rans if ran.reason]
    whole = [ran for ran in rans if not ran.reason]
    figures: dict[str, float | None] = {
        name: float(np.mean([getattr(ran, name) for ran in whole])) if whole else None
        for name in ("z_track", "u_total")
    }
    figures |= {
        name: max((getattr(ran, name) for ran in whole), default=None)
        for name in ("settled_deg", "saturated", "changes_per_s")
    }
    z_track, u_total = figures["z_track"], figures["u_total"]
    complete = z_track is not None and u_total is not None and not reasons
    return Summary(
        cost=z_track + weight * u_total if complete else None,  # type: ignore[operator]  # they are numbers
        **figures,
        trips=len(reasons),
        reason=reasons[0] if reasons else None,
    )


def worse(before: Summary, after: Summary) -> str | None:
    """In what one set of runs is worse than another."""
    if after.trips > before.trips:
        return f"{after.trips} runs trip, before {before.trips}: {after.reason}"
    if before.cost is not None and after.cost is not None and after.cost > before.cost:
        return f"the cost rises from {before.cost:.4g} to {after.cost:.4g}"
    return None


# ── the search ──


class TuneOptions(NamedTuple):
    """What to search, and by what."""

    names: Sequence[str] = ()  # fields of the law's settings; its gains if empty
    scale: bool = False  # whether a gain keeps the ratio between its elements
    weight: float = 1e-7  # of u_total [1/V²]
    max_saturated: float | None = None  # limits; None is MORE times what the configured gains have
    max_chatter: float | None = None
    seeds: int = 2  # of training, from 0 up
    winds: Sequence[float] = (0.0, 1.0)  # parts of plant.wind.torque in training, each with every seed
    held_out: int = 4  # cases held out: further seeds, each with a wind of its own
    budget: int = 1000  # experiments of the search, at most
    duration_s: float = 10.0
    reach: float = 10.0  # largest factor by which a gain may change, either way
    seed: int = 0  # the same seed finds the same
    within_deg: float = 10.0  # bound of the attitude error, for the margins

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

    def __init__(self, settings: Settings, options: TuneOptions, workers: Workers[Any], progress: Progress) -> None:
        self._settings, self._options, self._workers, self._progress = settings, options, workers, progress
        self.configured = _searchable(settings, options.names)
        self.dimensions = list(self._dimensions())
        if not self.dimensions:
            raise TuneError("there is nothing to search: these gains are 0, or at a bound; name others: --gain NAME")
        self.training = options.training(settings.plant.emulated)
        self.found = dict[tuple[Gain, ...], list[Ran]]()
        self.experiments = 0
        self.without_effect = list[str]()
        self.limits = Limits(saturated=options.max_saturated, changes_per_s=options.max_chatter)

    def run(self) -> None:
        """Search until the budget is spent, or the candidates are alike."""
        from scipy.optimize import differential_evolution  # an extra, and slow to import

        options, each = self._options, len(self.training)
        least = (1 + len(self.dimensions) + 2 * _population(self.dimensions)) * each
        if options.budget < least:
            raise TuneError(
                f"--budget must be at least {least}: two generations of candidates, {each} experiments each"
            )
        self._progress(0, options.budget)
        [before] = self.evaluate([self.configured])
        self.limits = limits_of(summary(before, options.weight), self.limits)
        self._leave_out(before)
        if not self.dimensions:
            return
        population = _population(self.dimensions)
        generations = (options.budget // each - len(self.found)) // population
        random = np.random.default_rng(options.seed)
        low, high = (np.array([getattr(one, side) for one in self.dimensions]) for side in ("low", "high"))
        first = random.standard_normal((population, len(self.dimensions))) * log(options.reach) / _SPREAD
        first[0] = 0.0
        differential_evolution(
            lambda columns: np.array([self._rank(ran) for ran in self.evaluate(map(self.gains, columns.T))]),
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

    def best(self) -> Gains:
        """The gains of the first rank so far. Raises TuneError if every candidate trips."""
        if not self.found:
            return self.configured
        gains, rans = min(self.found.items(), key=lambda item: (self._rank(item[1]), item[0]))
        if reasons := [ran.reason for ran in rans if ran.reason]:
            raise TuneError(f"no gains were found that do not trip; with the best of them, {reasons[0]}")
        return dict(zip(self.configured, gains, strict=True))

    def _rank(self, rans: Sequence[Ran]) -> float:
        return rank(rans, self.limits, self._options.weight)

    def _leave_out(self, before: list[Ran]) -> None:
        """Leave out what changes no figure, such as gains about an axis without a motor: it would be left at random."""
        factors = np.eye(len(self.dimensions)) * [one.high or one.low for one in self.dimensions] / 2
        still = [runs == before for runs in self.evaluate(map(self.gains, factors))]
        self.without_effect = [one.name for one, same in zip(self.dimensions, still, strict=True) if same]
        self.dimensions = [one for one, same in zip(self.dimensions, still, strict=True) if not same]

    def evaluate(self, candidates: Iterable[Gains]) -> list[list[Ran]]:
        """Runs of candidates, each under every training case; those found already do not run again."""
        keys = [tuple(gains.values()) for gains in candidates]
        missing = [key for key in dict.fromkeys(keys) if key not in self.found]
        gains = [dict(zip(self.configured, key, strict=True)) for key in missing]
        runs = [run_of(self._settings, as_overrides({"law": each})) for each in gains]
        work = partial(run_cases, cases=self.training, duration_s=self._options.duration_s)
        for number, rans in self._workers.stream(work, runs):
            self.found[missing[number]] = rans  # as they come: ^C keeps them
            self.experiments += len(rans)
            self._progress(self.experiments, self._options.budget)
        return [self.found[key] for key in keys]

    def judged(self, each: Sequence[Gains], held_out: Sequence[Case]) -> list[Tuned]:
        """What the search has not seen of some sets of gains: held-out cases, late commands, certificate."""
        options, done = self._options, self.experiments
        total = done + 2 * len(each)
        with_gains = [_with_gains(self._settings, gains) for gains in each]
        held = partial(run_cases, cases=held_out, duration_s=options.duration_s)
        rans = self._workers.rows(held, list(map(run_of, with_gains)), lambda n: self._progress(done + n, total))
        pushed = [run_of(with_case(one, self.training[0])) for one in with_gains]
        late = partial(survived, within_deg=options.within_deg)
        margins = self._workers.rows(late, pushed, lambda n: self._progress(done + len(each) + n, total))
        trained = self.evaluate(each)
        return [
            Tuned(
                gains=each[i],
                training=summary(trained[i], options.weight),
                held_out=summary(rans[i], options.weight),
                certificate=verdict(with_gains[i]),
                **margins[i],
            )
            for i in range(len(each))
        ]

    def gains(self, factors: Floats) -> Gains:
        """The configured gains times the factors whose logarithms are given."""
        gains = dict(self.configured)
        for one, factor in zip(self.dimensions, factors, strict=True):
            gains[one.gain] = _times(gains[one.gain], one.element, exp(factor))
        return gains

    def _dimensions(self) -> Iterator[_Dimension]:
        for name, gain in self.configured.items():
            values = (gain,) if isinstance(gain, float) else gain
            elements = [None] if self._options.scale or isinstance(gain, float) else range(len(gain))
            for element in elements:
                if not any(values if element is None else [values[element]]):
                    continue  # no factor changes 0
                low, high = (self._bound(name, element, side * log(self._options.reach)) for side in (-1, 1))
                if low < high:
                    yield _Dimension(name if element is None else f"{name}[{element}]", name, element, low, high)

    def _bound(self, name: str, element: int | None, furthest: float) -> float:
        """How far the logarithm of a factor may go in a direction, by the bounds of the law's settings."""

        def allowed(factor: float) -> bool:
            with suppress(ValidationError, AeroloopError):
                _with_gains(self._settings, {name: _times(self.configured[name], element, exp(factor))})
                return True
            return False

        if allowed(furthest):
            return furthest
        inside, outside = 0.0, furthest
        for _ in range(20):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if allowed(middle) else (inside, middle)
        return inside


def _population(dimensions: Sequence[_Dimension]) -> int:
    return max(_LEAST, 4 * len(dimensions))


def _with_gains(settings: Settings, gains: Gains) -> Settings:
    """The configuration with other gains. Raises AeroloopError or ValidationError if the law refuses them."""
    return with_law_settings(load_over(settings, as_overrides({"law": gains})))


def _times(gain: Gain, element: int | None, factor: float) -> Gain:
    if factor == 1:
        return gain  # to the last digit
    if isinstance(gain, float):
        return float(f"{gain * factor:.{_DIGITS}g}")
    scaled = (float(f"{value * factor:.{_DIGITS}g}") for value in gain)
    return tuple(new if element in (None, i) else old for i, (old, new) in enumerate(zip(gain, scaled, strict=True)))


def _searchable(settings: Settings, names: Sequence[str]) -> Gains:
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


def verdict(settings: Settings) -> str:
    """The verdict of the configuration's certificate, or why its law has none."""
    try:
        return certify_any(settings).verdict
    except (NoTheoremError, BoundlessError) as error:
        return str(error)
