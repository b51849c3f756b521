"""Codes of measurements: to the last bit those of six quantizers, one for each value, whatever the plant measures."""

from __future__ import annotations

from math import inf, isfinite, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.models import Claim
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from tests.plant_emulator.endpoint.test_endpoint import PERIOD_NS, RecordingPlant

SIGNALS = (
    SignalSpec(bits=8, limit=1.0),
    SignalSpec(bits=5, limit=0.7, kind="hysteresis-uniform"),
    SignalSpec(bits=9, limit=2.0, kind="logarithmic-uniform"),
    SignalSpec(bits=None, limit=1.0),
)
VALUES = st.one_of(st.floats(-1.2, 1.2), st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e300, 0, 1]))
MEASUREMENTS = st.lists(
    st.one_of(st.tuples(*[VALUES] * 7), st.tuples(*[st.one_of(VALUES, st.sampled_from([nan, inf, -inf]))] * 7)),
    max_size=20,
)


@pytest.mark.parametrize("attitude", SIGNALS, ids=lambda signal: f"{signal.kind}-{signal.bits}")
@pytest.mark.parametrize("rate", SIGNALS, ids=lambda signal: f"{signal.kind}-{signal.bits}")
@settings(max_examples=25)
@given(measured=MEASUREMENTS)
def test_codes_are_those_of_a_quantizer_for_each_value(
    attitude: SignalSpec, rate: SignalSpec, measured: list[tuple[float, ...]]
) -> None:
    wire, plant = WireSpec(attitude=attitude, rate=rate), RecordingPlant()
    endpoint = Endpoint(plant, wire, PERIOD_NS)
    endpoint.claim(Claim(controller="a", session="s", period_ns=PERIOD_NS, lockstep=False, auto_arm=True, wire=wire))
    quantizers = [signal.quantizer() for signal in (attitude, rate) for _ in range(3)]
    for k, (w, x, y, z, *omega) in enumerate(measured):
        plant.now = Measurement((w, x, y, z), (omega[0], omega[1], omega[2]))
        codes = [quantizer.invalid for quantizer in quantizers]
        if all(map(isfinite, (w, x, y, z, *omega))):
            sent = (x, y, z) if w >= 0 else (-x, -y, -z)
            codes = [quantizer.encode(value) for quantizer, value in zip(quantizers, (*sent, *omega), strict=True)]
        assert endpoint.tick(None, k) == wire.measurement.pack(k, codes)
    assert endpoint.saturated == sum(quantizer.saturated for quantizer in quantizers)
