"""Specs of the wire: by their bits, and strategies that draw any."""

from __future__ import annotations

from hypothesis import strategies as st

from aeroloop.protocol.wire.spec import MAX_ACTUATORS, SignalSpec, WireSpec

COUNTER_BITS = range(4, 17)


def wire_of(
    attitude: int | None, rate: int | None, voltage: int | None, actuators: int = 2, counter_bits: int = 8
) -> WireSpec:
    return WireSpec.model_validate(
        {
            "attitude": {"bits": attitude, "limit": 1.0},
            "rate": {"bits": rate, "limit": 1.0},
            "voltage": {"bits": voltage, "limit": 24.0},
            "actuators": actuators,
            "counter_bits": counter_bits,
        }
    )


any_width = st.none() | st.integers(2, 16)
any_counter_bits = st.sampled_from(COUNTER_BITS)
wires = st.builds(wire_of, any_width, any_width, any_width, st.integers(1, MAX_ACTUATORS), any_counter_bits)


@st.composite
def signals(draw: st.DrawFn) -> SignalSpec:
    """Any signal: any bits and limit, with or without a dead zone."""
    limit = draw(st.floats(1e-6, 1e6))
    deadzone = draw(st.none() | st.floats(0.01, 0.99).map(lambda part: part * limit))
    return SignalSpec(bits=draw(any_width), limit=limit, deadzone=deadzone)


specs = st.builds(
    WireSpec,
    attitude=signals(),
    rate=signals(),
    voltage=signals(),
    actuators=st.integers(1, MAX_ACTUATORS),
    counter_bits=any_counter_bits,
)
