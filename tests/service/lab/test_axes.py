"""`--vary`: values, ranges, combinations, their names, and what is refused."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from aeroloop.service.cli.main import execute
from aeroloop.service.config import load, load_over
from aeroloop.service.config_sources import tree_of
from aeroloop.service.lab.axes import Axis, configurations, digest_of, parse_axes

BENCH = load()
SCALARS = (
    st.booleans() | st.integers(-99, 99) | st.floats(-9, 9).map(lambda x: round(x, 3)) | st.text("ab,[]=. ", max_size=4)
)
VALUES = SCALARS | st.lists(SCALARS, max_size=3)
DECIMALS = st.decimals(-100, 100, places=2)


def values_of(axis: Axis) -> list[Any]:
    """What `--set` makes of each value."""
    return [tree_of([f"key={value}"])["key"] for value in axis.values]


@given(st.lists(VALUES, min_size=1, max_size=5))
def test_values_are_those_of_a_list_whatever_they_hold(values: list[Any]) -> None:
    [axis] = parse_axes([f"wire.x={','.join(map(json.dumps, values))}"])
    assert axis.key == "wire.x"
    assert values_of(axis) == values


@given(DECIMALS, DECIMALS, st.integers(2, 50))
def test_a_range_is_even_includes_both_ends_and_is_exact_in_decimals(low: Any, high: Any, n: int) -> None:
    assume(low != high)
    [axis] = parse_axes([f"wire.x=cont,{low}..{high}*{n}"])
    exact = [Fraction(low) + (Fraction(high) - Fraction(low)) * i / (n - 1) for i in range(n)]
    assert values_of(axis) == ["cont", *map(float, exact)]


def test_a_range_of_whole_numbers_stays_whole_where_it_can() -> None:
    assert repr(values_of(*parse_axes(["wire.rate.bits=6..7*3"]))) == "[6, 6.5, 7]"


@pytest.mark.parametrize(
    ("vary", "names"),
    [
        (["nonsense"], "'nonsense'"),
        (["wire.rate.bits=cont,,8"], "a value is missing"),
        (["wire.rate.bits=6..12"], "a..b*n"),
        (["wire.rate.bits=8,17"], "wire.rate.bits: should be less than or equal to 16, not 17"),
        (["wire.rate.bitz=8"], "did you mean wire.rate.bits?"),
        (["wire.rate.bits=8,8"], "the same twice"),
        (["plant.wind.seed=1,2"], "--seeds"),
        (["recorder.max_file_mb=1,2"], "law, loop, plant, reference, wire"),
        (["wire.rate.limit=1..2*9999", "wire.attitude.limit=0.5..1*9999"], "at most"),
        (["law.C2*=1,two"], "factors are numbers"),
        (["law.C2*=2", "law.C2=[1,1,1]"], "gives law.C2 twice"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_what_cannot_be_varied_is_refused_in_one_line_before_anything_is_written(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, vary: list[str], names: str
) -> None:
    options = [word for text in vary for word in ("--vary", text)]
    assert execute(["lab", "sweep", "--out", str(tmp_path / "a.parquet"), *options]) == 2
    captured = capfd.readouterr()
    assert (captured.out, len(captured.err.splitlines()), list(tmp_path.iterdir())) == ("", 1, [])
    assert names in captured.err


def test_factors_scale_what_is_configured_a_number_or_a_list() -> None:
    found = configurations(BENCH, parse_axes(["law.C2*=0.5,2", "wire.rate.limit*=1..2*2"]), 1, 1.0)
    assert [each.values for each in found] == [(0.5, 1.0), (0.5, 2.0), (2.0, 1.0), (2.0, 2.0)]
    for (gain, limit), changed in ((each.values, load_over(BENCH, each.overrides)) for each in found):
        assert list(changed.law.model_dump()["C2"]) == [gain * value for value in BENCH.law.model_dump()["C2"]]
        assert changed.wire.rate.limit == limit * BENCH.wire.rate.limit


def test_a_configuration_has_one_name_however_it_was_configured() -> None:
    def name(*overrides: str, vary: str = "wire.rate.bits=9", duration_s: float = 1.0) -> str:
        [found] = configurations(load(overrides=list(overrides)), parse_axes([vary]), 1, duration_s)
        return found.digest

    same = name()
    assert name("wire.rate.bits=9", vary="wire.voltage.bits=6") == name("wire.voltage.bits=6")
    for alike in (["wire.rate.bits=5"], ["plant.wind.seed=7", "plant.sensors.seed=3"], ["vehicle=other"]):
        assert name(*alike) == same
    others = {
        name(duration_s=2.0), name(vary="wire.rate.bits=8"), name("plant.wind.blowing=true"), name("law.C2=[1, 1, 1]"),
        name("reference.amplitude=[1, 2, 3]"), name("loop.rate_hz=400"), name("plant.sensors.gyro_noise=0.1"),
    }  # fmt: skip
    assert len(others) == 7
    assert same not in others


def test_a_changed_law_or_plant_of_ones_own_is_another_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    law, plant, model = tmp_path / "changing_law.py", tmp_path / "changing_plant.py", tmp_path / "changing.xml"
    mine = [
        load(overrides=["law.kind=changing_law:Mine"]),
        load(overrides=["plant.kind=changing_plant:Mine"]),
        load(overrides=["plant.kind=mujoco", f"plant.own.model={model}"]),
    ]
    digests = set[str]()
    for gain in (1, 2):
        law.write_text(f"from tests.support.failing_laws import Runaway\nclass Mine(Runaway):\n    gain = {gain}\n")
        plant.write_text(f"import aeroloop\nclass Mine(aeroloop.Plant):\n    gain = {gain}\n")
        model.write_text(f"<mujoco model='{gain}'/>")
        for settings in mine * 2:  # a file that stays as it is changes no name
            digests.add(digest_of(settings.description(), 1.0))
    assert len(digests) == 6
