"""What an observer counts with: durations in bins, values at a quantizer's limit, and what is told now and then.

Each takes a block of a few thousand at once, by numpy, and holds no more however many blocks come.
"""

from __future__ import annotations

from math import nan
from typing import Final

import numpy as np
import numpy.typing as npt

from protocol.wire import SignalSpec
from service.logs.report import Array, Spread

BLOCK: Final = 4096
"""Ticks that are reduced at once."""

_BINS_PER_OCTAVE: Final = 16
_BINS: Final = 32 * _BINS_PER_OCTAVE  # 1 µs … 2^32 µs, as protocol.clock.Histogram

Integers = npt.NDArray[np.int64]


class Durations:
    """A histogram of durations as `protocol.clock.Histogram`, which takes many at once."""

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
        """How they were spread; None if there were none."""
        total = int(self._counts.sum())
        if not total:
            return None
        reached = np.cumsum(self._counts)

        def percentile(percent: float) -> float:
            i = int(np.searchsorted(reached, total * percent / 100))
            return float(round(min(2 ** ((i + 0.5) / _BINS_PER_OCTAVE), self._max_us), 1))

        return Spread(
            count=total,
            p50=percentile(50),
            p90=percentile(90),
            p99=percentile(99),
            p999=percentile(99.9),
            max=round(self._max_us, 1),
            bins=[(round(2 ** (i / _BINS_PER_OCTAVE), 3), int(self._counts[i])) for i in np.flatnonzero(self._counts)],
        )


class Outermost:
    """How many values of a signal were at the quantizer's outermost level."""

    def __init__(self, signal: SignalSpec) -> None:
        quantizer = signal.quantizer()
        self._top, self._invalid = quantizer.encode(quantizer.limit), quantizer.invalid
        self._values = self._saturated = 0

    def add(self, codes: Array) -> npt.NDArray[np.bool_]:
        """Count codes, and say which frames have one that is no valid value. Shapes (n, values) and (n,)."""
        invalid = np.isnan(codes) | (codes == self._invalid)
        self._values += codes.size - int(invalid.sum())
        self._saturated += int(((np.abs(codes) >= self._top) & ~invalid).sum())
        return np.asarray(invalid.any(axis=1))

    @property
    def share(self) -> float | None:
        """Of the valid values; None if there were none."""
        return self._saturated / self._values if self._values else None


class Told:
    """What is told less often than every tick: between two it is interpolated, after the last one it is held."""

    def __init__(self, columns: int) -> None:
        self._at: list[float] = []
        self._values: list[tuple[float, ...]] = []
        self._columns = columns

    def add(self, at: float, values: tuple[float, ...]) -> None:
        """Told at a place on an axis that rises."""
        if self._at and at <= self._at[-1]:
            return
        if len(self._at) >= 2 * BLOCK:  # it goes on while there are no ticks: forget the older half
            del self._at[:BLOCK], self._values[:BLOCK]
        self._at.append(at)
        self._values.append(values)

    def on(self, at: Array) -> Array:
        """The values at places that rise, NaN before the first; forgets what lies before them. Shape (n, columns)."""
        if not self._at:
            return np.full((len(at), self._columns), nan)
        known, values = np.array(self._at), np.array(self._values)
        columns = [np.interp(at, known, values[:, i], left=nan) for i in range(self._columns)]
        past = max(0, int(np.searchsorted(known, at[-1], side="right")) - 1)
        del self._at[:past], self._values[:past]
        return np.stack(columns, axis=1)
