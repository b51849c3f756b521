"""Logarithmic-uniform quantizer: intervals grow with the value up to a threshold, and have equal lengths beyond it.

The error is proportional to small values, as in a logarithmic quantizer, and bounded throughout, as in a uniform one.
Of the N = 2^(R−1) − 1 intervals on either side the first m are geometric, the others l long:

    edge   e₀ = y₀   e_i = y₀·(y_t/y₀)^(i/m)   e_m = y_t   e_i = y_t + (i − m)·l   e_N = limit
    code      0     |         1 … m                |         m + 1 … N

m is the least number for which no geometric interval is longer than l. A level is the middle of its interval. The paper
names this kind (Remark 8) and cites another text for it; the definition here is the project's own (SPEC.md, section 2).
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from math import expm1, log
from typing import Final

from aeroloop.protocol.wire.quantizer import TIE, CodedQuantizer

MIN_LOGARITHMIC_BITS: Final = 3
"""With 2 bits there is one interval, which cannot be geometric and uniform."""

_ALIKE: Final = 1 - 2.0**-30
"""Tolerance of the last geometric interval against l: where the two are equal, rounding must not choose m."""

_APART: Final = 2.0**-46
"""Least distance of two edges, relative: more than what counts as a tie."""


class LogarithmicQuantizer(CodedQuantizer):
    """The logarithmic-uniform quantizer. A tie goes towards zero.

    Args:
        bits: R, 3…16.
        limit: Edge of the range [signal's unit], > 0.
        deadzone: y₀ [signal's unit]; if None a quarter of the uniform quantizer's, limit / (2^R − 1) / 4.
        threshold: y_t, where the intervals stop growing [signal's unit], at most limit/2; limit/4 if None.

    Attributes:
        threshold: y_t as used.
        growing: m, the number of geometric intervals on either side.
        step: l, the length of the uniform intervals [signal's unit].
        edges: e₀ … e_N [signal's unit].

    Raises:
        ValueError: A value out of bounds.
    """

    def __init__(self, bits: int, limit: float, deadzone: float | None = None, threshold: float | None = None) -> None:
        super().__init__(bits, limit)
        if bits < MIN_LOGARITHMIC_BITS:
            raise ValueError(f"a logarithmic-uniform quantizer has at least {MIN_LOGARITHMIC_BITS} bits, not {bits}")
        self.deadzone = limit / (2**bits - 1) / 4 if deadzone is None else deadzone
        self.threshold = limit / 4 if threshold is None else threshold
        if not 0 < self.threshold <= limit / 2:
            raise ValueError(f"a threshold is more than 0 and at most half the limit {limit}, not {self.threshold}")
        if not 0 < self.deadzone < self.threshold:
            raise ValueError(f"a dead zone lies between 0 and the threshold {self.threshold}, not at {self.deadzone}")
        self.growing = self._least_growing()
        self.step = self._step(self.growing)
        self.edges = self._edges()
        lengths = [b - a for a, b in pairwise(self.edges)]
        if not all(b - a > _APART * b for a, b in pairwise(self.edges)):
            raise ValueError(f"a limit of {limit} leaves no intervals that a float can distinguish")
        self.bound = max(self.deadzone, max(lengths) / 2)
        self._tabulate([(a + b) / 2 for a, b in pairwise(self.edges)])

    def encode(self, y: float) -> int:
        """The code of a value; see `Quantizer.encode`."""
        i = bisect_left(self.edges, abs(y) * TIE)
        if i > self.top:
            self.saturated += 1
            i = self.top
        elif y != y:
            raise ValueError("NaN has no code; send the code for 'no valid value'")
        return i if y > 0 else -i

    def _least_growing(self) -> int:
        """m, by bisection: with a larger m the geometric intervals get shorter and the uniform ones longer."""
        low, high = 1, self.top - 1
        while low < high:
            m = (low + high) // 2
            longest = -self.threshold * expm1(-log(self.threshold / self.deadzone) / m)
            if longest * _ALIKE <= self._step(m):
                high = m
            else:
                low = m + 1
        return low

    def _step(self, m: int) -> float:
        return (self.limit - self.threshold) / (self.top - m)

    def _edges(self) -> list[float]:
        m, ratio = self.growing, self.threshold / self.deadzone
        growing = [self.deadzone * ratio ** (i / m) for i in range(m)]
        alike = [self.threshold + i * self.step for i in range(self.top - m)]
        return [*growing, *alike, self.limit]
