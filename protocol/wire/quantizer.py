"""Quantizers, (C.13)–(C.15): value ↔ code ↔ level.

A value is quantized to a level (C.14); the level's index is the code, an R-bit two's-complement integer, and only the
code is sent. R bits index 2^R − 1 levels, symmetric about zero; the spare code, −2^(R−1), means "no valid value" and
its level is NaN.

    code   −2^(R−1)   −(2^(R−1) − 1)  …  −1   0   1  …  2^(R−1) − 1
    level  NaN        −y_max          …  −y₁  0   y₁ …  y_max

Remark 8 names two more kinds and cites another text for them; the definitions here are the project's own (SPEC.md,
section 2).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise
from math import ceil, copysign, expm1, inf, log, nan
from typing import Final

MIN_BITS: Final = 2
MAX_BITS: Final = 16
MIN_LOGARITHMIC_BITS: Final = 3  # with 2 bits there is one interval, which cannot be geometric and uniform
TIE: Final[float] = 1 - 2.0**-50
"""A value within a few units in the last place of an interval's edge lies on the edge: dividing by l rounds."""
SLACK: Final[float] = 1 - TIE
_ALIKE: Final = 1 - 2.0**-30  # where the last geometric interval is l, rounding must not choose m
_APART: Final = 2.0**-46  # least relative distance of two edges: more than what counts as a tie


class Quantizer(ABC):
    """A bounded quantizer of one scalar signal: |y^Q − y| ≤ bound for every |y| ≤ limit, as (C.13) requires.

    y^Q is `level(encode(y))`; (C.15) applies it to each element of a vector. Encoding may depend on the last code, so
    each scalar has a quantizer of its own. `bound` is δ_y of (C.13), `limit` the edge of the range and `outermost` the
    largest level [signal's unit]; `saturated` counts values beyond the range, `invalid` stands for "no valid value".
    """

    bound: float
    outermost: float
    invalid: float

    def __init__(self, limit: float) -> None:
        if not 0 < limit < inf:
            raise ValueError(f"a signal's limit is positive and finite, not {limit}")
        self.limit = limit
        self.saturated = 0

    @abstractmethod
    def encode(self, y: float) -> float:
        """The code of a value; beyond the range the outermost level's. Raises ValueError for NaN: send `invalid`."""

    @abstractmethod
    def level(self, code: float) -> float:
        """The level of a code; NaN for `invalid`. Raises ValueError for what is not a code of this quantizer."""

    def reset(self) -> None:  # noqa: B027  # most kinds have no memory
        """Clear the memory at a session's start; `saturated` goes on counting."""

    def resume(self, code: float) -> None:  # noqa: B027  # the same
        """Restore the memory: this code was the last. `invalid` changes nothing."""


class Continuous(Quantizer):
    """The paper's "cont.": no quantization. The value is its own code; beyond the range, the limit; NaN is invalid."""

    def __init__(self, limit: float) -> None:
        super().__init__(limit)
        self.outermost = limit
        self.bound = 0.0
        self.invalid = nan

    def encode(self, y: float) -> float:
        if -self.limit <= y <= self.limit:
            return y
        _refuse_nan(y)
        self.saturated += 1
        return copysign(self.limit, y)

    def level(self, code: float) -> float:
        return float(code)


class CodedQuantizer(Quantizer):
    """A quantizer with R-bit codes and a table of levels, symmetric about 0; kinds differ in levels and in `encode`.

    `bits` is R, 2…16; `top` is N = 2^(R−1) − 1, the code of the outermost level; `deadzone` is y₀, the largest
    magnitude that is quantized to 0 by its value alone. `levels[code]` decodes: a negative index is two's complement. A
    parameter out of bounds is a ValueError; all but `bits` have the signal's unit.
    """

    deadzone: float
    levels: list[float]
    invalid: int

    def __init__(self, bits: int, limit: float) -> None:
        super().__init__(limit)
        if not MIN_BITS <= bits <= MAX_BITS:
            raise ValueError(f"a quantizer has {MIN_BITS} to {MAX_BITS} bits, not {bits}")
        self.bits = bits
        self.top: int = 2 ** (bits - 1) - 1
        self.invalid = -self.top - 1

    def _tabulate(self, positive: Sequence[float]) -> None:
        """Set the levels 1…N."""
        self.levels = [0.0, *positive, nan, *(-y for y in reversed(positive))]
        self.outermost = self.levels[self.top]

    def level(self, code: float) -> float:
        if not (isinstance(code, int) and self.invalid <= code <= self.top):
            raise ValueError(f"{code!r} is not a code of {self.bits} bits")
        return self.levels[code]


class UniformQuantizer(CodedQuantizer):
    """The uniform quantizer of (C.14). A tie goes towards zero: intervals are (y_i − l/2, y_i + l/2].

    `step` is l, (limit − y₀) / (2^(R−1) − 1), so that the outermost interval ends at the limit. By default y₀ is l/2:
    levels are k·l, and l is 2·limit / (2^R − 1) as in the paper, which says only y₀ > 0.
    """

    def __init__(self, bits: int, limit: float, deadzone: float | None = None) -> None:
        super().__init__(bits, limit)
        if deadzone is None:
            self.step: float = 2 * limit / (2**bits - 1)
            self.deadzone = self.step / 2
        elif 0 < deadzone < limit:
            self.step = (limit - deadzone) / self.top
            self.deadzone = deadzone
        else:
            raise ValueError(f"a dead zone lies between 0 and the limit {limit}, not at {deadzone}")
        if not 0 < self.step < inf:
            raise ValueError(f"a limit of {limit} leaves no step that a float can hold")
        self.bound = max(self.deadzone, self.step / 2)
        self._tabulate([self.deadzone + self.step / 2 + i * self.step for i in range(self.top)])

    def encode(self, y: float) -> int:
        x: float = (abs(y) - self.deadzone) / self.step * TIE
        if x <= 0.0:
            return 0
        if x > self.top:
            self.saturated += 1
            return self.top if y > 0 else -self.top
        _refuse_nan(y)
        return ceil(x) if y > 0 else -ceil(x)


class HysteresisQuantizer(UniformQuantizer):
    """The uniform quantizer's levels, and a code that is held while the value stays near its level.

    The held level's interval is widened by h on either side, l/2 by default; a value outside it is quantized uniformly.
    Noise of less than h about an edge therefore changes no code and no frame, and the error bound grows by h. A tie
    goes to the held level. The last code is the only state.

        held level   0                  ±y_i
        stays while  |y| ≤ y₀ + h       y_i − l/2 − h ≤ ±y ≤ y_i + l/2 + h
    """

    _held: int | None

    def __init__(self, bits: int, limit: float, deadzone: float | None = None, hysteresis: float | None = None) -> None:
        super().__init__(bits, limit, deadzone)
        self.hysteresis = self.step / 2 if hysteresis is None else hysteresis
        if not 0 < self.hysteresis < limit:
            raise ValueError(f"hysteresis is more than 0 and less than the limit {limit}, not {hysteresis}")
        self.bound += self.hysteresis
        self.reset()

    def encode(self, y: float) -> int:
        if self._held is None or not self._stays(y, self._held):
            self._held = super().encode(y)
        return self._held

    def reset(self) -> None:
        self._held = None

    def resume(self, code: float) -> None:
        if code != self.invalid:
            self._held = int(code)

    def _stays(self, y: float, held: int) -> bool:
        # A value within a few units in the last place of an edge lies on it. Beyond the limit a value saturates.
        h, outer = self.hysteresis, self.deadzone + abs(held) * self.step
        inner = outer - self.step
        high = min(self.limit, outer + h + SLACK * (outer + h))
        low = inner - h - SLACK * (inner + h) if held else -high
        return low <= (-y if held < 0 else y) <= high


class LogarithmicQuantizer(CodedQuantizer):
    """Logarithmic-uniform: intervals grow with the value up to a threshold, and have equal lengths beyond it.

    The error is proportional to small values, as in a logarithmic quantizer, and bounded throughout, as in a uniform
    one. Of the N = 2^(R−1) − 1 intervals on either side the first m are geometric, the others l long:

        edge   e₀ = y₀   e_i = y₀·(y_t/y₀)^(i/m)   e_m = y_t   e_i = y_t + (i − m)·l   e_N = limit
        code      0     |         1 … m                |         m + 1 … N

    m, `growing`, is the least number for which no geometric interval is longer than l, `step`. A level is the middle
    of its interval. A tie goes towards zero. By default y_t, `threshold`, is limit/4, and y₀ a quarter of the uniform
    kind's.
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
        ratio = self.threshold / self.deadzone
        growing = [self.deadzone * ratio ** (i / self.growing) for i in range(self.growing)]
        alike = [self.threshold + i * self.step for i in range(self.top - self.growing)]
        self.edges = [*growing, *alike, limit]
        if not all(b - a > _APART * b for a, b in pairwise(self.edges)):
            raise ValueError(f"a limit of {limit} leaves no intervals that a float can distinguish")
        self.bound = max(self.deadzone, max(b - a for a, b in pairwise(self.edges)) / 2)
        self._tabulate([(a + b) / 2 for a, b in pairwise(self.edges)])

    def encode(self, y: float) -> int:
        _refuse_nan(y)
        i = bisect_left(self.edges, abs(y) * TIE)
        if i > self.top:
            self.saturated += 1
            i = self.top
        return i if y > 0 else -i

    def _least_growing(self) -> int:
        """m, by bisection: with a larger m the geometric intervals get shorter and the uniform ones longer."""

        def serves(m: int) -> bool:
            longest = -self.threshold * expm1(-log(self.threshold / self.deadzone) / m)
            return longest * _ALIKE <= self._step(m)

        return 1 + bisect_left(range(1, self.top - 1), True, key=serves)

    def _step(self, m: int) -> float:
        return (self.limit - self.threshold) / (self.top - m)


def _refuse_nan(y: float) -> None:
    if y != y:
        raise ValueError("NaN has no code; send the code for 'no valid value'")
