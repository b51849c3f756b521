"""Relay of the bridge, without a node: frames passed on, ticks, sessions. Its times are exact, sans-I/O.

What it has in common with the plant's Endpoint, freshness, watchdog and latch: ../plant_emulator/endpoint.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.protocol.messages.models import Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.messages.trace import Outcome
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from tests.support.can_stage import measurement
from tests.support.plant_end import COUNTERS, OFF, PERIOD_NS, WIRE, claim_of, command, volts
from tests.support.simulated_link import wire_of

WATCHDOG_NS = 100_000_000
FIRST_MEASUREMENT_NS = 1_000_000_000
NOW = 5_000_000_000_000
"""Some instant on the monotonic clock [ns]."""
BOTH = wire_of("on_change", "on_change")


def granted(wire: WireSpec = WIRE, *, lockstep: bool = False) -> Relay:
    """A relay in a session, which has no measurement yet."""
    it = Relay(wire, PERIOD_NS, lockstep=lockstep, watchdog_s=0.1, armed=True)
    assert isinstance(it.claim(claim_of(wire=wire, lockstep=lockstep)), Grant)
    return it


def driven(wire: WireSpec = WIRE, *, lockstep: bool = False) -> Relay:
    """A relay whose first command, of echo 0, came at NOW."""
    it = granted(wire, lockstep=lockstep)
    assert it.measurement(measurement(0)) is not None
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
    it = granted()
    there, back = measurement(counter, codes), WIRE.command.pack(counter, voltages)
    assert it.measurement(measurement(0)) == measurement(0)
    assert it.measurement(there) == there
    assert it.counter == counter
    assert it.command(back, NOW) == back  # stale or not: the node judges it again
    it.release("of-a")
    assert it.measurement(there) is it.command(back, NOW) is None
    assert it.refused == 0


def test_measurements_of_before_the_session_are_dropped() -> None:
    it = granted()
    for session in range(3):
        for late in (7, 8, 15):
            assert it.measurement(measurement(late)) is None, session
        for counter in (0, 1, 3, 15, 0):
            assert it.measurement(measurement(counter)) == measurement(counter)
        it.release("of-a")
        it.claim(claim_of())
    assert it.refused == 0


@pytest.mark.parametrize("frame", [b"", bytes(4), bytes(6), bytes(8)])
def test_malformed_frames_are_counted_and_neither_pass_nor_feed_the_watchdog(frame: bytes) -> None:
    it = driven()
    assert it.measurement(frame) is it.command(frame, NOW + WATCHDOG_NS - 1) is None
    assert it.refused == 2
    assert it.watch(NOW + WATCHDOG_NS)
    assert it.trip is TripCause.COMMAND_TIMEOUT


def test_a_tick_is_a_measurement_that_passes_with_what_was_received_before_it() -> None:
    it = granted()
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
    assert seen == [
        (0, 0, Outcome.NONE, -1, OFF),
        (1, 1, Outcome.ACTED, 0, volts(5)),
        (2, 2, Outcome.REPEATED, 0, volts(5)),
        (5, 5, Outcome.ACTED, 2, volts(7)),  # two were lost on the bus
        (6, 6, Outcome.MALFORMED, 2, volts(7)),
        (7, 7, Outcome.ACTED, 6, OFF),  # whether it is the right answer is the node's to say
        (5 + COUNTERS, 5 + COUNTERS, Outcome.NONE, 6, OFF),
    ]
    assert not it.watch(NOW + WATCHDOG_NS - 1)
    assert it.watch(NOW + WATCHDOG_NS)
    assert (it.ticked, it.session_tick, it.answered, it.voltages) == (6 + COUNTERS, 6 + COUNTERS, -1, OFF)
    assert it.notices[-1].text == "no fresh command for 100 ms: 0 V"
    assert [(operation.kind, operation.tick) for operation in it.changes] == [("claim", -1)]


def test_the_first_measurement_has_a_second_and_owes_nothing_to_the_time_of_the_last_session() -> None:
    it = driven()
    it.release("of-a")
    later = NOW + 60_000_000_000
    assert not it.watch(later)
    it.claim(claim_of())
    assert not it.watch(later + 1_000_000_000)  # from the first look at the clock
    assert not it.watch(later + 1_000_000_000 + FIRST_MEASUREMENT_NS - 1)
    assert it.watch(later + 1_000_000_000 + FIRST_MEASUREMENT_NS)
    assert "no first command within 1 s" in it.notices[-1].text


def test_in_lockstep_a_session_waits_as_long_as_it_likes_for_all_but_its_first_command() -> None:
    it = driven(lockstep=True)
    assert not it.watch(NOW + 3_600_000_000_000)
    first = granted(lockstep=True)
    assert not first.watch(NOW)
    assert first.watch(NOW + FIRST_MEASUREMENT_NS)


def test_while_it_is_unavailable_claims_are_refused_and_clear_no_latch() -> None:
    it = driven()
    it.expire(TripCause.NODE, "node 1 has been silent for 501 ms")
    it.unavailable = "node 1 is silent on the bus"
    for auto_arm in (False, True):
        assert it.claim(claim_of(auto_arm=auto_arm)) == Refusal(reason="node 1 is silent on the bus")
    assert (it.state, it.trip, it.number) == (PlantState.TRIPPED, TripCause.NODE, 1)
    it.unavailable = None
    refusal = it.claim(claim_of(auto_arm=False))
    assert isinstance(refusal, Refusal)
    assert "has been silent for 501 ms" in refusal.reason
    assert isinstance(it.claim(claim_of()), Grant)


# ── on change: an empty frame stands for a silent tick, in lockstep only ──


def test_silence_passes_in_lockstep_after_a_sessions_first_frame_and_has_the_counter_after_the_last() -> None:
    it = granted(BOTH, lockstep=True)
    assert it.measurement(UNCHANGED) is it.command(UNCHANGED, NOW) is None
    assert (it.session_tick, it.refused) == (-1, 1)  # the command was no first one
    assert it.measurement(measurement(0)) is not None
    for k in range(1, 15):
        assert it.measurement(UNCHANGED) == UNCHANGED
        assert it.counter == k
    assert it.command(command(0), NOW) is not None
    assert it.command(UNCHANGED, NOW) == UNCHANGED
    assert it.refused == 1


@pytest.mark.parametrize(("wire", "lockstep"), [(BOTH, False), (WIRE, True), (WIRE, False)])
def test_an_empty_frame_is_refused_elsewhere_and_feeds_no_watchdog(wire: WireSpec, lockstep: bool) -> None:
    it = driven(wire, lockstep=lockstep)
    assert it.measurement(UNCHANGED) is it.command(UNCHANGED, NOW + WATCHDOG_NS - 1) is None
    assert it.refused == 2
    assert it.watch(NOW + WATCHDOG_NS) == (not lockstep)
