"""Faults in the plant's time: from its start, injected, over, cleared, closed; and again from the same seed."""

from __future__ import annotations

from functools import partial
from weakref import ref

import pytest

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, LimitMonitor, LimitSettings
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.spec import WireSpec
from tests.support.faulty_plant import LIMIT, driven, faulty, missing, sample, sensed
from tests.support.faulty_streams import numbered, passed


def test_a_fault_begins_and_ends_at_the_tick_that_its_decimals_mean() -> None:
    """In floats, 53 of the first 100 multiples of 0.009 fall short of their decimals: 3 · 0.009 < 0.027."""
    for k in range(1, 100):
        when = f"off@{9 * k}e-3..{9 * k + 9}e-3"
        plant, _ = faulty(f"rate:{when}", period=0.009)
        seen = []
        for _ in range(k + 2):
            seen.append(missing(plant.measure().rate))
            plant.advance()
        assert seen == [False] * k + [True, False]
        ticks = passed(f"command:{when}", frames=[b"a"] * (k + 2), period=0.009)
        assert [not tick for tick in ticks] == [False] * k + [True, False]


def test_nothing_fails_and_no_time_passes_before_the_start() -> None:
    plant, stand = faulty("rate:off", "motors:off", started=False)
    for _ in range(5):
        plant.actuate((3.0, 3.0))
        plant.advance()
    assert (plant.time, stand.voltages, plant.measure()) == (0.0, (3.0, 3.0), sample(5))
    plant.start()
    plant.actuate((3.0, 3.0))
    assert stand.voltages == (0.0, 0.0)
    assert missing(plant.measure().rate)
    plant.advance()
    plant.start()
    plant.advance()
    assert plant.time == 0.2


def test_the_time_waited_for_a_start_changes_no_random_number() -> None:
    def run(waited: int) -> list[float]:
        plant, stand = faulty("rate:noise=1", started=False)
        for _ in range(waited):
            plant.advance()
        plant.start()
        stand.k = 0
        seen = []
        for _ in range(5):
            plant.advance()
            seen.append(plant.measure().rate[0])
        return seen

    assert run(0) == run(7)


def test_an_injected_fault_counts_from_now() -> None:
    plant, _ = faulty()
    seen = []
    for k in range(10):
        if k == 4:
            plant.inject(Fault.parse("rate:off@0.2..0.4"))
        plant.advance()
        seen.append(missing(plant.measure().rate))
    assert seen == [t in (6, 7) for t in range(1, 11)]


def test_what_gets_stuck_now_holds_what_it_has_now() -> None:
    plant, stand = faulty()
    for k in range(1, 4):
        plant.actuate((1.0 * k, 2.0 * k))
        plant.advance()
        plant.measure()
    for text in ("motor1:stuck", "rate:stuck", "attitude:stuck"):
        plant.inject(Fault.parse(text))
    plant.actuate((9.0, 9.0))
    plant.advance()
    assert stand.voltages == (3.0, 9.0)
    assert plant.measure() == sample(3)


def test_what_is_late_from_now_on_is_what_it_is_now_until_the_delay_is_over() -> None:
    plant, stand = faulty()
    seen = []
    for k in range(1, 8):
        if k == 4:
            plant.inject(Fault.parse("motor1:delay=0.2"))
            plant.inject(Fault.parse("rate.x:delay=0.2"))
        plant.actuate((1.0 * k, 0.0))
        plant.advance()
        seen.append(plant.measure().rate[0])
    assert [u[0] for u in stand.periods] == [1, 2, 3, 3, 3, 4, 5]
    assert seen == [1, 2, 3, 3, 3, 4, 5]


@pytest.mark.parametrize("text", ["motor1:bias=1@0..0.2", "rate:bias=1@0..0.2", "attitude:bias=1@0..0.2"])
def test_a_fault_that_is_over_is_forgotten(text: str) -> None:
    """A plant that receives faults for days must not look through all of them at every tick."""
    fault = Fault.parse(text)
    plant, _ = faulty(fault)
    kept = ref(fault)
    del fault
    plant.advance()
    assert kept() is not None
    plant.advance()
    plant.advance()
    assert kept() is None


def test_once_cleared_sensors_and_motors_act_as_without_faults() -> None:
    plant, stand = faulty("rate:off", "attitude:off", "motors:off")
    plant.actuate((5.0, 5.0))
    plant.advance()
    assert stand.voltages == (0.0, 0.0)
    plant.clear()
    assert stand.voltages == (5.0, 5.0)
    plant.advance()
    assert plant.measure() == sample(2)


@pytest.mark.parametrize("fault", ["motors:bias=3", "motors:stuck@0.1", "motors:garble=1", "motors:delay=1"])
def test_it_is_closed_at_no_voltage_whatever_its_faults_even_one_that_comes_too_late(fault: str) -> None:
    plant, stand = faulty(fault)
    for _ in range(3):
        plant.actuate((5.0, 5.0))
        plant.advance()
    assert stand.voltages != (0.0, 0.0) or "delay" in fault
    too_late = Fault.parse("motor1:off")
    for step in (plant.close, plant.close, plant.clear, partial(plant.inject, too_late), plant.advance):
        step()
        assert stand.voltages == (0.0, 0.0)


def test_an_endpoint_trips_when_its_sensors_fail() -> None:
    """0.1 s are 50 ticks of 2 ms."""
    wire, period_ns = WireSpec(), 2_000_000
    plant, still = faulty("rate:off@0.2", started=False, period=0.002)
    guard = LimitMonitor(LimitSettings(max_rate=1e9, max_invalid_s=0.1), period_ns, LIMIT)
    endpoint = Endpoint(plant, wire, period_ns, limits=guard, armed=True)
    claim = Claim(controller="a", session="a", period_ns=period_ns, lockstep=False, auto_arm=False, wire=wire)
    assert isinstance(endpoint.claim(claim), Grant)
    plant.start()
    endpoint.tick(None, 0)
    k = 0
    while endpoint.state in (PlantState.GRANTED, PlantState.DRIVEN):
        endpoint.tick(wire.command.pack(endpoint.counter, [1, 1]), k := k + 1)
        assert k < 1000
    assert endpoint.cause is not None
    assert "no valid value" in endpoint.cause
    assert k == 100 + 50
    assert still.voltages == (0.0, 0.0)


RANDOM = ("attitude:noise=0.1", "attitude:garble=0.3", "rate:noise=0.1", "rate.x:garble=0.3", "rate:drop=0.3")


def test_the_same_seed_fails_the_same_way_and_another_otherwise() -> None:
    def all_of(seed: int) -> list[str]:
        seen = sensed(*RANDOM, ticks=50, seed=seed)
        motors = driven("motors:noise=1", "motor1:garble=0.3", "motors:drop=0.3", ticks=50, seed=seed)
        stream = [
            passed(f"command:{kind}=0.5", frames=numbered(50), seed=seed)
            for kind in ("drop", "garble", "duplicate", "reorder")
        ]
        return [repr(part) for part in (seen, motors, *stream)]

    assert all_of(3) == all_of(3)
    assert all(one != other for one, other in zip(all_of(3), all_of(4), strict=True))


def test_one_more_fault_leaves_the_random_numbers_of_the_others() -> None:
    alone = [m.rate for m in sensed("rate:noise=0.1")]
    assert [m.rate for m in sensed("rate:noise=0.1", "attitude:garble=0.5")] == alone
