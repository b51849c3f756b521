"""`lab tune`: gains of a law by differential evolution in lockstep experiments, then in runs that the search never saw.

A candidate is the configured gains, each times a factor, searched in its logarithm by SciPy's `differential_evolution`;
the ratios between a gain's axes stay. Each candidate runs calm and in wind with several seeds; its cost is the mean of
z_track + `WEIGHT` · u_total. One that trips, or changes a voltage more than `MORE` times as often as the configured
gains do, ranks behind all others. Held-out runs, of other seeds and winds, have no part in the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from math import exp, inf, log
from operator import itemgetter
from statistics import fmean
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.config_text import toml
from aeroloop.service.control.laws.registry import law_class
from aeroloop.service.figures import Floats
from aeroloop.service.lab.engine import Progress, Row, Run, Sheets, Workers, cell, figures_row, run_of
from aeroloop.service.lab.margins import WITHIN_DEG, survived

WEIGHT: Final = 1e-7
"""Of u_total in the cost: on the paper's bench effort is about a sixth of it [1/V²]."""
MORE: Final = 1.25
"""The most changes of a voltage, over those of the configured gains: noise must not be bought with wear."""
_REACH: Final = log(10)
"""Logarithm of the largest factor of a gain, up or down."""

Gain = float | tuple[float, ...]
Gains = dict[str, Gain]


class TuneError(AeroloopError):
    """Nothing can be searched, or nothing was found; one line."""


class TuneOptions(NamedTuple):
    """What to search, and how long."""

    names: Sequence[str] = ()  # fields of the law's settings; its gains if empty
    seeds: int = 2  # of training, from 0 up, each calm and in wind
    held_out: int = 4  # cases held out: further seeds, each with a wind of its own
    budget: int = 1000  # experiments of the search, at most
    duration_s: float = 10.0


class Case(NamedTuple):
    """What an experiment is repeated under."""

    seed: int
    wind: float  # part of plant.wind.torque that blows; 0 is calm


def cases_of(settings: Settings, options: TuneOptions) -> tuple[list[Case], list[Case]]:
    """Training cases, and those held out: later seeds, in winds between calm and that of training.

    A plant that no seed and no wind changes has one case, and none held out.
    """
    if not settings.plant.emulated:
        return [Case(0, 0.0)], []
    n = options.held_out
    training = [Case(seed, wind) for wind in (0.0, 1.0) for seed in range(options.seeds)]
    return training, [Case(options.seeds + i, round((2 * i + 1) / (2 * n), 6)) for i in range(n)]


def _run(settings: Settings, gains: Gains, case: Case) -> Run:
    wind = dict[str, Any]()
    if settings.plant.emulated:
        torque = [case.wind * value for value in settings.plant.wind.torque]
        wind = {"plant": {"wind": {"blowing": case.wind != 0, "torque": torque}}}
    return run_of(settings, as_overrides({"law": gains, **wind}), case.seed)


# ── costs ──


def summary(rows: Sequence[Row]) -> Row:
    """Runs with the same gains under several cases, in sum.

    cost, z_track and u_total are means, command_changes_per_s is the largest of all runs; trips is how many have no
    figures, and reason why the first of them has none: then all others are None.
    """
    reasons = [row["reason"] or "it answers nothing" for row in rows if row["reason"] or row["z_track"] is None]
    found: Row = dict.fromkeys(("cost", "z_track", "u_total", "command_changes_per_s"))
    if rows and not reasons:
        found |= {name: fmean(row[name] for row in rows) for name in ("z_track", "u_total")}
        found["cost"] = found["z_track"] + WEIGHT * found["u_total"]
        found["command_changes_per_s"] = max(row["command_changes_per_s"] for row in rows)
    return {**found, "trips": len(reasons), "reason": reasons[0] if reasons else None}


def rank(found: Row, most_changes: float) -> float:
    """What is minimised: the cost; far above it one that trips, or changes a voltage too often."""
    if found["trips"]:
        return 1e6 * float(found["trips"])
    excess = float(found["command_changes_per_s"] - most_changes)
    return 1e3 + excess if excess > 0 else float(found["cost"])


# ── the search ──


class Tuning(BaseModel):
    """A search for gains, and what it found.

    Before and after have gains; training and held_out, as of `summary`; delay_ms and lost_frames, as of `survived`.
    """

    model_config = ConfigDict(frozen=True)

    law: str
    duration_s: float = Field(description="length of an experiment [s]")
    training: list[Case]
    held_out: list[Case] = Field(description="cases that the search has not seen")
    before: Row
    after: Row
    overrides: list[str] = Field(description="what has changed, as `--set` takes it")
    candidates: int = Field(description="sets of gains that have run under all training cases")
    interrupted: bool
    worse: bool = Field(description="whether more held-out runs trip than before, or they cost more")


def tune(
    settings: Settings, options: TuneOptions, workers: Workers, progress: Progress = lambda _done, _total: None
) -> Tuning:
    """Search gains. ^C ends the search, not this: what whole generations have found so far is the result.

    `progress` is called with experiments of the search done, and in all, at most. Raises TuneError if there is nothing
    to search or every candidate trips, ModuleNotFoundError without SciPy.
    """
    from scipy.optimize import differential_evolution  # an extra, and slow to import

    configured, (training, held_out) = _searchable(settings, options.names), cases_of(settings, options)
    each, size = len(training), len(configured)
    population = max(8, 4 * size)
    if options.budget < (least := 2 * population * each):
        raise TuneError(f"--budget must be at least {least}: two generations of candidates, {each} runs each")
    tried = list[tuple[float, Gains]]()

    def evaluate(candidates: Sequence[Gains], cases: Sequence[Case]) -> list[Row]:
        reasons = [_refusal(settings, gains) for gains in candidates]
        allowed = [gains for gains, reason in zip(candidates, reasons, strict=True) if reason is None]
        runs, begun = [_run(settings, gains, case) for gains in allowed for case in cases], len(tried) * each
        work = partial(figures_row, duration_s=options.duration_s)
        rows = iter(workers.rows(work, runs, lambda done: progress(begun + done, options.budget)))
        return [summary([{"reason": why} if why else next(rows) for _ in cases]) for why in reasons]

    def ranks(logarithms: Floats) -> Floats:
        candidates = [_scaled(configured, column) for column in logarithms.T]
        found = [rank(row, most_changes) for row in evaluate(candidates, training)]
        tried.extend(zip(found, candidates, strict=True))
        return np.array(found)

    progress(0, options.budget)
    [before] = evaluate([configured], training)
    most_changes = inf if before["trips"] else MORE * before["command_changes_per_s"]
    random, interrupted = np.random.default_rng(0), False
    first = random.normal(scale=_REACH / 3, size=(population, size)).clip(-_REACH, _REACH)
    first[0] = 0.0
    try:
        differential_evolution(
            ranks, [(-_REACH, _REACH)] * size, init=first, maxiter=options.budget // (each * population) - 1,
            rng=random, polish=False, updating="deferred", vectorized=True, tol=1e-3,
        )  # fmt: skip
    except KeyboardInterrupt:
        interrupted = True
    _, best = min(tried, key=itemgetter(0), default=(inf, configured))
    [after] = evaluate([best], training)
    if after["trips"]:
        raise TuneError(f"no gains were found that do not trip; with the best of them, {after['reason']}")
    held = evaluate([configured, best], held_out)
    work = partial(survived, duration_s=options.duration_s)
    margins = workers.rows(work, [_run(settings, gains, training[0]) for gains in (configured, best)])
    sides = [
        {"gains": gains, "training": trained, "held_out": unseen, **margin}
        for gains, trained, unseen, margin in zip((configured, best), (before, after), held, margins, strict=True)
    ]
    changed = {f"law.{name}": gain for name, gain in best.items() if gain != configured[name]}
    return Tuning(
        law=settings.law.kind, duration_s=options.duration_s, training=training, held_out=held_out,
        before=sides[0], after=sides[1], overrides=as_overrides(changed), candidates=len(tried),
        interrupted=interrupted, worse=bool(held_out) and rank(held[1], inf) > rank(held[0], inf),
    )  # fmt: skip


def _refusal(settings: Settings, gains: Gains) -> str | None:
    """Why the law does not take these gains."""
    try:
        with_law_settings(load_over(settings, as_overrides({"law": gains})))
    except (AeroloopError, ValidationError) as error:
        return str(error).splitlines()[0]
    return None


def _scaled(configured: Gains, logarithms: Floats) -> Gains:
    """The configured gains times the factors whose logarithms are given."""
    return {
        name: _times(gain, by) if isinstance(gain, float) else tuple(_times(value, by) for value in gain)
        for (name, gain), by in zip(configured.items(), logarithms, strict=True)
    }


def _times(value: float, logarithm: float) -> float:
    return float(f"{value * exp(logarithm):.4g}") if logarithm else value  # what is printed is what ran


def _searchable(settings: Settings, names: Sequence[str]) -> Gains:
    """The gains, or other fields of the law's settings, that are named. Raises TuneError if they are no numbers."""
    law = settings.law
    fields = {name: gain for name in type(law).model_fields if (gain := _as_gain(getattr(law, name))) is not None}
    chosen = list(names) or [name for name in law_class(law).gains if name in fields]
    if not chosen or (wrong := [name for name in chosen if name not in fields]):
        what = f"has no gain {wrong[0]!r} that is not 0" if chosen else "names no gains of its own: give --gain NAME"
        raise TuneError(f"law {law.kind} {what}; its settings are {', '.join(fields) or 'none of numbers'}")
    return {name: fields[name] for name in chosen}


def _as_gain(value: Any) -> Gain | None:
    with suppress(TypeError, ValueError):
        if not isinstance(value, bool | str):
            gain = tuple(map(float, value)) if isinstance(value, Sequence) else float(value)
            return gain if np.any(gain) else None  # no factor changes 0
    return None


# ── what it gives ──


def toml_of(tuning: Tuning) -> str:
    """The gains found as a section of a configuration file, after the command's own words on what they are."""
    worse = "# Not to be used: worse in the runs held out.\n" if tuning.worse else ""
    gains = {name: gain if isinstance(gain, float) else list(gain) for name, gain in tuning.after["gains"].items()}
    return f"{worse}{toml({'law': {'kind': tuning.law, **gains}})}"


_FIGURES: Final = (
    ("cost, 1e-4 s", "cost", "{:.2f}", 1e4),
    ("z_track, 1e-4 s", "z_track", "{:.2f}", 1e4),
    ("u_total, V²·s", "u_total", "{:.0f}", 1),
    ("command changes/s, most", "command_changes_per_s", "{:.1f}", 1),
    ("runs that trip", "trips", "{}", 1),
)


def sheets(tuning: Tuning) -> Sheets:
    """What the search gains in both sets of runs, and the gains."""
    both = {"before": tuning.before, "after": tuning.after}
    worse = "Not to be used: worse in the runs held out."
    yield worse if tuning.worse else "Better gains found." if tuning.overrides else "No better gains found.", []
    rows = [
        {"": title}
        | {
            f"{part.replace('_', ' ')}: {when}": cell(side[part][name], form, scale)
            for part in ("training", "held_out")
            for when, side in both.items()
        }
        for title, name, form, scale in _FIGURES
    ]
    yield "", rows
    survives = (("delay_ms", "delay survived, ms"), ("lost_frames", "frames lost in a row survived"))
    gains = [{"": n} | {when: _numbers(side["gains"][n]) for when, side in both.items()} for n in tuning.after["gains"]]
    margins = [
        {"": title} | {when: cell(side[name], "{:g}", missing="none") for when, side in both.items()}
        for name, title in survives
    ]
    yield "", [*gains, *margins]
    yield (
        f"{tuning.candidates} sets of gains of law {tuning.law}, {len(tuning.training)} experiments of "
        f"{tuning.duration_s:g} s each{'; interrupted' if tuning.interrupted else ''}. Cost: mean of z_track + "
        f"{WEIGHT:g} · u_total. Held out: other seeds and winds. Survived: with an error within {WITHIN_DEG:g}°, calm.",
        [],
    )
    if tuning.overrides:
        yield "\n".join(f"--set '{words}'" for words in tuning.overrides), []


def _numbers(gain: Gain) -> str:
    return f"{gain:g}" if isinstance(gain, float) else ", ".join(f"{value:g}" for value in gain)
