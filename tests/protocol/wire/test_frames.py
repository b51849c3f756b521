"""Frames: exactly the bits of SPEC.md, and refusal of malformed bytes."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import inf, isnan, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.frames import FrameFormat
from tests.support.wires import any_width

formats = st.builds(FrameFormat, st.lists(any_width, min_size=1, max_size=8), st.integers(4, 16))


def bit_string(form: FrameFormat, counter: int, codes: Sequence[float]) -> str:
    """A frame in characters "0" and "1", with "." for padding; shares no code with the packer."""
    bits = f"{counter:0{form.counter_bits}b}"
    while None in form.widths and len(bits) % 8:
        bits += "."
    for width, code in zip(form.widths, codes, strict=True):
        if width is None:
            bits += "".join(f"{byte:08b}" for byte in struct.pack(">d", code))
        else:
            bits += f"{int(code) % 2**width:0{width}b}"
    return bits.ljust(-(-len(bits) // 8) * 8, ".")


def as_bytes(bits: str) -> bytes:
    bits = bits.replace(".", "0")
    return bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8))


def codes_of(widths: Sequence[int | None]) -> st.SearchStrategy[tuple[float, ...]]:
    """Any codes a frame of these widths can hold, "no valid value" included."""
    floats = st.floats(allow_infinity=False)
    return st.tuples(*(st.integers(-(2**n // 2), 2**n // 2 - 1) if n else floats for n in widths))


@settings(max_examples=300)
@given(formats, st.data())
def test_a_frame_is_the_bits_of_the_spec_and_unpacks_to_what_was_packed(form: FrameFormat, data: st.DataObject) -> None:
    counter, codes = data.draw(st.integers(0, 2**form.counter_bits - 1)), data.draw(codes_of(form.widths))
    frame, bits = form.pack(counter, codes), bit_string(form, counter, codes)
    assert frame == as_bytes(bits)
    assert (len(frame), form.bits, form.counters) == (form.size, len(bits) - bits.count("."), 2**form.counter_bits)
    arrived = form.unpack(frame)
    assert arrived is not None
    assert arrived[0] == form.counter(frame) == counter
    assert repr(arrived[1]) == repr(codes)  # types included; NaN equals itself


@settings(max_examples=300)
@given(formats, st.data())
def test_any_bytes_are_refused_or_are_exactly_what_packing_gives(form: FrameFormat, data: st.DataObject) -> None:
    laid_out = bit_string(form, 0, (0,) * len(form.widths))
    size = len(laid_out) // 8
    frame = data.draw(st.binary(min_size=max(size - 1, 0), max_size=size + 1) | st.binary(min_size=size, max_size=size))
    bits = "".join(f"{byte:08b}" for byte in frame)
    if len(frame) == size and data.draw(st.booleans()):  # else few would be well-formed
        bits = "".join("0" if part == "." else bit for bit, part in zip(bits, laid_out, strict=True))
        frame = as_bytes(bits)
    arrived = form.unpack(frame)
    assert form.counter(frame) == (None if arrived is None else arrived[0])
    if len(frame) != size or any(bit == "1" and part == "." for bit, part in zip(bits, laid_out, strict=True)):
        assert arrived is None
    elif arrived is not None:  # which of the many NaNs need not survive
        assert any(isnan(code) for code in arrived[1]) or form.pack(*arrived) == frame
    else:
        assert None in form.widths
    if None in form.widths:
        infinite = [inf if width is None else 0 for width in form.widths]
        assert form.unpack(as_bytes(bit_string(form, 0, infinite))) is None


@pytest.mark.parametrize("bits", [4, 8, 16])
def test_a_counter_or_a_code_that_does_not_fit_and_a_wrong_number_of_codes_are_refused(bits: int) -> None:
    form, free = FrameFormat([bits] * 2, bits), FrameFormat([None] * 2, bits)
    wrong: list[Any] = [-1, 2**bits, 0.5, nan]
    for counter in wrong:
        with pytest.raises(ValueError, match="does not fit"):
            form.pack(counter, [0, 0])
        with pytest.raises(ValueError, match="does not fit"):
            free.pack(counter, [0.0, 0.0])
    for code in (2 ** (bits - 1), -(2 ** (bits - 1)) - 1, 2**70, 0.0, 0.5, nan, inf):
        for codes in ((code, 0), (0, code)):
            with pytest.raises(ValueError, match="does not fit"):
                form.pack(0, codes)
    with pytest.raises(ValueError, match="2 codes, not 3"):
        form.pack(0, [0] * 3)
    for huge in (10**400, inf):
        with pytest.raises(ValueError, match=r"fit|infinite"):
            free.pack(0, (huge, 0.0))
