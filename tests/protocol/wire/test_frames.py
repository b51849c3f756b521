"""Frames: the bits of SPEC.md and what is refused, the tick of a frame, when one is sent, and the spec of it all."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import inf, isnan, nan
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from aeroloop.protocol.wire.frames import FrameFormat, TickCounter
from aeroloop.protocol.wire.spec import SignalBits, SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Sender, Transmit
from tests.support.wires import any_width, specs, wires

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
    assert form.is_well_formed(frame) == (arrived is not None)
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
        assert not form.is_well_formed(as_bytes(bit_string(form, 0, infinite)))


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


# ── tick counter: true ticks from a few bits, in spite of loss, delay, reordering and drifting clocks ──


PERIOD_NS = 2_000_000


@st.composite
def runs(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]]]:
    """A counter's range, and measurements (tick, time of arrival) in order of arrival, on a clock with any offset.

    The clock drifts by up to 1 %. Frames are dropped, ticks are skipped, frames overtake each other, each late by
    less than 3/4 of the counter's range, less what the clocks drift over a gap before it. One frame in every `counters`
    ticks is late by an eighth of the range at the most, so that the mark, which moves by 3 % of a period a tick against
    the true grid, is never a quarter of the range late.
    """
    counters = 2 ** draw(st.sampled_from([4, 5, 8, 10]))
    offset_ns = draw(st.integers(-(10**18), 10**18))
    period_ns = PERIOD_NS * (1 + draw(st.sampled_from([-0.01, -0.003, 0.0, 0.005, 0.01])))
    punctual = counters // 8
    skips = st.one_of(st.just(1), st.integers(1, 3), st.integers(1, counters))
    steps = draw(st.lists(st.tuples(skips, st.floats(0, 1)), max_size=300))
    tick, last_punctual = 0, 0
    arrivals = [(0, offset_ns + round(draw(st.floats(0, 1)) * punctual * PERIOD_NS))]
    for skip, late in steps:
        tick += skip
        most = 0.74 * counters - 0.01 * skip
        if tick - last_punctual >= counters:
            most, last_punctual = punctual, tick
        arrivals.append((tick, offset_ns + round(tick * period_ns + late * most * PERIOD_NS)))
    return counters, sorted(arrivals, key=lambda arrival: arrival[1])


@settings(max_examples=150)
@given(runs())
def test_a_frame_has_its_true_tick_however_it_was_held_up_and_whatever_the_clocks_say(
    run: tuple[int, list[tuple[int, int]]],
) -> None:
    counters, arrivals = run
    ticks, last = TickCounter(PERIOD_NS, counters, lockstep=False), -1
    for tick, at_ns in arrivals:
        assert ticks.advance(tick % counters, at_ns) == (tick if tick > last else None)
        last = max(last, tick)
        assert ticks.tick == last


@given(
    st.sampled_from([16, 256]),
    st.integers(-1, 40),
    st.lists(st.tuples(st.integers(1, 12), st.integers(), st.integers(0, 3)), max_size=60),
)
def test_in_lockstep_the_counter_gives_the_tick_at_any_time_and_a_repeated_or_older_frame_none(
    counters: int, tick: int, steps: list[tuple[int, int, int]]
) -> None:
    ticks = TickCounter(PERIOD_NS, counters, lockstep=True, tick=tick)
    for step, at_ns, older in steps:
        tick += step
        assert ticks.advance(tick % counters, at_ns) == tick
        assert ticks.advance((tick - older) % counters, at_ns) is None
        assert (ticks.tick, ticks.late_ns(tick, at_ns)) == (tick, 0)


@pytest.mark.parametrize("counters", [16, 256])
def test_a_counter_stands_for_a_tick_from_three_quarters_of_its_range_before_now_to_one_after(counters: int) -> None:
    """4 bits: from 12 ticks before the grid's present one to 3 after it."""
    now = 2 * counters
    for tick in range(now - 3 * counters // 4, now + counters // 4):
        ticks = TickCounter(PERIOD_NS, counters, lockstep=False)
        ticks.advance(0, 0)
        assert ticks.advance(tick % counters, now * PERIOD_NS) == tick


def test_how_late_a_frame_is_counts_from_the_fastest_ones() -> None:
    start, late = 10**15, 3_000_000
    ticks = TickCounter(PERIOD_NS, 256, lockstep=False)
    assert not ticks.known
    assert ticks.late_ns(0, start) == 0
    for tick in range(100):
        at_ns = start + tick * PERIOD_NS
        assert ticks.advance(tick, at_ns) == tick
        assert (ticks.late_ns(tick, at_ns), ticks.due_ns(tick), ticks.tick_at(at_ns)) == (0, at_ns, tick)
    at_ns = start + 100 * PERIOD_NS + late
    assert ticks.advance(100, at_ns) == 100
    assert late - PERIOD_NS // TickCounter.DRIFT <= ticks.late_ns(100, at_ns) <= late
    assert ticks.advance(101, start + 101 * PERIOD_NS) == 101  # one late frame moves the mark by no more than that
    assert ticks.late_ns(101, start + 101 * PERIOD_NS) == 0
    assert ticks.advance(101, start + 101 * PERIOD_NS + 100) is None  # not newer


def test_a_frame_held_up_for_too_long_is_judged_wrongly_alone() -> None:
    ticks = TickCounter(PERIOD_NS, 16, lockstep=False)
    assert ticks.advance(0, 3 * PERIOD_NS) == 0  # a first frame that was held up misleads nothing
    for k in range(3, 10):
        assert ticks.advance(k, k * PERIOD_NS) == k
    assert ticks.advance(10, (10 + 14) * PERIOD_NS) == 26  # sixteen too many
    # The plant goes on where its grid is; what would step back is passed over until the grid is past the error.
    found = [ticks.advance(k % 16, k * PERIOD_NS) for k in range(25, 40)]
    assert found == [None, None, *range(27, 40)]


def test_a_counter_of_4_bits_stands_for_twelve_ticks_before_now_to_three_after() -> None:
    def advanced(tick: int, now: int) -> int | None:
        ticks = TickCounter(PERIOD_NS, 16, lockstep=False)
        for k in range(81):
            ticks.advance(k % 16, k * PERIOD_NS)
        return ticks.advance(tick % 16, now * PERIOD_NS)

    assert [advanced(81 + early, 81) for early in (0, 1, 2, 3)] == [81, 82, 83, 84]
    assert advanced(81 + 4, 81) is None  # read as twelve ticks before, which is not newer
    assert [advanced(100 - late, 100) for late in (1, 11, 12)] == [99, 89, 88]
    assert advanced(100 - 13, 100) == 103


# ── transmit policy: a frame at once for a new level, else at the heartbeat, and not before ──


COUNTERS = 16
HEARTBEATS = st.integers(1, COUNTERS // 2 - 1)
CODES = st.tuples(st.integers(-1, 1), st.integers(0, 1))  # few, so that most ticks repeat the last
CODES_OF_A_RUN = st.lists(CODES, min_size=1, max_size=100)
STEPS = st.lists(
    st.tuples(st.sampled_from((1, 1, 1, 2, COUNTERS - 1, COUNTERS, COUNTERS + 1, 2 * COUNTERS)), CODES),
    min_size=1,
    max_size=60,
)


@given(CODES_OF_A_RUN, HEARTBEATS)
def test_without_a_change_a_frame_is_sent_exactly_a_heartbeat_after_the_last(
    run: list[tuple[int, int]], heartbeat: int
) -> None:
    sender = Sender("on_change", heartbeat, COUNTERS)
    sent = [k for k, codes in enumerate(run) if sender.due(k, codes)]
    assert sent[0] == 0
    for last, k in zip(sent, [*sent[1:], len(run)], strict=True):
        assert k - last <= heartbeat
        if k < len(run) and k - last < heartbeat:
            assert run[k] != run[last]


@settings(max_examples=200)
@given(STEPS, HEARTBEATS)
def test_where_ticks_are_missed_a_change_still_reaches_a_receiver_that_drops_repeated_counters(
    steps: list[tuple[int, tuple[int, int]]], heartbeat: int
) -> None:
    sender, k = Sender("on_change", heartbeat, COUNTERS), -1
    echo, held, ticks_wrong = -1, None, 0
    for ahead, codes in steps:
        k += ahead
        if sender.due(k, codes) and k % COUNTERS != echo:  # as a plant takes a command
            echo, held = k % COUNTERS, codes
        ticks_wrong = 0 if held == codes else ticks_wrong + 1
        # Only at a tick whose counter is the last one's, which no frame can mend before the next tick.
        assert ticks_wrong == 0 or k % COUNTERS == echo


@given(CODES_OF_A_RUN, CODES_OF_A_RUN, HEARTBEATS)
def test_a_sender_goes_on_from_the_memory_of_another(
    before: list[tuple[int, int]], after: list[tuple[int, int]], heartbeat: int
) -> None:
    first, second = Sender("on_change", heartbeat, COUNTERS), Sender("on_change", heartbeat, COUNTERS)
    for k, codes in enumerate(before):
        first.due(k, codes)
    second.resume(*first.memory)
    for k, codes in enumerate([before[-1], *after], start=len(before)):
        assert first.due(k, codes) == second.due(k, codes)


@pytest.mark.parametrize(
    ("before", "now", "sent"),
    [
        ((0.0, 1.5), (-0.0, 1.5), True),  # two frames, and a law may distinguish them
        ((-0.0, 1.5), (-0.0, 1.5), False),
        ((1, 0), (0, 1), True),
        ((-32, -32), (-32, -32), False),
        ((nan, nan), (nan, -nan), False),  # "no valid value"
    ],
)
def test_a_frame_whose_bits_differ_is_sent(before: tuple[float, ...], now: tuple[float, ...], sent: bool) -> None:
    sender = Sender("on_change", 7, COUNTERS)
    assert sender.due(0, before)
    assert sender.due(1, now) == sent


@given(st.integers(1, 127), st.integers(10, 7_800))
def test_a_heartbeat_of_so_many_periods_is_as_many_ticks(ticks: int, period_us: int) -> None:
    """However the binary fraction of it is rounded."""
    assert Transmit(heartbeat_s=ticks * period_us / 1e6).heartbeat_ticks(period_us * 1000, 256) == ticks


# ── spec of the wire: what it refuses, its differences, its JSON form, other bits ──


HELD, GROWING = {"kind": "hysteresis-uniform"}, {"kind": "logarithmic-uniform"}


@pytest.mark.parametrize(
    ("section", "broken", "why"),
    [
        ("attitude", {"bits": 17}, "attitude"),
        ("rate", {"limit": nan}, "rate"),
        ("rate", {"hysteresis": 0.1}, 'hysteresis belongs to kind = "hysteresis-uniform"'),
        ("rate", {**GROWING, "bits": 2}, "at least 3 bits"),
        ("rate", {**HELD, "hysteresis": 1.0}, "less than the limit"),
        ("actuators", 9, "actuators"),
        ("counter_bits", 3, "counter_bits"),
        ("transmit", "sometimes", "transmit"),
    ],
)
def test_a_spec_out_of_bounds_is_refused_by_the_name_of_its_field(section: str, broken: object, why: str) -> None:
    whole = (
        {"bits": 8, "limit": 1.0, **broken} if section in ("attitude", "rate") and isinstance(broken, dict) else broken
    )
    with pytest.raises(ValidationError, match=why):
        WireSpec.model_validate({section: whole})


@given(specs)
def test_a_spec_survives_json(spec: WireSpec) -> None:
    assert spec.measurement.size > 0  # which caches the format; that is no field
    again = WireSpec.model_validate_json(spec.model_dump_json())
    assert (again, hash(again), again.differences(spec)) == (spec, hash(spec), [])
    assert WireSpec.model_validate(spec.agreed()) == spec  # which leaves out what is not in use


def test_two_wires_differ_by_every_field_and_both_values() -> None:
    ours = WireSpec(rate=SignalSpec(bits=8, limit=3.0))
    theirs = WireSpec(
        attitude=SignalSpec(bits=None, limit=1.0),
        rate=SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform", hysteresis=0.1),
        actuators=3,
        transmit=Transmit(command="on_change"),
        counter_bits=10,
    )
    assert ours.differences(theirs) == [
        "attitude.bits: 8, not None", "rate.limit: 3.0, not 1.0", "rate.kind: uniform, not hysteresis-uniform",
        "rate.hysteresis: None, not 0.1", "actuators: 2, not 3", "transmit.command: periodic, not on_change",
        "counter_bits: 8, not 10",
    ]  # fmt: skip


@given(wires, any_width, any_width, any_width)
def test_with_bits_changes_the_bits_and_nothing_else(
    spec: WireSpec, a: int | None, b: int | None, u: int | None
) -> None:
    bits = SignalBits(a, b, u)
    assert SignalBits.parse(str(bits)) == bits
    changed = spec.with_bits(str(bits))
    assert SignalBits(changed.attitude.bits, changed.rate.bits, changed.voltage.bits) == bits
    assert all(".bits:" in line for line in changed.differences(spec))


def test_other_bits_keep_the_kind_and_are_refused_where_it_takes_none_such() -> None:
    wire = WireSpec(rate=SignalSpec(bits=8, limit=1.0, kind="logarithmic-uniform", threshold=0.2))
    assert wire.with_bits("10/6").rate == wire.rate.model_copy(update={"bits": 10})
    assert wire.with_bits("cont/6").with_bits("8/6") == wire
    with pytest.raises(ValueError, match=r"^a logarithmic-uniform quantizer has at least 3 bits, not 2$"):
        wire.with_bits("2/6")


@pytest.mark.parametrize("text", ["8", "8/6/4/2", "8/1", "17/6", "8/6/", "a/b", ""])
def test_bits_are_two_or_three_numbers_in_range(text: str) -> None:
    with pytest.raises(ValueError, match="such as 10/6/6"):
        SignalBits.parse(text)
