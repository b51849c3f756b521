"""`lab burden`: error against bits over a grid of bits, quantizers and sensors, sent on change and at every tick.

Each cell is one lockstep experiment that sends on change. An end that receives no frame holds its last levels, so the
run is the same to the last bit where every tick sends, and that traffic is the size of the frames times the rate. Every
figure is compared with that of float64 at every tick under the same sensors. On the Pareto front of the cells under the
same sensors are those that no other cell beats in error without more bits, or in bits without more error.

Bits range from those at which the loop begins to shake to those beyond which more gain nothing. Sensors range from
perfect ones to a gyro with noise wider than a step: noise, more than motion, changes a level from one tick to the
next. So besides one kind of quantizer for all signals, one choice has hysteresis on the noisy signal alone, the rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import product
from math import log10
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.spec import Kind, SignalBits
from aeroloop.service.config import ConfigError, Settings, from_description
from aeroloop.service.lab.engine import PROCESSES, Progress, Row, Sheets, cell, figures_row, open_workers, run_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BITS: Final = ("6/4", "7/5", "8/6", "9/7", "10/8", "12/10")
QUANTIZERS: Final[dict[str, tuple[Kind, Kind, Kind]]] = {
    **{kind: (kind, kind, kind) for kind in get_args(Kind)},
    "hysteresis-rate": ("uniform", "hysteresis-uniform", "uniform"),
}
"""Kinds for ε, ω and u, by the name of the choice."""
FLOAT64: Final = SignalBits(None, None, None)
SENSORS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "perfect": (
        "the true attitude and rate, so that only quantizers come between the body and the law",
        {"attitude": "perfect", "rate": "perfect"},
    ),
    "encoders": (
        "encoders and their filtered derivative, as on the paper's bench",
        {"attitude": "encoders", "rate": "derivative"},
    ),
    "gyro": (
        "encoders and a gyro with 2 mrad/s of noise, as MEMS gyros have at rest; a quarter of the 8-bit step",
        {"attitude": "encoders", "rate": "gyro", "gyro_noise": 0.002},
    ),
    "shaken-gyro": (
        "encoders and a gyro with 20 mrad/s of noise, as of one that the rotors shake; 2.5 steps of 8 bits",
        {"attitude": "encoders", "rate": "gyro", "gyro_noise": 0.02},
    ),
}
"""What they are, and fields of `plant.sensors`; others stay as configured. A body without joints has no encoders."""


class GridError(AeroloopError):
    """The cells cannot be run or compared; one line with the reason."""


class BurdenCell(NamedTuple):
    """One experiment."""

    bits: SignalBits
    quantizer: str | None  # None where nothing is quantized
    sensors: str


def grid(settings: Settings, bits: Sequence[str] = (), quantizers: Sequence[str] = ()) -> dict[BurdenCell, Settings]:
    """The configuration of every cell, under all sensors that the plant can have, float64 always among them.

    Args:
        settings: The configuration.
        bits: Such as 8/6 or 10/6/6; `cont` for float64; all of `BITS` if none.
        quantizers: Names out of `QUANTIZERS`; all if none.

    Raises:
        GridError: An unknown name, or a cell that the configuration does not allow.
    """
    try:
        pairs = dict.fromkeys(map(SignalBits.parse, bits or BITS))
    except ValueError as error:
        raise GridError(f"--bits: {error}") from None
    for name in quantizers:
        if name not in QUANTIZERS:
            raise GridError(f"--quantizer takes {', '.join(QUANTIZERS)}, not {name!r}")
    kinds = dict.fromkeys(quantizers or QUANTIZERS)
    levels = [name for name in SENSORS if settings.plant.kind == "aero" or name == "perfect"]
    choices: list[tuple[SignalBits, str | None]] = [each for each in product(pairs, kinds) if each[0] != FLOAT64]
    cells = [BurdenCell(*choice, level) for level in levels for choice in [*choices, (FLOAT64, None)]]
    return {each: _cell_settings(settings, each) for each in cells}


def _cell_settings(settings: Settings, chosen: BurdenCell) -> Settings:
    tree = settings.description()
    kinds = QUANTIZERS[chosen.quantizer] if chosen.quantizer else (None, None, None)
    for name, bits, kind in zip(chosen.bits._fields, chosen.bits, kinds, strict=True):
        signal = tree["wire"][name]
        if kind not in (None, signal["kind"]):  # parameters of a quantizer are not another's
            signal = {"limit": signal["limit"], "kind": kind}
        tree["wire"][name] = {**signal, "bits": bits}
    tree["wire"]["transmit"] |= {"measurement": "on_change", "command": "on_change"}
    tree["plant"]["sensors"] |= SENSORS[chosen.sensors][1]
    try:
        return from_description(tree)
    except ConfigError as error:  # such as too few bits for the quantizer
        raise GridError(f"{chosen.bits} {chosen.quantizer or 'float64'}, sensors {chosen.sensors}: {error}") from None


# ── what is measured ──


class Burden(BaseModel):
    """The grid.

    A point has its cell (bits as `--bits` takes them), the figures of `engine.figures_row`; every_tick_bits_per_s and
    bits_per_s, the payload of both directions, padding included, at every tick and on change; against_float64,
    z_track, and both of these, over those of float64 at every tick under the same sensors; and pareto, whether it is on
    the front of z_track against bits_per_s. Where it has a reason, other figures are None.
    """

    model_config = ConfigDict(frozen=True)

    duration_s: float = Field(description="length of each experiment [s]")
    rate_hz: float = Field(description="ticks a second [Hz]")
    sensors: dict[str, str] = Field(description="meaning of each name")
    points: list[Row]

    def under(self, sensors: str) -> list[Row]:
        """The points with these sensors."""
        return [point for point in self.points if point["sensors"] == sensors]


def measure_burden(
    settings: Settings,
    cells: dict[BurdenCell, Settings],
    duration_s: float,
    progress: Progress = lambda _done, _total: None,
    engine: str = PROCESSES,
) -> Burden:
    """Run a grid on every worker.

    Args:
        settings: The configuration.
        cells: As of `grid`.
        duration_s: Length of each experiment [s].
        progress: Called with experiments done and experiments in all.
        engine: As of `open_workers`.

    Raises:
        GridError: The loop trips with float64, or float64 has no error to compare with.
    """
    runs, work = list(map(run_of, cells.values())), partial(figures_row, duration_s=duration_s)
    with open_workers(engine) as workers:
        rows = workers.rows(work, runs, lambda done: progress(done, len(runs)))
    points = [_point(*each, row) for each, row in zip(cells.items(), rows, strict=True)]
    sensors = dict.fromkeys(point["sensors"] for point in points)
    for name in sensors:
        _compare([point for point in points if point["sensors"] == name], name)
    texts = {name: SENSORS[name][0] for name in sensors}
    return Burden(duration_s=duration_s, rate_hz=settings.loop.rate_hz, sensors=texts, points=points)


def _point(chosen: BurdenCell, settings: Settings, row: Row) -> Row:
    has_figures, wire = row["reason"] is None, settings.wire
    always = (wire.measurement.size + wire.command.size) * 8 * settings.loop.rate_hz
    return {
        **chosen._asdict(),
        "bits": str(chosen.bits),
        **row,
        "every_tick_bits_per_s": always,
        "bits_per_s": row["measurement_bits_per_s"] + row["command_bits_per_s"] if has_figures else None,
        "against_float64": None,
        "pareto": False,
    }


def _compare(points: Sequence[Row], sensors: str) -> None:
    """Compare the points with the same sensors with float64, and with each other."""
    [baseline] = [point for point in points if point["quantizer"] is None]
    if baseline["reason"] is not None:
        raise GridError(f"float64 itself does not keep the loop running, sensors {sensors}: {baseline['reason']}")
    if not baseline["z_track"]:
        raise GridError(f"float64 makes no error, sensors {sensors}: nothing to compare with; let the reference move")
    done = [point for point in points if point["reason"] is None]
    of = {"z_track": "z_track", "every_tick_bits_per_s": "every_tick_bits_per_s", "bits_per_s": "every_tick_bits_per_s"}
    for point, on_it in zip(done, pareto_front((p["bits_per_s"], p["z_track"]) for p in done), strict=True):
        point["pareto"] = on_it
        point["against_float64"] = {name: point[name] / baseline[base] for name, base in of.items()}


def pareto_front(costs: Iterable[tuple[float, float]]) -> list[bool]:
    """Which pairs no other pair beats: as low in both and lower in one."""
    pairs = list(costs)
    return [not any(a <= x and b <= y and (a, b) != (x, y) for a, b in pairs) for x, y in pairs]


# ── as text ──


def sheets(burden: Burden) -> Sheets:
    """A table for each of the sensors, a row an experiment; a missing figure is a dash, with the reason below."""
    for name, text in burden.sensors.items():
        points = burden.under(name)
        yield f"sensors {name}: {text}", list(map(_row, points))
        reasons = [f"{point['bits']} {_short(point)}: {point['reason']}." for point in points if point["reason"]]
        if reasons:
            yield "\n".join(reasons), []
    yield (
        f"{burden.duration_s:g} s each, at {burden.rate_hz:g} Hz; of two numbers the first is measurements, the second "
        "commands; × and % are of float64 at every tick; ★ is on the Pareto front of z_track against bits on change.",
        [],
    )


def _short(point: Row) -> str:
    """Name of a point's quantizer in a table or a legend."""
    kind: str = point["quantizer"] or "float64"
    return "hysteresis on ω" if kind == "hysteresis-rate" else kind.removesuffix("-uniform")


def _row(point: Row) -> dict[str, str]:
    ratios = point["against_float64"] or dict.fromkeys(("z_track", "every_tick_bits_per_s", "bits_per_s"))
    frames = [cell(point[f"{name}_frames_per_s"], "{:.0f}") for name in ("measurement", "command")]
    return {
        "bits out/in": point["bits"],
        "quantizer": _short(point),
        "z_track, 10⁻⁴ s": cell(point["z_track"], "{:.1f}", 1e4) + cell(ratios["z_track"], " (×{:.2f})", missing=""),
        "u_total, V²·s": cell(point["u_total"], "{:.0f}"),
        "every tick: kbit/s": cell(point["every_tick_bits_per_s"], "{:.1f}", 1e-3)
        + cell(ratios["every_tick_bits_per_s"], " ({:.0f}%)", 100, missing=""),
        "on change: frames/s": " + ".join(frames),
        "on change: kbit/s": f"{'★ ' if point['pareto'] else ''}{cell(point['bits_per_s'], '{:.1f}', 1e-3)}"
        + cell(ratios["bits_per_s"], " ({:.1f}%)", 100, missing=""),
    }


# ── as a figure ──


def draw_burden(burden: Burden, path: Path) -> None:
    """Draw error against payload bits a second into a file, a panel for each of the sensors, both axes logarithmic.

    Colour and shape mark the quantizer; a full marker is sent on change, a hollow one at every tick. A line joins the
    Pareto front, its points labelled with bits out/in; dotted lines mark float64 at every tick. Raises OutputError if
    the file's name is wrong, or it cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from aeroloop.service.report import plots as style

    colours = style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.BLACK
    looks = dict(zip([*QUANTIZERS, None], zip(colours, "os^pD", strict=True), strict=True))
    columns = min(2, len(burden.sensors))
    rows = -(-len(burden.sensors) // columns)
    with style.figure_style():
        figure = Figure(figsize=(style.WIDTH_IN[columns], 0.75 + 2.5 * rows), layout="constrained")
        panels: list[Axes] = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flatten().tolist()
        for panel, name in zip(panels, burden.sensors, strict=True):
            style.logarithmic(panel, "x", (1, 2, 3, 5))
            style.logarithmic(panel, "y", (1, 2, 3, 5))
            _draw(panel, [point for point in burden.under(name) if point["reason"] is None], looks)
            panel.text(0.97, 0.95, f"sensors: {name}", transform=panel.transAxes, ha="right", va="top")
        figure.supxlabel("payload of measurements and commands [kbit/s]", fontsize="medium")
        figure.supylabel(r"$z_\mathrm{track}$ [$10^{-4}$ s]", fontsize="medium")
        drawn = {_short(point): looks[point["quantizer"]] for point in burden.points}
        legend = [
            *(Line2D([], [], marker=marker, label=name, **_marks(c, face=c)) for name, (c, marker) in drawn.items()),
            Line2D([], [], marker="o", label="sent on change", **_marks("0.4", face="0.4")),
            Line2D([], [], marker="o", label="sent at every tick", **_marks("0.4")),
            Line2D([], [], color="0.45", linewidth=0.9, label="Pareto front, bits out/in"),
            Line2D([], [], color="0.3", linewidth=0.6, linestyle=":", label="float64 at every tick"),
        ]
        figure.legend(handles=legend, loc="outside lower center", ncols=3)
        style.save_as(figure, path)


def _marks(color: str, face: str = "white") -> dict[str, Any]:
    return {"color": color, "markerfacecolor": face, "linestyle": "none", "markersize": 4}


def _draw(panel: Axes, points: list[Row], looks: dict[str | None, tuple[str, str]]) -> None:
    ahead = [point for point in points if point["pareto"]]
    front = sorted(((one["bits_per_s"] / 1e3, 1e4 * one["z_track"], one) for one in ahead), key=lambda each: each[:2])
    panel.plot(*zip(*(place for *place, _ in front), strict=True), color="0.45", linewidth=0.9, zorder=2)
    for point in points:
        (color, marker), error = looks[point["quantizer"]], 1e4 * point["z_track"]
        always, order = point["every_tick_bits_per_s"] / 1e3, 4 if point["pareto"] else 3
        panel.plot(always, error, marker, zorder=3, **_marks(color))
        panel.plot(point["bits_per_s"] / 1e3, error, marker, zorder=order, **_marks(color, color))
        if point["quantizer"] is None:
            panel.axvline(always, color="0.3", linewidth=0.6, linestyle=":", zorder=1)
            panel.axhline(error, color="0.3", linewidth=0.6, linestyle=":", zorder=1)
    labelled = list[tuple[float, float]]()  # to the lower left, where no point is
    for x, y, point in front:
        if all(abs(log10(x / other)) >= 0.2 or abs(log10(y / above)) >= 0.055 for other, above in labelled):
            labelled.append((x, y))
            label = point["bits"] if point["quantizer"] else "float64"
            panel.annotate(label, (x, y), xytext=(-4, -4), textcoords="offset points", ha="right", va="top", fontsize=6)
