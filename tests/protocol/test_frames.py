"""Frames are exactly the bits that SPEC.md says, and what is not a frame is refused.

`bit_string` below lays a frame out on its own, in characters "0" and "1", and shares no code with the packer.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from math import inf, isinf, isnan, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from protocol.frames import (
    COUNTERS,
    FrameFormat,
    TickCounter,
    pack_command,
    pack_measurement,
    unpack_command,
    unpack_measurement,
)
from protocol.quantizer import Continuous, UniformQuantizer
from protocol.wire import SignalSpec, WireSpec

Widths = tuple[int | None, ...]

WIDTHS: tuple[int | None, ...] = (None, *range(2, 17))


def wire(attitude: int | None, rate: int | None, voltage: int | None, actuators: int = 2) -> WireSpec:
    """A spec by its bits."""
    return WireSpec.model_validate(
        {
            "attitude": {"bits": attitude, "limit": 1.0},
            "rate": {"bits": rate, "limit": 1.0},
            "voltage": {"bits": voltage, "limit": 24.0},
            "actuators": actuators,
        }
    )


def formats() -> Iterator[FrameFormat]:
    """Both frames of every mixture of widths."""
    for first in WIDTHS:
        for second in WIDTHS:
            yield wire(first, second, 6).measurement
        for actuators in (2, 3):
            yield wire(8, 8, first, actuators).command


def bit_string(counter: int, widths: Widths, codes: Sequence[float]) -> str:
    """A frame in characters "0" and "1", padding included."""
    bits = f"{counter:04b}"
    if None in widths:
        bits += "0000"
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


def padding(widths: Widths) -> list[int]:
    """Positions, from the first bit, that carry nothing."""
    gap = [4, 5, 6, 7] if None in widths else []
    used = 4 + len(gap) + sum(64 if width is None else width for width in widths)
    return [*gap, *range(used, -(-used // 8) * 8)]


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


counters = st.integers(0, COUNTERS - 1)
any_width = st.none() | st.integers(2, 16)
wires = st.builds(wire, any_width, any_width, any_width, st.sampled_from([2, 3]))


@st.composite
def signals(draw: st.DrawFn) -> SignalSpec:
    """Any signal: any bits and limit, with or without a dead zone."""
    limit = draw(st.floats(1e-6, 1e6))
    deadzone = draw(st.none() | st.floats(0.01, 0.99).map(lambda part: part * limit))
    return SignalSpec(bits=draw(any_width), limit=limit, deadzone=deadzone)


specs = st.builds(WireSpec, attitude=signals(), rate=signals(), voltage=signals(), actuators=st.sampled_from([2, 3]))

Pack = Callable[[WireSpec, int, Sequence[float]], bytes]
Unpack = Callable[[WireSpec, bytes], tuple[int, tuple[float, ...]] | None]

both_frames = pytest.mark.parametrize(
    ("pack", "unpack", "widths_of"),
    [
        (pack_measurement, unpack_measurement, lambda w: (w.attitude.bits,) * 3 + (w.rate.bits,) * 3),
        (pack_command, unpack_command, lambda w: (w.voltage.bits,) * w.actuators),
    ],
    ids=["measurement", "command"],
)


@both_frames
@settings(max_examples=150)
@given(spec=wires, counter=counters, data=st.data())
def test_a_frame_is_the_bits_of_the_spec_and_unpacks_to_what_was_packed(
    pack: Pack,
    unpack: Unpack,
    widths_of: Callable[[WireSpec], Widths],
    spec: WireSpec,
    counter: int,
    data: st.DataObject,
) -> None:
    codes = data.draw(codes_of(widths_of(spec)))
    frame = pack(spec, counter, codes)
    assert frame == as_bytes(bit_string(counter, widths_of(spec), codes))
    arrived = unpack(spec, frame)
    assert arrived is not None
    assert arrived[0] == counter
    assert same(arrived[1], codes)


@pytest.mark.parametrize("bits", range(2, 17))
def test_every_code_of_every_width_survives_the_wire(bits: int) -> None:
    spec = wire(8, 8, bits)
    top = 2 ** (bits - 1) - 1
    for code in range(-top - 1, top + 1):
        other = -1 - code
        frame = pack_command(spec, code % COUNTERS, (code, other))
        assert frame == as_bytes(bit_string(code % COUNTERS, (bits, bits), (code, other)))
        assert unpack_command(spec, frame) == (code % COUNTERS, (code, other))


@pytest.mark.parametrize(
    ("form", "bits", "size"),
    [
        pytest.param(wire(8, 8, 6).measurement, 52, 7, id="R=8 measurement"),
        pytest.param(wire(10, 10, 6).measurement, 64, 8, id="R=10 measurement"),
        pytest.param(wire(8, 8, 6).command, 16, 2, id="R=6 command"),
        pytest.param(wire(8, 8, 6, 3).command, 22, 3, id="R=6 command of three"),
        pytest.param(wire(None, None, 6).measurement, 4 + 6 * 64, 49, id="cont measurement"),
        pytest.param(wire(8, 8, None).command, 4 + 2 * 64, 17, id="cont command"),
    ],
)
def test_frames_have_the_sizes_of_the_design(form: FrameFormat, bits: int, size: int) -> None:
    assert (form.bits, form.size) == (bits, size)
    assert len(form.pack(0, [0 if width else 0.0 for width in form.widths])) == size


def test_the_default_wire_is_the_paper_s() -> None:
    assert WireSpec() == wire(8, 8, 6, 2)


def test_without_quantization_the_counter_is_a_high_nibble_before_big_endian_doubles() -> None:
    codes = (0.0, -0.5, 1.0, 1e-300, -2.5, 3.14)
    assert pack_measurement(wire(None, None, 6), 9, codes) == bytes([0x90]) + struct.pack(">6d", *codes)
    assert pack_command(wire(8, 8, None), 15, (12.5, -24.0)) == bytes([0xF0]) + struct.pack(">2d", 12.5, -24.0)


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
        idle = padding(form.widths)
        assert len(idle) == 8 * form.size - form.bits
        for bit in idle:
            assert form.unpack(flipped(frame, bit)) is None
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
                assert form.unpack(as_bytes(bit_string(0, form.widths, codes))) is None
                with pytest.raises(ValueError, match="infinite"):
                    form.pack(0, codes)


@both_frames
@settings(max_examples=200)
@given(spec=wires, data=st.data())
def test_any_bytes_are_refused_or_are_exactly_what_packing_gives(
    pack: Pack, unpack: Unpack, widths_of: Callable[[WireSpec], Widths], spec: WireSpec, data: st.DataObject
) -> None:
    widths = widths_of(spec)
    size = len(bit_string(0, widths, (0,) * len(widths))) // 8
    frame = data.draw(st.binary(min_size=max(size - 1, 0), max_size=size + 1) | st.binary(min_size=size, max_size=size))
    if len(frame) == size and data.draw(st.booleans()):  # else few would be well-formed
        for bit in padding(widths):
            frame = bytes(b & ~(0x80 >> bit % 8) if i == bit // 8 else b for i, b in enumerate(frame))
    idle = any(frame[bit // 8] & 0x80 >> bit % 8 for bit in padding(widths)) if len(frame) == size else True
    arrived = unpack(spec, frame)
    if idle:
        assert arrived is None
        return
    text = "".join(f"{byte:08b}" for byte in frame)
    codes = list(read(text, widths))
    if any(isinf(code) for code in codes):
        assert arrived is None
        return
    assert arrived is not None
    assert arrived[0] == int(text[:4], 2)
    assert same(arrived[1], codes)
    again = pack(spec, *arrived)
    if any(isnan(code) for code in codes):  # which of the many NaNs it was need not survive
        once_more = unpack(spec, again)
        assert once_more is not None
        assert once_more[0] == arrived[0]
        assert same(once_more[1], codes)
    else:
        assert again == frame


def read(text: str, widths: Widths) -> Iterator[float]:
    """The codes in a string of bits, read independently of the code under test."""
    at = 8 if None in widths else 4
    for width in widths:
        field = text[at : at + (width or 64)]
        at += len(field)
        if width is None:
            yield float(struct.unpack(">d", int(field, 2).to_bytes(8, "big"))[0])
        else:
            yield int(field, 2) - (2**width if field[0] == "1" else 0)


@given(st.binary(max_size=60))
def test_unpacking_never_raises(frame: bytes) -> None:
    for spec in (wire(8, 8, 6), wire(10, 10, 6, 3), wire(None, 8, None), wire(3, None, None, 3)):
        for form in (spec.measurement, spec.command):
            assert form.unpack(frame) is None or len(frame) == form.size


@pytest.mark.parametrize("counter", [-1, 16, 2**70, 0.5, 1.0, nan])
def test_a_counter_that_does_not_fit_is_refused(counter: Any) -> None:
    for form in (wire(8, 8, 6).command, wire(8, 8, None).command):
        with pytest.raises(ValueError, match="does not fit"):
            form.pack(counter, [0 if width else 0.0 for width in form.widths])


@pytest.mark.parametrize("bits", range(2, 17))
def test_a_code_that_does_not_fit_is_refused(bits: int) -> None:
    spec = wire(bits, bits, bits)
    for bad in (2 ** (bits - 1), -(2 ** (bits - 1)) - 1, 2**70, -(2**70), 0.0, 0.5, nan, inf):
        for i in range(2):
            with pytest.raises(ValueError, match="does not fit"):
                pack_command(spec, 0, [bad if i == j else 0 for j in range(2)])
        for i in range(6):
            with pytest.raises(ValueError, match="does not fit"):
                pack_measurement(spec, 0, [bad if i == j else 0 for j in range(6)])


@pytest.mark.parametrize("count", [0, 1, 3, 6])
def test_a_wrong_number_of_codes_is_refused(count: int) -> None:
    for bits in (6, None):
        with pytest.raises(ValueError, match=f"2 codes, not {count}"):
            pack_command(wire(8, 8, bits), 0, [0] * count)


def test_an_integer_too_large_for_a_float_is_refused() -> None:
    with pytest.raises(ValueError, match=r"fit|infinite"):
        pack_command(wire(8, 8, None), 0, (10**400, 0.0))


@pytest.mark.parametrize(
    ("section", "broken"),
    [
        ("attitude", {"bits": 1, "limit": 1.0}),
        ("attitude", {"bits": 17, "limit": 1.0}),
        ("rate", {"bits": 8.5, "limit": 1.0}),
        ("rate", {"bits": "many", "limit": 1.0}),
        ("rate", {"bits": 8, "limit": 0.0}),
        ("rate", {"bits": 8, "limit": -1.0}),
        ("voltage", {"bits": 8, "limit": inf}),
        ("voltage", {"bits": 8, "limit": nan}),
        ("voltage", {"bits": 8}),
        ("voltage", {"limit": 1.0}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": 1.0}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": 1.5}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": 0.0}),
        ("attitude", {"bits": 8, "limit": 1.0, "deadzone": nan}),
        ("rate", {"bits": 8, "limit": 1.0, "offset": 0.0}),
        ("actuators", 1),
        ("actuators", 4),
        ("thrust", {"bits": 8, "limit": 1.0}),
    ],
)
def test_a_spec_out_of_bounds_is_refused_by_the_name_of_its_field(section: str, broken: object) -> None:
    with pytest.raises(ValidationError, match=section):
        WireSpec.model_validate({section: broken})


def test_the_word_cont_means_no_quantization() -> None:
    assert SignalSpec.model_validate({"bits": "cont", "limit": 2.0}) == SignalSpec(bits=None, limit=2.0)


@given(signals())
def test_a_signal_gives_its_quantizer(signal: SignalSpec) -> None:
    quantizer = signal.quantizer()
    assert quantizer.limit == signal.limit
    assert signal.quantizer() is not quantizer  # each counts its own saturations
    if signal.bits is None:
        assert isinstance(quantizer, Continuous)
    else:
        assert isinstance(quantizer, UniformQuantizer)
        assert quantizer.bits == signal.bits
        # Half a step, rounded twice, unless given.
        expected = signal.limit / (2**signal.bits - 1) if signal.deadzone is None else signal.deadzone
        assert quantizer.deadzone == pytest.approx(expected, rel=2.0**-50)


@given(specs)
def test_a_spec_survives_json(spec: WireSpec) -> None:
    assert spec.measurement.size > 0  # which caches the format; that is no field
    again = WireSpec.model_validate_json(spec.model_dump_json())
    assert again == spec
    assert hash(again) == hash(spec)
    assert again.differences(spec) == []


@given(specs)
def test_a_spec_cannot_be_changed(spec: WireSpec) -> None:
    with pytest.raises(ValidationError, match="frozen"):
        spec.actuators = 3
    with pytest.raises(ValidationError, match="frozen"):
        spec.rate.bits = 4


@pytest.mark.parametrize("field", ["bits", "limit", "deadzone"])
@pytest.mark.parametrize("signal", ["attitude", "rate", "voltage"])
def test_a_difference_names_its_field_and_both_values(signal: str, field: str) -> None:
    mine = {"bits": 8, "limit": 3.0, "deadzone": 0.5}
    theirs = {"bits": 10, "limit": 4.0, "deadzone": 0.25}
    a = WireSpec.model_validate({signal: mine})
    b = WireSpec.model_validate({signal: {**mine, field: theirs[field]}})
    assert a.differences(b) == [f"{signal}.{field}: {mine[field]}, not {theirs[field]}"]
    assert b.differences(a) == [f"{signal}.{field}: {theirs[field]}, not {mine[field]}"]


def test_all_differences_are_told_in_one_go() -> None:
    lines = wire(8, 8, 6, 2).differences(wire(None, 8, 4, 3))
    assert [re.split(":", line)[0] for line in lines] == ["attitude.bits", "voltage.bits", "actuators"]


@given(wires, any_width, any_width)
def test_with_bits_changes_the_bits_and_nothing_else(spec: WireSpec, out: int | None, inp: int | None) -> None:
    changed = spec.with_bits(out, inp)
    assert (changed.attitude.bits, changed.rate.bits, changed.voltage.bits) == (out, out, inp)
    assert changed.with_bits(8, 6) == spec.with_bits(8, 6)
    assert all(".bits:" in line for line in changed.differences(spec))


PERIOD_NS = 2_000_000


@given(st.lists(st.tuples(st.integers(1, 200), st.integers(0, TickCounter.LATE * PERIOD_NS)), max_size=200))
def test_a_counter_is_unwrapped_over_any_gap_while_frames_are_at_most_twelve_ticks_late(
    steps: list[tuple[int, int]],
) -> None:
    """The first frame is on time; then any number of ticks is skipped and each frame held up by any time allowed.

    Frames keep their order, as a plant that goes on only after it has sent does.
    """
    ticks, tick, sent = TickCounter(PERIOD_NS, lockstep=False), 0, 0
    assert ticks.advance(0, 0) == 0
    for step, late in steps:
        tick = max(tick + step, -(-sent // PERIOD_NS))
        sent = tick * PERIOD_NS + late
        assert ticks.advance(tick % COUNTERS, sent) == tick


def test_a_first_frame_that_was_held_up_misleads_nothing() -> None:
    ticks = TickCounter(PERIOD_NS, lockstep=False)
    assert ticks.advance(0, 3 * PERIOD_NS) == 0
    assert [ticks.advance(k % COUNTERS, k * PERIOD_NS) for k in range(3, 100)] == list(range(3, 100))


def test_a_frame_held_up_for_too_long_is_judged_wrongly_alone() -> None:
    ticks = TickCounter(PERIOD_NS, lockstep=False)
    for k in range(10):
        ticks.advance(k, k * PERIOD_NS)
    assert ticks.advance(10, (10 + 14) * PERIOD_NS) == 26  # sixteen too many
    # The plant goes on where its grid is; what would step back is passed over until the grid is past the error.
    found = [ticks.advance(k % COUNTERS, k * PERIOD_NS) for k in range(25, 40)]
    assert found == [None, None, *range(27, 40)]


def test_what_is_not_newer_has_no_tick() -> None:
    ticks = TickCounter(PERIOD_NS, lockstep=False)
    assert [ticks.advance(k, k * PERIOD_NS) for k in (0, 1, 2)] == [0, 1, 2]
    assert ticks.advance(2, 2 * PERIOD_NS + 100) is None
    assert ticks.advance(1, 2 * PERIOD_NS + 200) is None


def test_in_lockstep_a_counter_is_unwrapped_without_time() -> None:
    ticks = TickCounter(PERIOD_NS, lockstep=True, tick=29)
    assert [ticks.advance(counter, 0) for counter in (14, 15, 0, 1)] == [30, 31, 32, 33]
