"""What both ends of a CAN bus must agree on: heartbeats bit by bit, widths that fit a frame, the fingerprint."""

from __future__ import annotations

import re
from hashlib import sha256

from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import CanError, CanSettings, Heartbeat, check_widths, fingerprint
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import MAX_ACTUATORS, WireSpec, flat
from tests.support.can_in_process import PAPER
from tests.support.wires import wire_of

PERIOD_NS = 2_000_000
MARK = b"\1\2\3\4\5\6\7"


@settings(max_examples=40)
@given(state=st.sampled_from(PlantState), number=st.integers(0, 15), mark=st.binary(min_size=7, max_size=7))
def test_a_heartbeat_has_eight_bytes_as_specified_and_is_read_as_it_was_written(
    state: PlantState, number: int, mark: bytes
) -> None:
    packed = Heartbeat(state, number, mark).pack()
    states = [PlantState.IDLE, PlantState.GRANTED, PlantState.DRIVEN, PlantState.TRIPPED]
    assert packed == bytes([number << 4 | states.index(state)]) + mark
    assert Heartbeat.unpack(packed, 5) == Heartbeat(state, number, mark, 5)


def test_causes_are_numbered_as_in_the_specification() -> None:
    causes = [
        "no command in time",
        "invalid command",
        "attitude or rate envelope",
        "voltage saturation",
        "no valid measurement",
        "operator's stop",
        "controller gone",
        "no answer in lockstep",
        "bus lost",
        "node lost",
        "another plant of this name",
        "plant failed",
    ]
    assert [TripCause(cause).number for cause in causes] == list(range(1, 13))
    said = [Heartbeat(PlantState.TRIPPED, number, MARK).cause for number in range(16)]
    assert said == [None, *causes, None, None, None]


WIDTHS = st.one_of(st.none(), st.integers(MIN_BITS, MAX_BITS))
ADVICE = re.compile(
    r"a (?P<frame>\w+) frame has (?P<size>\d+) bytes, and a (?P<bus>classic CAN|CAN FD) frame holds \d+: "
    r"(?P<fd>set can\.fd = true, or )?"
    r"wire\.(?P<first>\w+)\.bits(?: and wire\.(?P<second>\w+)\.bits)? to (?P<widest>\d+) at the most"
    r"(?P<shorter>, or wire\.counter_bits = 4 with can\.short_counter = true)?$"
)


def _refusal(spec: WireSpec, *, fd: bool) -> str | None:
    try:
        check_widths(CanSettings(fd=fd), spec)
    except CanError as error:
        return str(error)
    return None


@settings(max_examples=60)
@given(
    bits=st.fixed_dictionaries({"attitude": WIDTHS, "rate": WIDTHS, "voltage": WIDTHS}),
    actuators=st.integers(1, MAX_ACTUATORS),
    counted=st.sampled_from([4, 8, 16]),
)
def test_a_spec_that_does_not_fit_is_refused_with_the_widths_that_would(
    bits: dict[str, int | None], actuators: int, counted: int
) -> None:
    def spec(bits: dict[str, int | None], counter_bits: int = counted) -> WireSpec:
        return wire_of(**bits, actuators=actuators, counter_bits=counter_bits)

    on_fd = _refusal(spec(bits), fd=True)
    assert (on_fd is not None) == (spec(bits).command.size > 64)  # eight doubles
    assert on_fd is None or "can.fd" not in on_fd
    while (said := _refusal(spec(bits), fd=False)) is not None:
        advice = ADVICE.match(said)
        assert advice is not None, said
        frame, size, widest = advice["frame"], int(advice["size"]), int(advice["widest"])
        assert getattr(spec(bits), frame).size == size > 8
        assert (advice["fd"] is not None) == (size <= 64)
        assert (advice["shorter"] is not None) == (getattr(spec(bits, 4), frame).size <= 8)
        signals = [name for name in (advice["first"], advice["second"]) if name is not None]
        bits = bits | dict.fromkeys(signals, widest)
        assert getattr(spec(bits), frame).size <= 8
        if widest < MAX_BITS:
            assert getattr(spec(bits | dict.fromkeys(signals, widest + 1)), frame).size > 8
    assert spec(bits).measurement.size <= 8
    assert spec(bits).command.size <= 8


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
