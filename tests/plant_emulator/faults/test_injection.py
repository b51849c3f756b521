"""Faults in the plant's time: from its start, injected, over, cleared, closed; and again from the same seed."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.faults.injection import MAX_FAULTS, FaultyPlant
from aeroloop.plant_emulator.faults.language import Fault, FaultError
from tests.support.faulty_plant import driven, faulty, missing, numbered, passed, sample, sensed


def inject(plant: FaultyPlant, *faults: str, clear: bool = False) -> list[tuple[int, str]]:
    ends = plant.inject([Fault.parse(fault) for fault in faults], "injected", clear=clear)
    return [(end.tick, end.text) for end in ends]


# ── begin and end ──


@given(
    period=st.sampled_from((0.002, 0.009, 1 / 300, 0.1)),
    start=st.integers(0, 300),
    length=st.none() | st.integers(1, 300),
)
def test_a_fault_acts_at_the_ticks_of_its_status_and_events_and_at_no_other(
    period: float, start: int, length: int | None
) -> None:
    """Starts and ends are whole milliseconds, most of them between two ticks; 3 · 0.009 < 0.027 in floats."""
    end = "" if length is None else f"..{(start + length) / 1000}"
    plant, _ = faulty(f"rate:off@{start / 1000}{end}", f"command:off@{start / 1000}{end}", period=period)
    acted, events = [], []
    for k in range(round(0.7 / period)):
        acted.append(missing(plant.measure().rate))
        assert (plant.passes("command", b"a") == []) == acted[-1]
        events += [transition.tick for transition in plant.transitions()]
        assert acted[-1] == (start / 1000 <= round(k * period, 9) < (start + (length or 1000)) / 1000)
        plant.advance()
    for status in plant.statuses(0):
        assert status.begin_tick is not None
        ticks = range(status.begin_tick, len(acted) if status.end_tick is None else status.end_tick)
        assert acted == [k in ticks for k in range(len(acted))]
        edges = [] if not ticks else [ticks.start] if length is None else [ticks.start, ticks.stop]
        assert events == sorted(2 * edges)


def test_begins_and_ends_are_returned_once_and_in_order_however_many_ticks_are_skipped() -> None:
    plant, _ = faulty("command:off@0.5..0.7", "rate:off@0.2", "rate:bias=1@0.61..0.69", started=False)
    plant.advance()
    assert plant.transitions() == []
    plant.start()
    for _ in range(9):
        plant.advance()
    found = plant.transitions()
    assert [transition.tick for transition in found] == [2, 5, 7]  # the last fault lies between two ticks
    assert found[0].text == "fault begins (configured): rate:off@0.2"
    assert found[2].text == "fault ends (configured): command:off@0.5..0.7, 0 commands dropped"
    assert plant.transitions() == []


def test_nothing_fails_and_no_time_passes_before_the_start() -> None:
    plant, stand = faulty("rate:off", "motors:off", "command:off", "motor1:noise=1", started=False)
    at_once, other = faulty("rate:off", "motors:off", "command:off", "motor1:noise=1")
    at_once.actuate((3.0, 3.0))
    for k in range(5):
        plant.actuate((3.0, 3.0))
        plant.advance()
        assert (plant.time, stand.voltages, plant.measure()) == (0.0, (3.0, 3.0), sample(k + 1))
        assert plant.passes("command", b"a") == [b"a"]
    plant.start()
    plant.actuate((3.0, 3.0))
    assert stand.voltages == other.voltages != (0.0, 0.0)  # nor does the wait use up random numbers
    assert stand.voltages[1] == 0.0
    assert missing(plant.measure().rate)
    plant.advance()
    plant.start()  # a second call does nothing
    plant.advance()
    assert plant.time == 0.2


# ── injection ──


def test_what_is_injected_counts_from_now_and_holds_what_it_has_now() -> None:
    plant, stand = faulty()
    seen = []
    for k in range(1, 9):
        if k == 4:
            inject(plant, "motor1:delay=0.2", "motor2:stuck", "rate.x:delay=0.2", "rate.y:stuck", "rate.z:off@0.2..0.3")
        plant.actuate((1.0 * k, -1.0 * k))
        plant.advance()
        seen.append(plant.measure())
    assert stand.periods == [(1, -1), (2, -2), (3, -3), (3, -3), (3, -3), (4, -3), (5, -3), (6, -3)]
    known = [m.rate for m in seen if not missing(m.rate)]
    assert [rate[0] for rate in known] == [1, 2, 3, 3, 4, 5, 6]
    assert [rate[1] for rate in known] == [10, 20, 30, 30, 30, 30, 30]
    assert [k for k, m in enumerate(seen, 1) if missing(m.rate)] == [5]
    assert [m.attitude for m in seen] == [sample(k).attitude for k in range(1, 9)]


def test_motors_fail_and_recover_under_a_held_voltage_and_one_stuck_at_once_keeps_what_it_had() -> None:
    plant, stand = faulty("motor1:off@0.3..0.6", "motor2:stuck", started=False)
    plant.actuate((5.0, 4.0))
    plant.start()
    plant.actuate((5.0, 9.0))
    for _ in range(8):
        plant.advance()
    assert stand.periods == [(5, 4)] * 3 + [(0, 4)] * 3 + [(5, 4)] * 2


def test_a_sample_is_taken_once_a_period_and_history_is_kept_however_often_it_is_read() -> None:
    plant, _ = faulty("rate:delay=0.2", "attitude:noise=1")
    for _ in range(5):
        plant.advance()
    once = plant.measure()
    assert once.rate == sample(3).rate
    assert plant.measure() is once
    plant.advance()
    assert plant.measure() != once


def test_of_faults_that_cannot_be_none_is_injected() -> None:
    plant, _ = faulty("rate:off")
    with pytest.raises(FaultError, match=r"^fault 'motor3:off@2': the plant has no motor3, but motor1, motor2$"):
        inject(plant, "rate:off", "motor3:off@2", clear=True)
    with pytest.raises(FaultError, match="op inject --clear"):
        inject(plant, *["rate:off"] * MAX_FAULTS)
    assert len(plant.statuses(0)) == 1
    three, stand = faulty("motor3:off", actuators=3)
    three.actuate((1.0, 2.0, 3.0))
    assert stand.voltages == (1.0, 2.0, 0.0)


def test_faults_that_are_over_make_room() -> None:
    """A plant that receives faults for days keeps a bounded number of them."""
    plant, _ = faulty(*["command:off@0..0.1"] * MAX_FAULTS)
    plant.transitions()
    plant.advance()
    plant.transitions()
    inject(plant, *["rate:off"] * (MAX_FAULTS - 1))
    assert [status.source for status in plant.statuses(0)] == ["configured"] + ["injected"] * (MAX_FAULTS - 1)


def test_once_cleared_the_plant_is_as_without_faults_and_what_was_to_come_never_begins() -> None:
    plant, stand = faulty("rate:off", "attitude:off", "motors:off", "command:delay=0.1", "rate:off@9")
    plant.transitions()
    plant.actuate((5.0, 5.0))
    plant.advance()
    assert plant.passes("command", b"a") == []
    ends = inject(plant, clear=True)
    assert [tick for tick, _ in ends] == [1] * 4
    assert ends[3][1] == "fault ends (configured): command:delay=0.1, 1 commands delayed"
    assert stand.voltages == (5.0, 5.0)
    plant.advance()
    assert plant.measure() == sample(2)
    assert plant.passes("command", b"b") == [b"b"]
    assert [(status.begin_tick, status.end_tick) for status in plant.statuses(10)] == [(10, 11)] * 4


def test_frames_are_of_one_direction_and_those_held_back_are_lost_with_their_session() -> None:
    plant, _ = faulty("command:delay=0.1", "measurement:off@0.2")
    assert plant.passes("command", b"a") == []
    plant.forget_frames()
    plant.advance()
    assert plant.passes("command", b"b") == []
    assert plant.passes("measurement", b"m") == [b"m"]
    plant.advance()
    assert plant.passes("command", None) == [b"b"]
    assert plant.passes("measurement", b"m") == []
    inject(plant, "command:stuck", clear=True)
    assert plant.passes("command", b"c") == [b"b"]  # the frame that passed last


@pytest.mark.parametrize("fault", ["motors:bias=3", "motors:stuck@0.1", "motors:garble=1", "motors:delay=1"])
def test_it_is_closed_at_no_voltage_whatever_its_faults_even_one_that_comes_too_late(fault: str) -> None:
    plant, stand = faulty(fault)
    for _ in range(3):
        plant.actuate((5.0, 5.0))
        plant.advance()
    assert stand.voltages != (0.0, 0.0) or "delay" in fault
    plant.close()
    plant.close()
    assert stand.voltages == (0.0, 0.0)
    for clear in (True, False):
        inject(plant, "motor1:off", clear=clear)
        plant.advance()
        assert stand.voltages == (0.0, 0.0)


# ── random numbers ──


def test_the_same_seed_fails_the_same_way_and_another_otherwise() -> None:
    sensors = ("attitude:noise=0.1", "attitude:garble=0.3", "rate:noise=0.1", "rate.x:garble=0.3", "rate:drop=0.3")

    def all_of(seed: int) -> list[str]:
        seen = sensed(*sensors, ticks=50, seed=seed)
        motors = driven("motors:noise=1", "motor1:garble=0.3", "motors:drop=0.3", ticks=50, seed=seed)
        kinds = ("drop", "garble", "duplicate", "reorder")
        streams = [passed(f"command:{kind}=0.5", frames=numbered(50), seed=seed) for kind in kinds]
        return [repr(part) for part in (seen, motors, *streams)]

    assert all_of(3) == all_of(3)
    assert all(one != other for one, other in zip(all_of(3), all_of(4), strict=True))


def test_one_more_fault_leaves_the_random_numbers_of_the_others_and_has_its_own() -> None:
    alone = [m.rate for m in sensed("rate:noise=0.1")]
    assert [m.rate for m in sensed("rate:noise=0.1", "attitude:garble=0.5")] == alone
    twice = [m.rate[0] - k for k, m in enumerate(sensed("rate:noise=0.1", "rate:noise=0.1"))]
    assert twice != pytest.approx([2 * (rate[0] - k) for k, rate in enumerate(alone)])
    plant, _ = faulty("command:drop=0.5", "measurement:drop=0.5")
    passes = [(plant.passes("command", b"a"), plant.passes("measurement", b"a")) for _ in range(100)]
    assert any(command != measurement for command, measurement in passes)
