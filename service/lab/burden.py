"""Burden of a loop: error against bits over a grid of bits, quantizers, transmit policies and sensors.

Each cell is one lockstep experiment. Both policies give the same run to the last bit, because an
end that receives no frame holds its last levels; so a cell runs once, and its codes give the traffic of both policies.
Every figure is compared with that of float64 at every tick under the same sensors. The Pareto front of the points under
the same sensors holds those that no other point beats in error without more bits, or in bits without more error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple, get_args

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.wire.transmit import Policy
from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures
from aeroloop.service.lab.burden_grid import SENSORS, BurdenCell, BurdenError, cell_settings
from aeroloop.service.lab.experiment import PATH, LoopEndedError, experiment, heartbeat_of, paths
from aeroloop.service.lab.traffic import Traffic, codes_of, frames_of, sent_ticks, traffic
from aeroloop.service.lab.workers import Workers
from aeroloop.service.lab.zenoh_bytes import LinkBytes, count_bytes

POLICIES: Final[tuple[Policy, ...]] = get_args(Policy)


class Ratios(BaseModel):
    """A point's figures over those of float64 at every tick, under the same sensors [1]."""

    model_config = ConfigDict(frozen=True)

    z_track: float
    u_total: float
    bits_per_s: float
    can_bits_per_s: float


class LinkRates(BaseModel):
    """Bytes a second that a Zenoh link carried, counted; headers of TCP and IP not included."""

    model_config = ConfigDict(frozen=True)

    measurement: float
    command: float


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
    zenoh_bytes_per_s: LinkRates | None = Field(default=None, description="counted for a few cells only")
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
    path: str = Field(description=PATH)
    points: list[Point]

    def under(self, sensors: str) -> list[Point]:
        """The points with these sensors."""
        return [point for point in self.points if point.sensors == sensors]


class Observation(NamedTuple):
    """Result of a cell's experiment; without figures if the loop ended early."""

    figures: Figures | None
    traffic: dict[Policy, tuple[Traffic, Traffic]]  # measurements and commands
    zenoh: dict[Policy, LinkBytes]  # bytes on a Zenoh link, if they were counted
    path: str
    reason: str | None = None


def measure_burden(
    settings: Settings,
    cells: Sequence[BurdenCell],
    duration_s: float,
    progress: Callable[[int, int], None] | None = None,
) -> Burden:
    """Run a grid on every core.

    Args:
        settings: The configuration; each cell overrides its own fields.
        cells: Cells to run, with float64 for each of the sensors.
        duration_s: Length of each experiment [s].
        progress: Called with experiments done and experiments in all.

    Raises:
        BurdenError: The loop trips with float64, or float64 has no error to compare with; or a cell does not fit the
            configuration.
    """
    jobs = [(cell_settings(settings, cell).description(), duration_s, cell.counted) for cell in cells]
    report = progress or (lambda _done, _total: None)
    report(0, len(jobs))
    with Workers() as workers:
        results = workers.each(observe, jobs, lambda done: report(done, len(jobs)))
    points = [point for cell, result in zip(cells, results, strict=True) for point in _points(cell, result)]
    sensors = dict.fromkeys(cell.sensors for cell in cells)
    return Burden(
        duration_s=duration_s,
        rate_hz=settings.loop.rate_hz,
        heartbeat_s=heartbeat_of(settings) * settings.loop.period,
        counter_bits=settings.wire.counter_bits,
        sensors={name: SENSORS[name].text for name in sensors},
        path=paths(result.path for result in results),
        points=[point for name in sensors for point in _beside_float64(points, name)],
    )


def observe(config: dict[str, Any], duration_s: float, counted: bool) -> Observation:
    """Run one cell for `duration_s` [s]; `config` dumps a configuration that sends at every tick."""
    settings = Settings.model_validate(config)
    wire, period, heartbeat = settings.wire, settings.loop.period, heartbeat_of(settings)
    kinds = wire.measurement, wire.command
    frames: list[tuple[bytes, bytes]] = []
    try:
        found = experiment(settings, duration_s, watch=lambda _k, *both: frames.append(both))
    except LoopEndedError as error:
        return Observation(None, {}, {}, "frames", str(error))
    if found.course is not None:
        codes = [found.course.measured, found.course.commanded]
    else:
        codes = [codes_of(each, kind) for each, kind in zip(zip(*frames, strict=True), kinds, strict=True)]
    rates: dict[Policy, tuple[Traffic, Traffic]] = {}
    zenoh: dict[Policy, LinkBytes] = {}
    for policy in POLICIES:
        out, inp = sent = [sent_ticks(each, policy, heartbeat) for each in codes]
        measurement, command = (traffic(*each, period) for each in zip(codes, kinds, sent, strict=True))
        rates[policy] = measurement, command
        if counted:
            measurements, commands = (frames_of(each, kind) for each, kind in zip(codes, kinds, strict=True))
            zenoh[policy] = count_bytes(settings.network, [measurements[k] for k in out], [commands[k] for k in inp])
    return Observation(found.figures, rates, zenoh, found.path)


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
        counted, seconds = found.zenoh.get(policy), found.figures.duration_s
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
                zenoh_bytes_per_s=counted
                and LinkRates(measurement=counted.measurement / seconds, command=counted.command / seconds),
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
