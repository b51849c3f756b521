"""Accumulators of an observer: histograms of durations, and counts of values at a quantizer's limit.

Each takes a block of a few thousand values at once, by numpy, in memory that does not grow.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.logs.traces import Array, Integers
from aeroloop.service.review.report import Spread

_BINS_PER_OCTAVE: Final = 16
_BINS: Final = 32 * _BINS_PER_OCTAVE  # 1 µs … 2^32 µs, as protocol/runtime/timing.py


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

        return Spread(
            count=total,
            p50=percentile(50),
            p90=percentile(90),
            p99=percentile(99),
            p999=percentile(99.9),
            max=round(self._max_us, 1),
            bins=[(round(2 ** (i / _BINS_PER_OCTAVE), 3), int(self._counts[i])) for i in np.flatnonzero(self._counts)],
        )


class SaturationCount:
    """Counts values of a signal at the quantizer's outermost level."""

    def __init__(self, signal: SignalSpec) -> None:
        quantizer = signal.quantizer()
        self._top, self._invalid = quantizer.encode(quantizer.limit), quantizer.invalid
        self._values = self._saturated = 0

    def add(self, codes: Array) -> npt.NDArray[np.bool_]:
        """Count codes, and return which frames have one without a valid value. Shapes (n, values) and (n,)."""
        invalid = np.isnan(codes) | (codes == self._invalid)
        self._values += codes.size - int(invalid.sum())
        self._saturated += int(((np.abs(codes) >= self._top) & ~invalid).sum())
        return np.asarray(invalid.any(axis=1))

    @property
    def share(self) -> float | None:
        """Share of the valid values; None if there were none."""
        return self._saturated / self._values if self._values else None
