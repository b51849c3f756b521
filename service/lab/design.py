"""`lab design`: bits of each signal and rate whose proof stays within an error, for the least payload.

The bound of a set costs milliseconds, so every split of a frame's bits is tried, for the paper's body. Of those that
none beats, with less payload or a smaller bound, experiments say beside the bound how well they track. On change the
same levels travel in fewer frames, so the bound stands: the front has what that sends, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import product, starmap
from math import inf
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.spec import SignalBits, WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.lab.engine import PROCESSES, Progress, Sheets, cell, figures_row, open_workers, run_of
from aeroloop.service.theorem.certificate import beyond
from aeroloop.service.theorem.extremes import extremes
from aeroloop.service.theorem.invariant import reach
from aeroloop.service.theorem.premises import PlantBounds, premises

BITS: Final = range(4, 15)
"""Of each signal."""


class DesignError(AeroloopError):
    """Nothing can be designed; one line with the reason."""


class Point(BaseModel):
    """One design: bits and rate, what is proven of it, and what experiments show."""

    kbit_s: float = Field(description="payload of both frames at every tick, padding included [kbit/s]")
    rate_hz: float
    bits: str = Field(description="of ε, ω and u")
    radius: float = Field(description="bound of ‖z‖ at every instant [1, rad/s]")
    degrees: float = Field(description="bound of the attitude error [deg]")
    beyond: list[str] = Field(description="ranges that the set exceeds")
    z_track: float | None = Field(default=None, description="of an experiment [s]; null where it tripped")
    on_change_kbit_s: float | None = Field(default=None, description="payload of the same, sent on change [kbit/s]")
    reason: str | None = Field(default=None, description="why z_track is null")

    def overrides(self) -> list[str]:
        """The design as overrides of the configuration."""
        bits = SignalBits.parse(self.bits)._asdict().items()
        return [f"loop.rate_hz={self.rate_hz:g}", *(f"wire.{name}.bits={n}" for name, n in bits)]


class Design(BaseModel):
    """The front: no design has less payload and as small a bound as one of these."""

    model_config = ConfigDict(frozen=True)

    tried: int
    front: list[Point] = Field(description="by payload, the least first")


def design(
    settings: Settings,
    *,
    error_deg: float,
    kbit: float | None = None,
    rates: Sequence[float] = (),
    delay_s: float = 0.0,
    lost: int = 0,
    duration_s: float = 50.0,
    progress: Progress = lambda _done, _total: None,
    engine: str = PROCESSES,
) -> Design:
    """Search the designs whose error is proven to stay within a bound, on the paper's body.

    Args:
        settings: The configuration; each design sets bits and rate.
        error_deg: Largest attitude error to be proven [deg].
        kbit: Largest payload [kbit/s]; any if None.
        rates: Rates of the loop [Hz]; the configured one if none.
        delay_s: Further age of every command [s].
        lost: Most frames lost in a row.
        duration_s: Length of the experiments of the front [s].
        progress: Called with experiments done and in all.
        engine: As of `open_workers`.

    Raises DesignError if no design is within the error, NoTheoremError and BoundlessError as `certify` does.
    """
    found, tried = list[Point](), 0
    for rate in rates or [settings.loop.rate_hz]:
        base = settings.model_copy(update={"loop": settings.loop.model_copy(update={"rate_hz": rate})})
        desired, period = extremes(base), base.loop.period
        for bits, size in _splits(base.wire):
            payload = size * 8 / period / 1e3
            if kbit is not None and payload > kbit:
                continue
            tried += 1
            split = base.model_copy(update={"wire": base.wire.with_bits(str(bits))})
            p = premises(split, desired, PlantBounds(period), 0.0, delay_s + lost * period)
            if (at := reach(p)) is not None and at.degrees <= error_deg:
                ranges = [name for *_, name in beyond(split, p, at)]
                found.append(
                    Point(
                        kbit_s=round(payload, 3), rate_hz=rate, bits=str(bits), radius=at.radius, degrees=at.degrees,
                        beyond=ranges,
                    )
                )  # fmt: skip
    found.sort(key=lambda point: (point.kbit_s, point.radius))
    least = np.minimum.accumulate([inf, *(point.radius for point in found)])
    front = [point for point, before in zip(found, least, strict=False) if point.radius < before]
    if not front:
        raise DesignError(
            f"no design of {tried} is proven to stay within {error_deg:g}°"
            f"{f' at up to {kbit:g} kbit/s' if kbit else ''}: allow more, or other rates (--rate)"
        )
    sent = ("wire.transmit=periodic", "wire.transmit=on_change")
    runs = [run_of(settings, [*point.overrides(), each]) for point in front for each in sent]
    with open_workers(engine) as workers:
        rows = workers.rows(partial(figures_row, duration_s=duration_s), runs, lambda n: progress(n, len(runs)))
    for point, every_tick, on_change in zip(front, rows[::2], rows[1::2], strict=True):
        point.z_track, point.reason = every_tick["z_track"], every_tick["reason"]
        if on_change["reason"] is None:
            sent = on_change["measurement_bits_per_s"] + on_change["command_bits_per_s"]
            point.on_change_kbit_s = round(sent / 1e3, 3)
    return Design(tried=tried, front=front)


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


def sheets(found: Design) -> Sheets:
    """The front as a table, and the design of the least payload to paste."""
    yield (
        f"Least payload whose error is proven at every instant, of the paper's body; {found.tried} designs.",
        [
            {
                "kbit/s": f"{point.kbit_s:g}",
                "on change": cell(point.on_change_kbit_s, "{:.1f}"),
                "rate, Hz": f"{point.rate_hz:g}",
                "bits": point.bits,
                "proven ‖z‖": f"{point.radius:.4f}",
                "proven": f"{point.degrees:.2f}°",
                "beyond": "; ".join(name.split(":")[0] for name in point.beyond),
                "z_track·1e4": point.reason or cell(point.z_track, "{:.1f}", 1e4),
            }
            for point in found.front
        ],
    )
    yield "\n  ".join(["The least payload, to paste:", *(f"--set {each}" for each in found.front[0].overrides())]), []
