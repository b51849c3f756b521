"""Burden of a loop: error against bits over a grid of bits, quantizers, transmit policies and sensors.

Each cell is one lockstep experiment. Both policies give the same run to the last bit, because an
end that receives no frame holds its last levels; so a cell runs once, and its codes give the traffic of both policies.
Every figure is compared with that of float64 at every tick under the same sensors. The Pareto front of the points under
the same sensors holds those that no other point beats in error without more bits, or in bits without more error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.transmit import Policy
from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures, Floats, Integers, StreamFigures
from aeroloop.service.lab.burden_grid import SENSORS, BurdenCell, BurdenError, cell_settings
from aeroloop.service.lab.bus import BITRATE, bus_bits, classic_frames
from aeroloop.service.lab.experiment import LoopEndedError, experiment, heartbeat_of, sent_ticks
from aeroloop.service.lab.workers import PROCESSES, Workers

POLICIES: Final[tuple[Policy, ...]] = get_args(Policy)


class Ratios(BaseModel):
    """A point's figures over those of float64 at every tick, under the same sensors [1]."""

    model_config = ConfigDict(frozen=True)

    z_track: float
    u_total: float
    bits_per_s: float
    can_bits_per_s: float


class Traffic(StreamFigures):
    """Traffic of one direction under one policy, over the whole run."""

    frames_per_s: float
    bits_per_s: float = Field(description="payload bits, padding included")
    changes_per_s: float = Field(description="changes of a component's code, of all components together")
    component_changes_per_s: list[float] = Field(description="the same, one by one: ε₁ ε₂ ε₃ ω₁ ω₂ ω₃, or u in order")
    mean_interval_ms: float | None = Field(description="from one frame to the next; null for less than two [ms]")
    least_interval_ms: float | None = Field(description="the least of these times [ms]")
    can_frames: int = Field(
        description="classic CAN frames that a frame fills; more than one is a split, without any header, of what "
        "this project sends as one CAN FD frame"
    )
    can_bits_per_s: float = Field(description="bits on a classic CAN bus, with worst-case stuffing")
    can_load: float = Field(description="share of a classic bus of 1 Mbit/s; above 1 it does not fit")


class Point(BaseModel):
    """One cell under one policy. Missing figures are null, with the reason."""

    model_config = ConfigDict(frozen=True)

    bits_out: int | None = Field(description="bits of ε and ω; null is float64")
    bits_in: int | None = Field(description="bits of u; null is float64")
    quantizer: str | None = Field(
        description="the kind of every signal, or hysteresis-rate: hysteresis-uniform for ω, uniform for the others; "
        "null where nothing is quantized"
    )
    sensors: str = Field(description="a name of `Burden.sensors`")
    transmit: Policy
    z_track: float | None = Field(default=None, description="∫ ε̃ᵀε̃ dt of the attitude as measured [s]")
    u_total: float | None = Field(default=None, description="∫ uᵀu dt of the commands as sent [V²·s]")
    measurement: Traffic | None = None
    command: Traffic | None = None
    bits_per_s: float | None = Field(default=None, description="payload bits of both directions, padding included")
    can_bits_per_s: float | None = Field(default=None, description="of both directions, as `Traffic` has it")
    can_load: float | None = Field(default=None, description="of both directions; above 1 it does not fit")
    against_float64: Ratios | None = None
    pareto: bool = Field(default=False, description="whether it is on the front of z_track against bits_per_s")
    reason: str | None = Field(default=None, description="why there are no figures")

    @property
    def bits(self) -> str:
        """Bits out and in, as `--bits` takes them."""
        return "/".join("cont" if bits is None else str(bits) for bits in (self.bits_out, self.bits_in))

    @property
    def label(self) -> str:
        """Short label: the bits, or float64."""
        return self.bits if self.quantizer else "float64"

    @property
    def is_baseline(self) -> bool:
        """Whether it is the baseline: float64 at every tick."""
        return self.quantizer is None and self.transmit == "periodic"


class Burden(BaseModel):
    """The grid."""

    model_config = ConfigDict(frozen=True)

    duration_s: float = Field(description="length of each experiment [s]")
    rate_hz: float = Field(description="ticks a second [Hz]")
    heartbeat_s: float = Field(description="on_change: the longest from one frame to the next [s]")
    counter_bits: int = Field(description="bits of the counter in each frame")
    sensors: dict[str, str] = Field(description="meaning of each name")
    points: list[Point]

    def under(self, sensors: str) -> list[Point]:
        """The points with these sensors."""
        return [point for point in self.points if point.sensors == sensors]


class Observation(NamedTuple):
    """Result of a cell's experiment; without figures if the loop ended early."""

    figures: Figures | None
    traffic: dict[Policy, tuple[Traffic, Traffic]]  # measurements and commands
    reason: str | None = None


def measure_burden(
    settings: Settings,
    cells: Sequence[BurdenCell],
    duration_s: float,
    progress: Callable[[int, int], None] | None = None,
    engine: str = PROCESSES,
) -> Burden:
    """Run a grid on every worker.

    Args:
        settings: The configuration; each cell overrides its own fields.
        cells: Cells to run, with float64 for each of the sensors.
        duration_s: Length of each experiment [s].
        progress: Called with experiments done and experiments in all.
        engine: As of `Workers`.

    Raises:
        BurdenError: The loop trips with float64, or float64 has no error to compare with; or a cell does not fit the
            configuration.
    """
    jobs = [(cell_settings(settings, cell).description(), duration_s) for cell in cells]
    report = progress or (lambda _done, _total: None)
    report(0, len(jobs))
    with Workers(engine) as workers:
        results = workers.each(observe, jobs, lambda done: report(done, len(jobs)))
    points = [point for cell, result in zip(cells, results, strict=True) for point in _points(cell, result)]
    sensors = dict.fromkeys(cell.sensors for cell in cells)
    return Burden(
        duration_s=duration_s,
        rate_hz=settings.loop.rate_hz,
        heartbeat_s=heartbeat_of(settings) * settings.loop.period,
        counter_bits=settings.wire.counter_bits,
        sensors={name: SENSORS[name].text for name in sensors},
        points=[point for name in sensors for point in _beside_float64(points, name)],
    )


def observe(config: dict[str, Any], duration_s: float) -> Observation:
    """Run one cell for `duration_s` [s]; `config` dumps a configuration that sends at every tick."""
    settings = Settings.model_validate(config)
    wire, period, heartbeat = settings.wire, settings.loop.period, heartbeat_of(settings)
    kinds = wire.measurement, wire.command
    frames: list[tuple[bytes, bytes]] = []
    try:
        found = experiment(settings, duration_s, watch=lambda _k, *both: frames.append(both))
    except LoopEndedError as error:
        return Observation(None, {}, str(error))
    if found.course is not None:
        codes = [found.course.measured, found.course.commanded]
    else:
        codes = [codes_of(each, kind) for each, kind in zip(zip(*frames, strict=True), kinds, strict=True)]
    rates: dict[Policy, tuple[Traffic, Traffic]] = {}
    for policy in POLICIES:
        sent = [sent_ticks(each, policy, heartbeat) for each in codes]
        measurement, command = (traffic(*each, period) for each in zip(codes, kinds, sent, strict=True))
        rates[policy] = measurement, command
    return Observation(found.figures, rates)


def codes_of(frames: Sequence[bytes], kind: FrameFormat) -> Floats:
    """Codes of frames. Shape (frames, components).

    Raises:
        ValueError: A frame is malformed.
    """
    unpacked = [kind.unpack(frame) for frame in frames]
    if None in unpacked:
        raise ValueError("a frame is malformed")
    return np.array([content[1] for content in unpacked if content is not None], float)


def traffic(codes: Floats, kind: FrameFormat, sent: Integers, period: float) -> Traffic:
    """The traffic of one direction.

    Args:
        codes: Codes at every tick from 0 on. Shape (ticks, components).
        kind: Format of the frames.
        sent: Ticks at which a frame was sent.
        period: Time between ticks [s].

    Raises:
        ValueError: There are no ticks.
    """
    if not len(codes):
        raise ValueError("no ticks, no traffic")
    duration = len(codes) * period
    changes = np.count_nonzero(np.diff(codes, axis=0), axis=0) / duration
    intervals = np.diff(sent) * (period * 1e3)
    on_bus = len(sent) * bus_bits(kind.size) / duration
    return Traffic(
        frames_per_s=len(sent) / duration,
        bits_per_s=len(sent) * kind.size * 8 / duration,
        changes_per_s=float(changes.sum()),
        component_changes_per_s=changes.tolist(),
        mean_interval_ms=float(intervals.mean()) if len(intervals) else None,
        least_interval_ms=float(intervals.min()) if len(intervals) else None,
        can_frames=len(classic_frames(kind.size)),
        can_bits_per_s=on_bus,
        can_load=on_bus / BITRATE,
    )


def pareto_front(costs: Iterable[tuple[float, float]]) -> list[bool]:
    """Which pairs no other pair beats: as low in both and lower in one."""
    pairs = list(costs)
    return [not any(a <= x and b <= y and (a, b) != (x, y) for a, b in pairs) for x, y in pairs]


def _points(cell: BurdenCell, found: Observation) -> list[Point]:
    choice = {name: getattr(cell, name) for name in ("bits_out", "bits_in", "quantizer", "sensors")}
    if found.figures is None:
        return [Point(**choice, transmit=policy, reason=found.reason) for policy in POLICIES]
    points = []
    for policy, (measurement, command) in found.traffic.items():
        points.append(
            Point(
                **choice,
                transmit=policy,
                z_track=found.figures.z_track,
                u_total=found.figures.u_total,
                measurement=measurement,
                command=command,
                bits_per_s=measurement.bits_per_s + command.bits_per_s,
                can_bits_per_s=measurement.can_bits_per_s + command.can_bits_per_s,
                can_load=measurement.can_load + command.can_load,
            )
        )
    return points


def _beside_float64(points: Sequence[Point], sensors: str) -> list[Point]:
    """The points with these sensors, compared with their baseline and with each other."""
    mine = [point for point in points if point.sensors == sensors]
    baseline = next(point for point in mine if point.is_baseline)
    if baseline.reason is not None:
        raise BurdenError(f"float64 itself does not keep the loop running, sensors {sensors}: {baseline.reason}")
    if not (baseline.z_track and baseline.u_total):
        raise BurdenError(f"float64 makes no error, sensors {sensors}: nothing to compare with; let the reference move")
    done = [point for point in mine if point.reason is None]
    front = pareto_front((_figure(point.bits_per_s), _figure(point.z_track)) for point in done)
    on_front = {id(point) for point, best in zip(done, front, strict=True) if best}
    return [
        point.model_copy(update={"pareto": id(point) in on_front, "against_float64": _ratios(point, baseline)})
        for point in mine
    ]


def _ratios(point: Point, baseline: Point) -> Ratios | None:
    if point.reason is not None:
        return None
    names = Ratios.model_fields
    return Ratios(**{name: _figure(getattr(point, name)) / _figure(getattr(baseline, name)) for name in names})


def _figure(figure: float | None) -> float:
    """A figure of a point without a `reason`, which has all of them."""
    assert figure is not None
    return figure
