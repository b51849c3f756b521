"""Comparison of laws: every law × bits × sensors × wind × plant in a sweep, what is proven of each, what each survives.

A law that is not the configured one has the gains of the tuning rule, from the bandwidth and damping ratio of the
configured C₁ and C₂; a law of one's own has its defaults. A law that adapts stands beside itself with all adaptation
gains 0. Everything else is the same for all of them. Frames are sent on change, so that a law that chatters pays in
bits. Then delay and lost frames grow, calm and with the first of bits and sensors, until the attitude error leaves a
bound or the plant trips.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from itertools import cycle, groupby, product
from math import inf
from operator import itemgetter
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.plant_emulator.settings import IDEAL_AERO
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, as_overrides, load_over, with_law_settings
from aeroloop.service.control.laws.adaptive import AdaptiveSettings
from aeroloop.service.control.laws.baselines import TUNED, NonadaptiveSettings, Response, response_of, tuned
from aeroloop.service.control.laws.interface import EstimateSettings
from aeroloop.service.lab.axes import Axis, Configuration, digest_of
from aeroloop.service.lab.burden import SENSORS, bits_of_text, chosen, marks
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.sweep import (
    PROCESSES,
    Column,
    Progress,
    Row,
    Sheets,
    SweepPlan,
    open_workers,
    run_of,
    sweep_rows,
    write_table,
)
from aeroloop.service.theorem.certificate import certify
from aeroloop.service.theorem.extremes import BoundlessError
from aeroloop.service.theorem.feedback import NoTheoremError

# ── what is compared ──

_OFF: Final = [0.0, 0.0, 0.0]
WITHOUT_ADAPTATION: Final[dict[str, dict[str, Any]]] = {
    "adaptive": {"kind": "nonadaptive"},  # the same law with θ̂ as first estimated; its own Γ cannot be 0
    "adaptive-torque": {"Gamma_torque": _OFF, "Gamma_damping": _OFF, "Gamma_coulomb": _OFF},
}
"""Settings that take the adaptation from a law."""
_NO_GAMMA: Final = ", Γ = 0"
"""Ends the name of such a law."""
LAWS: Final = ("adaptive", *TUNED)
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
    """Every combination of what is given, and each law that adapts also without its adaptation.

    Where nothing is: the configured law and LAWS, BITS, encoders, WINDS, and PLANTS or a configured other plant.

    Args:
        settings: The configuration.
        laws: Kinds of laws, also of one's own.
        bits: Such as 8/6 or 10/6/6; `cont` for float64.
        sensors: Names out of SENSORS.
        winds: Names out of WINDS.
        plants: Kinds of plants, also of one's own.
        seeds: Runs of each combination, with seeds from 0 up.
        duration_s: Length of an experiment [s].
        within_deg: Bound of the attitude error, for the margins [deg].

    Raises:
        GridError: An unknown name.
        ConfigError, PluginError, LawError: A combination is no configuration, or has no such law.
    """
    bodies = plants or (PLANTS if settings.plant.kind == PLANTS[0] else (settings.plant.kind,))
    levels, airs = chosen("--sensors", sensors or ("encoders",), SENSORS), chosen("--wind", winds, WINDS)
    pairs = [str(bits_of_text(text)) for text in bits or BITS]
    kinds = dict.fromkeys(laws or (settings.law.kind, *LAWS))
    names = [name for kind in kinds for name in (kind, kind + _NO_GAMMA)[: 1 + (kind in WITHOUT_ADAPTATION)]]
    found = dict[Choice, Configuration]()
    for plant, sensor, pair, law, wind in product(bodies, levels, pairs, names, airs):
        choice, overrides = _chosen(settings, Choice(law, pair, sensor, wind, plant))
        if choice not in found:
            description = with_law_settings(load_over(settings, overrides)).description()
            found[choice] = Configuration(overrides, choice, digest_of(description, duration_s))
    axes = [Axis(name, ()) for name in Choice._fields]
    plan = SweepPlan(settings, axes, list(found.values()), seeds, duration_s)
    return Comparison(plan, list(found), _response(settings), within_deg)


def _chosen(settings: Settings, choice: Choice) -> tuple[Choice, tuple[str, ...]]:
    """A combination as it can be had, and its overrides: a body without joints has no encoders."""
    plant: dict[str, Any] = {"kind": choice.plant}
    wire: dict[str, Any] = {
        **{name: {"bits": bits} for name, bits in bits_of_text(choice.bits)._asdict().items()},
        "transmit": {"measurement": "on_change", "command": "on_change"},
    }
    body = settings.law
    if choice.plant not in PLANTS:
        choice = choice._replace(sensors=AS_CONFIGURED, wind=AS_CONFIGURED)
        with closing(load_over(settings, [f"plant.kind={choice.plant}"]).plant.make(settings.loop.period)) as made:
            wire["actuators"] = made.actuators
    elif settings.plant.ideal:
        choice = choice._replace(sensors=IDEAL, wind=IDEAL)
        plant |= {"sensors": {}, "wind": {}}
    else:
        plant |= {"sensors": dict(SENSORS[choice.sensors].changes), "wind": {"blowing": WINDS[choice.wind]}}
    if choice.plant == "rigid_body":
        rate = plant["sensors"].get("rate", "perfect")
        plant["sensors"] |= {"attitude": "perfect", "rate": "perfect" if rate == "derivative" else rate}
        choice = choice._replace(sensors={"encoders": "perfect"}.get(choice.sensors, choice.sensors))
        if settings.plant.kind != "rigid_body":
            body = body.model_copy(update={"allocation": three_motors(body.allocation)})
            same = {
                name: getattr(body, name) for name in ("inertia", "mass", "gravity", "centre_of_mass", "allocation")
            }
            plant["rigid_body"] = {**same, "damping": IDEAL_AERO.damping}
            plant["rotor"] = {"lag_up_s": 0.0, "lag_down_s": 0.0}
            plant["friction"] = {"viscous": [], "coulomb": []}
            plant["wind"]["torque"] = [0.0, *settings.plant.wind.torque[:2]]  # about y and z, as on the Aero
            wire["actuators"] = 3
    return choice, tuple(as_overrides({"wire": wire, "plant": plant, "law": _law(settings, choice.law, body)}))


def three_motors(allocation: Sequence[Sequence[float]]) -> list[list[float]]:
    """B of a free body like the Aero: its two motors, and one that rolls it as strongly as the others move it."""
    motors = [[float(value) for value in row[1:]] for row in allocation[1:]]
    strongest = max(abs(value) for row in motors for value in row)
    return [[strongest, 0.0, 0.0], *([0.0, *row] for row in motors)]


def _law(settings: Settings, name: str, body: Any) -> dict[str, Any]:
    """`[law]` of a law of this name, over the configuration's."""
    law, kind = settings.law, name.removesuffix(_NO_GAMMA)
    section: dict[str, Any] = {"allocation": [list(row) for row in body.allocation]}
    off = WITHOUT_ADAPTATION[kind] if kind != name else {}
    if (kind := off.get("kind", kind)) == law.kind:
        return section | off
    if kind in (*LAWS, "nonadaptive") and isinstance(law, EstimateSettings):  # what is known of the body's damping
        section |= {"damping_estimate": law.damping_estimate, "damping_bound": law.damping_bound}
    if kind in ("adaptive", "nonadaptive") and isinstance(law, AdaptiveSettings | NonadaptiveSettings):
        section |= {"C1": law.C1, "C2": law.C2}
    return {"kind": kind, **section, **tuned(kind, body, _response(settings)), **off}


def _response(settings: Settings) -> Response:
    """The response that the configured gains of the paper's law give; those of Table C.1, if it has none."""
    law = settings.law
    gains = law if isinstance(law, AdaptiveSettings | NonadaptiveSettings) else AdaptiveSettings()
    return response_of(law.inertia, gains.C1, gains.C2)


# ── the comparison ──


_MEANS: Final = ("z_track", "u_total", "command_changes_per_s")
_WORST: Final = ("max_error_deg", "second_half_error_deg")
_PROVEN: Final = ("pointwise_deg", "plant_deg", "holds")
_MARGINS: Final = {
    "delay_ms": "largest further delay of commands within the bound [ms]; null: none is",
    "lost_frames": "most commands lost in a row, again and again; null: none may be",
}


class Laws(BaseModel):
    """The comparison.

    A row has its `Choice`; of the law's certificate `holds`, pointwise_deg and plant_deg by the names of `Certificate`,
    all null of a law without a theorem; figures by the names of `Figures` (means over the seeds, and the largest errors
    of any); spread, standard deviations of the means over the seeds, null for one seed; bits_per_s of both directions,
    sent on change; and reason, why there are no figures: then all of them are None. A margin has law, plant, delay_ms
    and lost_frames: what the law survives, calm, with the first of bits and sensors.
    """

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
    rows: list[Row]
    margins: list[Row]
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
        SweepError, OutputError: As of `run_sweep`.
    """
    plan, choices, response, within_deg = comparison
    searched = dict[tuple[str, str], tuple[str, ...]]()  # calm, with the first of bits and sensors that a plant has
    for choice, configuration in zip(choices, plan.configurations, strict=True):
        calm = ("plant.wind.blowing=false",) if choice.wind in WINDS else ()
        searched.setdefault((choice.law, choice.plant), (*configuration.overrides, *calm))
    before, work = len(choices) * plan.seeds, partial(survived, within_deg=within_deg)
    total, searches = before + len(searched), [run_of(plan.settings, overrides) for overrides in searched.values()]
    with open_workers(engine) as workers:
        rows = sweep_rows(plan, workers, out, lambda done, _: progress(done, total))
        margins = workers.rows(work, searches, lambda done: progress(before + done, total))
    of = dict(zip(searched, margins, strict=True))
    if out is not None:
        further = (of[choice.law, choice.plant] for choice in choices for _ in range(plan.seeds))
        texts = {**_MARGINS, "within_deg": "bound of the attitude error, for the margins [deg]"}
        whole = [row | margin | {"within_deg": within_deg} for row, margin in zip(rows, further, strict=True)]
        write_table(out, plan, whole, texts)
    compared, gains = list[Row](), dict[str, dict[str, Any]]()
    for i, (choice, configuration) in enumerate(zip(choices, plan.configurations, strict=True)):
        settings = with_law_settings(load_over(plan.settings, configuration.overrides))
        if choice.plant == choices[0].plant:
            gains[choice.law] = settings.description()["law"]
        figures = _over_seeds(rows[i * plan.seeds : (i + 1) * plan.seeds])
        compared.append({**choice._asdict(), **_proven(settings), **figures})
    return Laws(
        duration_s=plan.duration_s,
        seeds=plan.seeds,
        bandwidth=list(response.bandwidth),
        damping_ratio=list(response.damping),
        period_ms=plan.settings.loop.period * 1e3,
        within_deg=within_deg,
        margin_duration_s=PUSHED_S,
        margin_at=f"{choices[0].bits} bits",
        gains=gains,
        rows=compared,
        margins=[{"law": law, "plant": plant, **of[law, plant]} for law, plant in searched],
        out=None if out is None else str(out),
    )


def _proven(settings: Settings) -> Row:
    """What is proven of a configuration."""
    try:
        certificate = certify(settings, margins=False)
    except (NoTheoremError, BoundlessError):
        return dict.fromkeys(_PROVEN)
    return {name: getattr(certificate, name, None) for name in _PROVEN}


def _over_seeds(rows: Sequence[Row]) -> Row:
    """Figures of a combination, of those of its seeds."""
    if reasons := [row["reason"] for row in rows if row["reason"] is not None]:
        several = f"{len(reasons)} of {len(rows)} seeds: " if len(rows) > 1 else ""
        return {**dict.fromkeys((*_MEANS, *_WORST, "bits_per_s", "spread")), "reason": f"{several}{reasons[0]}"}
    return {
        **{name: fmean(row[name] for row in rows) for name in _MEANS},
        **{name: max(row[name] for row in rows) for name in _WORST},
        "bits_per_s": fmean(row["measurement_bits_per_s"] + row["command_bits_per_s"] for row in rows),
        "spread": {name: stdev(row[name] for row in rows) for name in _MEANS} if len(rows) > 1 else None,
        "reason": None,
    }


# ── margins of any law on any plant: runs frame by frame, without a watchdog ──

OLDEST_S: Final = 1.0
"""No search goes beyond this age of a command [s]."""
PUSHED_S: Final = 10.0
"""Length of a run with delay or lost frames [s]."""


def survived(settings: Settings, within_deg: float) -> Row:
    """The longest delay [ms], and the most frames lost in a row, with which the error stays within the bound.

    None if none is. It looks no further than a second.
    """
    settings = with_law_settings(settings)
    most, guess = settings.loop.ticks(OLDEST_S), settings.loop.ticks(0.1)
    delay = last_good(lambda ticks: largest_error_deg(settings, delay=ticks) <= within_deg, guess, most)
    lost = last_good(lambda ticks: largest_error_deg(settings, lost=ticks) <= within_deg, guess, most)
    delay_ms = None if delay is None else round(delay * settings.loop.period * 1e3, 6)
    return {"delay_ms": delay_ms, "lost_frames": lost}


def last_good(good: Callable[[int], bool], guess: int, most: int) -> int | None:
    """The last number that is good, if all larger ones are not, by bisection from a guess.

    None if 0 is not good, `most` if none is found to be bad by doubling the guess up to it.
    """
    low, high = 0, max(1, guess)
    while good(high):
        low, high = high, 2 * high
        if high > most:
            return most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if good(middle) else (low, middle)
    return low if low or good(0) else None


def largest_error_deg(settings: Settings, delay: int = 0, lost: int = 0) -> float:
    """The largest attitude error in the second half of a run [deg]; infinite if the plant trips or the law fails."""
    try:
        with closing(Late(settings.plant.make(settings.loop.period), delay, lost)) as plant:
            found = run_experiment(settings, PUSHED_S, plant=plant).second_half_error_deg
    except (AeroloopError, ValueError):
        return inf
    return inf if found is None else found


class Late(Plant):
    """A plant whose commands act `delay` ticks later, and of which `lost` in a row never do."""

    def __init__(self, plant: Plant, delay: int, lost: int) -> None:
        self.actuators = plant.actuators
        self._plant, self._every = plant, lost + 1
        self._due = deque([(0.0,) * plant.actuators] * delay)
        self._ticks = 0

    def actuate(self, voltages: Sequence[float]) -> None:
        """Take the command of a tick; the one that is due replaces the one in force."""
        self._due.append(tuple(voltages))
        due = self._due.popleft()
        if self._ticks % self._every == 0:
            self._plant.actuate(due)
        self._ticks += 1

    def advance(self) -> None:
        """Integrate one period."""
        self._plant.advance()

    def measure(self) -> Measurement:
        """Sensor values at the end of the last period."""
        return self._plant.measure()

    def close(self) -> None:
        """0 V."""
        self._plant.close()


# ── as text ──

_COLUMNS: Final = (
    Column("z_track 10⁻⁴ s", "z_track", "{:.1f}", 1e4),
    Column("u_total V²·s", "u_total", "{:.0f}"),
    Column("settled", "second_half_error_deg", "{:.2f}°"),
    Column("changes/s", "command_changes_per_s", "{:.0f}"),
    Column("kbit/s", "bits_per_s", "{:.1f}", 1e-3),
)
_SURVIVED: Final = (
    Column("delay", "delay_ms", "{:g} ms", missing="none"),
    Column("frames lost in a row", "lost_frames", "{}", missing="none"),
)
_BOUND: Final = Column("bound", "pointwise_deg", "{:.2f}°")
_HOLDS: Final = {True: "holds", False: "no", None: "–"}


def sheets(laws: Laws) -> Sheets:
    """A table for each plant, its sensors and bits: a line is a law, with what it survives where that was searched."""
    margins = {(each["law"], each["plant"]): each for each in laws.margins}
    plants = set[str]()
    for (plant, sensors, bits), found in groupby(laws.rows, itemgetter("plant", "sensors", "bits")):
        rows, first = list(found), plant not in plants
        plants.add(plant)
        of_law = {law: list(each) for law, each in groupby(rows, itemgetter("law"))}
        lines = []
        for law, each in of_law.items():
            cells = {"law": law, "bound": _BOUND.text(each[0])}
            cells["certificate"] = "; ".join(dict.fromkeys(_HOLDS[row["holds"]] for row in each))
            cells |= {column.title: "; ".join(map(column.text, each)) for column in _COLUMNS}
            if first:
                cells |= {column.title: column.text(margins[law, plant]) for column in _SURVIVED}
            lines.append(cells)
        winds = "; ".join(dict.fromkeys(row["wind"] for row in rows))
        yield f"{plant} · sensors: {sensors} · {bits} bits · {winds}", lines
        failed = [f"{row['law']}, {row['wind']}: {row['reason']}" for row in rows if row["reason"] is not None]
        if failed:
            yield "\n".join(failed), []
    yield from ((note, []) for note in _notes(laws))


def _notes(laws: Laws) -> list[str]:
    bandwidth, damping = (
        "/".join(dict.fromkeys(f"{value:.2f}" for value in values)) for values in (laws.bandwidth, laws.damping_ratio)
    )
    seeds = f"means of seeds 0 to {laws.seeds - 1}" if laws.seeds > 1 else "seed 0"
    notes = [
        f"Tuned to ωₙ = {bandwidth} rad/s and ζ = {damping} of the linearised error, which the paper's gains have "
        "(service/control/laws/README.md has the rule); a law of your own, and the configured one, as configured. "
        "Γ = 0: the same law without adaptation.",
        "Bound: proven of the error at every instant, in the end, for the paper's body; certificate: whether one is "
        "proven of this plant, too (lab certify says what fails); – without a theorem, or without a set.",
        f"{laws.duration_s:g} s each, {seeds}, sent on change. Settled is the largest error of the second half, of any "
        f"seed. Survived with an error within {laws.within_deg:g}°, calm, for {laws.margin_duration_s:g} s, without a "
        "watchdog: commands that act later, or of which so many in a row never do, again and again, up to 1 s.",
    ]
    return notes if laws.out is None else [*notes, f"All experiments: {laws.out}"]


# ── as a figure ──

_SHAPES: Final = "osD^vP"
_PANELS: Final = (
    (r"$z_\mathrm{track}$ [$10^{-4}$ s]", "z_track", 1e4, True),
    ("settled error [°]", "second_half_error_deg", 1, True),
    (r"$u_\mathrm{total}$ [V²·s]", "u_total", 1, False),
    ("changes of commands [1/s]", "command_changes_per_s", 1, True),
)
"""Label, figure, its factor, and whether the axis is logarithmic."""


def draw_laws(laws: Laws, path: Path) -> None:
    """Draw the comparison into a file: a row of panels for each plant and its sensors, a line of marks for each law.

    Colour is calm or wind, a shape the bits. A full bar is the delay that a law survives, a hollow one the frames lost
    in a row, with their periods. A law without figures has a cross. Raises OutputError if the file's name is wrong, or
    it cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    from aeroloop.service.report.figure_style import BLACK, BLUE, ORANGE, WIDTH_IN, figure_style, logarithmic, save_as

    kinds, bits, winds = (list(dict.fromkeys(row[name] for row in laws.rows)) for name in ("law", "bits", "wind"))
    shapes = dict(zip(bits, cycle(_SHAPES), strict=False))
    colours = {wind: {"calm": BLUE, "wind": ORANGE}.get(wind, BLACK) for wind in winds}
    places = dict.fromkeys((row["plant"], row["sensors"]) for row in laws.rows)
    with figure_style():
        height = 0.7 + len(places) * (0.75 + 0.17 * len(kinds))
        figure = Figure(figsize=(WIDTH_IN[2], height), layout="constrained")
        panels = figure.subplots(len(places), len(_PANELS) + 1, sharey=True, squeeze=False)
        for line, place in zip(panels, places, strict=True):
            found = [row for row in laws.rows if (row["plant"], row["sensors"]) == place]
            for panel, (label, name, factor, is_logarithmic) in zip(line, _PANELS, strict=False):
                if is_logarithmic and any(row[name] for row in found):
                    logarithmic(panel, "x", (1, 2, 5))
                panel.set_xlabel(label)
                for row in found:
                    y = kinds.index(row["law"]) + (0.13 if row["wind"] == "wind" else -0.13)  # so that none is covered
                    hollow = marks(colours[row["wind"]], face="none")
                    if row["reason"] is not None:
                        panel.plot(0.97, y, "x", transform=panel.get_yaxis_transform(), **hollow)
                    else:
                        panel.plot(row[name] * factor, y, shapes[row["bits"]], **hollow)
            for margin in laws.margins:
                if margin["plant"] == place[0]:
                    y, lost_ms = kinds.index(margin["law"]), (margin["lost_frames"] or 0) * laws.period_ms
                    for offset, length, face in ((-0.14, margin["delay_ms"] or 0, "0.75"), (0.14, lost_ms, "white")):
                        line[-1].barh(y + offset, length, height=0.24, color=face, edgecolor="0.4", linewidth=0.5)
            line[-1].set_xlabel("survived [ms]")
            line[0].set_yticks(range(len(kinds)), kinds)
            line[0].set_ylim(len(kinds) - 0.4, -0.6)
            line[0].set_ylabel(", ".join(place))
        bars = (("0.75", "delay"), ("white", "frames lost in a row"))
        failed = ["did not last"] if any(row["reason"] for row in laws.rows) else []
        legend = [
            *(Line2D([], [], color=colour, linewidth=4, label=wind) for wind, colour in colours.items()),
            *(Line2D([], [], marker=shape, label=f"{of} bits", **marks("0.4")) for of, shape in shapes.items()),
            *(Patch(facecolor=face, edgecolor="0.4", linewidth=0.5, label=label) for face, label in bars),
            *(Line2D([], [], marker="x", label=label, **marks("0.4")) for label in failed),
        ]
        figure.legend(handles=legend, loc="outside lower center", ncols=6)
        save_as(figure, path)
