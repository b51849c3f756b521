"""Frames: exactly the bits of SPEC.md, and refusal of malformed bytes.

`bit_string` below lays a frame out in characters "0" and "1" and shares no code with the packer.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from math import inf, isinf, isnan, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.spec import MAX_ACTUATORS, WireSpec
from tests.support.wires import COUNTER_BITS, any_counter_bits, wire_of, wires

Widths = tuple[int | None, ...]

WIDTHS: tuple[int | None, ...] = (None, *range(2, 17))


def formats() -> Iterator[FrameFormat]:
    """Both frames of every mixture of widths, and of every width of the counter with some of them."""
    for first in WIDTHS:
        for second in WIDTHS:
            yield wire_of(first, second, 6).measurement
        for actuators in range(1, MAX_ACTUATORS + 1):
            yield wire_of(8, 8, first, actuators).command
    for counter_bits in COUNTER_BITS:
        for width in (2, 8, None):
            yield wire_of(8, width, 6, counter_bits=counter_bits).measurement
            yield wire_of(8, 8, width, counter_bits=counter_bits).command


def bit_string(counter: int, counter_bits: int, widths: Widths, codes: Sequence[float]) -> str:
    """A frame in characters "0" and "1", padding included."""
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
    """Eight characters a byte."""
    return bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8))


def padding(counter_bits: int, widths: Widths) -> list[int]:
    """Positions, from the first bit, that carry nothing."""
    first = -(-counter_bits // 8) * 8 if None in widths else counter_bits
    used = first + sum(64 if width is None else width for width in widths)
    return [*range(counter_bits, first), *range(used, -(-used // 8) * 8)]


def flipped(frame: bytes, bit: int) -> bytes:
    """The frame with one bit, counted from the first, turned."""
    changed = bytearray(frame)
    changed[bit // 8] ^= 0x80 >> bit % 8
    return bytes(changed)


def same(codes: Sequence[float], others: Sequence[float]) -> bool:
    """Equal, types included; NaN equals NaN."""
    return [repr(code) for code in codes] == [repr(code) for code in others]


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
    """The same of a command."""
    return spec.command, (spec.voltage.bits,) * spec.actuators


both_frames = pytest.mark.parametrize("direction", [measured, commanded])
Direction = Callable[[WireSpec], tuple[FrameFormat, Widths]]


@both_frames
@settings(max_examples=60)
@given(spec=wires, data=st.data())
def test_a_frame_is_the_bits_of_the_spec_and_unpacks_to_what_was_packed(
    direction: Direction, spec: WireSpec, data: st.DataObject
) -> None:
    form, widths = direction(spec)
    counter, codes = data.draw(st.integers(0, 2**spec.counter_bits - 1)), data.draw(codes_of(widths))
    frame = form.pack(counter, codes)
    assert frame == as_bytes(bit_string(counter, spec.counter_bits, widths, codes))
    arrived = form.unpack(frame)
    assert arrived is not None
    assert arrived[0] == form.counter(frame) == counter
    assert same(arrived[1], codes)


@pytest.mark.parametrize("bits", range(2, 17))
def test_every_code_of_every_width_survives_the_wire(bits: int) -> None:
    spec = wire_of(8, 8, bits)
    top = 2 ** (bits - 1) - 1
    for code in range(-top - 1, top + 1):
        other = -1 - code
        frame = spec.command.pack(code % 256, (code, other))
        assert frame == as_bytes(bit_string(code % 256, 8, (bits, bits), (code, other)))
        assert spec.command.unpack(frame) == (code % 256, (code, other))


@pytest.mark.parametrize("bits", COUNTER_BITS)
def test_every_counter_of_every_width_survives_the_wire(bits: int) -> None:
    spec = wire_of(8, 8, 6, counter_bits=bits)
    for form in (spec.measurement, spec.command):
        assert (form.counter_bits, form.counters) == (bits, 2**bits)
        codes = [-1] * len(form.widths)
        for counter in range(2**bits):
            frame = form.pack(counter, codes)
            assert form.counter(frame) == counter
            assert form.unpack(frame) == (counter, tuple(codes))


@pytest.mark.parametrize(
    ("form", "bits", "size"),
    [
        pytest.param(wire_of(8, 8, 6).measurement, 56, 7, id="R=8 measurement"),
        pytest.param(wire_of(10, 10, 6).measurement, 68, 9, id="R=10 measurement"),
        pytest.param(wire_of(10, 10, 6, 2, 4).measurement, 64, 8, id="R=10 measurement, 4 bits of counter"),
        pytest.param(wire_of(8, 8, 6).command, 20, 3, id="R=6 command"),
        pytest.param(wire_of(8, 8, 6, 2, 4).command, 16, 2, id="R=6 command, 4 bits of counter"),
        pytest.param(wire_of(8, 8, 6, 3).command, 26, 4, id="R=6 command of three"),
        pytest.param(wire_of(None, None, 6).measurement, 8 + 6 * 64, 49, id="cont measurement"),
        pytest.param(
            wire_of(None, None, 6, 2, 4).measurement, 4 + 6 * 64, 49, id="cont measurement, 4 bits of counter"
        ),
        pytest.param(wire_of(8, 8, None, 2, 10).command, 10 + 2 * 64, 18, id="cont command, 10 bits of counter"),
    ],
)
def test_frames_have_the_sizes_of_the_design(form: FrameFormat, bits: int, size: int) -> None:
    assert (form.bits, form.size) == (bits, size)
    assert len(form.pack(0, [0 if width else 0.0 for width in form.widths])) == size


def test_the_default_wire_is_the_paper_s() -> None:
    assert WireSpec() == wire_of(8, 8, 6, 2)


def test_without_quantization_the_counter_fills_whole_bytes_before_big_endian_doubles() -> None:
    codes = (12.5, -24.0)
    for bits, counter, before in ((4, 15, b"\xf0"), (8, 0x9A, b"\x9a"), (10, 0x2FF, b"\xbf\xc0")):
        command = wire_of(8, 8, None, counter_bits=bits).command
        assert command.pack(counter, codes) == before + struct.pack(">2d", *codes)
        assert command.first_bit == 8 * len(before)


@given(any_counter_bits, st.integers(1, 10**9))
def test_a_frame_is_mistaken_for_a_newer_one_no_sooner_than_the_counter_has_come_round(bits: int, period: int) -> None:
    assert wire_of(8, 8, 6, counter_bits=bits).freshness_ns(period) == 2**bits * period


def test_every_wrong_length_is_refused() -> None:
    for form in formats():
        frame = form.pack(5, [0 if width else 0.0 for width in form.widths])
        assert form.unpack(frame) is not None
        for length in range(len(frame)):
            assert form.unpack(frame[:length]) is None
        assert form.unpack(frame + b"\0") is None
        assert form.unpack(frame * 2) is None


def test_every_padding_bit_that_is_not_zero_is_refused_and_every_other_bit_carries_something() -> None:
    for form in formats():
        frame = form.pack(5, [1 if width else 0.5 for width in form.widths])  # 0.5: one bit turned is never infinite
        idle = padding(form.counter_bits, form.widths)
        assert len(idle) == 8 * form.size - form.bits
        for bit in idle:
            assert form.unpack(flipped(frame, bit)) is None
            assert form.counter(flipped(frame, bit)) is None
        before = form.unpack(frame)
        for bit in set(range(8 * form.size)) - set(idle):
            after = form.unpack(flipped(frame, bit))
            assert after is not None
            assert after != before


def test_an_infinite_float_is_refused_in_every_place() -> None:
    for form in formats():
        for i in (i for i, width in enumerate(form.widths) if width is None):
            for bad in (inf, -inf):
                codes: list[float] = [0 if width else 0.0 for width in form.widths]
                codes[i] = bad
                assert form.unpack(as_bytes(bit_string(0, form.counter_bits, form.widths, codes))) is None
                with pytest.raises(ValueError, match="infinite"):
                    form.pack(0, codes)


@both_frames
@settings(max_examples=80)
@given(spec=wires, data=st.data())
def test_any_bytes_are_refused_or_are_exactly_what_packing_gives(
    direction: Direction, spec: WireSpec, data: st.DataObject
) -> None:
    form, widths = direction(spec)
    size = len(bit_string(0, spec.counter_bits, widths, (0,) * len(widths))) // 8
    frame = data.draw(st.binary(min_size=max(size - 1, 0), max_size=size + 1) | st.binary(min_size=size, max_size=size))
    if len(frame) == size and data.draw(st.booleans()):  # else few would be well-formed
        for bit in padding(spec.counter_bits, widths):
            frame = bytes(b & ~(0x80 >> bit % 8) if i == bit // 8 else b for i, b in enumerate(frame))
    idle = padding(spec.counter_bits, widths)
    arrived = form.unpack(frame)
    assert form.counter(frame) == (None if arrived is None else arrived[0])
    if len(frame) != size or any(frame[bit // 8] & 0x80 >> bit % 8 for bit in idle):
        assert arrived is None
        return
    text = "".join(f"{byte:08b}" for byte in frame)
    codes = list(read(text, spec.counter_bits, widths))
    if any(isinf(code) for code in codes):
        assert arrived is None
        return
    assert arrived is not None
    assert arrived[0] == int(text[: spec.counter_bits], 2)
    assert same(arrived[1], codes)
    again = form.pack(*arrived)
    if any(isnan(code) for code in codes):  # which of the many NaNs it was need not survive
        once_more = form.unpack(again)
        assert once_more is not None
        assert once_more[0] == arrived[0]
        assert same(once_more[1], codes)
    else:
        assert again == frame


def read(text: str, counter_bits: int, widths: Widths) -> Iterator[float]:
    """The codes in a string of bits, read independently of the code under test."""
    at = -(-counter_bits // 8) * 8 if None in widths else counter_bits
    for width in widths:
        field = text[at : at + (width or 64)]
        at += len(field)
        if width is None:
            yield float(struct.unpack(">d", int(field, 2).to_bytes(8, "big"))[0])
        else:
            yield int(field, 2) - (2**width if field[0] == "1" else 0)


@given(st.binary(max_size=60))
def test_unpacking_never_raises(frame: bytes) -> None:
    for spec in (wire_of(8, 8, 6), wire_of(10, 10, 6, 3, 4), wire_of(None, 8, None), wire_of(3, None, None, 3, 11)):
        for form in (spec.measurement, spec.command):
            assert form.unpack(frame) is None or len(frame) == form.size
            assert form.counter(frame) is None or len(frame) == form.size


@pytest.mark.parametrize("bits", [4, 8, 11, 16])
def test_a_counter_that_does_not_fit_is_refused(bits: int) -> None:
    wrong: list[Any] = [-1, 2**bits, 2**70, 0.5, 1.0, nan]
    for form in (wire_of(8, 8, 6, 2, bits).command, wire_of(8, 8, None, 2, bits).command):
        for counter in wrong:
            with pytest.raises(ValueError, match="does not fit"):
                form.pack(counter, [0 if width else 0.0 for width in form.widths])


@pytest.mark.parametrize("bits", range(2, 17))
def test_a_code_that_does_not_fit_is_refused(bits: int) -> None:
    spec = wire_of(bits, bits, bits)
    for bad in (2 ** (bits - 1), -(2 ** (bits - 1)) - 1, 2**70, -(2**70), 0.0, 0.5, nan, inf):
        for i in range(2):
            with pytest.raises(ValueError, match="does not fit"):
                spec.command.pack(0, [bad if i == j else 0 for j in range(2)])
        for i in range(6):
            with pytest.raises(ValueError, match="does not fit"):
                spec.measurement.pack(0, [bad if i == j else 0 for j in range(6)])


@pytest.mark.parametrize("count", [0, 1, 3, 6])
def test_a_wrong_number_of_codes_is_refused(count: int) -> None:
    for bits in (6, None):
        with pytest.raises(ValueError, match=f"2 codes, not {count}"):
            wire_of(8, 8, bits).command.pack(0, [0] * count)


def test_an_integer_too_large_for_a_float_is_refused() -> None:
    with pytest.raises(ValueError, match=r"fit|infinite"):
        wire_of(8, 8, None).command.pack(0, (10**400, 0.0))
