"""A plant of one's own: found by name, watched over, behind the loop with any number of motors, and replayed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf, nan, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.hosts.trace import PlantReplay, why_not
from aeroloop.plant_emulator.plant import OwnPlant, PlantError
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.service.config import load
from tests.support.own_plants import Octoturntable, Turntable, TurntableSettings
from tests.support.plant_end import Stage

HERE = "tests.support.own_plants"
TABLE = f"{HERE}:Turntable"
PERIOD = 0.002
TICKS = 60


def table(**own: Any) -> tuple[OwnPlant, Turntable]:
    inner = Turntable(TurntableSettings(**own), PERIOD)
    return OwnPlant(inner, 24.0), inner


# ── what is no plant, and what a plant may not do ──


@pytest.mark.parametrize(
    ("kind", "own", "line"),
    [
        ("areo", {}, "plant.kind = 'areo' is not known: it is one of aero, fmu, mujoco, rigid_body, or package"),
        (f"{HERE}:Tabel", {}, "has no Tabel; its classes of aeroloop.Plant are Turntable, "),
        (f"{HERE}:NoPlant", {}, "does not derive from aeroloop.Plant"),
        (TABLE, {"inertai": 1}, "unknown key plant.own.inertai: did you mean plant.own.inertia?"),
        (TABLE, {"fails_in": "__init__"}, "Turntable (plant.kind) raised RuntimeError: no such table (own_plants.py"),
        (f"{HERE}:Legless", {}, "Legless has actuators = 0, which must be a whole number from 1 to 8 (own_plants.py"),
    ],
)
def test_what_is_no_plant_is_one_line(kind: str, own: dict[str, Any], line: str) -> None:
    with pytest.raises(AeroloopError) as caught:
        PlantSettings(kind=kind, own=own).make(PERIOD)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("own", "line"),
    [
        (
            {"gives": "few"},
            "Turntable measured Measurement(attitude=(1.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0)): measure() ",
        ),
        ({"gives": "nothing"}, "Turntable measured None: measure() must return Measurement((w, x, y, z), (x, y, z))"),
        ({"gives": "long"}, "Turntable measured an attitude of length 2, not a unit quaternion"),
        *(
            ({"signals": signals}, "truth() must return State")  # a log would not hold these
            for signals in ({"two words": 1.0}, {"state": "off"}, {f"n{i}": i for i in range(17)})
        ),
    ],
)
def test_what_is_no_measurement_is_one_line_and_it_is_closed_once(own: dict[str, Any], line: str) -> None:
    plant, inner = table(fails_in="close", fails_after=0, **own)
    plant.advance()
    with pytest.raises(PlantError) as caught:
        plant.truth() if "signals" in own else plant.measure()
    assert line in str(caught.value)
    assert "(own_plants.py, line " in str(caught.value)
    plant.close()
    plant.close()
    assert inner.closed == 1


@given(volts=st.floats(allow_nan=False), limit=st.floats(min_value=0.1, max_value=100))
def test_no_voltage_beyond_the_supplys_limit_reaches_it(volts: float, limit: float) -> None:
    inner = Turntable(TurntableSettings(), PERIOD)
    OwnPlant(inner, limit).actuate((volts,))
    assert inner.volts == (volts,) if abs(volts) <= limit else abs(inner.volts[0]) == limit


def test_a_voltage_that_is_no_number_is_0_v() -> None:
    inner = Octoturntable(TurntableSettings(), PERIOD)
    OwnPlant(inner, 24.0).actuate((nan, inf, -inf, 3.0, -25.0, nan, 24.0, -0.5))
    assert inner.volts == (0.0, 24.0, -24.0, 3.0, -24.0, 0.0, 24.0, -0.5)
    emulated = PlantSettings().build(PERIOD)
    emulated.actuate((nan, -30.0))
    assert emulated.truth().voltages == (0.0, -24.0)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["plant.wind.torque=[0, 0.01]"], "plant.wind is for the kinds aero and rigid_body, and plant.kind is"),
        (["plant.kind=aero", "plant.own.inertia=1"], "plant.own is for a plant of another kind, and plant.kind is"),
    ],
)
def test_a_setting_that_would_not_act_is_refused(words: list[str], line: str) -> None:
    with pytest.raises(AeroloopError, match="leave it out") as caught:
        load(None, [f"plant.kind={TABLE}", *words])
    assert line in str(caught.value)


def test_only_the_process_that_runs_it_needs_its_class() -> None:
    settings = load(None, ["plant.kind=nowhere:Table", "plant.own.anything.nested=1"])
    assert settings.plant.own == {"anything": {"nested": 1}}


# ── behind the loop ──


def stage_of(
    kind: str, wire: WireSpec, own: dict[str, Any] | None = None, faults: list[str] | None = None, *, lockstep: bool
) -> Stage:
    """An emulator with a plant of one's own, whose every measurement is answered at once with rising and falling u."""
    loop = LoopSettings(lockstep=lockstep, realtime="off")
    count = iter(range(TICKS * 10))

    def answer(stage: Stage, frame: bytes) -> None:
        stage.command(frame, [round(20 * sin(next(count) / 9 + i)) for i in range(wire.actuators)])

    def between(stage: Stage) -> None:
        if stage.endpoint.session is None and stage.endpoint.ticked < 0:  # once
            stage.claim()

    plant = PlantSettings(kind=f"{HERE}:{kind}", own=own or {}, faults=faults or [])
    return Stage(loop, wire, plant, between=between, answer=answer)


@pytest.mark.parametrize(("kind", "actuators", "lockstep"), [("Turntable", 1, False), ("Octoturntable", 8, True)])
def test_one_motor_or_eight_are_driven_and_replayed_byte_for_byte(kind: str, actuators: int, lockstep: bool) -> None:
    wire, own = WireSpec(actuators=actuators), {"inertia": 0.01}
    faults = [f"motor{actuators}:stuck@0.02..0.05", "rate.z:noise=0.05@0.03", "attitude:bias=0.1@0.02..0.06"]
    stage = stage_of(kind, wire, own, faults, lockstep=lockstep).run(TICKS)
    assert sum(fault.changed for fault in stage.endpoint.fault_statuses()) > 0
    replay = PlantReplay(stage.loop, wire, PlantSettings(kind=f"{HERE}:{kind}", own=own, faults=faults))
    for batch in stage.batches:
        assert batch.columns["voltages"].shape[1:] == (actuators,)
        replay.feed(batch)
    found = replay.result()
    assert (found.differ, found.stopped) == (0, None)
    assert found.ticks > TICKS / 2


@pytest.mark.parametrize(("method", "lockstep"), [("actuate", False), ("advance", True), ("measure", False)])
def test_a_plant_that_fails_trips_is_closed_at_0_v_and_ends_the_loop(method: str, lockstep: bool) -> None:
    stage = stage_of("Turntable", WireSpec(actuators=1), {"fails_in": method, "fails_after": 30}, lockstep=lockstep)
    with pytest.raises(PlantError, match=f"Turntable failed in {method}"):
        stage.run(TICKS)
    assert (stage.endpoint.state, stage.endpoint.trip) == (PlantState.TRIPPED, TripCause.PLANT)
    (tripped,) = [notice for notice in stage.endpoint.notices if notice.kind == "tripped"]
    assert f"Turntable failed in {method}(): RuntimeError: the table broke in {method} (own_plants.py" in tripped.text
    assert tripped.session == "s1"
    assert (Turntable.latest.closed, Turntable.latest.volts) == (1, (0.0,))


@pytest.mark.parametrize(
    ("kind", "faults", "line"),
    [
        ("Octoturntable", [], "wire.actuators is 1, but the plant has 8 actuators"),
        ("Turntable", ["motor2:off"], "the plant has no motor2, but motor1"),
    ],
)
def test_a_plant_that_does_not_fit_is_refused_and_closed(kind: str, faults: list[str], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        stage_of(kind, WireSpec(actuators=1), faults=faults, lockstep=False)
    assert (type(Turntable.latest).__name__, Turntable.latest.closed) == (kind, 1)


@pytest.mark.parametrize(
    ("plant", "why"),
    [
        ({"kind": f"{HERE}:Hardware"}, "Hardware (plant.kind) does not state that it is `repeatable`"),
        ({"via": "quanser"}, "plant.via is 'quanser'"),
    ],
)
def test_a_machine_is_not_moved_by_a_replay(plant: dict[str, Any], why: str) -> None:
    settings = PlantSettings(**plant)
    assert why in (why_not(settings) or "")
    with pytest.raises(ValueError, match=r"plant\."):
        PlantReplay(LoopSettings(), WireSpec(), settings)


def test_a_plant_whose_class_is_gone_is_refused_as_one_that_could_be_replayed() -> None:
    settings = PlantSettings(kind=f"{HERE}:Gone")
    for refused in (why_not, partial(PlantReplay, LoopSettings(), WireSpec())):
        with pytest.raises(PluginError, match="has no Gone"):
            refused(settings)


def test_a_plant_that_paces_the_loop_raises_the_tick_by_what_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Turntable, "paces", True)
    advance: Callable[[Turntable], None] = Turntable.advance
    count = iter(range(TICKS + 1))

    def late(self: Turntable) -> None:
        advance(self)
        self.passed = 3 if next(count) == 10 else 1

    monkeypatch.setattr(Turntable, "advance", late)
    assert stage_of("Turntable", WireSpec(actuators=1), lockstep=False).run(TICKS).skipped == 2


def test_garbage_of_a_plant_is_collected_with_a_session_and_without(monkeypatch: pytest.MonkeyPatch) -> None:
    sessions = list[str | None]()
    stage = stage_of("Turntable", WireSpec(actuators=1), lockstep=False)
    driver = "aeroloop.plant_emulator.hosts.driver.collect_garbage"
    monkeypatch.setattr(driver, lambda: sessions.append(stage.endpoint.session))
    monkeypatch.setattr(stage.wires, "take", lambda: None)  # so that the session ends for lack of a command
    stage.run(600)
    assert 500 < len(sessions) <= 601
    assert {*sessions} == {"s1", None}
