"""`lab tune`: gains of a law by differential evolution in lockstep experiments, then in runs that the search never saw.

A candidate is the configured gains times factors, searched in their logarithm (R. Storn and K. Price, Journal of Global
Optimization 11, 1997; SciPy's). It runs under the training cases, each a seed and a wind; its cost is the mean of
z_track + weight · u_total. Candidates are ranked by cost/(1 s + cost), which is below 1. One that trips or exceeds a
limit in any case ranks behind all others, at 1 + 1 for each run that trips + the part of the time that it did not last
+ the excess over each limit as a part of it. Held-out cases, of other seeds and winds, have no part in the search.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from math import exp, inf, isfinite, log
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.config_text import toml
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.figures import Floats
from aeroloop.service.lab.experiment import LoopEndedError, experiment
from aeroloop.service.lab.laws import PUSHED_S, survived
from aeroloop.service.lab.sweep import Column, Progress, Row, Sheets, Workers, run_of, with_seed
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.extremes import BoundlessError
from aeroloop.service.theorem.feedback import NoTheoremError

MORE: Final = 1.25
"""A limit that is not given is so many times what the configured gains have."""
_DIGITS: Final = 4
"""Of every candidate's gains: what is printed is what ran."""
_SPREAD: Final = 3.0
"""The first candidates scatter about the configured gains by the reach in decades over this."""

Gain = float | tuple[float, ...]
Gains = dict[str, Gain]


class TuneError(AeroloopError):
    """Nothing can be searched, or nothing was found; one line."""


# ── runs of a candidate ──


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
    try:
        figures, course, _ = experiment(settings, duration_s)
    except (ValueError, AeroloopError) as error:
        lasted = error.after_s / duration_s if isinstance(error, LoopEndedError) else 0.0
        return Ran(0, 0, 0, 0, 0, lasted, reason=str(error).splitlines()[0])
    full = min(settings.plant.voltage_limit, settings.wire.voltage.quantizer().outermost)
    saturated = float(np.mean(np.abs(course.voltages).max(axis=1) >= full))
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


_WORST: Final = ("settled_deg", "saturated", "changes_per_s")


def summary(rans: Sequence[Ran], weight: float) -> Row:
    """Runs with the same gains under several cases, in sum; the weight is of u_total [1/V²].

    cost, z_track and u_total are means, the others the largest of all runs, trips how many ended early and reason why
    the first of them did. Figures are None where all trip, the cost where any does.
    """
    reasons, whole = [ran.reason for ran in rans if ran.reason], [ran for ran in rans if not ran.reason]
    row: Row = dict.fromkeys(("cost", "z_track", "u_total", *_WORST))
    if whole:
        row["z_track"], row["u_total"] = (float(np.mean([ran[i] for ran in whole])) for i in (0, 1))
        row["cost"] = None if reasons else row["z_track"] + weight * row["u_total"]
        row |= {name: max(getattr(ran, name) for ran in whole) for name in _WORST}
    return row | {"trips": len(reasons), "reason": reasons[0] if reasons else None}


def _worse(before: Row, after: Row) -> str | None:
    """In what one set of runs is worse than another."""
    if after["trips"] > before["trips"]:
        return f"{after['trips']} runs trip, before {before['trips']}: {after['reason']}"
    if before["cost"] is not None and after["cost"] is not None and after["cost"] > before["cost"]:
        return f"the cost rises from {before['cost']:.4g} to {after['cost']:.4g}"
    return None


def rank(rans: Sequence[Ran], limits: Limits, weight: float) -> float:
    """What is minimised: as the module says, below 1 unless a run trips or exceeds a limit [1]."""
    exceeded = sum(2 - ran.lasted for ran in rans if ran.reason)
    for name, limit in limits:
        if limit is not None:
            exceeded += max(0.0, max(getattr(ran, name) for ran in rans) - limit) / max(limit, 1e-3)
    if exceeded:
        return 1 + exceeded
    cost = float(np.mean([ran.z_track + weight * ran.u_total for ran in rans]))
    return cost / (1 + cost)


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

    def cases(self, emulated: bool) -> tuple[list[Case], list[Case]]:
        """Training cases, and those held out: later seeds, winds evenly between calm and the largest of training.

        A plant that no seed and no wind changes has one case, and none held out.
        """
        if not emulated:
            return [Case(seed=0, wind=0.0)], []
        training = [Case(seed=seed, wind=wind) for wind in self.winds for seed in range(self.seeds)]
        strongest, n = max(self.winds, key=abs), self.held_out
        parts = [round((2 * i + 1) / (2 * n) * strongest, 6) for i in range(n)]
        return training, [Case(seed=self.seeds + i, wind=wind) for i, wind in enumerate(parts)]


def parse_winds(text: str) -> tuple[float, ...]:
    """Winds as an option gives them, `0,1`. Raises TuneError."""
    with suppress(ValueError):
        winds = tuple(map(float, text.split(",")))
        if all(map(isfinite, winds)):
            return tuple(dict.fromkeys(winds))
    raise TuneError(f"--winds must be numbers such as 0,1, not {text!r}")


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
        training: Cases of each candidate.
        held_out: Cases that no candidate sees.
        dimensions: What is searched.
        without_effect: Names of what was left out, as it changes no figure.
        found: Runs of every candidate so far, by its gains.
        limits: Of the constraints.
        experiments: Run so far.
    """

    def __init__(self, settings: Settings, options: TuneOptions, workers: Workers, progress: Progress) -> None:
        self._settings, self._options, self._workers, self._progress = settings, options, workers, progress
        self.configured = _searchable(settings, options.names)
        self.training, self.held_out = options.cases(settings.plant.emulated)
        self.dimensions = list(self._dimensions())
        self.without_effect = list[str]()
        self.found = dict[tuple[Gain, ...], list[Ran]]()
        self.limits = Limits(saturated=options.max_saturated, changes_per_s=options.max_chatter)
        self.experiments = 0
        if not self.dimensions:
            raise TuneError("there is nothing to search: these gains are 0, or at a bound; name others: --gain NAME")

    def run(self) -> None:
        """Search until the budget is spent, or the candidates are alike."""
        from scipy.optimize import differential_evolution  # an extra, and slow to import

        options, each, population = self._options, len(self.training), self._population()
        least = (1 + len(self.dimensions) + 2 * population) * each
        if options.budget < least:
            raise TuneError(
                f"--budget must be at least {least}: two generations of candidates, {each} experiments each"
            )
        self._progress(0, options.budget)
        [before] = self.evaluate([self.configured])
        if not any(ran.reason for ran in before):
            configured = {name: MORE * max(getattr(ran, name) for ran in before) for name, _ in self.limits}
            self.limits = Limits(**configured | self.limits.model_dump(exclude_none=True))
        self._leave_out(before)
        if not self.dimensions:
            return
        population = self._population()
        random = np.random.default_rng(options.seed)
        low, high = (np.array([getattr(one, side) for one in self.dimensions]) for side in ("low", "high"))
        first = random.standard_normal((population, len(self.dimensions))) * log(options.reach) / _SPREAD
        first[0] = 0.0
        differential_evolution(
            lambda columns: np.array([self._rank(ran) for ran in self.evaluate(map(self.gains, columns.T))]),
            list(zip(low, high, strict=True)),
            init=np.clip(first, low, high),
            maxiter=(options.budget // each - len(self.found)) // population - 1,
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

    def _population(self) -> int:
        return max(8, 4 * len(self.dimensions))

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

    def judged(self, each: Sequence[Gains]) -> list[Row]:
        """What the search has not seen of some sets of gains: held-out cases, late commands, certificate."""
        options, done, total = self._options, self.experiments, self.experiments + 2 * len(each)
        with_gains = [_with_gains(self._settings, gains) for gains in each]
        held = partial(run_cases, cases=self.held_out, duration_s=options.duration_s)
        rans = self._workers.rows(held, list(map(run_of, with_gains)), lambda n: self._progress(done + n, total))
        pushed = [run_of(with_case(one, self.training[0])) for one in with_gains]
        late = partial(survived, within_deg=options.within_deg)
        margins = self._workers.rows(late, pushed, lambda n: self._progress(done + len(each) + n, total))
        trained = self.evaluate(each)
        return [
            {
                "gains": each[i],
                "training": summary(trained[i], options.weight),
                "held_out": summary(rans[i], options.weight),
                **margins[i],
                "certificate": _verdict(with_gains[i]),
            }
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
    fields = {name: gain for name in type(law).model_fields if (gain := _as_gain(getattr(law, name))) is not None}
    chosen = list(names) or list(law_class(law).gains)
    if not chosen or (wrong := [name for name in chosen if name not in fields]):
        what = f"has no gain {wrong[0]!r}" if chosen else "names no gains of its own: give --gain NAME"
        raise TuneError(f"law {law.kind} {what}; its settings are {', '.join(fields) or 'none of numbers'}")
    return {name: fields[name] for name in chosen}


def _as_gain(value: Any) -> Gain | None:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, Sequence) and value and all(isinstance(each, int | float) for each in value):
        return tuple(float(each) for each in value)
    return None


def _verdict(settings: Settings) -> str:
    """The verdict of the configuration's certificate, or why its law has none."""
    try:
        return certify(settings).verdict
    except (NoTheoremError, BoundlessError) as error:
        return str(error)


# ── the result ──


class Tuning(BaseModel):
    """A search for gains, and what it found.

    Before and after have gains; training and held_out, as of `summary`; delay_ms and lost_frames, as of `survived`; and
    certificate, its verdict or why the law has none.
    """

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
    before: Row
    after: Row
    overrides: list[str] = Field(description="what has changed, as `--set` takes it")
    experiments: int = Field(description="run by the search")
    candidates: int
    seed: int = Field(description="of the search")
    interrupted: bool
    worse: str | None = Field(description="in what the held-out set is worse than before; null where it is not")
    exceeded: list[str] = Field(description="limits that the gains after exceed in the held-out set")


def tune(
    settings: Settings, options: TuneOptions, workers: Workers, progress: Progress = lambda _done, _total: None
) -> Tuning:
    """Search gains. ^C ends the search, not this: what it has found so far is the result.

    Args:
        settings: The configuration, with the law's own settings.
        options: What to search.
        workers: Where experiments run.
        progress: Called with experiments done and experiments in all, at most.

    Raises:
        TuneError: There is nothing to search, or every candidate trips.
        ModuleNotFoundError: SciPy is not installed.
    """
    search, interrupted = Search(settings, options, workers, progress), False
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted = True
    best = search.best()
    before, after = search.judged([search.configured, best])
    return Tuning(
        law=settings.law.kind,
        weight=options.weight,
        limits=search.limits,
        duration_s=options.duration_s,
        training=search.training,
        held_out=search.held_out,
        within_deg=options.within_deg,
        searched=[dimension.name for dimension in search.dimensions],
        without_effect=search.without_effect,
        before=before,
        after=after,
        overrides=as_overrides({name: gain for name, gain in best.items() if gain != search.configured[name]}, "law."),
        experiments=search.experiments,
        candidates=len(search.found),
        seed=options.seed,
        interrupted=interrupted,
        worse=_worse(before["held_out"], after["held_out"]),
        exceeded=[
            name for name, limit in search.limits if limit is not None and (after["held_out"][name] or 0.0) > limit
        ],
    )


def toml_of(tuning: Tuning) -> str:
    """The gains found as a section of a configuration file, after the command's own words on what they are."""
    worse = f"# Not to be used: in the held-out set {tuning.worse}.\n" if tuning.worse else ""
    gains = {name: gain if isinstance(gain, float) else list(gain) for name, gain in tuning.after["gains"].items()}
    return f"{worse}{toml({'law': {'kind': tuning.law, **gains}})}"


def sheets(tuning: Tuning) -> Sheets:
    """What the search gains in both sets of runs, what it costs, and the gains."""
    yield _outcome(tuning), []
    cost = f"{tuning.experiments} experiments of {tuning.duration_s:g} s with {tuning.candidates} sets of gains"
    yield f"{cost} of law {tuning.law}; seed {tuning.seed}{'; interrupted' if tuning.interrupted else ''}.", []
    yield "", list(_figures(tuning))
    both = zip(tuning.before["gains"].items(), tuning.after["gains"].values(), strict=True)
    yield "", [{"gain": name, "before": _numbers(old), "after": _numbers(new)} for (name, old), new in both]
    yield from ((note, []) for note in _notes(tuning))
    if tuning.overrides:
        yield "\n".join(f"--set '{words}'" for words in tuning.overrides), []


def _outcome(tuning: Tuning) -> str:
    if not tuning.overrides:
        return "No better gains found."
    if tuning.worse is not None:
        return f"Not to be used: in the held-out set {tuning.worse}."
    before, after = (side["held_out"]["cost"] for side in (tuning.before, tuning.after))
    if not tuning.held_out:
        return "Better gains found, but there is no held-out set: nothing varies with a seed or a wind."
    if before is None or after is None:
        return "Better gains found: what tripped in the held-out set trips less."
    return f"Better gains found: in the held-out set the cost changes by {after / before - 1:+.1%}."


_FIGURES: Final = (
    Column("cost, 1e-4 s", "cost", "{:.2f}", 1e4),
    Column("z_track, 1e-4 s", "z_track", "{:.2f}", 1e4),
    Column("u_total, V²·s", "u_total", "{:.0f}"),
    Column("error in 2nd half, deg", "settled_deg", "{:.2f}"),
    Column("saturated ticks", "saturated", "{:.2%}"),
    Column("command changes/s", "changes_per_s", "{:.1f}"),
    Column("runs that trip", "trips", "{:.0f}"),
)
_SURVIVED: Final = (
    Column("delay survived, ms", "delay_ms", "{:g}", missing="none"),
    Column("frames lost in a row", "lost_frames", "{:g}", missing="none"),
)


def _figures(tuning: Tuning) -> Iterator[dict[str, str]]:
    both, limits = (tuning.before, tuning.after), tuning.limits.model_dump(exclude_none=True)
    columns = ("training: before", "training: after", "held out: before", "held out: after", "limit")
    for figure in _FIGURES:
        cells = [figure.text(side[part]) for part in ("training", "held_out") for side in both]
        limit = figure.text(limits) if figure.name in limits else ""
        yield {"": figure.title} | dict(zip(columns, [*cells, limit], strict=True))
    for figure in _SURVIVED:
        cells = [figure.text(side) for side in both]
        yield {"": figure.title} | dict(zip(columns, [*cells, "", "", ""], strict=True))


def _notes(tuning: Tuning) -> Iterator[str]:
    if exceeded := tuning.exceeded:
        yield f"The gains after exceed a limit in the held-out set: {', '.join(exceeded)}."
    yield (
        f"cost = mean of z_track + {tuning.weight:g} · u_total; gains with which a run trips or exceeds a limit rank "
        "behind all others. Error, saturation and changes are the largest of all runs. Training: "
        f"{_cases(tuning.training)}. Held out: {_cases(tuning.held_out)}."
    )
    yield (
        f"Delay and frames lost again and again: the most with which the error stays within {tuning.within_deg:g}° in "
        f"the second half of {tuning.margin_duration_s:g} s, without a watchdog, in the first training case."
    )
    if tuning.without_effect:
        yield f"Without effect here, and not changed: {', '.join(tuning.without_effect)}."
    before, after = tuning.before["certificate"], tuning.after["certificate"]
    yield f"Before and after: {before}" if before == after else f"Before: {before}\nAfter: {after}"


def _cases(cases: Sequence[Case]) -> str:
    if not cases:
        return "none"
    seeds, winds = sorted({case.seed for case in cases}), sorted({case.wind for case in cases})
    return f"seeds {seeds[0]}…{seeds[-1]}, wind × {_numbers(tuple(winds))}"


def _numbers(gain: Gain) -> str:
    return f"{gain:g}" if isinstance(gain, float) else ", ".join(f"{value:g}" for value in gain)
