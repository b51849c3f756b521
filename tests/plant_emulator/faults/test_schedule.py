"""Schedule of faults: its ticks are those at which the faults act, and it stays bounded."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.faults.injection import ActingFault
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.faults.schedule import MAX_FAULTS, Schedule

PERIODS = (0.002, 0.009, 1 / 300, 0.1)


def acting(fault: Fault) -> ActingFault:
    return ActingFault(fault, np.random.default_rng(0), 0.0)


def with_faults(*texts: str, period: float = 0.1) -> Schedule:
    schedule = Schedule(period)
    for text in texts:
        schedule.add(acting(Fault.parse(text)), "configured")
    return schedule


@given(
    period=st.sampled_from(PERIODS),
    start=st.integers(0, 3000),
    length=st.none() | st.integers(1, 3000),
    near=st.integers(-3, 3),
)
def test_a_fault_acts_at_the_ticks_of_its_status_and_at_no_other(
    period: float, start: int, length: int | None, near: int
) -> None:
    """Starts and ends are whole milliseconds, most of them between two ticks."""
    fault = Fault(
        signal="command",
        kind="off",
        start_s=start / 1000,
        end_s=None if length is None else (start + length) / 1000,
    )
    schedule = Schedule(period)
    at_work = acting(fault)
    schedule.add(at_work, "configured")
    (status,) = schedule.statuses(0)
    assert status.begin_tick is not None
    for edge in (status.begin_tick, status.end_tick or 0):
        tick = max(0, edge + near)
        acts = status.begin_tick <= tick and (status.end_tick is None or tick < status.end_tick)
        assert at_work.active(round(tick * period, 9)) == acts


def test_each_begin_and_end_is_returned_once_and_in_order_however_many_ticks_are_skipped() -> None:
    schedule = with_faults("command:off@0.5..0.7", "rate:off@0.2", "rate:bias=1@0.61..0.69")
    assert schedule.due == 2
    assert schedule.transitions(1) == []
    transitions = schedule.transitions(9)
    assert [transition.tick for transition in transitions] == [
        2,
        5,
        7,
    ]  # the last lies between two ticks and never acts
    assert transitions[0].text == "fault begins (configured): rate:off@0.2"
    assert transitions[2].text == "fault ends (configured): command:off@0.5..0.7, 0 commands dropped"
    assert schedule.transitions(9) == []
    assert schedule.due == inf


def test_what_is_cleared_ends_then_and_what_is_to_come_never_begins() -> None:
    schedule = with_faults("command:off", "rate:off@2")
    schedule.transitions(3)
    assert [transition.tick for transition in schedule.clear(4)] == [4]
    assert [(status.begin_tick, status.end_tick) for status in schedule.statuses(10)] == [(10, 14)]
    assert schedule.transitions(1000) == []


def test_too_many_faults_are_refused_and_those_that_are_over_are_forgotten() -> None:
    schedule = with_faults(*["command:off@0..0.5"] * MAX_FAULTS)
    with pytest.raises(ValueError, match="op inject --clear"):
        schedule.make_room(1)
    schedule.transitions(5)
    schedule.make_room(MAX_FAULTS)
    for text in ["rate:off"] * MAX_FAULTS:
        schedule.add(acting(Fault.parse(text)), "injected")
    assert {status.source for status in schedule.statuses(0)} == {"injected"}
