"""Codes and levels of a signal, thousands at once: protocol/quantizer.py as numpy does it, to the last bit.

Codes stand in rows of doubles, which hold those of 16 bits and those that are not quantized alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from protocol.frames import SignalSpec
from protocol.quantizer import TIE, UniformQuantizer
from service.log.report import Array


def table(rows: Sequence[Sequence[float]]) -> Array:
    """Rows of equal length as a matrix; three times as fast as `np.array`. Shape (n, columns)."""
    columns = len(rows[0]) if rows else 0
    return np.fromiter(chain.from_iterable(rows), np.float64, len(rows) * columns).reshape(len(rows), columns)


def levels(signal: SignalSpec, codes: Array) -> Array:
    """The level of each code, in the signal's unit; NaN of one that says "no valid value". Any shape."""
    quantizer = signal.quantizer()
    if isinstance(quantizer, UniformQuantizer):
        return np.array(quantizer.levels)[codes.astype(np.intp)]  # a negative index counts from the end, as in a list
    return codes


def encoded(signal: SignalSpec, values: Array) -> Array:
    """The code of each value; the one that says "no valid value" of NaN. Any shape."""
    quantizer = signal.quantizer()
    if isinstance(quantizer, UniformQuantizer):
        x = (np.abs(values) - quantizer.deadzone) / quantizer.step * TIE
        codes = np.minimum(np.ceil(x), quantizer.top)
        codes = np.where(x <= 0.0, 0.0, np.where(values > 0, codes, -codes))
    else:
        codes = np.clip(values, -quantizer.limit, quantizer.limit)
    return np.where(np.isnan(values), quantizer.invalid, codes)
