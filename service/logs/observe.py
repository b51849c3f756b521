"""What is looked at in a session beside its figures: timing, gaps, saturation, and every quantity over time.

An `Observer` is told frames, ticks by the block, and what is told less often, keeps them for a few thousand ticks, and
reduces them by numpy; so a tick costs a few microseconds and memory stays bounded however long the session is.
Durations go into histograms, lines into buckets (thin.py), and of gaps the longest hundred are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from math import nan
from typing import Final

import numpy as np

from protocol.attitude import Quaternion
from protocol.messages import Telemetry
from service.config import Settings
from service.logs.codes import codes_in
from service.logs.grounds import Library
from service.logs.panels import columns_of, panels_of, with_level
from service.logs.report import Array, Gap, Panel, Spread
from service.logs.tallies import BLOCK, Durations, Integers, Outermost, Told
from service.logs.theorem import Trial
from service.logs.thin import ThinnedLines
from service.logs.ticks import Ticks

LONGEST_GAPS: Final = 100


class Observer:
    """Watches one session.

    Args:
        settings: The configuration of its controller.
        trial: Holds it against the theorem; one of the configuration alone if None.
    """

    def __init__(self, settings: Settings, trial: Trial | None = None) -> None:
        wire = settings.wire
        self._period = settings.loop.period
        self.trial = trial or Trial(Library(settings).of(()), (), settings.loop.period, None)
        self._columns = columns_of(settings, theta=self.trial.damping_known)
        self._lines = ThinnedLines(2 + len(self._columns))  # k and time of publication, then what is drawn
        self._ticks: list[Ticks] = []
        self._wire = wire
        self._measurements: list[bytes] = []
        self._measured: list[int] = []
        self._commands: list[bytes] = []
        self._waiting = 0
        self._damping, self._truth = Told(3), Told(4)
        self._outermost = {name: Outermost(getattr(wire, name)) for name in ("attitude", "rate", "voltage")}
        self._period_ns, self._latency_ns = Durations(), Durations()
        self._longest: list[tuple[int, int]] = []
        self._last_measured: Integers = np.empty(0, dtype=np.int64)
        self._last_answer: Integers = np.empty(0, dtype=np.int64)
        self._last_tick_ns = nan
        self._start_ns: int | None = None
        self.gap_count = 0
        self.invalid = {"measurement": 0, "command": 0}

    # ── what it is told ──

    def measurement(self, frame: bytes, published_ns: int) -> None:
        """A measurement that can be read, answered or not."""
        if self._start_ns is None:
            self._start_ns = published_ns
        self._measured.append(published_ns)
        self._measurements.append(frame)
        if len(self._measurements) >= BLOCK:
            self._reduce_measurements()

    def command(self, frame: bytes) -> None:
        """A command that can be read."""
        self._commands.append(frame)
        if len(self._commands) >= BLOCK:
            self._reduce_commands()

    def answered(self, k: Integers) -> None:
        """Ticks that were answered, be it by commands without a valid value. Shape (n,)."""
        answers = np.concatenate([self._last_answer, k])
        self._last_answer = answers[-1:]
        missing = np.diff(answers) - 1
        where = np.flatnonzero(missing)
        self.gap_count += len(where)
        found = [(int(missing[i]), int(answers[i]) + 1) for i in where]
        self._longest = sorted(self._longest + found, reverse=True)[:LONGEST_GAPS]

    def ticks(self, ticks: Ticks) -> None:
        """Ticks that are judged."""
        self._ticks.append(ticks)
        self._waiting += len(ticks.k)
        if self._waiting >= BLOCK:
            self._reduce_ticks()

    def telemetry(self, telemetry: Telemetry) -> None:
        """What the controller told of a tick."""
        self._damping.add(telemetry.tick, telemetry.damping_estimate)

    def truth(self, attitude: Quaternion, published_ns: int) -> None:
        """What the emulator told of the true attitude."""
        if self._start_ns is not None:
            self._truth.add((published_ns - self._start_ns) * 1e-9, attitude)

    def finish(self) -> None:
        """No more is to come."""
        self._reduce_measurements()
        self._reduce_commands()
        self._reduce_ticks()

    # ── what it has found ──

    @property
    def started(self) -> str:
        """When the first measurement was published, UTC; empty if there was none."""
        if self._start_ns is None:
            return ""
        return datetime.fromtimestamp(self._start_ns * 1e-9, UTC).isoformat(timespec="milliseconds")

    @property
    def timing(self) -> dict[str, Spread]:
        """Spreads by name, of what there was."""
        found = {"period": self._period_ns.spread(), "latency": self._latency_ns.spread()}
        return {name: spread for name, spread in found.items() if spread is not None}

    @property
    def gaps(self) -> list[Gap]:
        """The longest hundred, in order of time."""
        return [
            Gap(time_s=round(k * self._period, 9), tick=k, ticks=ticks)
            for k, ticks in sorted((k, ticks) for ticks, k in self._longest)
        ]

    @property
    def saturated(self) -> dict[str, float]:
        """Share of values at the outermost level, by signal."""
        return {name: share for name, signal in self._outermost.items() if (share := signal.share) is not None}

    @property
    def thinned(self) -> int:
        """Ticks behind two points of a line."""
        return self._lines.per_bucket

    def lines(self) -> tuple[Array, list[Panel]]:
        """Times on the law's clock [s] and panels."""
        points = self._lines.points()
        panels = panels_of(self._columns, points[:, 2:])
        return points[:, 0] * self._period, with_level(panels, "z_norm", "guaranteed in the end", self.trial.radius)

    def clock(self, within_s: float) -> Callable[[int], float | None]:
        """The law's clock [s] at a time of publication [ns]; None further than this from the session.

        In lockstep it does not run evenly, so it is read off the ticks; before the first and after the last it runs
        as clocks do.
        """
        points, start_ns = self._lines.points()[:, :2], self._start_ns
        law, wall = points[:, 0] * self._period, points[:, 1]

        def at(published_ns: int) -> float | None:
            if start_ns is None or not len(law):
                return None
            now = (published_ns - start_ns) * 1e-9
            if not wall[0] - within_s <= now <= wall[-1] + within_s:
                return None
            outside = min(0.0, now - float(wall[0])) + max(0.0, now - float(wall[-1]))
            return round(float(np.interp(now, wall, law)) + outside, 6)

        return at

    # ── a block at a time ──

    def _reduce_measurements(self) -> None:
        times = np.concatenate([self._last_measured, np.array(self._measured, dtype=np.int64)])
        self._period_ns.add(np.diff(times))
        self._last_measured = times[-1:]
        codes = codes_in(self._wire.measurement, self._measurements)
        wrong = self._outermost["attitude"].add(codes[:, :3]) | self._outermost["rate"].add(codes[:, 3:])
        self.invalid["measurement"] += int(wrong.sum())
        self._measured.clear()
        self._measurements.clear()

    def _reduce_commands(self) -> None:
        wrong = self._outermost["voltage"].add(codes_in(self._wire.command, self._commands))
        self.invalid["command"] += int(wrong.sum())
        self._commands.clear()

    def _reduce_ticks(self) -> None:
        if not self._waiting:
            return
        ticks = Ticks.joined(self._ticks)
        self._ticks.clear()
        self._waiting = 0
        assert self._start_ns is not None  # set by the first measurement
        published, latency = ticks.published_ns - self._start_ns, ticks.latency_ns
        self._latency_ns.add(latency[~np.isnan(latency)])
        periods = np.diff(published, prepend=self._last_tick_ns)
        self._last_tick_ns = float(published[-1])
        seconds = np.asarray(published * 1e-9, dtype=np.float64)
        k, desired, error = ticks.k.astype(np.float64), ticks.desired, ticks.attitude_error
        self._lines.add(
            np.column_stack(
                [
                    k,
                    seconds,
                    _alternating(_beside(ticks.attitude, desired), desired),
                    _alternating(ticks.rate, ticks.desired_rate),
                    error,
                    ticks.rate_error,
                    ticks.voltages,
                    _angle(error),
                    _angle(_error_vector(self._truth.on(seconds), desired)),
                    latency * 1e-3,
                    periods * 1e-3,
                    self._damping.on(k),
                    self.trial.ticks(ticks),
                ]
            )
        )


def _beside(attitude: Array, desired: Array) -> Array:
    """Of ±q, the one beside q_d. Shape (n, 4)."""
    return np.where(np.sum(attitude * desired, axis=1, keepdims=True) < 0, -attitude, attitude)


def _alternating(one: Array, other: Array) -> Array:
    """The columns of both by turns. Shape (n, 2·columns)."""
    return np.stack([one, other], axis=2).reshape(len(one), -1)


def _angle(error: Array) -> Array:
    """The angle [deg] of an error quaternion's vector part. Shapes (n, 3) and (n,)."""
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(1.0, np.linalg.norm(error, axis=1)))))


def _error_vector(attitude: Array, desired: Array) -> Array:
    """The vector part of q_d⁻¹ ⊗ q, as (C.16) has it. Shape (n, 3)."""
    length = np.linalg.norm(attitude, axis=1, keepdims=True)
    eta, eps = attitude[:, :1] / length, attitude[:, 1:] / length
    eta_d, eps_d = desired[:, :1], desired[:, 1:]
    return np.asarray(eta_d * eps - eta * eps_d - np.cross(eps_d, eps))
