"""`--vary` and a sweep: values, ranges, combinations and their names; the table, and what is resumed."""

from __future__ import annotations

import json
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, assume, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from aeroloop.service.cli.main import execute
from aeroloop.service.config import load, load_over
from aeroloop.service.config_sources import tree_of
from aeroloop.service.lab import sweep as module
from aeroloop.service.lab.axes import Axis, configurations, digest_of, parse_axes
from aeroloop.service.lab.engine import COLUMNS, Row, SweepError, figures_row
from aeroloop.service.lab.sweep import Key, Sweep, SweepPlan, open_rows, run_sweep
from tests.support.in_this_process import run_here

PLAIN = load()
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
    found = configurations(PLAIN, parse_axes(["law.C2*=0.5,2", "wire.rate.limit*=1..2*2"]), 1, 1.0)
    assert [each.values for each in found] == [(0.5, 1.0), (0.5, 2.0), (2.0, 1.0), (2.0, 2.0)]
    for (gain, limit), changed in ((each.values, load_over(PLAIN, each.overrides)) for each in found):
        assert list(changed.law.model_dump()["C2"]) == [gain * value for value in PLAIN.law.model_dump()["C2"]]
        assert changed.wire.rate.limit == limit * PLAIN.wire.rate.limit


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


# ── sweep in one process: the file of rows, the table, what is run and what is resumed ──


BENCH = load(overrides=["plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01"])
BITS = "wire.voltage.bits=4,6"
S = 0.3


@pytest.fixture(autouse=True)
def _no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    run_here(monkeypatch)


def plan(*vary: str, seeds: int = 1) -> SweepPlan:
    axes = parse_axes(vary)
    return SweepPlan(BENCH, axes, configurations(BENCH, axes, seeds, S), seeds, S)


def swept(out: Path, *vary: str, seeds: int = 1) -> tuple[Sweep, list[dict[str, Any]]]:
    """What a sweep did, and the rows of its table."""
    result = run_sweep(plan(*vary, seeds=seeds), out)
    return result, pq.read_table(out).to_pylist()


def test_a_row_has_the_values_the_seed_and_the_figures_of_its_experiment(tmp_path: Path) -> None:
    result, rows = swept(tmp_path / "a.parquet", BITS, seeds=2)
    assert (result.experiments, result.done, result.resumed, result.failed) == (4, 4, 0, 0)
    assert [(row["wire.voltage.bits"], row["seed"]) for row in rows] == [(4, 0), (4, 1), (6, 0), (6, 1)]
    for row in rows:
        seeds = [f"plant.{part}.seed={row['seed']}" for part in ("wind", "sensors")]
        settings = load_over(BENCH, [*seeds, f"wire.voltage.bits={row['wire.voltage.bits']}"])
        assert {name: row[name] for name in COLUMNS} == figures_row(settings, S)
    assert len({row["u_total"] for row in rows}) == 4


def test_a_run_that_trips_is_a_row_with_its_reason(tmp_path: Path) -> None:
    limits = "plant.limits.max_rate=0.001,10"
    result, (tripped, fine) = swept(tmp_path / "a.parquet", limits)
    assert result.failed == 1
    assert "the loop ended after" in tripped["reason"]
    assert tripped["z_track"] is tripped["skipped_ticks"] is fine["reason"] is None
    assert fine["z_track"] > 0
    options = ["--duration", str(S), "--seeds", "1", "--force"]
    for vary, code in ((limits, 1), ("plant.limits.max_rate=9,10", 0)):
        assert execute(["lab", "sweep", "--out", str(tmp_path / "b.csv"), "--vary", vary, *options]) == code
    assert len((tmp_path / "b.csv").read_text().splitlines()) == 3


def test_a_sweep_runs_what_is_new_in_values_seeds_or_code_and_ends_in_the_same_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, whole = tmp_path / "parts.parquet", tmp_path / "whole.parquet"
    swept(parts, "wire.voltage.bits=6")
    again, _ = swept(parts, "wire.voltage.bits=6")
    assert (again.done, again.resumed, again.failed) == (0, 1, 0)
    more, _ = swept(parts, BITS, seeds=2)
    assert (more.done, more.resumed) == (3, 1)
    swept(whole, BITS, seeds=2)
    assert parts.read_bytes() == whole.read_bytes()
    monkeypatch.setattr(module, "code_version", lambda: "0.2.1+other")
    other, rows = swept(parts, "wire.voltage.bits=6")
    assert (other.done, other.resumed, rows[0]["version"]) == (1, 0, "0.2.1+other")


def test_a_table_is_replaced_on_request_only_and_then_resumes(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "a.csv"
    command = ["lab", "sweep", "--vary", BITS, "--duration", "0.1", "--out", str(out)]
    assert execute([*command, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["done"] == 2
    table = out.read_bytes()
    assert execute(["lab", "sweep", "--duration", "0.1", "--out", str(out)]) == 2
    assert "name another file, or replace it with --force" in capfd.readouterr().err
    assert out.read_bytes() == table
    assert execute([*command, "--force"]) == 0
    assert re.search(r"resumed +2\b", capfd.readouterr().out)
    assert out.read_bytes() == table


def test_files_of_others_are_left_alone(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert execute(["lab", "sweep", "--duration", "0.1", "--out", str(tmp_path / "a.mat")]) == 2
    assert "a .parquet or .csv file" in capfd.readouterr().err
    (tmp_path / "b.jsonl").write_text("mine")
    assert execute(["lab", "sweep", "--duration", "0.1", "--out", str(tmp_path / "b.parquet")]) == 1
    assert "does not hold a sweep" in capfd.readouterr().err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


# ── the file of rows ──


def row(**figures: Any) -> Row:
    return dict.fromkeys(COLUMNS) | figures


ROWS = {
    Key("a" * 64, 0, "0.2.0+1"): row(z_track=0.1 + 0.2, u_total=5e-324, skipped_ticks=3),
    Key("a" * 64, 1, "0.2.0+1"): row(reason="the loop ended after 1 s: tilt of 91° – “limit”"),
    Key("b" * 64, 0, "0.2.0+1"): row(z_track=float("inf"), command_bits_per_s=1 / 3),
}


def whole(path: Path) -> bytes:
    """A file of ROWS, of which those that are missing are added."""
    with open_rows(path) as file:
        for key, each in ROWS.items():
            if key not in file.rows:
                file.append(key, each)
    return path.read_bytes()


@given(st.data())
@examples(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_cut_off_anywhere_keeps_its_whole_lines_and_takes_the_others_again(
    tmp_path: Path, data: st.DataObject
) -> None:
    path = tmp_path / "a.jsonl"
    path.unlink(missing_ok=True)
    complete = whole(path)
    length = data.draw(st.integers(0, len(complete)))
    path.write_bytes(complete[:length])
    kept = complete[:length].count(b"\n") - 1  # without the head
    with open_rows(path) as file:
        assert list(file.rows.items()) == list(ROWS.items())[: max(0, kept)]
    assert whole(path) == complete


def test_a_damaged_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    lines = whole(path).splitlines()
    path.write_bytes(b"\n".join([*lines[:2], b"\x00\x00\xff", *lines[2:], b""]))
    with pytest.raises(SweepError, match="line 3"), open_rows(path):
        pass


def test_a_file_serves_one_sweep_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    with open_rows(path), pytest.raises(SweepError, match="in use by another sweep"), open_rows(path):
        pass
