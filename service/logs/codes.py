"""Packing, unpacking and quantizing of thousands of frames at once, bit for bit as protocol/wire does it.

Codes are doubles, which hold codes of 16 bits and values that are not quantized alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import (
    TIE,
    CodedQuantizer,
    HysteresisQuantizer,
    LogarithmicQuantizer,
    Quantizer,
    UniformQuantizer,
)
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.logs.traces import Array


def codes_in(kind: FrameFormat, frames: Sequence[bytes] | NDArray[Any]) -> Array:
    """Codes of well-formed frames, as `unpack` returns them, contiguous in memory per signal. Shape (n, codes).

    `frames` are bytes each; or an array with a frame per element, dtype V, or per row, dtype uint8.
    """
    octets = frames if isinstance(frames, np.ndarray) else np.frombuffer(b"".join(frames), dtype=np.uint8)
    octets = np.ascontiguousarray(octets).view(np.uint8).reshape(len(frames), kind.size)
    # A code starts within a byte and spans at most 16 bits, or 64 for a double; zeros pad the end.
    columns = np.zeros((kind.size + 9, len(frames)), dtype=np.uint8)
    columns[: kind.size] = octets.T
    codes = np.empty((len(kind.widths), len(frames)))
    at = kind.first_bit
    for i, width in enumerate(kind.widths):
        byte, bit = divmod(at, 8)
        if width is None:
            first = np.ascontiguousarray(columns[byte : byte + 8].T).view(">u8")[:, 0].astype(np.uint64)
            codes[i] = (first << bit | columns[byte + 8] >> (8 - bit)).view(np.float64)
        else:
            a, b, c = columns[byte : byte + 3].astype(np.int32)
            codes[i] = (a << 24 | b << 16 | c << 8) << bit >> (32 - width)  # two's complement: the sign fills
        at += 64 if width is None else width
    return codes.T


def frames_of(kind: FrameFormat, counters: NDArray[np.int64], codes: Array) -> NDArray[np.uint8]:
    """Frames of counters and codes, as `pack` builds them, a row each. Shapes (n,) and (n, codes) to (n, size)."""
    bits = np.zeros((8 * kind.size, len(counters)), dtype=np.uint8)
    bits[: kind.counter_bits] = counters >> np.arange(kind.counter_bits - 1, -1, -1)[:, np.newaxis] & 1
    at = kind.first_bit
    for i, width in enumerate(kind.widths):
        if width is None:
            octets = np.ascontiguousarray(codes[:, i]).astype(">f8").view(np.uint8).reshape(-1, 8)
            bits[at : at + 64] = np.unpackbits(octets, axis=1).T
        else:
            bits[at : at + width] = codes[:, i].astype(np.int64) >> np.arange(width - 1, -1, -1)[:, np.newaxis] & 1
        at += 64 if width is None else width
    return np.packbits(bits, axis=0).T


def levels(signal: SignalSpec, codes: Array) -> Array:
    """Level of each code, in the signal's unit; NaN for the code of "no valid value". Any shape."""
    table = _levels(signal)
    return codes if table is None else table[codes.astype(np.intp)]  # a negative index counts from the end


@lru_cache(maxsize=8)
def _levels(signal: SignalSpec) -> Array | None:
    quantizer = signal.quantizer()
    return np.array(quantizer.levels) if isinstance(quantizer, CodedQuantizer) else None


def encoded_by(quantizer: Quantizer, values: Array) -> Array:
    """Code of each value, in order; NaN gives the code of "no valid value". Shape (n,).

    The quantizer keeps its state from block to block, and counts no saturations.
    """
    if isinstance(quantizer, HysteresisQuantizer):
        # Each code depends on the one before, so the quantizer itself computes it; a held value is cheap.
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
