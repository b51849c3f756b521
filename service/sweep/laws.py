"""Comparison of laws: every law × bits × sensors × wind × plant, on the same wire, with the same seeds and faults.

A law that is not the configured one has the gains of the tuning rule, from the bandwidth and damping ratio of the
configured C₁ and C₂; a law of one's own has its defaults. Each combination is an experiment of a sweep, with frames
sent on change, so that a law that chatters pays in bits. Then delay and lost frames grow, calm and with the first of
bits and sensors, until the attitude error leaves a bound or the plant trips.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.plant_emulator.settings import IDEAL_AERO
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.nonadaptive import NonadaptiveSettings
from aeroloop.service.control.laws.tracking import TrackingSettings
from aeroloop.service.control.laws.tuning import RULES, Response, response_of, tuned
from aeroloop.service.lab.burden_grid import SENSORS
from aeroloop.service.lab.experiment import PATH, paths
from aeroloop.service.lab.law_margins import PUSHED_S, survives
from aeroloop.service.lab.workers import PROCESSES, Workers
from aeroloop.service.logs.outputs import writing
from aeroloop.service.sweep.axes import Axis, Configuration, digest_of
from aeroloop.service.sweep.sweep import Plan, run_sweep

LAWS: Final = ("adaptive", "nonadaptive", *RULES)
BITS: Final = ("8/6", "cont/cont")
WINDS: Final = {"calm": False, "wind": True}
PLANTS: Final = ("aero", "rigid_body")
WITHIN_DEG: Final = 10.0
AS_CONFIGURED: Final = "its own"
"""Sensors and wind of a plant that is none of ours."""
IDEAL: Final = "ideal"
"""Those of an ideal plant of ours: perfect sensors, no wind."""
_MARGINS: Final = ("delay_ms", "lost_frames")


class Choice(NamedTuple):
    """A combination, in words."""

    law: str
    bits: str
    sensors: str
    wind: str
    plant: str


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
    path: str | None = Field(default=None, description=PATH)
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
    path: str = Field(description=PATH)
    rows: list[LawRow]
    margins: list[LawMargin]
    out: str | None = Field(description="table of all experiments")


class LawsError(AeroloopError):
    """The comparison cannot be made; one line with the reason."""


class Comparison(NamedTuple):
    """What is to be run."""

    plan: Plan
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
        Plan(settings, names, configurations, seeds, duration_s), choices, _response(settings), within_deg
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
        rows = with_margins(table, margins)
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
        path=paths(row["path"] or "frames" for row in rows),
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


def with_margins(table: Path, margins: Sequence[LawMargin]) -> list[dict[str, Any]]:
    """Add columns of the margins to a table of experiments; the rows of the whole."""
    import pyarrow as pa
    import pyarrow.parquet as parquet

    found = parquet.read_table(table)
    of = {(margin.law, margin.plant): margin for margin in margins}
    keys = list(zip(found["law"].to_pylist(), found["plant"].to_pylist(), strict=True))
    for name in _MARGINS:
        text = LawMargin.model_fields[name].description or ""
        field = pa.field(name, pa.float64(), metadata={"description": text})
        found = found.append_column(field, pa.array([getattr(of[key], name) for key in keys], pa.float64()))
    with writing(table, force=True) as part:
        parquet.write_table(found, part, compression="zstd")
    rows: list[dict[str, Any]] = found.to_pylist()
    return rows


def _row(choice: Choice, rows: Sequence[dict[str, Any]]) -> LawRow:
    """The row of a combination, of those of its seeds."""
    if reasons := [row["reason"] for row in rows if row["reason"] is not None]:
        several = f"{len(reasons)} of {len(rows)} seeds: " if len(rows) > 1 else ""
        return LawRow(**choice._asdict(), path="frames", reason=f"{several}{reasons[0]}")
    figures: dict[str, Any] = {
        name: fmean(row[name] for row in rows) for name in ("z_track", "u_total", "command_changes_per_s")
    }
    figures |= {name: max(row[name] for row in rows) for name in ("max_error_deg", "second_half_error_deg")}
    sent = fmean(row["measurement_bits_per_s"] + row["command_bits_per_s"] for row in rows)
    path = paths(row["path"] for row in rows)
    return LawRow(**choice._asdict(), **figures, bits_per_s=sent, path=path)
