"""Comparison of laws: every law × bits × sensors × wind × plant in a sweep, then what each law survives.

A law that is not the configured one has the gains of the tuning rule, from the bandwidth and damping ratio of the
configured C₁ and C₂; a law of one's own has its defaults. Everything else is the same for all of them. Frames are sent
on change, so that a law that chatters pays in bits. Then delay and lost frames grow, calm and with the first of bits
and sensors, until the attitude error leaves a bound or the plant trips.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import groupby, product
from pathlib import Path
from statistics import fmean
from typing import Any, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.plant_emulator.settings import IDEAL_AERO
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.baselines import (
    TUNED,
    NonadaptiveSettings,
    Response,
    TrackingSettings,
    response_of,
    tuned,
)
from aeroloop.service.lab.axes import Axis, Configuration, digest_of
from aeroloop.service.lab.burden import SENSORS
from aeroloop.service.lab.law_margins import PUSHED_S, survived
from aeroloop.service.lab.sweep import Progress, Row, RowFile, Sheets, SweepPlan, rows_file, sweep_rows, write_table
from aeroloop.service.lab.workers import PROCESSES, open_workers, run_of

LAWS: Final = ("adaptive", "nonadaptive", *TUNED)
BITS: Final = ("8/6", "cont/cont")
WINDS: Final = {"calm": False, "wind": True}
PLANTS: Final = ("aero", "rigid_body")
WITHIN_DEG: Final = 10.0
AS_CONFIGURED: Final = "its own"
"""Sensors and wind of a plant that is none of ours."""
IDEAL: Final = "ideal"
"""Those of an ideal plant of ours: perfect sensors, no wind."""


class Choice(NamedTuple):
    """A combination, in words."""

    law: str
    bits: str
    sensors: str
    wind: str
    plant: str


class LawsError(AeroloopError):
    """The comparison cannot be made; one line with the reason."""


class Comparison(NamedTuple):
    """What is to be run."""

    plan: SweepPlan
    choices: list[Choice]
    response: Response
    within_deg: float


def compare(
    settings: Settings,
    laws: Sequence[str] = (),
    bits: Sequence[str] = (),
    sensors: Sequence[str] = (),
    winds: Sequence[str] = (),
    plants: Sequence[str] = (),
    *,
    seeds: int = 1,
    duration_s: float,
    within_deg: float = WITHIN_DEG,
) -> Comparison:
    """Every combination of what is given.

    Where nothing is: the configured law and LAWS, BITS, encoders, WINDS, and PLANTS or a configured other plant.

    Args:
        settings: The configuration.
        laws: Kinds of laws, also of one's own.
        bits: Bits out and in, such as 8/6; `cont` for float64.
        sensors: Names out of SENSORS.
        winds: Names out of WINDS.
        plants: Kinds of plants, also of one's own.
        seeds: Runs of each combination, with seeds from 0 up.
        duration_s: Length of an experiment [s].
        within_deg: Bound of the attitude error, for the margins [deg].

    Raises:
        LawsError: An unknown name.
        ConfigError, PluginError, LawError: A combination is no configuration, or has no such law.
    """
    for option, given, known in (("--sensors", sensors, [*SENSORS]), ("--wind", winds, [*WINDS])):
        if unknown := [name for name in given if name not in known]:
            raise LawsError(f"{option} {unknown[0]!r} is not known: it is one of {', '.join(known)}")
    if wrong := [pair for pair in bits if pair.count("/") != 1]:
        raise LawsError(f"--bits takes bits out and in, such as 8/6 or cont/cont, not {wrong[0]!r}")
    found = list[tuple[Choice, Configuration]]()
    chosen = plants or (PLANTS if settings.plant.kind == PLANTS[0] else (settings.plant.kind,))
    axes = chosen, sensors or ("encoders",), winds or WINDS, bits or BITS
    for plant, sensor, wind, pair in product(*map(dict.fromkeys, axes)):
        for law in dict.fromkeys(laws or (settings.law.kind, *LAWS)):
            choice, overrides = _chosen(settings, Choice(law, pair, sensor, wind, plant))
            if all(choice != other for other, _ in found):
                description = with_law_settings(load_over(settings, overrides)).description()
                found.append((choice, Configuration(overrides, choice, digest_of(description, duration_s))))
    choices, configurations = map(list, zip(*found, strict=True))
    names = [Axis(name, ()) for name in Choice._fields]
    return Comparison(
        SweepPlan(settings, names, configurations, seeds, duration_s), choices, _response(settings), within_deg
    )


def _chosen(settings: Settings, choice: Choice) -> tuple[Choice, tuple[str, ...]]:
    """A combination as it can be had, and its overrides: a body without joints has no encoders."""
    out, _, inp = choice.bits.partition("/")
    changes: dict[str, Any] = {
        "wire": {
            "attitude": {"bits": _bits(out)},
            "rate": {"bits": _bits(out)},
            "voltage": {"bits": _bits(inp)},
            "transmit": {"measurement": "on_change", "command": "on_change"},
        },
        "plant": {"kind": choice.plant},
    }
    plant, body = changes["plant"], settings.law
    if choice.plant not in PLANTS:
        choice = choice._replace(sensors=AS_CONFIGURED, wind=AS_CONFIGURED)
        changes["wire"]["actuators"] = _motors(settings, choice.plant)
    elif settings.plant.ideal:
        choice = choice._replace(sensors=IDEAL, wind=IDEAL)
        plant["sensors"], plant["wind"] = {}, {}
    else:
        plant["sensors"] = dict(SENSORS[choice.sensors].changes)
        plant["wind"] = {"blowing": WINDS[choice.wind]}
    if choice.plant == "rigid_body":
        rate = plant["sensors"].get("rate", "perfect")
        plant["sensors"] |= {"attitude": "perfect", "rate": "perfect" if rate == "derivative" else rate}
        choice = choice._replace(sensors={"encoders": "perfect"}.get(choice.sensors, choice.sensors))
        if settings.plant.kind != "rigid_body":
            body = body.model_copy(update={"allocation": three_motors(body.allocation)})
            plant |= _free_body(settings, body.allocation)
            plant["wind"]["torque"] = [0.0, *settings.plant.wind.torque[:2]]  # about y and z, as on the Aero
            changes["wire"]["actuators"] = 3
    law = _law(settings, choice.law, body)
    return choice, tuple(as_overrides({**changes, "law": law}))


def _motors(settings: Settings, kind: str) -> int:
    """Motors of a plant of one's own. Raises PluginError or PlantError if it cannot be made."""
    plant = load_over(settings, [f"plant.kind={kind}"]).plant.make(settings.loop.period)
    plant.close()
    return plant.actuators


def _bits(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


def three_motors(allocation: Sequence[Sequence[float]]) -> list[list[float]]:
    """B of a free body like the Aero: its two motors, and one that rolls it as strongly as the others move it."""
    motors = [[float(value) for value in row[1:]] for row in allocation[1:]]
    strongest = max(abs(value) for row in motors for value in row)
    return [[strongest, 0.0, 0.0], *([0.0, *row] for row in motors)]


def _free_body(settings: Settings, allocation: Sequence[Sequence[float]]) -> dict[str, Any]:
    """A plant of the paper's equations: the body of the law's model, with the damping of an ideal Aero."""
    law = settings.law
    same = {name: getattr(law, name) for name in ("inertia", "mass", "gravity", "centre_of_mass")}
    return {
        "rigid_body": {**same, "allocation": allocation, "damping": IDEAL_AERO.damping},
        "rotor": {"lag_up_s": 0.0, "lag_down_s": 0.0},
        "friction": {"viscous": [], "coulomb": []},
    }


def _law(settings: Settings, kind: str, body: Any) -> dict[str, Any]:
    """`[law]` of a law of this kind, over the configuration's."""
    allocation = {"allocation": [list(row) for row in body.allocation]}
    if kind == settings.law.kind:
        return allocation
    papers = isinstance(settings.law, AdaptiveSettings | NonadaptiveSettings)
    known = {}
    if kind in LAWS and isinstance(settings.law, AdaptiveSettings | NonadaptiveSettings | TrackingSettings):
        known["damping_estimate"] = settings.law.damping_estimate
    if kind in ("adaptive", "nonadaptive") and papers:
        known |= {name: getattr(settings.law, name) for name in ("C1", "C2")}
    return {"kind": kind, **allocation, **known, **tuned(kind, body, _response(settings))}


def _response(settings: Settings) -> Response:
    """The response that the configured gains of the paper's law give; those of Table C.1, if it has none."""
    law = settings.law
    gains = law if isinstance(law, AdaptiveSettings | NonadaptiveSettings) else AdaptiveSettings()
    return response_of(law.inertia, gains.C1, gains.C2)


# ── the comparison ──


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
    progress: Progress = lambda _done, _total: None,
) -> Laws:
    """Run a comparison on every worker.

    Args:
        comparison: What to run.
        out: Table of all experiments, with the margins; rows are kept beside it as of `run_sweep`.
        engine: As of `open_workers`.
        progress: Called with experiments and searches done, and in all.

    Raises:
        SweepError, OutputError, WorkersError: As of `run_sweep`.
    """
    plan, choices = comparison.plan, comparison.choices
    pushed = list(_pushed(comparison))
    before = len(choices) * plan.seeds
    total = before + len(pushed)
    searches = [run_of(plan.settings, overrides) for _, overrides in pushed]
    with RowFile(out and rows_file(out)) as file, open_workers(engine) as workers:
        rows = sweep_rows(plan, workers, file, lambda done, _: progress(done, total))
        limits: list[Row] = workers.rows(
            partial(survived, within_deg=comparison.within_deg), searches, lambda done: progress(before + done, total)
        )
    margins = [LawMargin(law=choice.law, plant=choice.plant, **limit)
               for (choice, _), limit in zip(pushed, limits, strict=True)]  # fmt: skip
    if out is not None:
        write_table(out, plan, rows, _margin_columns(comparison, margins))
    first = choices[0]
    return Laws(
        duration_s=plan.duration_s,
        seeds=plan.seeds,
        bandwidth=list(comparison.response.bandwidth),
        damping_ratio=list(comparison.response.damping),
        period_ms=plan.settings.loop.period * 1e3,
        within_deg=comparison.within_deg,
        margin_duration_s=PUSHED_S,
        margin_at=f"{first.bits} bits",
        gains={choice.law: _gains(plan, configuration) for choice, configuration in
               zip(choices, plan.configurations, strict=True) if choice.plant == first.plant},
        rows=[_law_row(choice, rows[i * plan.seeds : (i + 1) * plan.seeds]) for i, choice in enumerate(choices)],
        margins=margins,
        out=None if out is None else str(out),
    )  # fmt: skip


def _gains(plan: SweepPlan, configuration: Configuration) -> dict[str, Any]:
    law: dict[str, Any] = with_law_settings(load_over(plan.settings, configuration.overrides)).description()["law"]
    return law


def _pushed(comparison: Comparison) -> Iterator[tuple[Choice, tuple[str, ...]]]:
    """The combinations whose margins are looked for: calm, with the first of bits and sensors that a plant has."""
    seen = set[tuple[str, str]]()
    for choice, configuration in zip(comparison.choices, comparison.plan.configurations, strict=True):
        if (choice.law, choice.plant) not in seen:
            seen.add((choice.law, choice.plant))
            calm = ("plant.wind.blowing=false",) if choice.wind in WINDS else ()
            yield choice, (*configuration.overrides, *calm)


def table_extras(within_deg: float) -> dict[str, float]:
    """Columns with one value that a table of a comparison has beside those of any sweep."""
    return {"within_deg": within_deg}


def _margin_columns(comparison: Comparison, margins: Sequence[LawMargin]) -> dict[str, tuple[Sequence[Any], str]]:
    of = {(margin.law, margin.plant): margin for margin in margins}
    each = [of[choice.law, choice.plant] for choice in comparison.choices for _ in range(comparison.plan.seeds)]
    columns: dict[str, tuple[Sequence[Any], str]] = {
        name: ([getattr(margin, name) for margin in each], LawMargin.model_fields[name].description or "")
        for name in ("delay_ms", "lost_frames")
    }
    columns["within_deg"] = [comparison.within_deg] * len(each), "bound of the attitude error, for the margins [deg]"
    return columns


def _law_row(choice: Choice, rows: Sequence[dict[str, Any]]) -> LawRow:
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


# ── as text ──


def sheets(laws: Laws) -> Sheets:
    """Figures of each combination, then what each law survives."""
    for (plant, sensors, wind, bits), found in groupby(laws.rows, lambda r: (r.plant, r.sensors, r.wind, r.bits)):
        around = [f"sensors and wind: {wind}"] if sensors == wind else [f"sensors: {sensors}", wind]
        rows = list(found)
        yield " · ".join([plant, *around, f"{bits} bits"]), list(map(_cells, rows))
        if failed := [f"{row.law}: {row.reason}" for row in rows if row.reason is not None]:
            yield "\n".join(failed), []
    for plant, margins in groupby(laws.margins, lambda margin: margin.plant):
        title = f"{plant} · calm · {laws.margin_at} · survived with an error within {laws.within_deg:g}°"
        yield (
            title,
            [
                {
                    "law": margin.law,
                    "delay": "none" if margin.delay_ms is None else f"{margin.delay_ms:g} ms",
                    "frames lost in a row": "none" if margin.lost_frames is None else str(margin.lost_frames),
                }
                for margin in margins
            ],
        )
    yield from ((note, []) for note in _notes(laws))


def _cells(row: LawRow) -> dict[str, str]:
    figures = {
        "z_track 10⁻⁴ s": (row.z_track, "{:.1f}", 1e4),
        "u_total V²·s": (row.u_total, "{:.0f}", 1),
        "largest": (row.max_error_deg, "{:.1f}°", 1),
        "settled": (row.second_half_error_deg, "{:.2f}°", 1),
        "changes/s": (row.command_changes_per_s, "{:.0f}", 1),
        "kbit/s": (row.bits_per_s, "{:.1f}", 1e-3),
    }
    cells = {
        name: "–" if value is None else form.format(value * scale) for name, (value, form, scale) in figures.items()
    }
    return {"law": row.law} | cells


def _notes(laws: Laws) -> Iterator[str]:
    bandwidth, damping = ("/".join(dict.fromkeys(f"{value:.2f}" for value in values)) for values in (
        laws.bandwidth, laws.damping_ratio))  # fmt: skip
    yield (
        f"Tuned to ωₙ = {bandwidth} rad/s and ζ = {damping} of the linearised error, which the paper's gains have "
        "(service/control/laws/README.md has the rule); a law of your own, and the configured one, as configured."
    )
    yield (
        f"{laws.duration_s:g} s each, {laws.seeds} seed{'s' * (laws.seeds > 1)}, sent on change. Settled is the "
        f"largest error of the second half. Survived for {laws.margin_duration_s:g} s, without a watchdog: commands "
        "that act later, or of which so many in a row never do, again and again, up to 1 s."
    )
    if laws.out is not None:
        yield f"All experiments: {laws.out}"
