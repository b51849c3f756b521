"""Frames, codes and levels, thousands at once: protocol/frames.py and quantizer.py as numpy does them, to the last bit.

Codes stand in rows of doubles, which hold those of 16 bits and those that are not quantized alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import nan

import numpy as np

from protocol.frames import FrameFormat
from protocol.hysteresis import HysteresisQuantizer
from protocol.logarithmic import LogarithmicQuantizer
from protocol.quantizer import TIE, CodedQuantizer, Quantizer, UniformQuantizer
from protocol.wire import SignalSpec
from service.logs.report import Array


def codes_in(kind: FrameFormat, frames: Sequence[bytes]) -> Array:
    """What `unpack` says of frames that it does not refuse: the codes of each. Shape (n, codes)."""
    octets = np.frombuffer(b"".join(frames), dtype=np.uint8).reshape(len(frames), kind.size)
    bits = np.unpackbits(octets, axis=1)
    codes = np.empty((len(frames), len(kind.widths)))
    at = kind.first_bit
    for i, width in enumerate(kind.widths):
        if width is None:
            codes[:, i] = np.packbits(bits[:, at : at + 64], axis=1).view(">f8")[:, 0]
            at += 64
        else:
            worth = 2.0 ** np.arange(width - 1, -1, -1)
            worth[0] *= -1  # two's complement
            codes[:, i] = bits[:, at : at + width] @ worth
            at += width
    return codes


def levels(signal: SignalSpec, codes: Array) -> Array:
    """The level of each code, in the signal's unit; NaN of one that says "no valid value". Any shape."""
    quantizer = signal.quantizer()
    if isinstance(quantizer, CodedQuantizer):
        return np.array(quantizer.levels)[codes.astype(np.intp)]  # a negative index counts from the end, as in a list
    return codes


def encoded(signal: SignalSpec, values: Array) -> Array:
    """The code of each value, by a quantizer a column that has encoded nothing yet; see `encoded_by`. Any shape."""
    columns = values.reshape(len(values), -1).T
    return np.stack([encoded_by(signal.quantizer(), column) for column in columns], axis=1).reshape(values.shape)


def encoded_by(quantizer: Quantizer, values: Array) -> Array:
    """The code of each value, one after another; the one that says "no valid value" of NaN. Shape (n,).

    What a quantizer remembers goes on from block to block. It counts no saturations.
    """
    if isinstance(quantizer, HysteresisQuantizer):
        # Each code depends on the one before, so this is no twin but the quantizer itself; a value that holds is cheap.
        saturated, encode = quantizer.saturated, quantizer.encode
        codes = np.array([encode(y) if y == y else nan for y in values.tolist()], dtype=np.float64)
        quantizer.saturated = saturated
    elif isinstance(quantizer, LogarithmicQuantizer):
        codes = np.minimum(np.searchsorted(quantizer.edges, np.abs(values) * TIE), quantizer.top).astype(np.float64)
        codes = np.where(values > 0, codes, 0.0 - codes)  # 0.0 − 0.0 is +0
    elif isinstance(quantizer, UniformQuantizer):
        x = (np.abs(values) - quantizer.deadzone) / quantizer.step * TIE
        codes = np.minimum(np.ceil(x), quantizer.top)
        codes = np.where(x <= 0.0, 0.0, np.where(values > 0, codes, -codes))
    else:
        codes = np.clip(values, -quantizer.limit, quantizer.limit)
    return np.where(np.isnan(values), quantizer.invalid, codes)
