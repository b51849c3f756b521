"""Relay of the bridge, without a node: what it does not share with the plant's Endpoint. Its times are exact."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.plant_emulator.hosts.can_bridge import Relay
from aeroloop.protocol.messages.models import Grant, Refusal
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED
from tests.support.plant_end import COUNTERS, PERIOD_NS, WIRE, claim_of, command
from tests.support.simulated_link import wire_of

WATCHDOG_NS = 100_000_000
FIRST_MEASUREMENT_NS = 1_000_000_000
NOW = 5_000_000_000_000
"""Some instant on the monotonic clock [ns]."""
BOTH = wire_of("on_change", "on_change")


def measurement(counter: int, codes: Sequence[int] = (1, -2, 3, -4, 5, -6)) -> bytes:
    return WIRE.measurement.pack(counter % COUNTERS, codes)


def granted(wire: WireSpec = WIRE, *, lockstep: bool = False) -> Relay:
    """A relay in a session, which has no measurement yet."""
    it = Relay(wire, PERIOD_NS, lockstep=lockstep, watchdog_s=0.1, armed=True)
    assert isinstance(it.claim(claim_of(wire=wire, lockstep=lockstep)), Grant)
    return it


def driven(wire: WireSpec = WIRE, *, lockstep: bool = False) -> Relay:
    """A relay whose first command, of echo 0, came at NOW."""
    it = granted(wire, lockstep=lockstep)
    assert it.measurement(measurement(0), NOW) is not None
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
    it, there, back = granted(), measurement(counter, codes), WIRE.command.pack(counter, voltages)
    later = NOW + (counter or COUNTERS) * PERIOD_NS
    assert it.measurement(measurement(0), NOW) == measurement(0)
    assert it.measurement(there, later) == there
    assert it.counter == counter
    assert it.command(back, later) == back  # stale or not: the node judges it again
    it.release("of-a")
    assert it.measurement(there, later) is it.command(back, later) is None
    assert it.refused == 0


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_repeated_or_overtaken_measurement_is_no_tick(lockstep: bool) -> None:
    it = granted(lockstep=lockstep)
    for k in range(6):
        assert it.measurement(measurement(k), NOW + k * PERIOD_NS) is not None
    just_after = NOW + 5 * PERIOD_NS + 1
    assert it.measurement(measurement(5), just_after) is None
    assert it.measurement(measurement(3), just_after) is None
    assert it.session_tick == 5
    assert it.measurement(measurement(8), NOW + 8 * PERIOD_NS) is not None  # frames 6 and 7 were lost
    assert it.session_tick == 8


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


def test_the_numbers_of_sessions_fit_a_heartbeats_four_bits_and_none_repeats_the_last() -> None:
    it = Relay(WIRE, PERIOD_NS, lockstep=False, watchdog_s=0.1, armed=True)
    numbers = [it.number]
    for _ in range(40):
        assert isinstance(it.claim(claim_of()), Grant)
        numbers.append(it.number)
        it.release("of-a")
    assert set(numbers) == set(range(16))
    assert all(number != later for number, later in pairwise(numbers))


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
    assert it.measurement(UNCHANGED, NOW) is it.command(UNCHANGED, NOW) is None
    assert (it.session_tick, it.refused) == (-1, 1)  # the command was no first one
    assert it.measurement(measurement(0), NOW) is not None
    for k in range(1, 15):
        assert it.measurement(UNCHANGED, NOW) == UNCHANGED
        assert it.counter == k
    assert it.command(command(0), NOW) is not None
    assert it.command(UNCHANGED, NOW) == UNCHANGED
    assert it.refused == 1


@pytest.mark.parametrize(("wire", "lockstep"), [(BOTH, False), (WIRE, True)])
def test_an_empty_frame_is_refused_elsewhere_and_feeds_no_watchdog(wire: WireSpec, lockstep: bool) -> None:
    it = driven(wire, lockstep=lockstep)
    assert it.measurement(UNCHANGED, NOW) is it.command(UNCHANGED, NOW + WATCHDOG_NS - 1) is None
    assert it.refused == 2
    assert it.watch(NOW + WATCHDOG_NS) == (not lockstep)
