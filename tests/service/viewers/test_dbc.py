"""DBC file, read back by cantools: decodes every code of every frame as `protocol` does.

Frames are packed by frames.py and padded to the CAN payload's length here; cantools reads only the DBC text.
"""

from __future__ import annotations

from functools import lru_cache
from math import isclose, isnan
from typing import Any, Final

import cantools
import pytest
from cantools.database.can import Database, Message, Signal
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import CanError, Heartbeat
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.viewers.dbc import dbc
from tests.protocol.wire.test_frames import codes_of
from tests.support.wires import specs

NODE: Final = 5
PERIOD_NS: Final = 2_000_001
ROUNDING: Final = 2.0**-51
"""Relative. The quantizer computes l + (i − 1)·l, which rounds twice, and a reader of the DBC i·l, which rounds once;
each rounding is at most 2^−53 of the level."""
UNITS: Final = {"eps": None, "omega": "rad/s", "u": "V"}
IDS: Final = {"Measurement": 0x100, "Command": 0x200, "PlantHeartbeat": 0x300, "ControllerHeartbeat": 0x380}

quantizer_of = lru_cache(SignalSpec.quantizer)  # one that makes a table of its levels is slow


@lru_cache
def read(spec: WireSpec) -> Database:
    """The DBC's text, through cantools, in its strict mode: no overlap, nothing beyond a message's end."""
    text = dbc(spec, NODE, PERIOD_NS)
    assert text.isascii()
    database = cantools.database.load_string(text, "dbc", strict=True)
    assert isinstance(database, Database)
    return database


def frames(spec: WireSpec) -> list[tuple[Message, FrameFormat, list[SignalSpec]]]:
    """Each message that carries a frame, the frame's format, and the spec of each code in it."""
    measurement, command = (read(spec).get_message_by_name(name) for name in ("Measurement", "Command"))
    return [
        (measurement, spec.measurement, [spec.attitude] * 3 + [spec.rate] * 3),
        (command, spec.command, [spec.voltage] * spec.actuators),
    ]


def bare(spec: SignalSpec) -> bool:
    """Whether the level of code i is not i times a step, so that the DBC has the bare code."""
    half_step = spec.bits is not None and spec.limit / (2**spec.bits - 1)
    uniform = spec.deadzone is None or isclose(spec.deadzone, half_step, rel_tol=1e-12)
    return spec.bits is not None and (spec.kind == "logarithmic-uniform" or not uniform)


def assert_means(signal: Signal, spec: SignalSpec, code: float, decoded: Any) -> None:
    """What cantools decoded is what this code is to the quantizer."""
    value = quantizer_of(spec).level(code)
    assert (signal.is_signed, signal.offset) == (True, 0)
    assert signal.unit == (None if bare(spec) else UNITS[signal.name.rstrip("12345678")])
    top = 2 ** ((spec.bits or 1) - 1) - 1 if bare(spec) else quantizer_of(spec).outermost
    assert [-(signal.minimum or 0), signal.maximum] == pytest.approx([top, top], rel=ROUNDING)
    if spec.bits is None:
        assert signal.is_float
        assert repr(decoded) == repr(value)  # repr: NaN equals itself, and −0 is not 0
    elif code == -(2 ** (spec.bits - 1)):
        assert isnan(value)
        assert decoded == "no_valid_value"
    elif bare(spec):
        assert decoded == code
        assert "bare code" in (signal.comment or "")
    else:
        assert abs(decoded - value) <= ROUNDING * abs(value)


def assert_decodes(message: Message, layout: FrameFormat, of: list[SignalSpec], counter: int, codes: Any) -> None:
    """A frame of these codes is, to cantools, its counter and these codes and what they mean, and nothing else."""
    payload = layout.pack(counter, codes).ljust(message.length, b"\0")
    assert len(payload) == message.length
    raw, decoded = message.decode(payload, scaling=False, decode_choices=False), message.decode(payload)
    assert isinstance(raw, dict)
    assert isinstance(decoded, dict)
    assert list(raw) == [signal.name for signal in message.signals]
    assert [repr(value) for value in raw.values()] == [repr(value) for value in (counter, *codes)]
    assert next(iter(decoded.values())) == counter
    for signal, spec, code in zip(message.signals[1:], of, codes, strict=True):
        assert_means(signal, spec, code, decoded[signal.name])


@settings(max_examples=60)
@given(spec=specs, data=st.data())
def test_any_codes_of_any_wire_decode(spec: WireSpec, data: st.DataObject) -> None:
    if spec.command.size > 64:  # eight voltages of 64 bits
        with pytest.raises(CanError, match=r"a frame of 6\d bytes does not fit into CAN FD's 64"):
            frames(spec)
        return
    assert {message.name: message.frame_id - NODE for message in read(spec).messages} == IDS
    assert [message.cycle_time for message in read(spec).messages] == [3, 3, 100, 100]  # in whole ms
    for message, layout, of in frames(spec):
        assert message.is_fd == (layout.size > 8)
        counter = data.draw(st.integers(0, 2**spec.counter_bits - 1))
        assert_decodes(message, layout, of, counter, data.draw(codes_of(layout.widths)))


@pytest.mark.parametrize("off", [1.0, 1 + 2.0**-50, 1 + 1e-9])
def test_a_dead_zone_gives_the_step_only_if_it_is_half_of_it_by_its_number(off: float) -> None:
    spec = WireSpec(voltage=SignalSpec(bits=6, limit=24.0, deadzone=24.0 / 63 * off))
    u2 = read(spec).get_message_by_name("Command").get_signal_by_name("u2")
    assert u2.scale == (pytest.approx(48.0 / 63, rel=1e-13) if off < 1 + 1e-12 else 1)


@pytest.mark.parametrize("state", PlantState)
def test_heartbeats_carry_state_fingerprint_and_cause_or_session(state: PlantState) -> None:
    mark = bytes.fromhex("fedcba98765432")
    both = {"state": state.value, "fingerprint": 0xFEDCBA98765432}
    for number in range(16):
        packed = Heartbeat(state, number, mark).pack()
        assert read(WireSpec()).decode_message(0x380 + NODE, packed) == {**both, "session": number}
        if number <= len(TripCause):
            cause = ["none", *map(str, TripCause)][number]
            assert read(WireSpec()).decode_message(0x300 + NODE, packed) == {**both, "cause": cause}
