"""Hysteresis-uniform quantizer: the uniform quantizer's levels, and a code that is held while the value stays near it.

The held level's interval is widened by h on either side; a value outside it is quantized uniformly. Noise of less than
h about an edge therefore changes no code and no frame, and the error bound grows by h:

    held level   0                  ±y_i
    stays while  |y| ≤ y₀ + h       y_i − l/2 − h ≤ ±y ≤ y_i + l/2 + h

The paper names this kind (Remark 8) and cites another text for it; the definition here is the project's own (SPEC.md,
section 2). The last code is the only state.
"""

from __future__ import annotations

from math import inf
from typing import Final

from aeroloop.protocol.wire.quantizer import TIE, UniformQuantizer

SLACK: Final[float] = 1 - TIE


class HysteresisQuantizer(UniformQuantizer):
    """The hysteresis-uniform quantizer. A tie goes to the held level.

    Args:
        bits: R, 2…16.
        limit: Edge of the range [signal's unit], > 0.
        deadzone: y₀ [signal's unit]; l/2 if None.
        hysteresis: h [signal's unit]; l/2 if None: a code changes once the value is more than a step from its level.

    Attributes:
        hysteresis: h as used.

    Raises:
        ValueError: A value out of bounds.
    """

    def __init__(self, bits: int, limit: float, deadzone: float | None = None, hysteresis: float | None = None) -> None:
        super().__init__(bits, limit, deadzone)
        self.hysteresis = self.step / 2 if hysteresis is None else hysteresis
        if not 0 < self.hysteresis < limit:
            raise ValueError(f"hysteresis is more than 0 and less than the limit {limit}, not {hysteresis}")
        self.bound += self.hysteresis
        self.reset()

    def encode(self, y: float) -> int:
        """The code of a value, given the held code; see `Quantizer.encode`."""
        if self._low <= y <= self._high:
            return self._held
        code = super().encode(y)
        self._hold(code)
        return code

    def reset(self) -> None:
        """Hold nothing: the next value is quantized uniformly."""
        self._held = 0
        self._low, self._high = inf, -inf

    def resume(self, code: float) -> None:
        """Hold the level of a code; see `Quantizer.resume`."""
        if code != self.invalid:
            self._hold(int(code))

    def _hold(self, code: int) -> None:
        # A value within a few units in the last place of an edge lies on it. Beyond the limit a value saturates.
        h, i = self.hysteresis, abs(code)
        outer = self.deadzone + i * self.step
        high = min(self.limit, outer + h + SLACK * (outer + h))
        if code:
            inner = outer - self.step
            low = inner - h - SLACK * (inner + h)
        else:
            low = -high
        self._held = code
        self._low, self._high = (-high, -low) if code < 0 else (low, high)
