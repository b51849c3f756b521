"""A plant of one's own: found by name, made with its settings, watched over."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.plant_emulator.plant import OwnPlant, PlantError
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import load
from tests.support.own_plants import Turntable, TurntableSettings

HERE = "tests.support.own_plants"
TABLE = f"{HERE}:Turntable"
PERIOD = 0.002


def settings_of(kind: str, **own: Any) -> PlantSettings:
    return PlantSettings(kind=kind, own=own)


def table(**own: Any) -> tuple[OwnPlant, Turntable]:
    inner = Turntable(TurntableSettings(**own), PERIOD)
    return OwnPlant(inner, 24.0), inner


def test_a_class_is_made_with_its_own_settings_and_the_period() -> None:
    made, (alike, _), (other, _) = settings_of(TABLE, inertia=0.5).make(PERIOD), table(inertia=0.5), table()
    for plant in (made, alike, other):
        plant.actuate((5.0,))
        plant.advance()
    assert made.measure() == alike.measure() != other.measure()


@pytest.mark.parametrize(
    ("kind", "own", "line"),
    [
        ("areo", {}, "plant.kind = 'areo' is not known: it is one of aero, fmu, mujoco, rigid_body, or package"),
        ("nowhere:Table", {}, "there is no module nowhere here"),
        (f"{HERE}:Tabel", {}, "has no Tabel; its classes of aeroloop.Plant are Turntable, "),
        (f"{HERE}:NoPlant", {}, "does not derive from aeroloop.Plant"),
        (f"{HERE}:Unfinished", {}, "Unfinished"),
        (TABLE, {"inertai": 1}, "unknown key plant.own.inertai: did you mean plant.own.inertia?"),
        (TABLE, {"inertia": -1}, "plant.own.inertia: should be greater than 0, not -1"),
        (TABLE, {"fails_in": "__init__"}, "Turntable (plant.kind) raised RuntimeError: no such table (own_plants.py"),
        (
            f"{HERE}:Legless",
            {},
            "Legless has actuators = 0, which must be a whole number from 1 to 8 (own_plants.py, line ",
        ),
    ],
)
def test_what_is_no_plant_is_one_line(kind: str, own: dict[str, Any], line: str) -> None:
    with pytest.raises(AeroloopError) as caught:
        settings_of(kind, **own).make(PERIOD)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("method", ["actuate", "advance", "measure", "truth", "close"])
def test_its_own_exception_is_one_line_with_class_file_and_line(method: str) -> None:
    plant, _ = table(fails_in=method, fails_after=0)
    with pytest.raises(PlantError) as caught:
        plant.actuate((1.0,)) if method == "actuate" else getattr(plant, method)()
    text = f"Turntable failed in {method}(): RuntimeError: the table broke in {method} (own_plants.py, line "
    assert str(caught.value).startswith(text)


@pytest.mark.parametrize(
    "signals",
    [
        {"two words": 1.0},
        {"": 1.0},
        {"α_rad": 1.0},
        {"a" * 41: 1.0},
        {"state": "off"},
        [1.0],
        {f"n{i}": i for i in range(17)},
    ],
)
def test_signals_that_no_log_would_hold_are_refused(signals: Any) -> None:
    plant, _ = table(signals=signals)
    with pytest.raises(PlantError, match=r"Turntable gave .*: truth\(\) must return State"):
        plant.truth()


def test_after_a_failure_it_is_closed_once_and_the_first_failure_stays_the_one_shown() -> None:
    plant, inner = table(fails_in="close", fails_after=0, gives="few")
    plant.advance()
    with pytest.raises(PlantError):
        plant.measure()
    plant.close()
    plant.close()
    assert inner.closed == 1


@pytest.mark.parametrize(
    ("gives", "line"),
    [
        ("few", "Turntable measured Measurement(attitude=(1.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0)): measure() must"),
        ("nothing", "Turntable measured None: measure() must return Measurement((w, x, y, z), (x, y, z))"),
        ("long", "Turntable measured an attitude of length 2, not a unit quaternion"),
    ],
)
def test_what_is_no_measurement_is_one_line(gives: str, line: str) -> None:
    plant, _ = table(gives=gives, fails_after=0)
    plant.advance()
    with pytest.raises(PlantError) as caught:
        plant.measure()
    assert line in str(caught.value)
    assert "(own_plants.py, line " in str(caught.value)


@given(volts=st.floats(allow_nan=False), limit=st.floats(min_value=0.1, max_value=100))
def test_no_voltage_beyond_the_supplys_limit_reaches_it(volts: float, limit: float) -> None:
    inner = Turntable(TurntableSettings(), PERIOD)
    OwnPlant(inner, limit).actuate((volts,))
    assert inner.volts == (volts,) if abs(volts) <= limit else abs(inner.volts[0]) == limit


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
