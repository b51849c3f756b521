"""Comparison of laws: runs what `law_choices` has, in a sweep, and looks for what each law survives.

Frames are sent on change, so that a law that chatters pays in bits. Then delay and lost frames grow, calm and with the
first of bits and sensors, until the attitude error leaves a bound or the plant trips.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import load_over, with_law_settings
from aeroloop.service.lab.law_margins import PUSHED_S, survives
from aeroloop.service.lab.workers import PROCESSES, Workers
from aeroloop.service.logs.outputs import writing
from aeroloop.service.sweep.axes import Configuration
from aeroloop.service.sweep.law_choices import WINDS, Choice, Comparison
from aeroloop.service.sweep.sweep import Plan, run_sweep
from aeroloop.service.sweep.table import WITHIN_DEG

_MARGINS: Final = ("delay_ms", "lost_frames")


class LawRow(BaseModel):
    """Figures of a combination, mean over the seeds; errors are the largest of any. Null with a reason."""

    model_config = ConfigDict(frozen=True)

    law: str
    bits: str = Field(description="of ε and ω, and of u; cont is float64")
    sensors: str
    wind: str
    plant: str
    z_track: float | None = Field(default=None, description="∫ ε̃ᵀε̃ dt of the attitude as measured [s]")
    u_total: float | None = Field(default=None, description="∫ uᵀu dt of the commands as sent [V²·s]")
    max_error_deg: float | None = Field(default=None, description="largest attitude error as measured [deg]")
    second_half_error_deg: float | None = Field(default=None, description="the same in the second half: settled [deg]")
    command_changes_per_s: float | None = Field(default=None, description="chatter: changes of a voltage [1/s]")
    bits_per_s: float | None = Field(default=None, description="payload of both directions, sent on change [bit/s]")
    reason: str | None = Field(default=None, description="why there are no figures, of the first seed that has none")


class LawMargin(BaseModel):
    """What a law survives, calm, with the first of bits and sensors."""

    model_config = ConfigDict(frozen=True)

    law: str
    plant: str
    delay_ms: float | None = Field(description="largest further delay of commands within the bound [ms]; null: none is")
    lost_frames: int | None = Field(description="most commands lost in a row, again and again; null: none may be")


class Laws(BaseModel):
    """The comparison."""

    model_config = ConfigDict(frozen=True)

    duration_s: float
    seeds: int
    bandwidth: list[float] = Field(description="ωₙ of the linearised attitude error of each axis, of all laws [rad/s]")
    damping_ratio: list[float] = Field(description="ζ of the same [1]")
    period_ms: float = Field(description="time between ticks [ms]")
    within_deg: float = Field(description="bound of the attitude error in the second half, for the margins [deg]")
    margin_duration_s: float = Field(description="length of a run with delay or lost frames [s]")
    margin_at: str = Field(description="bits of these; the sensors are the first of each plant")
    gains: dict[str, dict[str, Any]] = Field(description="settings of each law, for the first plant")
    rows: list[LawRow]
    margins: list[LawMargin]
    out: str | None = Field(description="table of all experiments")


def run_comparison(
    comparison: Comparison,
    out: Path | None = None,
    engine: str = PROCESSES,
    progress: Callable[[int, int], None] | None = None,
) -> Laws:
    """Run a comparison on every worker.

    Args:
        comparison: What to run.
        out: Parquet file of all experiments, with the margins; rows are kept beside it as of `run_sweep`.
        engine: As of `Workers`.
        progress: Called with experiments and searches done, and in all.

    Raises:
        SweepError, OutputError, WorkersError: As of `run_sweep`.
    """
    plan, choices = comparison.plan, comparison.choices
    pushed = list(_pushed(comparison))
    total = len(choices) * plan.seeds + 2 * len(pushed)
    report = progress or (lambda _done, _total: None)
    with TemporaryDirectory() as scratch:
        table = out or Path(scratch, "laws.parquet")
        run_sweep(plan, table, engine=engine, progress=lambda done, _: report(done, total))
        jobs = [(load_over(plan.settings, overrides).description(), lost, comparison.within_deg)
                for _, overrides in pushed for lost in (False, True)]  # fmt: skip
        with Workers(engine) as workers:
            before = total - len(jobs)
            survived = workers.each(survives, jobs, lambda done: report(before + done, total))
        period_ms = plan.settings.loop.period * 1e3
        margins = [
            LawMargin(
                law=choice.law, plant=choice.plant, delay_ms=delay and round(delay * period_ms, 6), lost_frames=lost
            )
            for (choice, _), delay, lost in zip(pushed, survived[::2], survived[1::2], strict=True)
        ]
        rows = with_margins(table, margins, comparison.within_deg)
    first = choices[0]
    return Laws(
        duration_s=plan.duration_s,
        seeds=plan.seeds,
        bandwidth=list(comparison.response.bandwidth),
        damping_ratio=list(comparison.response.damping),
        period_ms=period_ms,
        within_deg=comparison.within_deg,
        margin_duration_s=PUSHED_S,
        margin_at=f"{first.bits} bits",
        gains={choice.law: _gains(plan, configuration) for choice, configuration in
               zip(choices, plan.found, strict=True) if choice.plant == first.plant},
        rows=[_row(choice, rows[i * plan.seeds : (i + 1) * plan.seeds]) for i, choice in enumerate(choices)],
        margins=margins,
        out=None if out is None else str(out),
    )  # fmt: skip


def _gains(plan: Plan, configuration: Configuration) -> dict[str, Any]:
    law: dict[str, Any] = with_law_settings(load_over(plan.settings, configuration.overrides)).description()["law"]
    return law


def _pushed(comparison: Comparison) -> Iterator[tuple[Choice, tuple[str, ...]]]:
    """The combinations whose margins are looked for: calm, with the first of bits and sensors that a plant has."""
    seen = set[tuple[str, str]]()
    for choice, configuration in zip(comparison.choices, comparison.plan.found, strict=True):
        if (choice.law, choice.plant) not in seen:
            seen.add((choice.law, choice.plant))
            calm = ("plant.wind.blowing=false",) if choice.wind in WINDS else ()
            yield choice, (*configuration.overrides, *calm)


def with_margins(table: Path, margins: Sequence[LawMargin], within_deg: float) -> list[dict[str, Any]]:
    """Add columns of the margins, and their bound [deg], to a table of experiments; the rows of the whole."""
    import pyarrow as pa
    import pyarrow.parquet as parquet

    found = parquet.read_table(table)
    of = {(margin.law, margin.plant): margin for margin in margins}
    keys = list(zip(found["law"].to_pylist(), found["plant"].to_pylist(), strict=True))
    for name in _MARGINS:
        text = LawMargin.model_fields[name].description or ""
        field = pa.field(name, pa.float64(), metadata={"description": text})
        found = found.append_column(field, pa.array([getattr(of[key], name) for key in keys], pa.float64()))
    found = found.replace_schema_metadata({**found.schema.metadata, WITHIN_DEG: json.dumps(within_deg)})
    with writing(table, force=True) as part:
        parquet.write_table(found, part, compression="zstd")
    rows: list[dict[str, Any]] = found.to_pylist()
    return rows


def _row(choice: Choice, rows: Sequence[dict[str, Any]]) -> LawRow:
    """The row of a combination, of those of its seeds."""
    if reasons := [row["reason"] for row in rows if row["reason"] is not None]:
        several = f"{len(reasons)} of {len(rows)} seeds: " if len(rows) > 1 else ""
        return LawRow(**choice._asdict(), reason=f"{several}{reasons[0]}")
    figures: dict[str, Any] = {
        name: fmean(row[name] for row in rows) for name in ("z_track", "u_total", "command_changes_per_s")
    }
    figures |= {name: max(row[name] for row in rows) for name in ("max_error_deg", "second_half_error_deg")}
    sent = fmean(row["measurement_bits_per_s"] + row["command_bits_per_s"] for row in rows)
    return LawRow(**choice._asdict(), **figures, bits_per_s=sent)
