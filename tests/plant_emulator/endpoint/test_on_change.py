"""Plant endpoint with the on-change policy: frames sent, levels held, and the end of holding.

Time is the tick index; period i is the time from tick i to tick i + 1, as in test_endpoint.py.
"""

from __future__ import annotations

from math import nan

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.attitude import IDENTITY, Vector
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED, Policy, Transmit
from tests.plant_emulator.endpoint.test_endpoint import COUNTERS, OFF, PERIOD_NS, WATCHDOG_TICKS, RecordingPlant

HEARTBEAT = 15
"""Ticks: 30 ms of 2 ms."""


def wire_of(measurement: Policy = "on_change", command: Policy = "on_change") -> WireSpec:
    return WireSpec(transmit=Transmit(measurement=measurement, command=command))


BOTH = wire_of()


def claimed(wire: WireSpec = BOTH, *, lockstep: bool = False) -> tuple[Endpoint, RecordingPlant]:
    """An endpoint at tick 0 that has sent a session's first measurement."""
    plant = RecordingPlant(wire.actuators)
    endpoint = Endpoint(plant, wire, PERIOD_NS, lockstep=lockstep)
    claim(endpoint, "first")
    assert endpoint.tick(None, 0)
    return endpoint, plant


def claim(endpoint: Endpoint, session: str) -> None:
    answer = endpoint.claim(
        Claim(
            controller="a",
            session=session,
            period_ns=PERIOD_NS,
            lockstep=endpoint.lockstep,
            auto_arm=True,
            wire=endpoint.wire,
        )
    )
    assert isinstance(answer, Grant)


def command(echo: int, code: int = 5) -> bytes:
    return BOTH.command.pack(echo % COUNTERS, [code, -code])


def invalid(echo: int) -> bytes:
    return BOTH.command.pack(echo % COUNTERS, [BOTH.voltage.quantizer().invalid] * 2)


def volts(code: int = 5) -> tuple[float, float]:
    return code * 48 / 63, -code * 48 / 63


def turning(rate: float) -> Measurement:
    vector: Vector = (rate, 0.0, 0.0)
    return Measurement(IDENTITY, vector)


def state(endpoint: Endpoint) -> PlantState:
    return endpoint.state


# What it sends


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_plant_at_rest_sends_heartbeats_only_and_a_change_at_once(lockstep: bool) -> None:
    endpoint, plant = claimed(lockstep=lockstep)
    sent = {}
    for k in range(1, 60):
        plant.now = turning(0.5 if k >= 40 else 0.001)  # which is less than half a step
        if frame := endpoint.tick(command(k - 1), k):
            sent[k] = BOTH.measurement.unpack(frame)
    assert sent == {
        15: (15, (0,) * 6),
        30: (30, (0,) * 6),
        40: (40, (0, 0, 0, 64, 0, 0)),
        55: (55, (0, 0, 0, 64, 0, 0)),
    }


def test_silence_is_distinguished_from_no_session() -> None:
    endpoint, _ = claimed()
    assert endpoint.tick(command(0), 1) == UNCHANGED
    endpoint.release("first")
    assert endpoint.tick(None, 2) is None


def test_a_new_session_starts_with_a_frame_though_nothing_has_changed() -> None:
    endpoint, _ = claimed()
    assert endpoint.tick(command(0), 1) == UNCHANGED
    endpoint.release("first")
    claim(endpoint, "second")
    assert endpoint.tick(None, 2) == BOTH.measurement.pack(0, (0,) * 6)


def test_no_valid_value_is_said_once_held_and_ended_by_the_next_frame() -> None:
    endpoint, plant = claimed()
    said = {}
    for k in range(1, 40):
        plant.now = turning(nan if 10 <= k < 30 else 0.0)
        said[k] = endpoint.tick(invalid(k - 1) if 10 <= k - 1 < 30 else command(k - 1), k)
    no_value = [quantizer.invalid for quantizer in (BOTH.attitude.quantizer(), BOTH.rate.quantizer()) for _ in range(3)]
    assert {k: frame for k, frame in said.items() if frame} == {
        10: BOTH.measurement.pack(10, no_value),
        25: BOTH.measurement.pack(25 % COUNTERS, no_value),
        30: BOTH.measurement.pack(30 % COUNTERS, (0,) * 6),
    }
    assert plant.held[9:12] == [volts(), OFF, OFF]
    assert plant.held[30:] == [volts()] * 9
    assert state(endpoint) is PlantState.DRIVEN


# What it holds


def test_silence_in_real_time_holds_the_last_command_until_the_watchdogs_time_is_over() -> None:
    endpoint, plant = claimed()
    for k in range(1, 31):
        endpoint.tick(command(k - 1) if k in (1, 16) else None, k)
    for k in range(31, 100):
        endpoint.tick(None, k)
    assert plant.held[: 15 + WATCHDOG_TICKS] == [volts()] * (15 + WATCHDOG_TICKS)
    assert plant.held[15 + WATCHDOG_TICKS :] == [OFF] * (99 - 15 - WATCHDOG_TICKS)
    assert endpoint.trip is TripCause.COMMAND_TIMEOUT


@pytest.mark.parametrize("policy", ["on_change", "periodic"])
def test_an_empty_command_in_real_time_is_refused_and_feeds_no_watchdog(policy: Policy) -> None:
    endpoint, plant = claimed(wire_of(command=policy))
    endpoint.tick(command(0), 1)
    for k in range(2, 80):
        endpoint.tick(UNCHANGED, k)
    assert plant.held.index(OFF) == WATCHDOG_TICKS
    assert endpoint.refused == WATCHDOG_TICKS
    assert endpoint.accepted == 1


def test_an_empty_command_in_lockstep_is_refused_where_commands_are_periodic() -> None:
    endpoint, _ = claimed(wire_of(command="periodic"), lockstep=True)
    endpoint.tick(command(0), 1)
    endpoint.tick(UNCHANGED, 2)
    assert (endpoint.refused, endpoint.accepted) == (1, 1)


def test_an_empty_command_in_lockstep_answers_the_last_measurement_with_the_last_commands_voltages() -> None:
    endpoint, plant = claimed(lockstep=True)
    endpoint.tick(command(0, 7), 1)
    for k in range(2, 3 * WATCHDOG_TICKS):
        endpoint.tick(UNCHANGED, k)
    assert plant.held == [volts(7)] * (3 * WATCHDOG_TICKS - 1)
    assert endpoint.accepted == 3 * WATCHDOG_TICKS - 1
    assert endpoint.refused == 0
    assert state(endpoint) is PlantState.DRIVEN


def test_an_empty_command_before_a_sessions_first_is_refused_and_holds_nothing_of_the_last_session() -> None:
    endpoint, plant = claimed(lockstep=True)
    endpoint.tick(command(0, 7), 1)
    endpoint.release("first")
    endpoint.tick(None, 2)
    claim(endpoint, "second")
    endpoint.tick(None, 3)
    endpoint.tick(UNCHANGED, 4)
    assert plant.held == [volts(7), OFF, OFF, OFF]
    assert endpoint.refused == 1
    assert state(endpoint) is PlantState.GRANTED


def test_in_lockstep_silence_goes_on_saying_no_valid_value_only_while_that_is_the_right_answer() -> None:
    endpoint, plant = claimed(lockstep=True)
    endpoint.tick(command(0), 1)
    plant.now = turning(nan)
    endpoint.tick(UNCHANGED, 2)
    endpoint.tick(invalid(2), 3)
    endpoint.tick(UNCHANGED, 4)
    plant.now = turning(0.0)
    endpoint.tick(UNCHANGED, 5)
    assert plant.held == [volts(), volts(), OFF, OFF, OFF]
    assert state(endpoint) is PlantState.DRIVEN
    endpoint.tick(UNCHANGED, 6)  # answers a valid measurement
    assert endpoint.trip is TripCause.INVALID_COMMAND


# In real time, the end of silence may show late that values are valid again


def after_a_failure(policy: Policy, *, lockstep: bool = False) -> tuple[Endpoint, RecordingPlant, int]:
    """An endpoint whose measurements had no valid value until tick 9."""
    endpoint, plant = claimed(wire_of(measurement=policy), lockstep=lockstep)
    for k in range(1, 11):
        plant.now = turning(nan if 5 <= k < 10 else 0.0)
        endpoint.tick(invalid(k - 1) if 5 <= k - 1 < 10 else command(k - 1), k)
    return endpoint, plant, 10


def test_a_heartbeat_without_a_valid_value_is_forgiven_as_long_as_a_measurement_may_have_been_lost() -> None:
    endpoint, plant, k = after_a_failure("on_change")
    for later in range(HEARTBEAT):
        endpoint.tick(invalid(k + later), k + later + 1)
        assert state(endpoint) is PlantState.DRIVEN
        assert plant.held[-1] == OFF
    endpoint.tick(invalid(k + HEARTBEAT), k + HEARTBEAT + 1)
    assert endpoint.trip is TripCause.INVALID_COMMAND


@pytest.mark.parametrize(("policy", "lockstep"), [("periodic", False), ("on_change", True)])
def test_it_trips_at_once_where_every_measurement_is_there(policy: Policy, lockstep: bool) -> None:
    endpoint, _, k = after_a_failure(policy, lockstep=lockstep)
    endpoint.tick(invalid(k), k + 1)
    assert endpoint.trip is TripCause.INVALID_COMMAND


def test_nothing_is_forgiven_for_what_the_last_session_did_not_measure() -> None:
    endpoint, _, k = after_a_failure("on_change")
    endpoint.release("first")
    claim(endpoint, "second")
    endpoint.tick(None, k + 1)
    endpoint.tick(invalid(0), k + 2)
    assert endpoint.trip is TripCause.INVALID_COMMAND
