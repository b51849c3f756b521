"""Figures of merit: one set of names and one way to compute them, for the demo, the experiment and the review of a log.

All feed the same `Score`, tick by tick, so that their figures can be compared to the last bit. `z_track` and `u_total`
are (C.81), summed as rectangles, because a sampled loop holds its values for a period.
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
    trips: list[str] = Field(default_factory=list, description="why the plant went to 0 V by itself, each time")
    damages: list[str] = Field(default_factory=list, description="unreadable parts of the log")
    reasons: dict[str, str] = Field(default_factory=dict, description="why a figure is null")


class Score:
    """Sums over a run.

    Args:
        wire: Sizes of the frames.
        period: Time between ticks [s].
        watchdog_s: Longest time for which a plant holds a command [s].
    """

    def __init__(self, wire: WireSpec, period: float, watchdog_s: float = WATCHDOG_S) -> None:
        self._wire = wire
        self._period = period
        self._longest_hold = max(1, round(watchdog_s / period))
        self._first: int | None = None
        self._error_tick = self._command_tick = 0
        self._error_square = self._command_square = 0.0
        self._errors = self._commands = 0
        self._unsent_errors = self._unsent_commands = 0
        self._z_track = self._u_total = 0.0
        self._largest: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._largest_square = 0.0
        self._last: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self._largest_squares: list[float] = []  # of each second since the first error
        self._voltages: Sequence[float] = ()
        self._changes = 0

    def error(self, k: int, error: Sequence[float], *, sent: bool = True) -> None:
        """Add the attitude error ε̃ at tick k; it holds until the next. Shape (3,).

        It counts as a measurement frame only if one was sent.
        """
        self._unsent_errors += not sent
        if self._first is None:
            self._first = k
        else:
            self._z_track += self._error_square * ((k - self._error_tick) * self._period)
        x, y, z = error
        self._error_tick = k
        self._error_square = x * x + y * y + z * z
        self._last = x, y, z
        self._second(int((k - self._first) * self._period), self._error_square)
        if self._error_square > self._largest_square:
            self._largest, self._largest_square = self._last, self._error_square
        self._errors += 1

    def command(self, k: int, voltages: Sequence[float], *, sent: bool = True) -> None:
        """Add the voltages [V] commanded at tick k; held until the next, or the watchdog. Shape (actuators,).

        A command without a valid value sets the plant to 0 V. It counts as a frame only if one was sent.
        """
        self._unsent_commands += not sent
        self._changes += sum(a != b and (a == a or b == b) for a, b in zip(voltages, self._voltages, strict=False))
        self._voltages = tuple(voltages)
        if self._commands:
            held = min(k - self._command_tick, self._longest_hold)
            self._u_total += self._command_square * (held * self._period)
        self._command_tick = k
        square = sum(u * u for u in voltages)
        self._command_square = square if square == square else 0.0
        self._commands += 1

    def unsent(self, measurements: int, commands: int) -> None:
        """Subtract this many of the ticks added: they had no frame, because it would have repeated the last one."""
        self._unsent_errors += measurements
        self._unsent_commands += commands

    def errors(self, k: Integers, errors: Floats) -> None:
        """`error` for consecutive ticks: the same sums, in the same order. Shapes (n,) and (n, 3)."""
        if self._first is None and len(k):
            self.error(int(k[0]), errors[0].tolist())
            k, errors = k[1:], errors[1:]
        if not len(k):
            return
        square = squares(errors)
        before = np.append(self._error_square, square[:-1])
        self._z_track = added(self._z_track, before * (np.diff(k, prepend=self._error_tick) * self._period))
        seconds = ((k - self._first) * self._period).astype(int)  # type: ignore[operator]  # there was a first error
        starts = np.flatnonzero(np.diff(seconds, prepend=-1))
        for second, most in zip(seconds[starts], np.fmax.reduceat(square, starts), strict=True):
            self._second(int(second), float(most))
        largest = int(np.argmax(np.where(np.isnan(square), -1.0, square)))
        if square[largest] > self._largest_square:
            self._largest, self._largest_square = tuple(errors[largest].tolist()), float(square[largest])
        self._error_tick, self._error_square, self._last = int(k[-1]), float(square[-1]), tuple(errors[-1].tolist())
        self._errors += len(k)

    def commands(self, k: Integers, voltages: Floats) -> None:
        """`command` for consecutive ticks, likewise. Shapes (n,) and (n, actuators)."""
        if not self._commands and len(k):
            self.command(int(k[0]), voltages[0].tolist())
            k, voltages = k[1:], voltages[1:]
        if not len(k):
            return
        rows = np.vstack([self._voltages, voltages])
        known = ~(np.isnan(rows[1:]) & np.isnan(rows[:-1]))
        self._changes += int(np.count_nonzero((rows[1:] != rows[:-1]) & known))
        self._voltages = voltages[-1].tolist()
        square = squares(voltages)
        square[np.isnan(square)] = 0.0
        before = np.append(self._command_square, square[:-1])
        held = np.minimum(np.diff(k, prepend=self._command_tick), self._longest_hold)
        self._u_total = added(self._u_total, before * (held * self._period))
        self._command_tick, self._command_square = int(k[-1]), float(square[-1])
        self._commands += len(k)

    def _second(self, second: int, square: float) -> None:
        self._largest_squares += [0.0] * (second + 1 - len(self._largest_squares))
        if square > self._largest_squares[second]:
            self._largest_squares[second] = square

    @property
    def ticks(self) -> int:
        """Ticks from the first to the last error, both counted."""
        return 0 if self._first is None else self._error_tick - self._first + 1

    def figures(
        self,
        *,
        latency: Percentiles | None = None,
        log: str | None = None,
        trips: Sequence[str] = (),
        reasons: dict[str, str] | None = None,
        damages: Sequence[str] = (),
    ) -> Figures:
        """The figures so far; the last error and the last command count for one period."""
        reasons = dict(reasons or {})
        duration = self.ticks * self._period
        half = self._largest_squares[len(self._largest_squares) // 2 :]
        if not self._errors:
            for name in ("z_track", "max_error_deg", "final_error_deg", "second_half_error_deg", "skipped_ticks"):
                reasons[name] = "no measurement was answered"
        if not self._commands:
            reasons |= dict.fromkeys(("u_total", "command_changes_per_s"), "no command was sent")
        return Figures(
            duration_s=round(duration, 9),
            z_track=self._z_track + self._error_square * self._period if self._errors else None,
            u_total=self._u_total + self._command_square * self._period if self._commands else None,
            max_error_deg=degrees(angle(*self._largest)) if self._errors else None,
            final_error_deg=degrees(angle(*self._last)) if self._errors else None,
            second_half_error_deg=degrees(angle(sqrt(max(half)), 0.0, 0.0)) if half else None,
            command_changes_per_s=self._changes / duration if duration and self._commands else None,
            measurement=_stream(self._errors - self._unsent_errors, self._wire.measurement, duration),
            command=_stream(self._commands - self._unsent_commands, self._wire.command, duration),
            skipped_ticks=self.ticks - self._commands if self._errors else None,
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
