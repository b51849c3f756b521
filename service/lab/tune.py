"""Tuning of a law's gains in lockstep experiments: a search, then what it found in runs that it has not seen.

`tune_search` searches the gains of lowest cost (`tune_costs`) that keep to limits, in training cases. Held-out cases,
of other seeds and winds, have no part in it: before and after they show what it found.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings, as_overrides
from aeroloop.service.config_text import toml
from aeroloop.service.lab.law_margins import PUSHED_S, survives
from aeroloop.service.lab.tune_costs import Limits, Summary, summary, worse
from aeroloop.service.lab.tune_runs import Case, run_cases, with_case, with_law
from aeroloop.service.lab.tune_search import Gain, Plan, Progress, Search
from aeroloop.service.lab.workers import Workers
from aeroloop.service.theorem.any_law import certify_any
from aeroloop.service.theorem.configured import NoTheoremError
from aeroloop.service.theorem.extremes import BoundlessError


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
    worse: str | None = Field(description="in what the held-out set is worse than before; null where it is not")
    exceeded: list[str] = Field(description="limits that the gains after exceed in the held-out set")


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
    progress = progress or (lambda _done, _total: None)
    search = Search(settings, plan, workers, progress)
    interrupted = False
    try:
        search.run()
    except KeyboardInterrupt:
        interrupted = True
    best = search.best()
    held_out = plan.held_out_cases(settings.plant.emulated)
    before, after = _judged([search.configured, best], search, held_out, settings, plan, workers, progress)
    return Tuning(
        law=settings.law.kind,
        weight=plan.weight,
        limits=search.limits,
        duration_s=plan.duration_s,
        training=search.training,
        held_out=held_out,
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
        worse=worse(before.held_out, after.held_out),
        exceeded=[
            name
            for name, limit in search.limits
            if limit is not None and (getattr(after.held_out, name) or 0.0) > limit
        ],
    )


def _judged(
    each: Sequence[dict[str, Gain]],
    search: Search,
    held_out: list[Case],
    settings: Settings,
    plan: Plan,
    workers: Workers,
    progress: Progress,
) -> list[Tuned]:
    """What the search has not seen of some sets of gains: held-out cases, late commands, certificate."""
    laws = [search.law(gains) for gains in each]
    held = [(search.config, law, [case], plan.duration_s) for law in laws for case in held_out]
    pushed = [with_case(with_law(search.config, law), search.training[0]).description() for law in laws]
    late = [(config, lost, plan.within_deg) for config in pushed for lost in (False, True)]
    done, total = search.experiments, search.experiments + len(held) + len(late)
    rans = workers.each(run_cases, held, lambda count: progress(done + count, total))
    done += len(held)
    survived = workers.each(survives, late, lambda count: progress(done + count, total))
    found = list[Tuned]()
    n = len(held_out)
    for i, (gains, law, trained) in enumerate(zip(each, laws, search.evaluate(each), strict=True)):
        delay, lost = survived[2 * i : 2 * i + 2]
        tuned = Tuned(
            gains=gains,
            training=summary(trained, plan.weight),
            held_out=summary([ran for runs in rans[i * n : (i + 1) * n] for ran in runs], plan.weight),
            delay_ms=None if delay is None else round(delay * settings.loop.period * 1e3, 6),
            lost_frames=lost,
            certificate=verdict(with_law(search.config, law)),
        )
        found.append(tuned)
    return found


def verdict(settings: Settings) -> str:
    """The verdict of the configuration's certificate, or why its law has none."""
    try:
        return certify_any(settings).verdict
    except (NoTheoremError, BoundlessError) as error:
        return str(error)
