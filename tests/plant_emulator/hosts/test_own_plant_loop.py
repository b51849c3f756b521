"""A plant of one's own behind the loop: any number of motors, replay, and what happens when it fails."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from math import sin
from threading import Event
from typing import Any

import pytest

from aeroloop.plant_emulator.hosts.driver import Driver
from aeroloop.plant_emulator.hosts.trace import PlantReplay, why_not
from aeroloop.plant_emulator.plant import PlantError
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from tests.support.own_laws import Node, cycle
from tests.support.own_plants import Turntable, TurntableSettings
from tests.support.plant_stage import Stage

HERE = "tests.support.own_plants"
TICKS = 60


def stage_of(kind: str, wire: WireSpec, own: dict[str, Any], faults: list[str], *, lockstep: bool) -> Stage:
    """An emulator with a plant of one's own, whose every measurement is answered at once with rising and falling u."""
    loop = LoopSettings(lockstep=lockstep, realtime="off")
    count = iter(range(TICKS * 10))

    def answer(stage: Stage, frame: bytes) -> None:
        stage.command(frame, [round(20 * sin(next(count) / 9 + i)) for i in range(wire.actuators)])

    def between(stage: Stage) -> None:
        if stage.endpoint.session is None and stage.endpoint.ticked < 0:  # once
            stage.claim()

    plant = PlantSettings(kind=f"{HERE}:{kind}", own=own, faults=faults)
    return Stage(loop, wire, plant, between=between, answer=answer)


@pytest.mark.parametrize(("kind", "actuators"), [("Turntable", 1), ("Octoturntable", 8)])
@pytest.mark.parametrize("lockstep", [False, True])
def test_one_motor_or_eight_are_driven_and_replayed_byte_for_byte(kind: str, actuators: int, lockstep: bool) -> None:
    wire = WireSpec(actuators=actuators)
    faults = [f"motor{actuators}:stuck@0.02..0.05", "rate.z:noise=0.05@0.03", "attitude:bias=0.1@0.02..0.06"]
    stage = stage_of(kind, wire, {"inertia": 0.01}, faults, lockstep=lockstep).run(TICKS)
    assert stage.endpoint.accepted > TICKS / 2
    truth = stage.driver.truth()
    assert truth is not None
    assert len(truth.voltages) == actuators
    assert sum(fault.changed for fault in stage.driver.fault_statuses()) > 0
    replay = PlantReplay(stage.loop, wire, PlantSettings(kind=f"{HERE}:{kind}", own={"inertia": 0.01}, faults=faults))
    for batch in stage.batches:
        assert batch.header.actuators == actuators
        assert batch.columns["voltages"].shape[1:] == (actuators,)
        replay.feed(batch)
    found = replay.result()
    assert (found.differ, found.stopped) == (0, None)
    assert found.ticks > TICKS / 2


@pytest.mark.parametrize("method", ["actuate", "advance", "measure"])
@pytest.mark.parametrize("lockstep", [False, True])
def test_a_plant_that_fails_trips_is_closed_at_0_v_and_ends_the_loop(method: str, lockstep: bool) -> None:
    stage = stage_of("Turntable", WireSpec(actuators=1), {"fails_in": method, "fails_after": 30}, [], lockstep=lockstep)
    with pytest.raises(PlantError, match=f"Turntable failed in {method}"):
        stage.run(TICKS)
    assert (stage.endpoint.state, stage.endpoint.trip) == (PlantState.TRIPPED, TripCause.PLANT)
    (tripped,) = [notice for notice in stage.endpoint.notices if notice.kind == "tripped"]
    assert f"Turntable failed in {method}(): RuntimeError: the table broke in {method} (own_plants.py" in tripped.text
    assert tripped.session == "s1"
    assert (Turntable.latest.closed, Turntable.latest.volts) == (1, (0.0,))


@pytest.mark.parametrize(
    ("kind", "wire", "faults", "line"),
    [
        ("Octoturntable", WireSpec(), [], "wire.actuators is 2, but the plant has 8 actuators"),
        ("Turntable", WireSpec(actuators=1), ["motor2:off"], "the plant has no motor2, but motor1"),
    ],
)
def test_a_plant_that_does_not_fit_is_refused_and_closed(
    kind: str, wire: WireSpec, faults: list[str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[str] = []
    monkeypatch.setattr(Turntable, "close", lambda self: closed.append(type(self).__name__))
    with pytest.raises(ValueError, match=line):
        stage_of(kind, wire, {}, faults, lockstep=False)
    assert closed == [kind]


@pytest.mark.parametrize(
    ("plant", "why"),
    [
        ({"kind": f"{HERE}:Hardware"}, "Hardware (plant.kind) does not state that it is `repeatable`"),
        ({"kind": f"{HERE}:Gone"}, "has no Gone"),
        ({"via": "can"}, "plant.via is 'can'"),
        ({"via": "quanser"}, "plant.via is 'quanser'"),
    ],
)
def test_a_machine_is_not_moved_by_a_replay(plant: dict[str, Any], why: str) -> None:
    settings = PlantSettings(**plant)
    assert why in (why_not(settings) or "")
    with pytest.raises(ValueError, match=r"plant\."):
        PlantReplay(LoopSettings(), WireSpec(), settings)


def test_a_plant_that_paces_the_loop_raises_the_tick_by_what_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Turntable, "paces", True)
    advance: Callable[[Turntable], None] = Turntable.advance
    count = iter(range(TICKS + 1))

    def late(self: Turntable) -> None:
        advance(self)
        self.passed = 3 if next(count) == 10 else 1

    monkeypatch.setattr(Turntable, "advance", late)
    stage = stage_of("Turntable", WireSpec(actuators=1), {}, [], lockstep=False).run(TICKS)
    assert stage.skipped == 2
    truth = Turntable.latest.truth()
    assert truth is not None
    assert truth.attitude[3] != 0  # it did turn


class Cyclic(Turntable):
    """Makes two objects a tick that refer to each other."""

    def advance(self) -> None:
        super().advance()
        cycle()


@pytest.fixture
def _collector_off() -> Iterator[None]:
    """As `prepare_process` leaves it."""
    gc.collect()
    gc.freeze()
    gc.disable()
    yield
    gc.unfreeze()
    gc.enable()


@pytest.mark.usefixtures("_collector_off")
def test_the_cycles_of_a_plant_of_ones_own_are_collected_with_a_session_and_without() -> None:
    loop, wire, settings = LoopSettings(realtime="off"), WireSpec(actuators=1), PlantSettings(watchdog_s=10)
    driver = Driver(Cyclic(TurntableSettings(), loop.period), loop, wire, settings, stop := Event())

    def between(stage: Stage) -> None:
        if stage.endpoint.ticked == 3000:
            stage.claim()

    stage = Stage(loop, wire, settings, driver=driver, between=between)
    stage.stop = stop
    before = Node.alive
    stage.run(6000)
    assert len(stage.wires.sent) > 200  # until no first command came
    assert Node.alive - before < 2_000  # of 12 000
