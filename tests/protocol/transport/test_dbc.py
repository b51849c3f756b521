"""DBC file, read back by cantools: decodes every code of every frame as `protocol` does.

Frames are packed by frames.py and padded to the CAN payload's length here; cantools reads only the DBC text.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from math import isclose, isnan, nan, pi
from typing import Any, Final

import cantools
import pytest
from cantools.database.can import Database, Message, Signal
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import CanError, Heartbeat
from aeroloop.protocol.transport.dbc import dbc
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from tests.protocol.test_spec_document import FRAME_ROWS, Row, as_bits
from tests.protocol.wire.test_frames import codes_of
from tests.support.wires import specs

NODE: Final = 5
PERIOD_NS: Final = 2_000_000
ROUNDING: Final = 2.0**-51
"""Relative. The quantizer computes l + (i − 1)·l, which rounds twice, and a reader of the DBC i·l, which rounds once;
each rounding is at most 2^−53 of the level."""

MEASURED: Final = ["eps1", "eps2", "eps3", "omega1", "omega2", "omega3"]
UNITS: Final = {"eps": None, "omega": "rad/s", "u": "V"}
FD_LENGTHS: Final = {12, 16, 20, 24, 32, 48, 64}


def wire(out: int | None, inp: int | None, actuators: int = 2, counter_bits: int = 8) -> WireSpec:
    """The default wire with other bits."""
    changed = {"actuators": actuators, "counter_bits": counter_bits}
    return WireSpec.model_validate({**WireSpec().with_bits(out, inp).model_dump(), **changed})


WIRES: Final = {
    "8/6": wire(8, 6),
    "10/10, eight bytes": wire(10, 10, counter_bits=4),
    "10/10, FD": wire(10, 10),
    "8/6 and 11 bits of counter": wire(8, 6, counter_bits=11),
    "cont/cont and 10 bits of counter": wire(None, None, counter_bits=10),
    "16/16, FD": wire(16, 16),
    "2/2": wire(2, 2),
    "three actuators": wire(8, 6, 3),
    "three actuators of 16": wire(11, 16, 3),
    "cont/cont": wire(None, None),
    "cont and 8": WireSpec(attitude=SignalSpec(bits=None, limit=1.0)),
    "9 and cont": WireSpec(attitude=SignalSpec(bits=9, limit=0.7), rate=SignalSpec(bits=None, limit=5.0)),
    "dead zones": WireSpec(
        attitude=SignalSpec(bits=10, limit=1.0, deadzone=0.01),
        rate=SignalSpec(bits=16, limit=7.3, deadzone=1e-5),
        voltage=SignalSpec(bits=7, limit=24.0, deadzone=2.5),
    ),
    "a dead zone on one": WireSpec(rate=SignalSpec(bits=4, limit=2.0, deadzone=0.25)),
    "other kinds": WireSpec(
        attitude=SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform"),
        rate=SignalSpec(bits=10, limit=7.3, kind="logarithmic-uniform"),
        voltage=SignalSpec(bits=7, limit=24.0, kind="logarithmic-uniform", deadzone=0.01, threshold=2.0),
    ),
    "hysteresis about a dead zone": WireSpec(
        rate=SignalSpec(bits=9, limit=2.0, kind="hysteresis-uniform", deadzone=0.25, hysteresis=0.1)
    ),
    "steps of one": WireSpec(rate=SignalSpec(bits=4, limit=7.5), voltage=SignalSpec(bits=5, limit=15.5)),
    "tiny and huge": WireSpec(rate=SignalSpec(bits=12, limit=1e-9), voltage=SignalSpec(bits=12, limit=3e20)),
}

every_wire = pytest.mark.parametrize("spec", WIRES.values(), ids=WIRES.keys())


@lru_cache
def read(spec: WireSpec, node: int = NODE, period_ns: int = PERIOD_NS) -> Database:
    """The DBC's text, through cantools, in its strict mode: no overlap, nothing beyond a message's end."""
    database = cantools.database.load_string(dbc(spec, node, period_ns), "dbc", strict=True)
    assert isinstance(database, Database)
    return database


quantizer_of = lru_cache(SignalSpec.quantizer)
"""A quantizer makes a table of its levels; one of each is enough here."""


def frames(spec: WireSpec) -> list[tuple[Message, FrameFormat, list[SignalSpec]]]:
    """Each message that carries a frame, the frame's format, and the spec of each code in it."""
    database = read(spec)
    return [
        (
            database.get_message_by_name("Measurement"),
            spec.measurement,
            [spec.attitude] * 3 + [spec.rate] * 3,
        ),
        (database.get_message_by_name("Command"), spec.command, [spec.voltage] * spec.actuators),
    ]


def codes_to_try(spec: SignalSpec) -> Sequence[float]:
    """All codes up to ten bits; beyond, every 37th, and all near the ends, zero and the powers of two."""
    if spec.bits is None:
        return [0.0, -0.0, spec.limit, -spec.limit, 1 / 3, -pi * 1e-7, 5e-324, nan]
    half: int = 2 ** (spec.bits - 1)
    if spec.bits <= 10:
        return range(-half, half)
    marks = [0, *(sign * 2**power for power in range(spec.bits) for sign in (1, -1))]
    near = {mark + step for mark in marks for step in range(-3, 4)}
    return sorted({code for code in (*near, *range(-half, half, 37)) if -half <= code < half})


def by_formula(comment: str, code: int) -> float:
    """The level of a bare code by nothing but its signal's comment."""
    found = re.search(r"sgn\(i\) \* \(y0 \+ l/2 \+ \(\|i\| - 1\) \* l\).* with y0 = (\S+) and l = (\S+)\.$", comment)
    assert found, comment
    y0, step = float(found[1]), float(found[2])
    magnitude = y0 + step / 2 + (abs(code) - 1) * step if code else 0.0
    return -magnitude if code < 0 else magnitude


def by_logarithmic_formula(comment: str, code: int) -> float:
    """The same of the logarithmic-uniform kind."""
    found = re.search(
        r"else sgn\(i\) \* \(e\(\|i\| - 1\) \+ e\(\|i\|\)\) / 2 .*"
        r" with e\(k\) = y0 \* \(yt / y0\) \*\* \(k / m\) for k < m, else yt \+ \(k - m\) \* l;"
        r" y0 = (\S+), yt = (\S+), m = (\d+) and l = (\S+)\.$",
        comment,
    )
    assert found, comment
    y0, yt, m, step = float(found[1]), float(found[2]), int(found[3]), float(found[4])

    def edge(k: int) -> float:
        return y0 * (yt / y0) ** (k / m) if k < m else yt + (k - m) * step

    magnitude = (edge(abs(code) - 1) + edge(abs(code))) / 2 if code else 0.0
    return -magnitude if code < 0 else magnitude


def bare(spec: SignalSpec) -> bool:
    """Whether the level of code i is not i times a step, so that the DBC has the bare code."""
    return spec.bits is not None and (
        spec.kind == "logarithmic-uniform"
        or not (spec.deadzone is None or isclose(spec.deadzone, spec.limit / (2**spec.bits - 1), rel_tol=1e-12))
    )


def assert_signal(signal: Signal, spec: SignalSpec, code: float, decoded: Any) -> None:
    """What cantools decoded is what this code is to the quantizer."""
    value = quantizer_of(spec).level(code)
    if spec.bits is None:
        assert signal.is_float
        assert repr(decoded) == repr(value)  # repr: NaN equals itself, and −0 is not 0
    elif code == -(2 ** (spec.bits - 1)):
        assert isnan(value)
        assert decoded == "no_valid_value"
    elif not bare(spec):
        assert abs(decoded - value) <= ROUNDING * abs(value)
    else:
        assert decoded == code
        assert signal.comment is not None
        if spec.kind == "logarithmic-uniform":
            assert by_logarithmic_formula(signal.comment, int(code)) == pytest.approx(value, rel=ROUNDING, abs=0)
        else:
            assert by_formula(signal.comment, int(code)) == value


def assert_decodes(message: Message, layout: FrameFormat, of: Sequence[SignalSpec], counter: int, codes: Any) -> None:
    """A frame of these codes is, to cantools, its counter and these codes and what they mean, and nothing else."""
    payload = layout.pack(counter, codes).ljust(message.length, b"\0")
    assert len(payload) == message.length
    names = [signal.name for signal in message.signals]
    raw = message.decode(payload, scaling=False, decode_choices=False)
    assert isinstance(raw, dict)
    assert list(raw) == names
    assert [repr(value) for value in raw.values()] == [repr(value) for value in (counter, *codes)]
    decoded = message.decode(payload)
    assert isinstance(decoded, dict)
    assert decoded[names[0]] == counter
    for signal, spec, code in zip(message.signals[1:], of, codes, strict=True):
        assert_signal(signal, spec, code, decoded[signal.name])


def top(spec: SignalSpec) -> float:
    """The largest code."""
    return spec.limit if spec.bits is None else 2 ** (spec.bits - 1) - 1


def some_codes(of: Sequence[SignalSpec]) -> list[float]:
    """A frame's codes, neighbours of different bits: the largest, the smallest, −1, and so on."""
    return [[top(spec), -top(spec), -1 if spec.bits else -0.1][i % 3] for i, spec in enumerate(of)]


@every_wire
def test_every_code_of_every_signal_decodes_and_leaves_the_others_alone(spec: WireSpec) -> None:
    for message, layout, of in frames(spec):
        around = some_codes(of)
        for i, signal in enumerate(of):
            for n, code in enumerate(codes_to_try(signal)):
                assert_decodes(message, layout, of, n % layout.counters, [*around[:i], code, *around[i + 1 :]])


@pytest.mark.parametrize("bits", range(2, 17))
def test_every_code_of_every_width_decodes(bits: int) -> None:
    """All 2^R, for every R, but in one signal of a command only."""
    spec = wire(8, bits)
    _, (message, layout, _) = frames(spec)
    half = 2 ** (bits - 1)
    quantizer = spec.voltage.quantizer()
    for code in range(-half, half):
        decoded = message.decode(layout.pack(code % layout.counters, (code, -1 - code)).ljust(message.length, b"\0"))
        assert isinstance(decoded, dict)
        for name, one in (("u2", code), ("u3", -1 - code)):
            if one == -half:
                assert decoded[name] == "no_valid_value"
            else:
                value, level = decoded[name], quantizer.level(one)
                assert isinstance(value, (int, float))  # an int where the step is
                assert abs(value - level) <= ROUNDING * abs(level)
        assert decoded["echo"] == code % layout.counters


@settings(max_examples=60)
@given(spec=specs, data=st.data())
def test_any_codes_of_any_wire_decode(spec: WireSpec, data: st.DataObject) -> None:
    if spec.command.size > 64:  # eight voltages of 64 bits
        with pytest.raises(CanError, match=r"a frame of 6\d bytes does not fit into CAN FD's 64"):
            frames(spec)
        return
    for message, layout, of in frames(spec):
        counter = data.draw(st.integers(0, 2**spec.counter_bits - 1))
        assert_decodes(message, layout, of, counter, data.draw(codes_of(layout.widths)))


@pytest.mark.parametrize("row", FRAME_ROWS, ids=" ".join)
def test_the_golden_frames_of_the_spec_decode_to_their_codes(row: Row) -> None:
    frame, counter_bits, bits, actuators, counter, codes, text = row
    widths = [as_bits(cell.strip()) for cell in bits.split(",")]
    changed: dict[str, object] = {"counter_bits": int(counter_bits)}
    if frame == "measurement":
        changed |= {"attitude": {"bits": widths[0], "limit": 1.0}, "rate": {"bits": widths[1], "limit": 1.0}}
        spec, (name, first) = WireSpec.model_validate(changed), ("Measurement", "counter")
    else:
        changed |= {"voltage": {"bits": widths[0], "limit": 24.0}, "actuators": int(actuators)}
        spec = WireSpec.model_validate(changed)
        name, first = "Command", "echo"
    message = read(spec).get_message_by_name(name)
    payload = bytes.fromhex(text)
    raw = message.decode(payload.ljust(message.length, b"\0"), scaling=False, decode_choices=False)
    assert isinstance(raw, dict)
    assert raw.pop(first) == int(counter)
    assert [str(value).lower() for value in raw.values()] == codes.lower().split()


@every_wire
def test_cantools_encodes_codes_to_the_same_payload(spec: WireSpec) -> None:
    for message, layout, of in frames(spec):
        codes = some_codes(of)
        values: Any = dict(zip([signal.name for signal in message.signals], [9, *codes], strict=True))
        assert message.encode(values, scaling=False) == layout.pack(9, codes).ljust(message.length, b"\0")


def test_no_valid_value_can_be_sent_by_its_name() -> None:
    spec = WIRES["8/6"]
    command = read(spec).get_message_by_name("Command")
    payload = command.encode({"echo": 7, "u2": "no_valid_value", "u3": "no_valid_value"})
    assert payload == spec.command.pack(7, (-32, -32))


@every_wire
def test_signals_have_names_units_bounds_and_comments(spec: WireSpec) -> None:
    (measurement, *_), (command, *_) = frames(spec)
    commanded = ["u2", "u3"] if spec.actuators == 2 else ["u1", "u2", "u3"]
    assert [signal.name for signal in measurement.signals] == ["counter", *MEASURED]
    assert [signal.name for signal in command.signals] == ["echo", *commanded]
    for message, _, of in frames(spec):
        first, *others = message.signals
        assert (first.start, first.length, first.is_signed) == (7, spec.counter_bits, False)
        assert (first.minimum, first.maximum) == (0, 2**spec.counter_bits - 1)
        assert all(signal.comment and signal.byte_order == "big_endian" for signal in message.signals)
        for signal, one in zip(others, of, strict=True):
            quantizer = quantizer_of(one)
            assert (signal.is_signed, signal.offset) == (True, 0)
            assert signal.unit == (None if bare(one) else UNITS[signal.name.rstrip("123")])
            highest = top(one) if bare(one) else quantizer.outermost
            assert signal.maximum == pytest.approx(highest, rel=ROUNDING, abs=0)
            assert signal.minimum == pytest.approx(-highest, rel=ROUNDING, abs=0)
            if one.bits is None:
                assert signal.choices is None
                assert signal.scale == 1
            else:
                assert signal.choices == {-(2 ** (one.bits - 1)): "no_valid_value"}
                if bare(one):
                    assert signal.scale == 1
                else:
                    assert isinstance(quantizer, UniformQuantizer)
                    assert signal.scale == quantizer.step


@pytest.mark.parametrize("bits", [4, 8, 16])
def test_the_counters_comment_states_its_modulus(bits: int) -> None:
    measurement = read(wire(8, 6, counter_bits=bits)).get_message_by_name("Measurement")
    assert f"modulo {2**bits};" in (measurement.signals[0].comment or "")


@pytest.mark.parametrize("off", [1.0, 1 + 2.0**-50, 1 - 1e-14])
def test_a_dead_zone_that_is_half_a_step_by_its_number_gives_the_step_too(off: float) -> None:
    spec = WireSpec(voltage=SignalSpec(bits=6, limit=24.0, deadzone=24.0 / 63 * off))
    u2 = read(spec).get_message_by_name("Command").get_signal_by_name("u2")
    assert u2.scale == pytest.approx(48.0 / 63, rel=1e-13)
    assert u2.unit == "V"


def test_a_dead_zone_that_is_nearly_half_a_step_gives_the_bare_code() -> None:
    spec = WireSpec(voltage=SignalSpec(bits=6, limit=24.0, deadzone=24.0 / 63 * (1 + 1e-9)))
    assert read(spec).get_message_by_name("Command").get_signal_by_name("u2").scale == 1


@pytest.mark.parametrize("node", [1, 5, 127])
def test_identifiers_and_ends_are_those_of_the_node(node: int) -> None:
    database = read(WIRES["8/6"], node)
    found = {message.name: (message.frame_id, *message.senders, *message.receivers) for message in database.messages}
    assert found == {
        "Measurement": (0x100 + node, "Plant", "Controller"),
        "Command": (0x200 + node, "Controller", "Plant"),
        "PlantHeartbeat": (0x300 + node, "Plant", "Controller"),
        "ControllerHeartbeat": (0x380 + node, "Controller", "Plant"),
    }
    assert not any(message.is_extended_frame for message in database.messages)
    assert {one.name for one in database.nodes} == {"Plant", "Controller"}


@pytest.mark.parametrize("node", [-1, 0, 128, 0x700])
def test_a_node_that_has_no_identifiers_is_refused(node: int) -> None:
    with pytest.raises(ValueError, match=f"1 to 127, not {node}"):
        dbc(WireSpec(), node, PERIOD_NS)


@pytest.mark.parametrize(
    ("name", "lengths"),
    [
        ("8/6", (7, 3)),
        ("10/10, eight bytes", (8, 3)),
        ("10/10, FD", (12, 4)),  # 9 and 4
        ("8/6 and 11 bits of counter", (8, 3)),
        ("16/16, FD", (16, 5)),  # 13 and 5
        ("2/2", (3, 2)),
        ("three actuators", (7, 4)),
        ("cont/cont", (64, 20)),  # 49 and 17
        ("cont/cont and 10 bits of counter", (64, 20)),  # 50 and 18
        ("cont and 8", (32, 3)),  # 28
    ],
)
def test_payloads_have_these_lengths(name: str, lengths: tuple[int, int]) -> None:
    assert tuple(message.length for message, *_ in frames(WIRES[name])) == lengths


@every_wire
def test_a_payload_is_the_frame_s_or_the_next_of_can_fd_and_the_bus_states_it(spec: WireSpec) -> None:
    database = read(spec)
    for message, layout, _ in frames(spec):
        assert message.is_fd == (layout.size > 8)
        lengths = FD_LENGTHS if message.is_fd else {layout.size}
        assert message.length == min(length for length in lengths if length >= layout.size)
    for name in ("PlantHeartbeat", "ControllerHeartbeat"):
        assert not database.get_message_by_name(name).is_fd
    assert database.dbc is not None
    fast = any(message.is_fd for message in database.messages)
    assert database.dbc.attributes["BusType"].value == ("CAN FD" if fast else "CAN")


@pytest.mark.parametrize(
    ("period_ns", "cycle_ms"),
    [(2_000_000, 2), (1_000_000, 1), (250_000, 1), (1, 1), (2_500_000, 3), (2_000_001, 3), (1_000_000_000, 1000)],
)
def test_cycle_times_are_whole_milliseconds_and_the_comment_has_the_period(period_ns: int, cycle_ms: int) -> None:
    database = read(WireSpec(), NODE, period_ns)
    found = {message.name: message.cycle_time for message in database.messages}
    beats = dict.fromkeys(("PlantHeartbeat", "ControllerHeartbeat"), 100)
    assert found == {"Measurement": cycle_ms, "Command": cycle_ms, **beats}
    for name in ("Measurement", "Command"):
        comment = database.get_message_by_name(name).comment
        assert comment is not None
        assert f"every {period_ns} ns" in comment
    assert all(message.comment for message in database.messages)


@pytest.mark.parametrize("period_ns", [0, -1, 65_535_000_001])
def test_a_period_that_is_none_is_refused(period_ns: int) -> None:
    with pytest.raises(ValueError, match=f"period of {period_ns} ns"):
        dbc(WireSpec(), NODE, period_ns)


FINGERPRINT: Final = bytes.fromhex("fedcba98765432")


@pytest.mark.parametrize("state", PlantState)
def test_heartbeats_carry_state_fingerprint_and_cause_or_session(state: PlantState) -> None:
    database = read(WireSpec())
    both = {"state": state.value, "fingerprint": 0xFEDCBA98765432}
    for cause in (None, *TripCause):
        number = cause.number if cause else 0
        decoded = database.decode_message(0x300 + NODE, Heartbeat(state, number, FINGERPRINT).pack())
        assert decoded == {**both, "cause": cause.value if cause else "none"}
    for session in range(16):
        decoded = database.decode_message(0x380 + NODE, Heartbeat(state, session, FINGERPRINT).pack())
        assert decoded == {**both, "session": session}


@pytest.mark.parametrize(("name", "highest"), [("PlantHeartbeat", len(TripCause)), ("ControllerHeartbeat", 15)])
def test_heartbeats_have_eight_bytes_bounds_and_comments(name: str, highest: int) -> None:
    message = read(WireSpec()).get_message_by_name(name)
    assert message.length == 8
    assert [signal.minimum for signal in message.signals] == [0, 0, 0]
    assert [signal.maximum for signal in message.signals] == [highest, 3, 2**56 - 1]
    assert all(signal.comment for signal in message.signals)


@every_wire
def test_doubles_are_marked_as_such_and_the_text_is_ascii(spec: WireSpec) -> None:
    text = dbc(spec, NODE, PERIOD_NS)
    assert text.isascii()
    marked = re.findall(r"^SIG_VALTYPE_ (\d+) (\w+) : (\d);\r?$", text, re.MULTILINE)
    doubles = [
        (str(message.frame_id), signal.name, "2")
        for message, _, of in frames(spec)
        for signal, one in zip(message.signals[1:], of, strict=True)
        if one.bits is None
    ]
    assert marked == doubles
