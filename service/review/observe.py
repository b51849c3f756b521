"""Observations of a session beside its figures: timing, gaps, saturation, and every quantity over time.

An `Observer` takes frames and ticks by the block and reduces them by numpy, so memory stays bounded however long the
session is. Durations go into histograms, lines into buckets (downsample.py), and the longest hundred gaps are kept.
"""

from __future__ import annotations

from datetime import UTC, datetime
from math import inf, nan
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.messages.models import Percentiles
from aeroloop.service.config import Settings
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array, Integers
from aeroloop.service.review.accumulators import Durations, SaturationCount
from aeroloop.service.review.angles import beside, of_nearer_sign, roll_pitch_yaw, without_jumps
from aeroloop.service.review.downsample import MAX_POINTS, DownsampledLines
from aeroloop.service.review.panels import columns_of, panels_of, with_level
from aeroloop.service.review.report import Gap, Panel, Spread
from aeroloop.service.review.theorem_check import TheoremCheck

LONGEST_GAPS: Final = 100


class DrawnPart(NamedTuple):
    """What of a session is drawn; its figures are of all of it.

    Attributes:
        since_s: From this time on, on the law's clock [s].
        until_s: To this time [s].
        points: The most points of a line: so many ticks are drawn each by itself, more in buckets.
    """

    since_s: float = -inf
    until_s: float = inf
    points: int = MAX_POINTS


WHOLE: Final = DrawnPart()


class Observer:
    """Observes one session.

    Args:
        settings: The configuration of its controller.
        check: Checks it against the theorem.
        part: What of it is drawn.

    Attributes:
        check: The same check.
    """

    def __init__(self, settings: Settings, check: TheoremCheck, part: DrawnPart = WHOLE) -> None:
        wire = settings.wire
        self._period = settings.loop.period
        self.check = check
        self._columns = columns_of(settings, theta=check.damping_known)
        self._part = part
        self._lines = DownsampledLines(1 + len(self._columns), part.points)  # k, then what is drawn
        self._last_angles: Array = np.zeros(3)
        self._outermost = {name: SaturationCount(getattr(wire, name)) for name in ("attitude", "rate", "voltage")}
        self._timing = {name: Durations() for name in ("period", "latency", "measurement_delay", "command_delay")}
        self._longest: list[tuple[int, int]] = []
        self._last_answer: Integers = np.empty(0, dtype=np.int64)
        self._last_sent_ns = nan
        self._start_ns: int | None = None
        self.gap_count = 0
        self.invalid = {"measurement": 0, "command": 0}

    # ── input ──

    def frames(self, measurements: Array, commands: Array) -> None:
        """Add codes of frames that were sent, answered or not. Shapes (n, 6) and (m, actuators)."""
        wrong = self._outermost["attitude"].add(measurements[:, :3]) | self._outermost["rate"].add(measurements[:, 3:])
        self.invalid["measurement"] += int(wrong.sum())
        self.invalid["command"] += int(self._outermost["voltage"].add(commands).sum())

    def answered(self, k: Integers) -> None:
        """Add ticks that a command answered, with or without a valid value. Shape (n,)."""
        answers = np.concatenate([self._last_answer, k])
        self._last_answer = answers[-1:]
        missing = np.diff(answers) - 1
        where = np.flatnonzero(missing)
        self.gap_count += len(where)
        found = [(int(missing[i]), int(answers[i]) + 1) for i in where]
        self._longest = sorted(self._longest + found, reverse=True)[:LONGEST_GAPS]

    def ticks(self, ticks: Ticks) -> None:
        """Add a block of ticks that are judged."""
        if not len(ticks.k):
            return
        if self._start_ns is None:
            self._start_ns = int(ticks.wall_ns[0])
        sent = np.where(ticks.sent_ns >= 0, ticks.sent_ns.astype(np.float64), nan)
        periods = np.full(len(sent), nan)
        known = np.flatnonzero(ticks.sent_ns >= 0)
        periods[known] = np.diff(sent[known], prepend=self._last_sent_ns)
        if len(known):
            self._last_sent_ns = float(sent[known[-1]])
        durations = periods, ticks.latency_ns, ticks.measurement_delay_ns, ticks.command_delay_ns
        for histogram, values in zip(self._timing.values(), durations, strict=True):
            histogram.add(values[~np.isnan(values)])
        desired, error, drawn = ticks.desired, ticks.attitude_error, self.check.ticks(ticks)
        angles = without_jumps(roll_pitch_yaw(desired), self._last_angles)
        self._last_angles = angles[-1]
        seen, true = (beside(roll_pitch_yaw(q), angles) for q in (ticks.attitude, drawn.true_attitude))
        t = ticks.k * self._period
        self._lines.add(
            np.column_stack(
                [
                    ticks.k.astype(np.float64),
                    _alternating(seen, angles, true),
                    _alternating(of_nearer_sign(ticks.attitude, desired), desired),
                    _alternating(ticks.rate, ticks.desired_rate),
                    error,
                    ticks.rate_error,
                    ticks.voltages,
                    np.degrees(2 * np.arcsin(np.minimum(1.0, np.linalg.norm(error, axis=1)))),
                    drawn.true_error,
                    ticks.latency_ns * 1e-3,
                    periods * 1e-3,
                    ticks.damping_estimate,
                    drawn.norms,
                ]
            )[(t >= self._part.since_s) & (t <= self._part.until_s)]
        )

    # ── results ──

    @property
    def started(self) -> str:
        """When the first measurement was sent, UTC; empty if there was none."""
        if self._start_ns is None:
            return ""
        return datetime.fromtimestamp(self._start_ns * 1e-9, UTC).isoformat(timespec="milliseconds")

    @property
    def timing(self) -> dict[str, Spread]:
        """Spreads by name, without empty ones."""
        return {name: spread for name, one in self._timing.items() if (spread := one.spread()) is not None}

    @property
    def latency(self) -> Percentiles | None:
        """Loop latency of this session [µs]; None if it is not known."""
        spread = self._timing["latency"].spread()
        return None if spread is None else Percentiles(**spread.model_dump(include=set(Percentiles.model_fields)))

    @property
    def gaps(self) -> list[Gap]:
        """The longest hundred, in order of time."""
        found = sorted((k, ticks) for ticks, k in self._longest)
        return [Gap(time_s=round(k * self._period, 9), tick=k, ticks=ticks) for k, ticks in found]

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
        panels, time = panels_of(self._columns, points[:, 1:]), points[:, 0] * self._period
        since_s, until_s = self.check.judged_s
        judged = (time >= since_s) & (time < until_s)
        label, level = "bound, once within it", self.check.pointwise_radius
        if level is None:
            label, level = "bound of the root mean square", self.check.radius
        return time, with_level(panels, "z_norm", label, level, judged)


def _alternating(*tables: Array) -> Array:
    """The first column of each, then the second of each, and so on. Shape (n, tables·columns)."""
    return np.stack(tables, axis=2).reshape(len(tables[0]), -1)
