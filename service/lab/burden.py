"""`lab burden`: error against bits over a grid of bits, quantizers, transmit policies and sensors.

Each cell is one lockstep experiment. Both policies give the same run to the last bit, because an end that receives no
frame holds its last levels; so a cell runs once, and its codes give the traffic of both. Every figure is compared with
that of float64 at every tick under the same sensors. On the Pareto front of the points under the same sensors are those
that no other point beats in error without more bits, or in bits without more error.

Bits range from those at which the loop begins to shake to those beyond which more gain nothing. Sensors range from
perfect ones to a gyro with noise wider than a step: noise, more than motion, changes a level from one tick to the
next. So besides one kind of quantizer for all signals, one choice has hysteresis on the noisy signal alone, the rate.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from math import log10
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.transport.can_format import CLASSIC_BYTES
from aeroloop.protocol.wire.frames import MIN_COUNTER_BITS, FrameFormat
from aeroloop.protocol.wire.spec import Kind, SignalBits, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Policy, Transmit
from aeroloop.protocol.wording import problem
from aeroloop.service.config import Settings
from aeroloop.service.figures import Floats, Integers
from aeroloop.service.lab.experiment import LoopEndedError, experiment, heartbeat_of, sent_ticks
from aeroloop.service.lab.sweep import PROCESSES, Progress, Row, Sheets, open_workers, run_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# ── the grid ──

BITS: Final = ("6/4", "7/5", "8/6", "9/7", "10/8", "12/10")
FLOAT64: Final = SignalBits(None, None, None)
QUANTIZERS: Final[dict[str, tuple[Kind, Kind, Kind]]] = {
    **{kind: (kind, kind, kind) for kind in get_args(Kind)},
    "hysteresis-rate": ("uniform", "hysteresis-uniform", "uniform"),
}
"""Kinds for ε, ω and u, by the name of the choice."""
POLICIES: Final[tuple[Policy, ...]] = get_args(Policy)


class GridError(AeroloopError):
    """The cells cannot be run or compared; one line with the reason."""


class SensorChoice(NamedTuple):
    """A choice of sensors: a description for a person, and fields of `plant.sensors`."""

    text: str
    changes: dict[str, Any]


SENSORS: Final = {
    "perfect": SensorChoice(
        "the true attitude and rate, so that only quantizers come between the body and the law",
        {"attitude": "perfect", "rate": "perfect"},
    ),
    "encoders": SensorChoice(
        "encoders and their filtered derivative, as on the paper's bench",
        {"attitude": "encoders", "rate": "derivative"},
    ),
    "gyro": SensorChoice(
        "encoders and a gyro with 2 mrad/s of noise, as MEMS gyros have at rest; a quarter of the 8-bit step",
        {"attitude": "encoders", "rate": "gyro", "gyro_noise": 0.002},
    ),
    "shaken-gyro": SensorChoice(
        "encoders and a gyro with 20 mrad/s of noise, as of one that the rotors shake; 2.5 steps of 8 bits",
        {"attitude": "encoders", "rate": "gyro", "gyro_noise": 0.02},
    ),
}
"""Other fields of `plant.sensors` stay as configured."""


class BurdenCell(NamedTuple):
    """One experiment. Bits of None are float64; the quantizer is None where nothing is quantized."""

    bits_out: int | None  # of ε
    bits_rate: int | None
    bits_in: int | None
    quantizer: str | None
    sensors: str


def grid(
    settings: Settings, bits: Sequence[str] = (), quantizers: Sequence[str] = (), sensors: Sequence[str] = ()
) -> list[BurdenCell]:
    """The cells of a grid, always with float64. An empty argument selects all.

    Args:
        settings: The configuration.
        bits: Such as 8/6 or 10/6/6; `cont` for float64.
        quantizers: Names out of QUANTIZERS.
        sensors: Names out of SENSORS.

    Raises:
        GridError: An unknown name, or a cell that the configuration does not allow.
    """
    pairs = [pair for pair in dict.fromkeys(map(bits_of_text, bits or BITS)) if pair != FLOAT64]
    kinds = chosen("--quantizer", quantizers, QUANTIZERS)
    levels = chosen("--sensors", sensors, SENSORS)
    choices: list[tuple[SignalBits, str | None]] = [*product(pairs, kinds), (FLOAT64, None)]
    cells = [BurdenCell(*pair, kind, level) for level in levels for pair, kind in choices]
    for cell in cells:
        cell_settings(settings, cell)
    return cells


def cell_settings(settings: Settings, cell: BurdenCell) -> Settings:
    """The configuration of a cell, sending at every tick.

    Raises:
        GridError: The bits are too few for the quantizer, or the plant has no such sensors.
    """
    wire, plant = settings.wire, settings.plant
    kinds = QUANTIZERS[cell.quantizer] if cell.quantizer else (None, None, None)
    signals = {"attitude": cell.bits_out, "rate": cell.bits_rate, "voltage": cell.bits_in}
    try:
        chosen = WireSpec(
            **{
                name: _quantized(getattr(wire, name), bits, kind)
                for (name, bits), kind in zip(signals.items(), kinds, strict=True)
            },
            actuators=wire.actuators,
            transmit=Transmit(heartbeat_s=wire.transmit.heartbeat_s),
            counter_bits=wire.counter_bits,
        )
        sensors = plant.sensors.model_copy(update=SENSORS[cell.sensors].changes)
        measured = type(plant).model_validate({**plant.model_dump(), "sensors": sensors.model_dump()})
    except ValidationError as error:
        why = problem(error, SignalSpec, WireSpec, type(plant))
        name = f"{SignalBits(*cell[:3])} {cell.quantizer or 'float64'}"
        raise GridError(f"{name} with sensors {cell.sensors}: {why}") from None
    return settings.model_copy(update={"wire": chosen, "plant": measured})


def _quantized(signal: SignalSpec, bits: int | None, kind: Kind | None) -> SignalSpec:
    """A signal with other bits and another quantizer; parameters stay if the kind stays."""
    if kind in (None, signal.kind):
        return signal.with_bits(bits)
    return SignalSpec(bits=bits, limit=signal.limit, kind=kind)


def bits_of_text(text: str) -> SignalBits:
    """Bits as `--bits` takes them, such as 8/6, 10/6/6 or cont. Raises GridError."""
    try:
        return SignalBits.parse(text)
    except ValueError as error:
        raise GridError(f"--bits: {error}") from None


def chosen(option: str, names: Sequence[str], choices: Collection[str]) -> list[str]:
    """The names without repetitions, or all choices if there are none. Raises GridError if one is no choice."""
    for name in names:
        if name not in choices:
            raise GridError(f"{option} takes {', '.join(choices)}, not {name!r}")
    return list(dict.fromkeys(names or choices))


# ── points ──


class Burden(BaseModel):
    """The grid. A point is one cell under one policy.

    A point has its cell (bits of None are float64), transmit, z_track [s], u_total [V²·s], measurement and command as
    `traffic` has them, of both together bits_per_s (padding included), can_bits_per_s and can_load; against_float64,
    these figures over those of float64 at every tick under the same sensors; pareto, whether it is on the front of
    z_track against bits_per_s; and reason, why there are no figures: then all of them are None.
    """

    model_config = ConfigDict(frozen=True)

    duration_s: float = Field(description="length of each experiment [s]")
    rate_hz: float = Field(description="ticks a second [Hz]")
    heartbeat_s: float = Field(description="on_change: the longest from one frame to the next [s]")
    counter_bits: int = Field(description="bits of the counter in each frame")
    sensors: dict[str, str] = Field(description="meaning of each name")
    points: list[Row]

    def under(self, sensors: str) -> list[Row]:
        """The points with these sensors."""
        return [point for point in self.points if point["sensors"] == sensors]


def measure_burden(
    settings: Settings,
    cells: Sequence[BurdenCell],
    duration_s: float,
    progress: Progress = lambda _done, _total: None,
    engine: str = PROCESSES,
) -> Burden:
    """Run a grid on every worker.

    Args:
        settings: The configuration; each cell overrides its own fields.
        cells: Cells to run, with float64 for each of the sensors.
        duration_s: Length of each experiment [s].
        progress: Called with experiments done and experiments in all.
        engine: As of `open_workers`.

    Raises:
        GridError: The loop trips with float64, or float64 has no error to compare with; or a cell does not fit the
            configuration.
    """
    runs = [run_of(cell_settings(settings, cell)) for cell in cells]
    progress(0, len(runs))
    with open_workers(engine) as workers:
        observed = workers.rows(partial(observe, duration_s=duration_s), runs, lambda done: progress(done, len(runs)))
    points = [cell._asdict() | row for cell, rows in zip(cells, observed, strict=True) for row in rows]
    sensors = dict.fromkeys(cell.sensors for cell in cells)
    return Burden(
        duration_s=duration_s,
        rate_hz=settings.loop.rate_hz,
        heartbeat_s=heartbeat_of(settings) * settings.loop.period,
        counter_bits=settings.wire.counter_bits,
        sensors={name: SENSORS[name].text for name in sensors},
        points=[
            point
            for name in sensors
            for point in _compared([point for point in points if point["sensors"] == name], name)
        ],
    )


_FIGURES: Final = ("z_track", "u_total", "measurement", "command", "bits_per_s", "can_bits_per_s", "can_load")


def observe(settings: Settings, duration_s: float) -> list[Row]:
    """Run one cell, which sends at every tick, for `duration_s` [s]: its point under each policy."""
    wire, period, heartbeat = settings.wire, settings.loop.period, heartbeat_of(settings)
    try:
        figures, course, _ = experiment(settings, duration_s)
    except LoopEndedError as error:
        return [{"transmit": policy, **dict.fromkeys(_FIGURES), "reason": str(error)} for policy in POLICIES]
    rows = []
    for policy in POLICIES:
        out, inp = (
            traffic(codes, kind, sent_ticks(codes, policy, heartbeat), period)
            for codes, kind in ((course.measured, wire.measurement), (course.commanded, wire.command))
        )
        both = [out[name] + inp[name] for name in _FIGURES[4:]]
        values = figures.z_track, figures.u_total, out, inp, *both
        rows.append({"transmit": policy, **dict(zip(_FIGURES, values, strict=True)), "reason": None})
    return rows


def traffic(codes: Floats, kind: FrameFormat, sent: Integers, period: float) -> Row:
    """The traffic of one direction under one policy.

    Changes are those of a code, of all components together and one by one: ε₁ ε₂ ε₃ ω₁ ω₂ ω₃, or u in order. Intervals
    are None for less than two frames. On a classic bus of 1 Mbit/s, with worst-case stuffing, can_load above 1 does not
    fit; can_frames above 1 is a split, without any header, of what this project sends as one CAN FD frame.

    Args:
        codes: Codes at every tick from 0 on. Shape (ticks, components).
        kind: Format of the frames.
        sent: Ticks at which a frame was sent.
        period: Time between ticks [s].
    """
    duration = len(codes) * period
    changes = np.count_nonzero(np.diff(codes, axis=0), axis=0) / duration
    intervals = np.diff(sent) * (period * 1e3)
    full, rest = divmod(kind.size, CLASSIC_BYTES)
    split = [CLASSIC_BYTES] * full + [rest] * (rest > 0)
    on_bus = len(sent) * sum(map(classic_frame_bits, split)) / duration
    return {
        "frames_per_s": len(sent) / duration,
        "bits_per_s": len(sent) * kind.size * 8 / duration,  # payload, padding included
        "changes_per_s": float(changes.sum()),
        "component_changes_per_s": changes.tolist(),
        "mean_interval_ms": float(intervals.mean()) if len(intervals) else None,
        "least_interval_ms": float(intervals.min()) if len(intervals) else None,
        "can_frames": len(split),
        "can_bits_per_s": on_bus,
        "can_load": on_bus / 1e6,
    }


def classic_frame_bits(data_bytes: int) -> int:
    """Bits of one classic CAN frame of 0…8 data bytes with worst-case stuffing, interframe space included.

    Besides its data, a frame with an 11-bit identifier has 34 bits under stuffing and 13 without. After five equal bits
    the sender stuffs an opposite one, so at worst one bit is added for every four after the first (Davis, Burns, Bril
    and Lukkien, Controller Area Network schedulability analysis, 2007).
    """
    stuffed = 34 + 8 * data_bytes
    return stuffed + (stuffed - 1) // 4 + 13


def pareto_front(costs: Iterable[tuple[float, float]]) -> list[bool]:
    """Which pairs no other pair beats: as low in both and lower in one."""
    pairs = list(costs)
    return [not any(a <= x and b <= y and (a, b) != (x, y) for a, b in pairs) for x, y in pairs]


def _compared(points: Sequence[Row], sensors: str) -> list[Row]:
    """The points with the same sensors, compared with their baseline and with each other."""
    [baseline] = [point for point in points if _is_baseline(point)]
    if baseline["reason"] is not None:
        raise GridError(f"float64 itself does not keep the loop running, sensors {sensors}: {baseline['reason']}")
    if not (baseline["z_track"] and baseline["u_total"]):
        raise GridError(f"float64 makes no error, sensors {sensors}: nothing to compare with; let the reference move")
    done = [point for point in points if point["reason"] is None]
    front = iter(pareto_front((point["bits_per_s"], point["z_track"]) for point in done))
    names = ("z_track", "u_total", "bits_per_s", "can_bits_per_s")
    compared = []
    for point in points:
        has_figures = point["reason"] is None
        ratios = {name: point[name] / baseline[name] for name in names} if has_figures else None
        found = {"against_float64": ratios, "pareto": has_figures and next(front), "reason": point["reason"]}
        compared.append({name: value for name, value in point.items() if name != "reason"} | found)
    return compared


def _is_baseline(point: Row) -> bool:
    return point["quantizer"] is None and point["transmit"] == "periodic"


def bits_of(point: Row) -> str:
    """Bits as `--bits` takes them."""
    return str(SignalBits(point["bits_out"], point["bits_rate"], point["bits_in"]))


# ── as text ──

_SPLIT: Final = "†"


def sheets(burden: Burden) -> Sheets:
    """A table for each of the sensors: a row is one experiment with its traffic under both policies.

    A missing figure is a dash, with the reason below.
    """
    for name, text in burden.sensors.items():
        points = burden.under(name)
        rows = [_row(*both) for both in zip(points[::2], points[1::2], strict=True)]
        titles = max(rows, key=len)  # float64 has figures
        yield f"sensors {name}: {text}", [dict.fromkeys(titles, "–") | row for row in rows]
        reasons = [
            f"{bits_of(point)} {_short_name(point)}: {point['reason']}." for point in points[::2] if point["reason"]
        ]
        if reasons:
            yield "\n".join(reasons), []
    yield from ((note, []) for note in _notes(burden))


def _short_name(point: Row) -> str:
    """Name of a point's quantizer in a table or a legend."""
    kind: str = point["quantizer"] or "float64"
    return "hysteresis on ω" if kind == "hysteresis-rate" else kind.removesuffix("-uniform")


def _row(always: Row, changed: Row) -> dict[str, str]:
    """A row of a point at every tick, and the same sent on change; nothing but its name where it has no figures."""
    name = {"bits out/in": bits_of(always), "quantizer": _short_name(always)}
    if always["reason"] is not None:
        return name
    error, out, inp = always["against_float64"]["z_track"], changed["measurement"], changed["command"]
    return {
        **name,
        "z_track, 10⁻⁴ s": f"{always['z_track'] * 1e4:.1f} (×{error:.{2 if error < 9.995 else 1}f})",
        "u_total, V²·s": f"{always['u_total']:.0f}",
        "changes/s": f"{out['changes_per_s']:.0f} + {inp['changes_per_s']:.0f}",
        "every tick: kbit/s": _payload(always),
        "every tick: CAN kbit/s": _bus(always),
        "on change: frames/s": f"{out['frames_per_s']:.0f} + {inp['frames_per_s']:.0f}",
        "on change: ms between, mean": f"{_ms(out['mean_interval_ms'])} + {_ms(inp['mean_interval_ms'])}",
        "least": f"{_ms(out['least_interval_ms'], 'g')} + {_ms(inp['least_interval_ms'], 'g')}",
        "on change: kbit/s": _payload(changed),
        "on change: CAN kbit/s": _bus(changed),
    }


def _payload(point: Row) -> str:
    star = "★ " if point["pareto"] else ""
    return f"{star}{point['bits_per_s'] / 1e3:.1f} ({_share(point['against_float64']['bits_per_s'])})"


def _bus(point: Row) -> str:
    """Bits a second on the bus, and its load; marks a split frame and a load above 1."""
    load = point["can_load"]
    words = _share(load) + (", too much" if load > 1 else "")
    return f"{point['can_bits_per_s'] / 1e3:.0f} ({words}){_SPLIT if _is_split(point) else ''}"


def _is_split(point: Row) -> bool:
    return any(part and part["can_frames"] > 1 for part in (point["measurement"], point["command"]))


def _share(ratio: float) -> str:
    return f"{100 * ratio:.{0 if ratio > 0.0995 else 1}f}%"


def _ms(interval: float | None, digits: str = ".1f") -> str:
    return "–" if interval is None else f"{interval:{digits}}"


def _notes(burden: Burden) -> Iterator[str]:
    rate, bits = burden.rate_hz, burden.counter_bits
    yield (
        f"{burden.duration_s:g} s each; of two numbers the first is measurements, the second "
        "commands; × and % are of float64 at every tick; ★ is on the Pareto front of z_track against payload bits."
    )
    yield (
        f"Every tick: {rate:g} + {rate:g} frames/s, {1e3 / rate:g} ms apart. On change: at least every "
        f"{burden.heartbeat_s * 1e3:g} ms. CAN: a classic bus of 1 Mbit/s and its load, worst-case stuffing, without "
        "heartbeats."
    )
    shorter = f"; {MIN_COUNTER_BITS} bits would carry {2 * MIN_COUNTER_BITS * rate / 1e3:g}"
    yield (
        f"The counter has {bits} bits: at every tick {rate:g} + {rate:g} frames/s carry {2 * bits * rate / 1e3:g} "
        f"kbit/s of it{shorter if bits > MIN_COUNTER_BITS else ''}, padding apart."
    )
    if any(map(_is_split, burden.points)):
        yield (
            f"{_SPLIT} A frame of more than 8 bytes, reckoned as the classic frames that its bytes fill; in fact it "
            "goes as one CAN FD frame."
        )


# ── as a figure ──


def draw_burden(burden: Burden, path: Path) -> None:
    """Draw error against payload bits a second into a file, a panel for each of the sensors, both axes logarithmic.

    Colour and shape mark the quantizer; a full marker is sent on change, a hollow one at every tick. A line joins the
    Pareto front, its points labelled with bits out/in; dotted lines mark float64 at every tick. Raises OutputError if
    the file's name is wrong, or it cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from aeroloop.service.report.figure_style import WIDTH_IN, figure_style, save_as

    names, styles = list(burden.sensors), _styles()
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    with figure_style():
        size = WIDTH_IN[1 if columns == 1 else 2], 0.75 + 2.5 * rows
        figure = Figure(figsize=size, layout="constrained")
        panels: list[Axes] = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flatten().tolist()
        for panel, name in zip(panels, names, strict=False):
            _draw(panel, [point for point in burden.under(name) if point["reason"] is None])
            panel.annotate(f"sensors: {name}", (1, 1), xycoords="axes fraction", xytext=(-4, -4),
                           textcoords="offset points", ha="right", va="top",
                           bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})  # fmt: skip
        errors = [_place(point)[1] for point in burden.points if point["reason"] is None]
        panels[0].set_ylim(0.78 * min(errors), 1.2 * max(errors))
        for i, panel in enumerate(panels):
            panel.set_visible(i < len(names))
            if i % columns == 0:
                panel.set_ylabel(r"$z_\mathrm{track}$ [$10^{-4}$ s]")
            if i + columns >= len(names):  # the last of its column
                panel.set_xlabel("payload of measurements and commands [kbit/s]")
                panel.tick_params(labelbottom=True)
        drawn = {_short_name(point): styles[point["quantizer"]] for point in burden.points}
        legend = [
            *(
                Line2D([], [], marker=marker, label=name, **marks(color, face=color))
                for name, (color, marker) in drawn.items()
            ),
            Line2D([], [], marker="o", label="sent on change", **marks("0.4", face="0.4")),
            Line2D([], [], marker="o", label="sent at every tick", **marks("0.4")),
            Line2D([], [], color="0.45", linewidth=0.9, label="Pareto front, bits out/in"),
            Line2D([], [], color="0.3", linewidth=0.6, linestyle=":", label="float64 at every tick"),
        ]
        figure.legend(handles=legend, loc="outside lower center", ncols=3)
        save_as(figure, path)


def marks(color: str, face: str = "white") -> dict[str, Any]:
    """Style of marks in a figure of a study, hollow unless they have a face."""
    return {"color": color, "markerfacecolor": face, "linestyle": "none", "markersize": 4}


def _styles() -> dict[str | None, tuple[str, str]]:
    """Colour and marker of each quantizer."""
    from aeroloop.service.report.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE

    return {
        "uniform": (BLUE, "o"),
        "hysteresis-uniform": (ORANGE, "s"),
        "logarithmic-uniform": (GREEN, "^"),
        "hysteresis-rate": (PURPLE, "p"),
        None: (BLACK, "D"),
    }


def _place(point: Row) -> tuple[float, float]:
    """Payload [kbit/s] and error [1e-4 s]."""
    return point["bits_per_s"] / 1e3, point["z_track"] * 1e4


def _draw(panel: Axes, points: list[Row]) -> None:
    from aeroloop.service.report.figure_style import logarithmic

    logarithmic(panel, "x", (1, 2, 3, 5))
    logarithmic(panel, "y", (1, 2, 3, 5))
    panel.margins(x=0.08)
    front = sorted({_place(point): point for point in points if point["pareto"]}.items(), key=lambda item: item[0])
    panel.plot(*zip(*(place for place, _ in front), strict=True), color="0.45", linewidth=0.9, zorder=2)
    for point in points:
        (color, marker), (payload, error) = _styles()[point["quantizer"]], _place(point)
        face, order = color if point["transmit"] == "on_change" else "white", 4 if point["pareto"] else 3
        panel.plot(payload, error, marker, zorder=order, **marks(color, face))
        if _is_baseline(point):
            panel.axvline(payload, color="0.3", linewidth=0.6, linestyle=":", zorder=1)
            panel.axhline(error, color="0.3", linewidth=0.6, linestyle=":", zorder=1)
    labelled: list[tuple[float, float]] = []  # to the lower left, where no point is
    for (x, y), point in front:
        if all(abs(log10(x / other)) >= 0.2 or abs(log10(y / above)) >= 0.055 for other, above in labelled):
            labelled.append((x, y))
            label = bits_of(point) if point["quantizer"] else "float64"
            panel.annotate(label, (x, y), xytext=(-4, -4), textcoords="offset points", ha="right", va="top", fontsize=6)
