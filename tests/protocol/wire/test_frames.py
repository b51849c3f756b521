"""Frames: exactly the bits of SPEC.md, and refusal of malformed bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from math import inf, isnan, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.wires import wire_of, wires

Widths = tuple[int | None, ...]


def bit_string(counter: int, counter_bits: int, widths: Widths, codes: Sequence[float]) -> str:
    """A frame in characters "0" and "1", padding included; shares no code with the packer."""
    bits = f"{counter:0{counter_bits}b}"
    while None in widths and len(bits) % 8:
        bits += "0"
    for width, code in zip(widths, codes, strict=True):
        if width is None:
            bits += "".join(f"{byte:08b}" for byte in struct.pack(">d", code))
        else:
            bits += f"{int(code) % 2**width:0{width}b}"
    while len(bits) % 8:
        bits += "0"
    return bits


def as_bytes(bits: str) -> bytes:
    return bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8))


def padding(counter_bits: int, widths: Widths) -> set[int]:
    """Positions, from the first bit, that carry nothing."""
    first = -(-counter_bits // 8) * 8 if None in widths else counter_bits
    used = first + sum(64 if width is None else width for width in widths)
    return {*range(counter_bits, first), *range(used, -(-used // 8) * 8)}


def codes_of(widths: Widths) -> st.SearchStrategy[tuple[float, ...]]:
    """Any codes a frame of these widths can hold, "no valid value" included."""
    one: Callable[[int | None], st.SearchStrategy[float]] = lambda width: (  # noqa: E731
        st.floats(allow_infinity=False) if width is None else st.integers(-(2 ** (width - 1)), 2 ** (width - 1) - 1)
    )
    return st.tuples(*(one(width) for width in widths))


def measured(spec: WireSpec) -> tuple[FrameFormat, Widths]:
    """A measurement's format, and its widths by the spec."""
    return spec.measurement, (spec.attitude.bits,) * 3 + (spec.rate.bits,) * 3


def commanded(spec: WireSpec) -> tuple[FrameFormat, Widths]:
    return spec.command, (spec.voltage.bits,) * spec.actuators


both_frames = pytest.mark.parametrize("direction", [measured, commanded])
Direction = Callable[[WireSpec], tuple[FrameFormat, Widths]]


@both_frames
@settings(max_examples=150)
@given(spec=wires, data=st.data())
def test_a_frame_is_the_bits_of_the_spec_and_unpacks_to_what_was_packed(
    direction: Direction, spec: WireSpec, data: st.DataObject
) -> None:
    form, widths = direction(spec)
    counter, codes = data.draw(st.integers(0, 2**spec.counter_bits - 1)), data.draw(codes_of(widths))
    frame = form.pack(counter, codes)
    assert frame == as_bytes(bit_string(counter, spec.counter_bits, widths, codes))
    assert len(frame) == form.size
    assert form.bits == 8 * form.size - len(padding(spec.counter_bits, widths))
    assert form.counters == 2**spec.counter_bits
    arrived = form.unpack(frame)
    assert arrived is not None
    assert arrived[0] == form.counter(frame) == counter
    assert repr(arrived[1]) == repr(codes)  # types included; NaN equals itself


@both_frames
@settings(max_examples=150)
@given(spec=wires, data=st.data())
def test_any_bytes_are_refused_or_are_exactly_what_packing_gives(
    direction: Direction, spec: WireSpec, data: st.DataObject
) -> None:
    form, widths = direction(spec)
    size = len(bit_string(0, spec.counter_bits, widths, (0,) * len(widths))) // 8
    frame = data.draw(st.binary(min_size=max(size - 1, 0), max_size=size + 1) | st.binary(min_size=size, max_size=size))
    bits = "".join(f"{byte:08b}" for byte in frame)
    idle = padding(spec.counter_bits, widths)
    if len(frame) == size and data.draw(st.booleans()):  # else few would be well-formed
        bits = "".join("0" if i in idle else bit for i, bit in enumerate(bits))
        frame = as_bytes(bits)
    arrived = form.unpack(frame)
    assert form.counter(frame) == (None if arrived is None else arrived[0])
    if len(frame) != size or any(bits[i] == "1" for i in idle):
        assert arrived is None
    elif arrived is not None:  # which of the many NaNs need not survive
        assert any(isnan(code) for code in arrived[1]) or form.pack(*arrived) == frame
    else:
        assert None in widths
    if None in widths:
        infinite = [inf if width is None else 0 for width in widths]
        assert form.unpack(as_bytes(bit_string(0, spec.counter_bits, widths, infinite))) is None


@pytest.mark.parametrize("bits", [4, 8, 16])
def test_a_counter_or_a_code_that_does_not_fit_and_a_wrong_number_of_codes_are_refused(bits: int) -> None:
    form, free = wire_of(8, 8, bits, 2, bits).command, wire_of(8, 8, None, 2, bits).command
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
    with pytest.raises(ValueError, match=r"fit|infinite"):
        free.pack(0, (10**400, 0.0))
