"""Relay of the bridge, without a node: frames passed on, its watchdog, sessions. Its times are exact, sans-I/O."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.protocol.messages.models import Claim, Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Outcome
from tests.support.can_stage import COUNTERS, OFF, PERIOD_NS, WIRE, command, measurement

WATCHDOG_NS = 100_000_000
FIRST_MEASUREMENT_NS = 1_000_000_000
FIRST_COMMAND_NS = (COUNTERS - 1) * PERIOD_NS
"""After the first measurement, before its counter comes round."""
NOW = 5_000_000_000_000
"""Some instant on the monotonic clock [ns]."""


def relay(*, lockstep: bool = False, armed: bool = True, watchdog_s: float = 0.1) -> Relay:
    """A relay that is not claimed."""
    return Relay(WIRE, PERIOD_NS, lockstep=lockstep, watchdog_s=watchdog_s, armed=armed)


def claim(name: str = "a", *, lockstep: bool = False, auto_arm: bool = False) -> Claim:
    """A claim that fits it."""
    return Claim(
        controller=name, session=f"of-{name}", period_ns=PERIOD_NS, lockstep=lockstep, auto_arm=auto_arm, wire=WIRE
    )


def granted(*, lockstep: bool = False, watchdog_s: float = 0.1) -> Relay:
    """A relay in a session, whose first measurement came at NOW."""
    it = relay(lockstep=lockstep, watchdog_s=watchdog_s)
    assert isinstance(it.claim(claim(lockstep=lockstep)), Grant)
    assert it.measurement(measurement(0)) is not None
    it.watch(NOW)
    return it


def driven(*, lockstep: bool = False, watchdog_s: float = 0.1) -> Relay:
    """A relay whose first command, of echo 0, came at NOW."""
    it = granted(lockstep=lockstep, watchdog_s=watchdog_s)
    assert it.command(command(0), NOW) is not None
    assert it.state is PlantState.DRIVEN
    return it


@settings(max_examples=40)
@given(
    counter=st.integers(0, COUNTERS - 1),
    codes=st.lists(st.integers(-128, 127), min_size=6, max_size=6),
    voltages=st.lists(st.integers(-32, 31), min_size=2, max_size=2),
)
def test_what_is_well_formed_passes_untouched_in_a_session_and_only_there(
    counter: int, codes: list[int], voltages: list[int]
) -> None:
    it = relay()
    there, back = measurement(counter, codes), WIRE.command.pack(counter, voltages)
    assert it.measurement(there) is it.command(back, NOW) is None
    it.claim(claim())
    assert it.measurement(measurement(0)) == measurement(0)
    assert it.measurement(there) == there
    assert it.counter == counter
    assert it.command(back, NOW) == back
    assert it.release("of-a")
    assert it.measurement(there) is it.command(back, NOW) is None
    assert it.refused == 0


def test_measurements_of_before_the_session_are_dropped() -> None:
    it = relay()
    for session in range(3):
        it.claim(claim())
        for late in (7, 8, 15):
            assert it.measurement(measurement(late)) is None, session
        for counter in (0, 1, 3, 15, 0):
            assert it.measurement(measurement(counter)) == measurement(counter)
        it.release("of-a")
    assert it.refused == 0


@pytest.mark.parametrize("frame", [b"", bytes(6), bytes(8)])
def test_a_malformed_measurement_is_counted_and_does_not_pass(frame: bytes) -> None:
    it = granted()
    assert it.measurement(frame) is None
    assert it.refused == 1
    assert it.measurement(measurement(1)) is not None


@pytest.mark.parametrize("frame", [b"", bytes(2), bytes(4), b"\0\0\1"])
def test_a_malformed_command_is_counted_and_neither_passes_nor_feeds_the_watchdog(frame: bytes) -> None:
    it = driven()
    assert it.command(frame, NOW + WATCHDOG_NS) is None
    assert it.refused == 1
    it.watch(NOW + WATCHDOG_NS + 1)
    assert it.trip is TripCause.COMMAND_TIMEOUT


@pytest.mark.parametrize("watchdog_ns", [WATCHDOG_NS, 250_000_000])
def test_the_watchdog_trips_a_nanosecond_after_its_time_and_reports_why(watchdog_ns: int) -> None:
    it = driven(watchdog_s=watchdog_ns / 1e9)
    it.watch(NOW + watchdog_ns)
    assert it.session is not None
    it.watch(NOW + watchdog_ns + 1)
    assert it.state is PlantState.TRIPPED
    assert it.trip is TripCause.COMMAND_TIMEOUT
    assert it.session is None
    tripped = [notice.text for notice in it.notices if notice.kind == "tripped"]
    assert tripped == [f"no fresh command for {watchdog_ns // 1_000_000} ms: 0 V"]


def test_a_tick_is_a_measurement_that_passes_with_what_was_received_before_it() -> None:
    it = relay()
    it.measurement(measurement(0))
    assert it.ticked == -1
    it.claim(claim())
    seen = []
    for counter, frames in (
        (0, []),
        (1, [command(0)]),
        (2, [command(0, code=9)]),
        (5, [command(2, code=7)]),
        (6, [b"?"]),
        (7, [WIRE.command.pack(6, [WIRE.voltage.quantizer().invalid] * 2)]),
        (5 + COUNTERS, []),
    ):
        for frame in frames:
            it.command(frame, NOW)
        assert it.measurement(measurement(counter)) is not None
        seen.append((it.ticked, it.session_tick, it.outcome, it.answered, it.voltages))
    level = WIRE.voltage.quantizer().level
    five, seven = (level(5), level(-5)), (level(7), level(-7))
    assert seen == [
        (0, 0, Outcome.NONE, -1, OFF),
        (1, 1, Outcome.ACTED, 0, five),
        (2, 2, Outcome.REPEATED, 0, five),
        (5, 5, Outcome.ACTED, 2, seven),  # two were lost on the bus
        (6, 6, Outcome.MALFORMED, 2, seven),
        (7, 7, Outcome.ACTED, 6, OFF),  # whether it is the right answer is the node's to say
        (5 + COUNTERS, 5 + COUNTERS, Outcome.NONE, 6, OFF),
    ]
    assert it.watch(NOW + WATCHDOG_NS + 1)
    assert (it.ticked, it.session_tick, it.answered, it.voltages) == (6 + COUNTERS, 6 + COUNTERS, -1, OFF)
    assert [(operation.kind, operation.tick) for operation in it.changes] == [("claim", -1)]


def test_the_first_measurement_has_a_second_and_the_first_command_until_the_counter_comes_round() -> None:
    in_time, late, silent = granted(), granted(), relay()
    in_time.watch(NOW + FIRST_COMMAND_NS)
    assert in_time.command(command(0), NOW + FIRST_COMMAND_NS) is not None
    in_time.watch(NOW + FIRST_COMMAND_NS + WATCHDOG_NS)
    assert in_time.state is PlantState.DRIVEN
    late.watch(NOW + FIRST_COMMAND_NS + 1)
    assert late.trip is TripCause.COMMAND_TIMEOUT
    assert "no first command within 0.51 s" in late.notices[-1].text
    silent.claim(claim())
    silent.watch(NOW)
    silent.watch(NOW + FIRST_MEASUREMENT_NS)
    assert silent.state is PlantState.GRANTED
    silent.watch(NOW + FIRST_MEASUREMENT_NS + 1)
    assert "no first command within 1 s" in silent.notices[-1].text


def test_the_next_session_owes_nothing_to_the_time_and_the_echo_of_the_last() -> None:
    it, later = driven(), NOW + 60_000_000_000
    it.release("of-a")
    it.watch(later)
    it.claim(claim())
    it.watch(later + 1_000_000_000)
    it.watch(later + 1_000_000_000 + FIRST_MEASUREMENT_NS)
    assert it.state is PlantState.GRANTED
    it.measurement(measurement(0))
    assert it.command(command(0), later + 2_000_000_000) is not None
    it.watch(later + 2_000_000_000 + WATCHDOG_NS + 1)
    assert it.trip is TripCause.COMMAND_TIMEOUT  # it was driven


def test_in_lockstep_a_session_waits_as_long_as_it_likes() -> None:
    it = driven(lockstep=True)
    it.watch(NOW + 3_600_000_000_000)
    assert it.state is PlantState.DRIVEN


def test_the_number_counts_sessions_modulo_16_and_refusals_not_at_all() -> None:
    it, seen = relay(), []
    for _ in range(18):
        it.claim(claim())
        assert isinstance(it.claim(claim("b")), Refusal)
        seen.append(it.number)
        it.release("of-a")
    assert seen == [*range(1, 16), 0, 1, 2]


def test_while_it_is_unavailable_claims_are_refused_and_clear_no_latch() -> None:
    it = driven()
    it.expire(TripCause.NODE, "node 1 has been silent for 501 ms")
    it.unavailable = "node 1 is silent on the bus"
    for auto_arm in (False, True):
        assert it.claim(claim(auto_arm=auto_arm)) == Refusal(reason="node 1 is silent on the bus")
    assert (it.state, it.trip, it.number) == (PlantState.TRIPPED, TripCause.NODE, 1)
    it.unavailable = None
    refusal = it.claim(claim())
    assert isinstance(refusal, Refusal)
    assert "has been silent for 501 ms" in refusal.reason
    assert isinstance(it.claim(claim(auto_arm=True)), Grant)


def test_an_operators_stop_ends_what_passes() -> None:
    """Stops, trips, holders and arming are those of every plant end: ../plant_emulator/endpoint."""
    it = driven()
    it.stop()
    assert (it.state, it.trip) == (PlantState.TRIPPED, TripCause.OPERATOR)
    assert it.measurement(measurement(0)) is it.command(command(1), NOW) is None


def test_it_may_start_unarmed_and_refuses_a_claim_that_differs() -> None:
    it = relay(armed=False)
    assert isinstance(it.claim(claim()), Refusal)
    assert it.arm()
    other = claim().model_copy(update={"wire": WIRE.with_bits(10, 6), "period_ns": 4_000_000, "lockstep": True})
    refusal = it.claim(other)
    assert isinstance(refusal, Refusal)
    assert refusal.differences == [
        "attitude.bits: 8, not 10",
        "rate.bits: 8, not 10",
        "period_ns: 2000000, not 4000000",
        "lockstep: False, not True",
    ]
    assert isinstance(it.claim(claim()), Grant)
