"""Observations of a session beside its figures: timing, gaps, saturation, and every quantity over time.

An `Observer` takes frames and ticks by the block and reduces them by numpy, so memory stays bounded however long the
session is. Durations go into histograms, lines into buckets (downsample.py), and the longest hundred gaps are kept.
"""

from __future__ import annotations

from datetime import UTC, datetime
from math import inf, nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.messages.models import Percentiles
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.config import Settings
from aeroloop.service.logs.table import euler_deg
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array, Integers
from aeroloop.service.review.angles import beside, of_nearer_sign, without_jumps
from aeroloop.service.review.downsample import MAX_POINTS, DownsampledLines
from aeroloop.service.review.panels import columns_of, drawn_state, panels_of, with_level
from aeroloop.service.review.report import Gap, Panel, Spread
from aeroloop.service.review.theorem_check import TheoremCheck

LONGEST_GAPS: Final = 100
_BINS_PER_OCTAVE: Final = 16
_BINS: Final = 32 * _BINS_PER_OCTAVE  # 1 µs … 2^32 µs, as protocol/runtime/timing.py


class DrawnPart(NamedTuple):
    """What of a session is drawn, from and to a time on the law's clock [s]; its figures are of all of it.

    `points` is the most points of a line: so many ticks are drawn each by itself, more in buckets.
    """

    since_s: float = -inf
    until_s: float = inf
    points: int = MAX_POINTS


WHOLE: Final = DrawnPart()


class Durations:
    """Histogram of durations with the bins of `protocol/runtime/timing.py`; takes many at once."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._max_us = 0.0

    def add(self, nanoseconds: Array | Integers) -> None:
        """Count durations [ns]; under 1 µs counts as 1 µs, over an hour as an hour. Shape (n,)."""
        if len(nanoseconds):
            us = np.maximum(1.0, nanoseconds * 1e-3)
            bins = np.minimum((np.log2(us) * _BINS_PER_OCTAVE).astype(np.int64), _BINS - 1)
            self._counts += np.bincount(bins, minlength=_BINS)
            self._max_us = max(self._max_us, float(us.max()))

    def spread(self) -> Spread | None:
        """Their distribution; None if there were none."""
        if not (total := int(self._counts.sum())):
            return None
        reached = np.cumsum(self._counts)

        def percentile(percent: float) -> float:
            i = int(np.searchsorted(reached, total * percent / 100))
            return float(round(min(2 ** ((i + 0.5) / _BINS_PER_OCTAVE), self._max_us), 1))

        points = {"p50": 50, "p90": 90, "p99": 99, "p999": 99.9}
        filled = np.flatnonzero(self._counts).tolist()
        bins = [(round(2 ** (i / _BINS_PER_OCTAVE), 3), int(self._counts[i])) for i in filled]
        found = {name: percentile(percent) for name, percent in points.items()}
        return Spread(count=total, **found, max=round(self._max_us, 1), bins=bins)


class SaturationCount:
    """Counts values of a signal at the quantizer's outermost level."""

    def __init__(self, signal: SignalSpec) -> None:
        quantizer = signal.quantizer()
        self._top, self._invalid = quantizer.encode(quantizer.limit), quantizer.invalid
        self._values = self._saturated = 0

    def add(self, codes: Array) -> NDArray[np.bool_]:
        """Count codes, and return which frames have one without a valid value. Shapes (n, values) and (n,)."""
        invalid = np.isnan(codes) | (codes == self._invalid)
        self._values += codes.size - int(invalid.sum())
        self._saturated += int(((np.abs(codes) >= self._top) & ~invalid).sum())
        return np.asarray(invalid.any(axis=1))

    @property
    def share(self) -> float | None:
        """Share of the valid values; None if there were none."""
        return self._saturated / self._values if self._values else None


class Observer:
    """Observes one session; `check` checks it against the theorem, `part` of it is drawn."""

    def __init__(self, settings: Settings, check: TheoremCheck, part: DrawnPart = WHOLE) -> None:
        wire = settings.wire
        self._period = settings.loop.period
        self.check = check
        self._columns = columns_of(settings, theta=check.damping_known)
        self._drawn_state = drawn_state(settings)
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
        angles = without_jumps(euler_deg(desired), self._last_angles)
        self._last_angles = angles[-1]
        seen, true = (beside(euler_deg(q), angles) for q in (ticks.attitude, drawn.true_attitude))
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
                    ticks.state[:, self._drawn_state],
                    drawn.norms,
                ]
            )[(t >= self._part.since_s) & (t <= self._part.until_s)]
        )

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
