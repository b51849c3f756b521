"""Downsampling of lines in bounded memory, so that a page holds every tick of minutes, and an outline of hours.

Rows go into buckets, each with the least and the largest value of every column and the order of the two. When there are
too many buckets, neighbours are merged in pairs; so the number of points is bounded whatever the length, and no extreme
is lost. While there are few enough rows, each is a bucket of its own and the lines are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MAX_POINTS: Final = 180_000
"""Points of a line. While a session has no more ticks (six minutes at 500 Hz), every tick is drawn."""


class Buckets(NamedTuple):
    """Rows in buckets.

    Attributes:
        low: Least value of every column; NaN where a column has none. Shape (buckets, columns).
        high: Largest value.
        rising: Whether the least came before the largest.
        rows: How many rows each holds. Shape (buckets,).
    """

    low: Array
    high: Array
    rising: Flags
    rows: npt.NDArray[np.int64]

    @classmethod
    def of(cls, rows: Array) -> Self:
        """Every row in a bucket of its own. Shape (rows, columns)."""
        return cls(rows, rows, np.ones(rows.shape, dtype=bool), np.ones(len(rows), dtype=np.int64))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Several, at least one, one after the other; no copy where one suffices."""
        filled = [part for part in parts if len(part.rows)] or parts[:1]
        if len(filled) == 1:
            return filled[0]
        low = np.concatenate([part.low for part in filled])
        exact = all(part.low is part.high for part in filled)
        high = low if exact else np.concatenate([part.high for part in filled])
        return cls(low, high, *map(np.concatenate, zip(*(part[2:] for part in filled), strict=True)))

    def part(self, cut: slice) -> Self:
        """A slice of the buckets."""
        return type(self)(self.low[cut], self.high[cut], self.rising[cut], self.rows[cut])

    def paired(self) -> Self:
        """Neighbours merged; if their number is odd, the last stays as it is."""
        end = len(self.rows) // 2 * 2
        first, then = self.part(slice(0, end, 2)), self.part(slice(1, end, 2))
        low, high = np.fmin(first.low, then.low), np.fmax(first.high, then.high)
        later_low, later_high = low != first.low, high != first.high
        among = np.where(later_low, then.rising, first.rising)
        merged = type(self)(low, high, np.where(later_low == later_high, among, later_high), first.rows + then.rows)
        return self.joined([merged, self.part(slice(end, None))])


class DownsampledLines:
    """Columns over a position that rises, the first of them, in bounded memory: with at most `max_points` points.

    `per_bucket` is rows behind two points of a line; 1 as long as nothing was thinned out.
    """

    def __init__(self, columns: int, max_points: int = MAX_POINTS) -> None:
        self._parts = [Buckets.of(np.empty((0, columns)))]
        self._count = 0
        self._max_points = max_points
        self.per_bucket = 1

    def add(self, rows: Array) -> None:
        """Add rows. Shape (rows, columns)."""
        part, size = Buckets.of(rows), 1
        while size < self.per_bucket and len(part.rows) > 1:
            part, size = part.paired(), 2 * size
        last = self._parts[-1]
        if len(part.rows) == len(last.rows) == 1 and part.rows[0] + last.rows[0] <= self.per_bucket:
            # A bucket may hold more rows than one call adds: the last one is filled up.
            part = Buckets.joined([self._parts.pop(), part]).paired()
            self._count -= 1
        self._parts.append(part)
        self._count += len(part.rows)
        while self._count * (1 if self.per_bucket == 1 else 2) > self._max_points:
            parts, self._parts = self._parts, []
            whole = Buckets.joined(parts)
            del parts  # a third of the memory
            whole = whole.paired()
            self._parts = [whole.part(slice(-1)), whole.part(slice(-1, None))]  # the last may not be full
            self._count = len(whole.rows)
            self.per_bucket *= 2

    def points(self) -> Array:
        """The lines' points: every row, or two per bucket that span it. Shape (points, columns).

        The two stand in the middle of the bucket's first and second half, each line's extremes in order of time.
        """
        low, high, rising, rows = Buckets.joined(self._parts)
        if self.per_bucket == 1:
            return low
        points = np.empty((2 * len(rows), low.shape[1]))
        points[0::2], points[1::2] = np.where(rising, low, high), np.where(rising, high, low)
        start, end = low[:, 0], high[:, 0]
        quarter = np.maximum(0.0, ((end - start + 1) / 2 - 1) / 2)
        points[0::2, 0], points[1::2, 0] = start + quarter, end - quarter
        kept = np.ones(len(points), dtype=bool)
        kept[1::2] = rows > 1
        return np.asarray(points[kept])
