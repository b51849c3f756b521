"""Figures of merit: one set of names and one way to compute them, for the demo, the experiment and the review of a log.

`z_track` and `u_total` are (C.81), summed as rectangles, because a sampled loop holds its values for a period.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, sqrt

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.messages.models import Percentiles
from aeroloop.protocol.wire.attitude import angle
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.spec import WATCHDOG_S, WireSpec

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


class StreamFigures(BaseModel):
    """Traffic in one direction, over `duration_s`."""

    model_config = ConfigDict(frozen=True)

    frames_per_s: float | None
    bits_per_s: float | None = Field(description="payload bits, padding included")


class Figures(BaseModel):
    """Tracking, control effort and traffic of a run. A figure not available is null, with its reason in `reasons`."""

    model_config = ConfigDict(frozen=True)

    duration_s: float = Field(description="time evaluated, on the law's clock [s]")
    z_track: float | None = Field(description="∫ ε̃ᵀε̃ dt of the attitude as measured [s]; 0.0049 is 49 in Table C.2")
    u_total: float | None = Field(description="∫ uᵀu dt of the commands as sent [V²·s]")
    max_error_deg: float | None = Field(description="largest attitude error as measured [deg]")
    final_error_deg: float | None = Field(description="attitude error at the last tick as measured [deg]")
    second_half_error_deg: float | None = Field(
        default=None, description="largest attitude error as measured in the second half, by whole seconds [deg]"
    )
    command_changes_per_s: float | None = Field(
        default=None, description="changes of a commanded voltage, of all motors together [1/s]"
    )
    measurement: StreamFigures
    command: StreamFigures
    skipped_ticks: int | None = Field(description="ticks without a command, whatever the reason")
    latency_us: Percentiles | None
    log: str | None
    trips: list[str] = Field(default_factory=list, description="why the plant tripped to 0 V, each time")
    damages: list[str] = Field(default_factory=list, description="unreadable parts of the log")
    reasons: dict[str, str] = Field(default_factory=dict, description="why a figure is null, or of a part only")


def figures(
    wire: WireSpec,
    period: float,
    errors: tuple[Integers, Floats],
    commands: tuple[Integers, Floats],
    *,
    watchdog_s: float = WATCHDOG_S,
    unsent: tuple[int, int] = (0, 0),
    latency: Percentiles | None = None,
    log: str | None = None,
    trips: Sequence[str] = (),
    reasons: dict[str, str] | None = None,
    damages: Sequence[str] = (),
) -> Figures:
    """Figures of a run, whose ticks are `period` seconds apart.

    `errors` are ticks, ascending, and the attitude error ε̃ at each, which holds until the next, shapes (n,), (n, 3).
    `commands` are ticks, ascending, and the voltages commanded at each, held until the next or for `watchdog_s`, shapes
    (m,), (m, actuators); NaN sets the plant to 0 V [V]. Of these measurements and commands so many had no frame
    (`unsent`), as it would have repeated the last one.
    """
    (k, error), (answered, voltages) = errors, commands
    reasons, names = dict(reasons or {}), ("z_track", "max_error_deg", "final_error_deg", "second_half_error_deg")
    z_track = u_total = largest_deg = last_deg = half_deg = changes_per_s = None
    ticks = int(k[-1] - k[0]) + 1 if len(k) else 0
    duration = ticks * period
    if len(k):
        square = squares(error)
        z_track = added(0.0, square * (np.diff(k, append=k[-1] + 1) * period))
        known = np.where(np.isnan(square), -1.0, square)
        largest_deg, last_deg = (degrees(angle(*error[i].tolist())) for i in (int(np.argmax(known)), -1))
        seconds = ((k - k[0]) * period).astype(int)
        half = known[seconds >= (seconds[-1] + 1) // 2].max(initial=0.0)
        half_deg = degrees(angle(sqrt(half), 0.0, 0.0))
    else:
        reasons |= dict.fromkeys((*names, "skipped_ticks"), "no measurement was answered")
    if len(answered):
        square = squares(voltages)
        held = np.minimum(np.diff(answered, append=answered[-1] + 1), max(1, round(watchdog_s / period)))
        u_total = added(0.0, np.where(np.isnan(square), 0.0, square) * (held * period))
        now, before = voltages[1:], voltages[:-1]
        changes = int(np.count_nonzero((now != before) & ~(np.isnan(now) & np.isnan(before))))
        changes_per_s = changes / duration if duration else None
    else:
        reasons |= dict.fromkeys(("u_total", "command_changes_per_s"), "no command was sent")
    return Figures(
        duration_s=round(duration, 9),
        z_track=z_track,
        u_total=u_total,
        max_error_deg=largest_deg,
        final_error_deg=last_deg,
        second_half_error_deg=half_deg,
        command_changes_per_s=changes_per_s,
        measurement=_stream(len(k) - unsent[0], wire.measurement, duration),
        command=_stream(len(answered) - unsent[1], wire.command, duration),
        skipped_ticks=int(np.ptp(np.append(k, answered))) + 1 - len(answered) if len(k) else None,
        latency_us=latency,
        log=log,
        trips=list(trips),
        damages=list(damages),
        reasons=reasons,
    )


def squares(rows: Floats) -> Floats:
    """vᵀv of every row, its terms added from the first to the last. Shapes (n, columns) and (n,)."""
    total = np.zeros(len(rows))
    for column in rows.T:
        total += column * column
    return total


def added(start: float, terms: Floats) -> float:
    """`start` plus the terms, added in order; `np.sum` adds pairwise, which rounds differently."""
    return float(np.add.accumulate(np.append(start, terms))[-1])


def _stream(frames: int, kind: FrameFormat, duration: float) -> StreamFigures:
    if not duration:
        return StreamFigures(frames_per_s=None, bits_per_s=None)
    return StreamFigures(frames_per_s=frames / duration, bits_per_s=frames * kind.size * 8 / duration)
