"""Plant endpoint with the on-change policy: frames sent, levels held, and the end of holding.

Time is the tick index; period i is the time from tick i to tick i + 1, as in test_endpoint.py.
"""

from __future__ import annotations

from math import nan

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.models import Grant
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy
from tests.support.plant_end import COUNTERS, OFF, claim_of, claimed, command, state_of, volts
from tests.support.simulated_link import wire_of

HEARTBEAT = 15
"""Ticks: 30 ms of 2 ms."""
WATCHDOG_TICKS = 50
BOTH = wire_of("on_change", "on_change")


def claim_again(endpoint: Endpoint) -> None:
    endpoint.release("of-a")
    answer = endpoint.claim(claim_of("b", wire=endpoint.wire, lockstep=endpoint.lockstep))
    assert isinstance(answer, Grant)


def invalid(echo: int) -> bytes:
    return BOTH.command.pack(echo % COUNTERS, [BOTH.voltage.quantizer().invalid] * 2)


def turning(rate: float) -> Measurement:
    return Measurement(IDENTITY, (rate, 0.0, 0.0))


# ── what it sends ──


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_plant_at_rest_sends_heartbeats_only_and_a_change_at_once(lockstep: bool) -> None:
    endpoint, plant = claimed(BOTH, lockstep=lockstep)
    sent = {}
    for k in range(1, 60):
        plant.now = turning(0.5 if k >= 40 else 0.001)  # which is less than half a step
        frame = endpoint.tick(command(k - 1), k)
        assert frame is not None  # silence is distinguished from no session
        if frame != UNCHANGED:
            sent[k] = BOTH.measurement.unpack(frame)
    changed = (0, 0, 0, 64, 0, 0)
    assert sent == {15: (15, (0,) * 6), 30: (30, (0,) * 6), 40: (40, changed), 55: (55, changed)}
    claim_again(endpoint)  # a session starts with a frame though nothing has changed
    assert endpoint.tick(None, 60) == BOTH.measurement.pack(0, changed)
    endpoint.release("of-b")
    assert endpoint.tick(None, 61) is None


def test_no_valid_value_is_said_once_held_and_ended_by_the_next_frame() -> None:
    endpoint, plant = claimed(BOTH)
    said = {}
    for k in range(1, 40):
        plant.now = turning(nan if 10 <= k < 30 else 0.0)
        said[k] = endpoint.tick(invalid(k - 1) if 10 <= k - 1 < 30 else command(k - 1), k)
    no_value = [quantizer.invalid for quantizer in (BOTH.attitude.quantizer(), BOTH.rate.quantizer()) for _ in range(3)]
    assert {k: frame for k, frame in said.items() if frame} == {
        10: BOTH.measurement.pack(10, no_value),
        25: BOTH.measurement.pack(25, no_value),
        30: BOTH.measurement.pack(30, (0,) * 6),
    }
    assert plant.periods[9:12] == [volts(), OFF, OFF]
    assert plant.periods[30:] == [volts()] * 9
    assert state_of(endpoint) is PlantState.DRIVEN


# ── what it holds ──


@pytest.mark.parametrize("policy", ["on_change", "periodic"])
def test_in_real_time_no_frame_holds_for_the_watchdogs_time_and_an_empty_one_is_refused(policy: Policy) -> None:
    for frame in (None, UNCHANGED):
        endpoint, plant = claimed(wire_of("on_change", policy))
        for k in range(1, 80):
            endpoint.tick(command(k - 1) if k in (1, 16) else frame, k)
        assert plant.periods == [volts()] * (15 + WATCHDOG_TICKS) + [OFF] * (79 - 15 - WATCHDOG_TICKS)
        assert endpoint.trip is TripCause.COMMAND_TIMEOUT
        assert endpoint.refused == (0 if frame is None else 14 + WATCHDOG_TICKS)


def test_an_empty_command_in_lockstep_repeats_the_last_commands_voltages_but_none_of_the_last_session() -> None:
    endpoint, plant = claimed(BOTH, lockstep=True)
    endpoint.tick(command(0, 7), 1)
    for k in range(2, 300):
        endpoint.tick(UNCHANGED, k)
    assert plant.periods == [volts(7)] * 299
    assert (endpoint.refused, state_of(endpoint)) == (0, PlantState.DRIVEN)
    claim_again(endpoint)
    endpoint.tick(None, 300)
    endpoint.tick(UNCHANGED, 301)
    assert plant.periods[299:] == [OFF, OFF]
    assert (endpoint.refused, state_of(endpoint)) == (1, PlantState.GRANTED)


# ── in real time, the end of silence may show late that values are valid again ──


def test_a_heartbeat_without_a_valid_value_is_forgiven_as_long_as_a_measurement_may_have_been_lost() -> None:
    endpoint, plant = claimed(BOTH)
    for k in range(1, 11 + HEARTBEAT):
        plant.now = turning(nan if 5 <= k < 10 else 0.0)
        endpoint.tick(invalid(k - 1) if k > 5 else command(k - 1), k)
        assert state_of(endpoint) is PlantState.DRIVEN
        assert plant.periods[-1] == (OFF if k > 5 else volts())
    endpoint.tick(invalid(10 + HEARTBEAT), 11 + HEARTBEAT)
    assert endpoint.trip is TripCause.INVALID_COMMAND
