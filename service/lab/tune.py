"""Tuning of a law's gains in lockstep experiments: a search, then what it found in runs that it has not seen.

Held-out cases, of other seeds and winds, have no part in the search (tune_search.py): before and after they show what
it found.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings, as_overrides
from aeroloop.service.config_text import toml
from aeroloop.service.lab.law_margins import PUSHED_S
from aeroloop.service.lab.sweep import Progress, Sheets
from aeroloop.service.lab.tune_search import Case, Gain, Limits, Search, Tuned, TuneOptions, worse
from aeroloop.service.lab.workers import Workers


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
    worse: str | None = Field(description="in what the held-out set is worse than before; null where it is not")
    exceeded: list[str] = Field(description="limits that the gains after exceed in the held-out set")


def tune(
    settings: Settings, options: TuneOptions, workers: Workers[Any], progress: Progress = lambda _done, _total: None
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
    search = Search(settings, options, workers, progress)
    interrupted = False
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted = True
    best = search.best()
    held_out = options.held_out_cases(settings.plant.emulated)
    before, after = search.judged([search.configured, best], held_out)
    return Tuning(
        law=settings.law.kind,
        weight=options.weight,
        limits=search.limits,
        duration_s=options.duration_s,
        training=search.training,
        held_out=held_out,
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
        worse=worse(before.held_out, after.held_out),
        exceeded=[
            name
            for name, limit in search.limits
            if limit is not None and (getattr(after.held_out, name) or 0.0) > limit
        ],
    )


def toml_of(tuning: Tuning) -> str:
    """The gains found as a section of a configuration file, after the command's own words on what they are."""
    worse = f"# Not to be used: in the held-out set {tuning.worse}.\n" if tuning.worse else ""
    gains = tuning.after.model_dump(mode="json")["gains"]
    return f"{worse}{toml({'law': {'kind': tuning.law, **gains}})}"


# ── as text ──


def sheets(tuning: Tuning) -> Sheets:
    """What the search gains in both sets of runs, what it costs, and the gains."""
    yield _outcome(tuning), []
    cost = f"{tuning.experiments} experiments of {tuning.duration_s:g} s with {tuning.candidates} sets of gains"
    yield f"{cost} of law {tuning.law}; seed {tuning.seed}{'; interrupted' if tuning.interrupted else ''}.", []
    yield "", list(_figures(tuning))
    both = zip(tuning.before.gains.items(), tuning.after.gains.values(), strict=True)
    yield "", [{"gain": name, "before": _gain(old), "after": _gain(new)} for (name, old), new in both]
    yield from ((note, []) for note in _notes(tuning))
    if tuning.overrides:
        yield "\n".join(f"--set '{words}'" for words in tuning.overrides), []


def _outcome(tuning: Tuning) -> str:
    if not tuning.overrides:
        return "No better gains found."
    if tuning.worse is not None:
        return f"Not to be used: in the held-out set {tuning.worse}."
    before, after = tuning.before.held_out.cost, tuning.after.held_out.cost
    if not tuning.held_out:
        return "Better gains found, but there is no held-out set: nothing varies with a seed or a wind."
    if before is None or after is None:
        return "Better gains found: what tripped in the held-out set trips less."
    return f"Better gains found: in the held-out set the cost changes by {after / before - 1:+.1%}."


def _figures(tuning: Tuning) -> Iterator[dict[str, str]]:
    both = tuning.before, tuning.after
    sides = [getattr(side, part) for part in ("training", "held_out") for side in both]
    columns = ("training: before", "training: after", "held out: before", "held out: after", "limit")
    for label, name, scale, form in (
        ("cost, 1e-4 s", "cost", 1e4, "{:.2f}"),
        ("z_track, 1e-4 s", "z_track", 1e4, "{:.2f}"),
        ("u_total, V²·s", "u_total", 1, "{:.0f}"),
        ("error in 2nd half, deg", "settled_deg", 1, "{:.2f}"),
        ("saturated ticks", "saturated", 1, "{:.2%}"),
        ("command changes/s", "changes_per_s", 1, "{:.1f}"),
        ("runs that trip", "trips", 1, "{:.0f}"),
    ):
        values = [getattr(side, name) for side in sides]
        cells = ["–" if value is None else form.format(value * scale) for value in values]
        limit = getattr(tuning.limits, name, None)
        yield {"": label} | dict(zip(columns, [*cells, "" if limit is None else form.format(limit)], strict=True))
    for label, name in (("delay survived, ms", "delay_ms"), ("frames lost in a row", "lost_frames")):
        survives = [getattr(side, name) for side in both]
        cells = ["none" if value is None else f"{value:g}" for value in survives]
        yield {"": label} | dict(zip(columns, [*cells, "", "", ""], strict=True))


def _notes(tuning: Tuning) -> Iterator[str]:
    if exceeded := tuning.exceeded:
        yield f"The gains after exceed a limit in the held-out set: {', '.join(exceeded)}."
    yield (
        f"cost = mean of z_track + {tuning.weight:g} · u_total; gains with which a run trips or exceeds a limit rank "
        "behind all others. Error, saturation and changes are the largest of all runs. Training: "
        f"{_cases(tuning, held_out=False)}. Held out: {_cases(tuning, held_out=True)}."
    )
    yield (
        f"Delay and frames lost again and again: the most with which the error stays within {tuning.within_deg:g}° in "
        f"the second half of {tuning.margin_duration_s:g} s, without a watchdog, in the first training case."
    )
    if tuning.without_effect:
        yield f"Without effect here, and not changed: {', '.join(tuning.without_effect)}."
    before, after = tuning.before.certificate, tuning.after.certificate
    yield f"Before and after: {before}" if before == after else f"Before: {before}\nAfter: {after}"


def _cases(tuning: Tuning, *, held_out: bool) -> str:
    cases = tuning.held_out if held_out else tuning.training
    if not cases:
        return "none"
    seeds, winds = sorted({case.seed for case in cases}), sorted({case.wind for case in cases})
    return f"seeds {seeds[0]}…{seeds[-1]}, wind × {', '.join(f'{wind:g}' for wind in winds)}"


def _gain(gain: Gain) -> str:
    return f"{gain:g}" if isinstance(gain, float) else ", ".join(f"{value:g}" for value in gain)
