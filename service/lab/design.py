"""Design: bits of each signal, rate and gains whose proof stays within an error for the least payload.

The bound of a set costs milliseconds, so every split of a frame's bits is tried. Of those that none beats, with less
payload or a smaller bound, experiments say beside the bound how well they track. On change the same levels travel in
fewer frames, so the bound stands: the front has what that sends, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import product, starmap
from math import asin, degrees
from typing import Any, Final, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.spec import SignalBits, WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.lab.sweep import PROCESSES, Progress, Run, Sheets, figures_row, open_workers, run_of
from aeroloop.service.theorem.certificate import beyond, premises
from aeroloop.service.theorem.extremes import extremes
from aeroloop.service.theorem.invariant import reach
from aeroloop.service.theorem.plant_bounds import paper_body, plant_bounds

BITS: Final = range(4, 15)
"""Of each signal."""
FACTORS: Final = (0.5, 1.0, 1.5, 2.0)
"""Of each gain, where gains are searched."""


Gains: TypeAlias = dict[str, tuple[float, ...]]


class DesignError(AeroloopError):
    """Nothing can be designed; one line with the reason."""


class Point(BaseModel):
    """One design: bits, rate and gains, what is proven of it, and what experiments show."""

    model_config = ConfigDict(frozen=True)

    kbit_s: float = Field(description="payload of both frames at every tick, padding included [kbit/s]")
    rate_hz: float
    bits: str = Field(description="of ε, ω and u")
    gains: Gains = Field(description="gains in place of the configuration's")
    radius: float = Field(description="bound of ‖z‖ at every instant [1, rad/s]")
    degrees: float = Field(description="bound of the attitude error [deg]")
    beyond: list[str] = Field(description="ranges that the set exceeds; none may be of a configured plant")
    z_track: float | None = Field(default=None, description="of an experiment [s]; null where it tripped")
    on_change_kbit_s: float | None = Field(default=None, description="payload of the same, sent on change [kbit/s]")
    reason: str | None = Field(default=None, description="why z_track is null")

    def overrides(self) -> list[str]:
        """The design as overrides of the configuration."""
        bits = SignalBits.parse(self.bits)._asdict().items()
        gains = (f"law.{name}={list(gain)}" for name, gain in self.gains.items())
        return [f"loop.rate_hz={self.rate_hz:g}", *(f"wire.{name}.bits={n}" for name, n in bits), *gains]


class Design(BaseModel):
    """The front: no design has less payload and as small a bound as one of these."""

    model_config = ConfigDict(frozen=True)

    body: str = Field(description="whose error is bounded: the paper's body or the configured plant")
    tried: int
    front: list[Point] = Field(description="by payload, the least first")


def design(
    settings: Settings,
    *,
    error_deg: float,
    kbit: float | None = None,
    rates: Sequence[float] = (),
    gains: bool = False,
    plant: bool = False,
    delay_s: float = 0.0,
    lost: int = 0,
    duration_s: float = 50.0,
    progress: Progress = lambda _done, _total: None,
    engine: str = PROCESSES,
) -> Design:
    """Search the designs whose error is proven to stay within a bound.

    Args:
        settings: The configuration; each design sets bits, rate and gains.
        error_deg: Largest attitude error to be proven [deg].
        kbit: Largest payload [kbit/s]; any if None.
        rates: Rates of the loop [Hz]; the configured one if none.
        gains: Search the law's gains, too, by `FACTORS`.
        plant: Of the configured plant, whose set must be within every range; else of the paper's body.
        delay_s: Further age of every command [s].
        lost: Most frames lost in a row.
        duration_s: Length of the experiments of the front [s].
        progress: Called with designs and experiments done and in all.
        engine: As of `open_workers`.

    Raises:
        DesignError: No design is within the error.
        NoTheoremError: Nothing is proven of the law.
        BoundlessError: The reference has no bounds.
    """
    found, tried = list[Point](), 0
    chosen = list(product(rates or [settings.loop.rate_hz], _gains(settings) if gains else [{}]))
    for done, (rate, gain) in enumerate(chosen):
        progress(done, len(chosen))
        loop, law = settings.loop.model_copy(update={"rate_hz": rate}), settings.law.model_copy(update=gain)
        base = settings.model_copy(update={"loop": loop, "law": law})
        points = _points(base, gain, plant, delay_s + lost * loop.period, kbit)
        tried += len(points)
        found += [point for point in points if point is not None and point.degrees <= error_deg]
    front = list(_front(found))
    if not front:
        raise DesignError(
            f"no design of {tried} is proven to stay within {error_deg:g}°"
            f"{f' at up to {kbit:g} kbit/s' if kbit else ''}: allow more, or other rates (--rate) and gains (--gains)"
        )
    with open_workers(engine) as workers:
        runs = [_run(settings, point, change) for point in front for change in (False, True)]
        rows = workers.rows(partial(figures_row, duration_s=duration_s), runs, lambda n: progress(n, len(runs)))
    return Design(
        body="the configured plant" if plant else "the paper's body",
        tried=tried,
        front=[_simulated(point, *rows[2 * i : 2 * i + 2]) for i, point in enumerate(front)],
    )


def _points(base: Settings, gains: Gains, plant: bool, late_s: float, kbit: float | None) -> list[Point | None]:
    """Every split of full frames with these gains and this rate; None where nothing is proven."""
    desired = extremes(base)
    bounds = plant_bounds(base, True) if plant else paper_body(base)
    found = list[Point | None]()
    for bits, size in _splits(base.wire):
        payload = size * 8 / base.loop.period / 1e3
        if kbit is not None and payload > kbit:
            continue
        split = base.model_copy(update={"wire": base.wire.with_bits(str(bits))})
        p = premises(split, desired, bounds, 0.0, late_s)
        at = reach(p)
        outside = [] if at is None else [name for *_, name in beyond(split, p, at)]
        if at is None or (plant and (outside or bounds.unproven)):
            found.append(None)
            continue
        found.append(
            Point(
                kbit_s=round(payload, 3),
                rate_hz=base.loop.rate_hz,
                bits=str(bits),
                gains=gains,
                radius=at.radius,
                degrees=degrees(2 * asin(at.eps_e)),
                beyond=outside,
            )
        )
    return found


@lru_cache(maxsize=8)
def _splits(wire: WireSpec) -> list[tuple[SignalBits, int]]:
    """Bits of full frames, where one more bit of any signal would be a byte more, and the bytes of both frames."""
    sizes = dict[SignalBits, int]()
    for bits in starmap(SignalBits, product(BITS, repeat=3)):
        split = wire.with_bits(str(bits))
        sizes[bits] = split.measurement.size + split.command.size
    return [
        (bits, size)
        for bits, size in sizes.items()
        if all(sizes.get(bits._replace(**{name: each + 1})) != size for name, each in bits._asdict().items())
    ]


def _gains(settings: Settings) -> list[Gains]:
    """Gains of attitude and rate error, by `FACTORS`."""
    known = {name: getattr(settings.law, name) for name in ("C1", "C2", "kp", "kd") if hasattr(settings.law, name)}
    return [
        {
            name: tuple(round(factor * value, 6) for value in known[name])
            for name, factor in zip(known, some, strict=True)
        }
        for some in product(FACTORS, repeat=len(known))
    ]


def _front(points: Sequence[Point]) -> Iterator[Point]:
    """The points that no other beats at less payload, the least payload first."""
    least = float("inf")
    for point in sorted(points, key=lambda one: (one.kbit_s, one.radius)):
        if point.radius < least:
            least = point.radius
            yield point


def _run(settings: Settings, point: Point, on_change: bool) -> Run:
    return run_of(settings, [*point.overrides(), *(["wire.transmit=on_change"] if on_change else [])])


def _simulated(point: Point, every_tick: dict[str, Any], on_change: dict[str, Any]) -> Point:
    sent = [on_change[f"{name}_bits_per_s"] for name in ("measurement", "command")]
    found = {
        "z_track": every_tick["z_track"],
        "reason": every_tick["reason"],
        "on_change_kbit_s": None if None in sent else round(sum(sent) / 1e3, 3),
    }
    return point.model_copy(update=found)


def sheets(found: Design) -> Sheets:
    """The front as a table, and the design of the least payload to paste."""
    rows = [
        {
            "kbit/s": f"{point.kbit_s:g}",
            "on change": "–" if point.on_change_kbit_s is None else f"{point.on_change_kbit_s:.1f}",
            "rate, Hz": f"{point.rate_hz:g}",
            "bits": point.bits,
            **{name: " ".join(f"{value:g}" for value in gain) for name, gain in point.gains.items()},
            "proven ‖z‖": f"{point.radius:.4f}",
            "proven": f"{point.degrees:.2f}°",
            "beyond": "; ".join(name.split(":")[0] for name in point.beyond),
            "z_track·1e4": point.reason if point.z_track is None else f"{point.z_track * 1e4:.1f}",
        }
        for point in found.front
    ]
    names = dict.fromkeys(name for row in rows for name in row)
    yield (
        f"Least payload whose error is proven at every instant, of {found.body}; {found.tried} designs.",
        [{name: str(row.get(name, "")) for name in names} for row in rows],
    )
    yield "\n  ".join(["The least payload, to paste:", *(f"--set {each}" for each in found.front[0].overrides())]), []
