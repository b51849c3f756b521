"""Quantizers as CasADi expressions, for loops that are compiled as a whole.

Each line does the float operations of its twin in `quantizer.py`, in the same order, so that every bit is equal.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from math import nan
from threading import RLock
from typing import Final

import casadi as ca

from aeroloop.protocol.wire.quantizer import (
    SLACK,
    TIE,
    CodedQuantizer,
    Continuous,
    HysteresisQuantizer,
    LogarithmicQuantizer,
    Quantizer,
    UniformQuantizer,
)

NUMBERS: Final = ("deadzone", "step", "top", "limit", "hysteresis", "threshold", "growing")
"""Attributes of quantizers that the expressions use; a kind has some of them."""

_SWITCH: Final = RLock()


@contextmanager
def as_written() -> Iterator[None]:
    """Build expressions and insert functions operation by operation; c·(d·x) otherwise becomes (c·d)·x, which rounds.

    CasADi has one switch for all threads, so one at a time may build so. `if_else` still turns −0.0 into 0.0.
    """
    with _SWITCH:
        before = ca.GlobalOptions.getSimplificationOnTheFly()
        ca.GlobalOptions.setSimplificationOnTheFly(False)
        try:
            yield
        finally:
            ca.GlobalOptions.setSimplificationOnTheFly(before)


def numbers(quantizer: Quantizer) -> list[float]:
    """The NUMBERS of a quantizer; 0 for those that its kind lacks."""
    return [float(getattr(quantizer, name, 0.0)) for name in NUMBERS]


def with_numbers(quantizer: Quantizer, symbols: ca.SX) -> Quantizer:
    """A quantizer for `level` and `encode` whose NUMBERS are inputs, so that one function serves all of its kind."""
    symbolic = copy(quantizer)
    for i, name in enumerate(NUMBERS):
        setattr(symbolic, name, symbols[i])
    return symbolic


def level(quantizer: Quantizer, code: ca.SX) -> ca.SX:
    """The level of a code, as `Quantizer.level`. Build it `as_written`. Shape (1,)."""
    if isinstance(quantizer, Continuous):
        return code
    assert isinstance(quantizer, CodedQuantizer)
    index = ca.fabs(code)
    if isinstance(quantizer, LogarithmicQuantizer):
        magnitude = (_edge(quantizer, index - 1) + _edge(quantizer, index)) / 2
    else:
        assert isinstance(quantizer, UniformQuantizer)
        magnitude = (quantizer.deadzone + quantizer.step / 2) + (index - 1) * quantizer.step
    return ca.if_else(code < -quantizer.top, nan, ca.sign(code) * magnitude)


def encode(quantizer: Quantizer, y: ca.SX, held: ca.SX) -> ca.SX:
    """The code of a value, as `Quantizer.encode`; not of NaN. Build it `as_written`. Shape (1,).

    Of the quantizer it takes the parameters alone: its memory is `held`, the last code; NaN before the first.
    """
    if isinstance(quantizer, Continuous):
        return ca.fmax(-quantizer.limit, ca.fmin(quantizer.limit, y))
    assert isinstance(quantizer, CodedQuantizer)
    if isinstance(quantizer, LogarithmicQuantizer):
        value = ca.fabs(y) * TIE
        guess = ca.fmin(_intervals(quantizer, value), quantizer.top)
        index = guess + (value > _edge(quantizer, guess)) - (value <= _edge(quantizer, guess - 1))
    else:
        assert isinstance(quantizer, UniformQuantizer)
        index = ca.ceil((ca.fabs(y) - quantizer.deadzone) / quantizer.step * TIE)
    code = ca.sign(y) * ca.fmax(ca.fmin(index, quantizer.top), 0) + 0  # −0.0 is 0.0
    return ca.if_else(_stays(quantizer, y, held), held, code) if isinstance(quantizer, HysteresisQuantizer) else code


def saturates(quantizer: Quantizer, y: ca.SX) -> ca.SX:
    """1 if a value is beyond the range, as `Quantizer.saturated` counts, else 0. Build it `as_written`. Shape (1,)."""
    if isinstance(quantizer, UniformQuantizer):  # what a hysteresis holds is within the range
        return (ca.fabs(y) - quantizer.deadzone) / quantizer.step * TIE > quantizer.top
    return ca.fabs(y) * (1 if isinstance(quantizer, Continuous) else TIE) > quantizer.limit


def _stays(quantizer: HysteresisQuantizer, y: ca.SX, held: ca.SX) -> ca.SX:
    """Whether a value is within the held code's interval, widened; false if nothing is held."""
    h = quantizer.hysteresis
    outer = quantizer.deadzone + ca.fabs(held) * quantizer.step
    inner = outer - quantizer.step
    high = ca.fmin(quantizer.limit, outer + h + SLACK * (outer + h))
    low = ca.if_else(held == 0, -high, inner - h - SLACK * (inner + h))
    along = ca.if_else(held < 0, -y, y)
    return ca.logic_and(low <= along, along <= high)  # low is NaN if held is


def _edge(quantizer: LogarithmicQuantizer, i: ca.SX) -> ca.SX:
    """e_i; what it gives for i < 0 lies below e₀, and that for i = N is the limit."""
    m, ratio = quantizer.growing, quantizer.threshold / quantizer.deadzone
    growing = quantizer.deadzone * ca.SX(ratio) ** (i / m)
    alike = quantizer.threshold + (i - m) * quantizer.step
    return ca.if_else(i < m, growing, ca.if_else(i < quantizer.top, alike, quantizer.limit))


def _intervals(quantizer: LogarithmicQuantizer, value: ca.SX) -> ca.SX:
    """How many edges lie below a value: by logarithm and division, so it may be wrong by one."""
    m, ratio = quantizer.growing, quantizer.threshold / quantizer.deadzone
    growing = ca.ceil(ca.log(ca.fmax(value, quantizer.deadzone) / quantizer.deadzone) / ca.log(ratio) * m)
    alike = m + ca.ceil((value - quantizer.threshold) / quantizer.step)
    return ca.if_else(value < quantizer.threshold, growing, alike)
