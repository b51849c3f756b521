"""Quantizers, (C.13)–(C.15): value ↔ code ↔ level.

A value is quantized to a level (C.14); the level's index is the code, an R-bit two's-complement integer, and only the
code is sent. R bits index 2^R − 1 levels, symmetric about zero; the spare code, −2^(R−1), means "no valid value" and
decodes to NaN.

    code   −2^(R−1)   −(2^(R−1) − 1)  …  −1   0   1  …  2^(R−1) − 1
    level  NaN        −y_max          …  −y₁  0   y₁ …  y_max

With y₀ = l/2 the levels are k·l and l = 2·limit / (2^R − 1). The paper gives this l and says only y₀ > 0; l/2 is
inferred: with it, 2^R − 1 intervals of that length fill the range exactly. For any other y₀ the step is such that the
outermost interval ends exactly at the limit, too: l = (limit − y₀) / (2^(R−1) − 1).

The uniform quantizer is the paper's; `hysteresis` and `logarithmic` define two more kinds (Remark 8).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import ceil, copysign, nan
from typing import Final

MIN_BITS: Final = 2
MAX_BITS: Final = 16

TIE: Final[float] = 1 - 2.0**-50
"""A value within a few units in the last place of an interval's edge lies on the edge: dividing by l rounds."""


class Quantizer(ABC):
    """A bounded quantizer of one scalar signal: |y^Q − y| ≤ bound for every |y| ≤ limit, as (C.13) requires.

    Decoding is stateless; encoding may depend on the last code, so each scalar has a quantizer of its own.

    Attributes:
        limit: Edge of the range, in the signal's unit.
        bound: δ_y of (C.13), in the signal's unit.
        saturated: Number of values beyond the range, which got the outermost level.
        outermost: The largest level, where saturation begins [signal's unit].
        invalid: The code of "no valid value".
        level: `decode` without its check, for codes out of a frame, which are always valid.
    """

    limit: float
    bound: float
    saturated: int
    outermost: float
    invalid: float
    level: Callable[[float], float]

    @abstractmethod
    def encode(self, y: float) -> float:
        """The code of a value. Beyond the range: the outermost level's, and `saturated` goes up.

        Raises:
            ValueError: y is NaN. The caller sends `invalid` for a failed sensor.
        """

    @abstractmethod
    def decode(self, code: float) -> float:
        """The level of a code; NaN for `invalid`.

        Raises:
            ValueError: Not a code of this quantizer.
        """

    def reset(self) -> None:  # noqa: B027  # most kinds have no memory
        """Clear the memory at a session's start; `saturated` goes on counting."""

    def resume(self, code: float) -> None:  # noqa: B027  # the same
        """Restore the memory: this code was the last. `invalid` changes nothing."""

    def quantize(self, y: float) -> float:
        """y^Q, the level that the quantizer gives y; (C.15) applies it to each element of a vector."""
        return self.decode(self.encode(y))


class CodedQuantizer(Quantizer):
    """A quantizer with R-bit codes and a table of levels, symmetric about 0; kinds differ in levels and in `encode`.

    Args:
        bits: R, 2…16.
        limit: Edge of the range [signal's unit], > 0.

    Attributes:
        top: N = 2^(R−1) − 1, the code of the outermost level.
        deadzone: y₀, the largest magnitude that is quantized to 0 by its value alone [signal's unit].
        levels: Level by code. Python's negative index is two's complement, so `levels[code]` is the whole decoder.

    Raises:
        ValueError: A value out of bounds.
    """

    deadzone: float
    levels: list[float]
    invalid: int

    def __init__(self, bits: int, limit: float) -> None:
        if not MIN_BITS <= bits <= MAX_BITS:
            raise ValueError(f"a quantizer has {MIN_BITS} to {MAX_BITS} bits, not {bits}")
        if not 0 < limit < float("inf"):
            raise ValueError(f"a quantizer's limit is positive and finite, not {limit}")
        self.bits = bits
        self.limit = limit
        self.top: int = 2 ** (bits - 1) - 1
        self.invalid = -self.top - 1
        self.saturated = 0

    def _tabulate(self, positive: Sequence[float]) -> None:
        """Set the levels 1…N."""
        self.levels = [0.0, *positive, nan, *(-y for y in reversed(positive))]
        self.outermost = self.levels[self.top]
        self.level = self.levels.__getitem__  # type: ignore[assignment]  # a code out of a frame is an int

    def decode(self, code: float) -> float:
        """The level of a code; NaN for `invalid`."""
        if not (isinstance(code, int) and self.invalid <= code <= self.top):
            raise ValueError(f"{code!r} is not a code of {self.bits} bits")
        return self.levels[code]


class UniformQuantizer(CodedQuantizer):
    """The uniform quantizer of (C.14). A tie goes towards zero: intervals are (y_i − l/2, y_i + l/2].

    Args:
        bits: R, 2…16.
        limit: Edge of the range [signal's unit], > 0.
        deadzone: y₀ [signal's unit]; l/2 if None, as inferred from the paper's l.

    Attributes:
        step: l, the length of an interval [signal's unit].

    Raises:
        ValueError: A value out of bounds.
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
        if not 0 < self.step < float("inf"):
            raise ValueError(f"a limit of {limit} leaves no step that a float can hold")
        self.bound = max(self.deadzone, self.step / 2)
        self._tabulate([self.deadzone + self.step / 2 + i * self.step for i in range(self.top)])

    def encode(self, y: float) -> int:
        """The code of a value; see `Quantizer.encode`."""
        x: float = (abs(y) - self.deadzone) / self.step * TIE
        if x <= 0.0:
            return 0
        if x > self.top:
            self.saturated += 1
            return self.top if y > 0 else -self.top
        if y != y:
            raise ValueError("NaN has no code; send the code for 'no valid value'")
        return ceil(x) if y > 0 else -ceil(x)


class Continuous(Quantizer):
    """The paper's "cont.": no quantization. The value is its own code; beyond the range, the limit; NaN is invalid.

    Raises:
        ValueError: The limit is not positive and finite.
    """

    def __init__(self, limit: float) -> None:
        if not 0 < limit < float("inf"):
            raise ValueError(f"a signal's limit is positive and finite, not {limit}")
        self.limit = self.outermost = limit
        self.bound = 0.0
        self.saturated = 0
        self.invalid = nan
        self.level = float

    def encode(self, y: float) -> float:
        """The value itself, within ±limit; see `Quantizer.encode`."""
        if -self.limit <= y <= self.limit:
            return y
        if y != y:
            raise ValueError("NaN has no code; send the code for 'no valid value'")
        self.saturated += 1
        return copysign(self.limit, y)

    def decode(self, code: float) -> float:
        """The value itself; NaN for `invalid`."""
        return float(code)
