"""What both ends of a CAN bus must agree on: heartbeats bit by bit, widths that fit a frame, the fingerprint."""

from __future__ import annotations

from hashlib import sha256

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import CanError, CanSettings, Heartbeat, check_widths, fingerprint
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import MAX_ACTUATORS, WireSpec, flat
from tests.support.can_in_process import PAPER
from tests.support.wires import wire_of

PERIOD_NS = 2_000_000


@settings(max_examples=40)
@given(state=st.sampled_from(PlantState), number=st.integers(0, 15), mark=st.binary(min_size=7, max_size=7))
def test_a_heartbeat_has_eight_bytes_as_specified_and_is_read_as_it_was_written(
    state: PlantState, number: int, mark: bytes
) -> None:
    packed = Heartbeat(state, number, mark).pack()
    states = [PlantState.IDLE, PlantState.GRANTED, PlantState.DRIVEN, PlantState.TRIPPED]
    assert packed == bytes([number << 4 | states.index(state)]) + mark
    assert Heartbeat.unpack(packed, 5) == Heartbeat(state, number, mark, 5)


WIDTHS = st.one_of(st.none(), st.integers(MIN_BITS, MAX_BITS))


@settings(max_examples=60)
@given(
    bits=st.fixed_dictionaries({"attitude": WIDTHS, "rate": WIDTHS, "voltage": WIDTHS}),
    actuators=st.integers(1, MAX_ACTUATORS),
    counted=st.sampled_from([4, 8, 16]),
    fd=st.booleans(),
)
def test_a_spec_is_refused_if_and_only_if_a_frame_does_not_fit_and_the_line_names_its_signals(
    bits: dict[str, int | None], actuators: int, counted: int, fd: bool
) -> None:
    wire = wire_of(**bits, actuators=actuators, counter_bits=counted)
    longest = 64 if fd else 8
    if max(wire.measurement.size, wire.command.size) <= longest:
        check_widths(CanSettings(fd=fd), wire)
        return
    measured = wire.measurement.size > longest
    frame, signal = ("measurement", "attitude") if measured else ("command", "voltage")
    size = getattr(wire, frame).size
    with pytest.raises(CanError, match=f"^a {frame} frame has {size} bytes.*lower wire.{signal}.bits") as refused:
        check_widths(CanSettings(fd=fd), wire)
    assert ("can.fd" in str(refused.value)) == (not fd)


def test_the_fingerprint_is_the_one_of_the_specification() -> None:
    """Seven bytes of SHA-256 over this very text; another implementation must come to the same."""
    text = (
        '{"lockstep": false, "period_ns": 2000000, "wire": {"actuators": 2, '
        '"attitude": {"bits": 8, "deadzone": null, "limit": 1.0}, "counter_bits": 8, '
        '"rate": {"bits": 8, "deadzone": null, "limit": 1.0}, '
        '"voltage": {"bits": 6, "deadzone": null, "limit": 24.0}}}'
    )
    ours = fingerprint(PAPER, PERIOD_NS, lockstep=False)
    assert ours == sha256(text.encode()).digest()[:7]
    assert ours.hex() == "094b8ce4a32f59"


def test_the_fingerprint_differs_if_anything_does_that_both_ends_must_agree_on() -> None:
    plain = flat(PAPER.model_dump())
    own = {
        "bits": 9, "limit": 2.5, "deadzone": 0.125, "kind": "logarithmic-uniform",
        "hysteresis": {"kind": "hysteresis-uniform", "hysteresis": 0.125},
        "threshold": {"kind": "logarithmic-uniform", "threshold": 0.125},
        "actuators": 3, "counter_bits": 10, "measurement": "on_change", "command": "on_change", "heartbeat_s": 0.02,
    }  # fmt: skip
    seen = {fingerprint(PAPER, PERIOD_NS + more, lockstep=on) for more in (0, 1) for on in (False, True)}
    for path in plain:
        section, _, field = path.rpartition(".")
        value = own[field]  # of each field of the wire, another one
        other = PAPER.model_dump()
        (other[section] if section else other).update(value if isinstance(value, dict) else {field: value})
        seen.add(fingerprint(WireSpec.model_validate(other), PERIOD_NS, lockstep=False))
    seen.add(fingerprint(PAPER.with_bits("cont/6"), PERIOD_NS, lockstep=False))
    assert len(seen) == 4 + len(plain) + 1
