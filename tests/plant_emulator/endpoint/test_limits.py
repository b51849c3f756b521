"""Limits of the plant end: tilt, rate, time at full voltage, time without valid sensor values."""

from __future__ import annotations

from math import cos, nan, radians, sin

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, LimitMonitor, LimitSettings
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.models import Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.attitude import IDENTITY
from tests.support.plant_end import AT_REST, COUNTERS, OFF, PERIOD_NS, WIRE, RecordingPlant, claim_of


def turned(degrees: float, axis: str = "y") -> Measurement:
    half = radians(degrees) / 2
    return Measurement((cos(half), 0.0, sin(half) * (axis == "y"), sin(half) * (axis == "z")), AT_REST)


def driven(limits: LimitSettings) -> tuple[Endpoint, RecordingPlant]:
    """An endpoint at tick 1, at full voltage."""
    plant = RecordingPlant()
    full = WIRE.voltage.quantizer().outermost
    endpoint = Endpoint(plant, WIRE, PERIOD_NS, limits=LimitMonitor(limits, PERIOD_NS, full))
    assert isinstance(endpoint.claim(claim_of()), Grant)
    endpoint.tick(None, 0)
    endpoint.tick(WIRE.command.pack(0, [31, -31]), 1)
    assert endpoint.state is PlantState.DRIVEN
    return endpoint, plant


@pytest.mark.parametrize(
    ("within", "beyond", "why"),
    [
        (turned(29.9), turned(30.1), "tilted by 30.1°, more than limits.max_tilt_deg = 30°: 0 V"),
        (turned(-29.9), turned(-30.1), "tilted by 30.1°, more than limits.max_tilt_deg = 30°: 0 V"),
        (
            Measurement(IDENTITY, (0.0, 3.0, 3.9)),
            Measurement(IDENTITY, (0.0, 3.0, 4.1)),
            "turns at 5.08 rad/s, more than limits.max_rate = 5 rad/s: 0 V",
        ),
    ],
)
def test_beyond_an_envelope_it_trips_within_the_tick_and_names_it(
    within: Measurement, beyond: Measurement, why: str
) -> None:
    endpoint, plant = driven(LimitSettings(max_tilt_deg=30.0, max_rate=5.0))
    plant.now = within
    assert endpoint.tick(None, 2) is not None
    plant.now = beyond
    assert endpoint.tick(None, 3) is None
    assert (endpoint.state, endpoint.trip, plant.voltages) == (PlantState.TRIPPED, TripCause.ENVELOPE, OFF)
    assert endpoint.cause == why
    assert isinstance(endpoint.claim(claim_of("b", auto_arm=False)), Refusal)  # latched, as every trip


def test_turning_about_the_vertical_is_no_tilt() -> None:
    endpoint, plant = driven(LimitSettings(max_tilt_deg=1.0))
    for k, yaw in enumerate(range(0, 360, 10), start=2):
        plant.now = turned(yaw, "z")
        assert endpoint.tick(WIRE.command.pack((k - 1) % COUNTERS, [1, 1]), k) is not None


@pytest.mark.parametrize(
    ("limit", "cause"), [("max_saturated_s", TripCause.SATURATION), ("max_invalid_s", TripCause.SENSORS)]
)
def test_what_may_last_a_while_trips_just_after_it(limit: str, cause: TripCause) -> None:
    """0.02 s are 10 ticks; the eleventh in a row is one too many. One tick of another kind begins the count anew."""
    endpoint, plant = driven(LimitSettings.model_validate({limit: 0.02}))
    saturates = cause is TripCause.SATURATION
    for k in range(1, 60):
        plant.now = Measurement((1.0 if saturates or k % 8 == 0 else nan, 0.0, 0.0, 0.0), AT_REST)
        endpoint.tick(WIRE.command.pack(k % COUNTERS, [31 if saturates and k % 8 else 30, 0]), k + 1)
    assert endpoint.trip is None  # the last tick of another kind was the 56th, of 59
    ticks = 3
    while endpoint.state is PlantState.DRIVEN:
        assert ticks < 20
        plant.now = Measurement((1.0 if saturates else nan, 0.0, 0.0, 0.0), AT_REST)
        endpoint.tick(WIRE.command.pack((57 + ticks) % COUNTERS, [31 if saturates else 30, 0]), 58 + ticks)
        ticks += 1
    assert ticks == 11
    assert endpoint.trip == cause
    assert plant.voltages == OFF
