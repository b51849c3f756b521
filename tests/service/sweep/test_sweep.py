"""Sweep in one process: the table, what is run and what is resumed."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.sweep import sweep as module
from aeroloop.service.sweep.axes import parse_axes
from aeroloop.service.sweep.rows import Rows, SweepError, measured
from aeroloop.service.sweep.sweep import Sweep, plan, run_sweep
from tests.support.in_this_process import InThisProcess

BENCH = load(overrides=["plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01"])
BITS = "wire.voltage.bits=4,6"
S = 0.3


@pytest.fixture(autouse=True)
def _no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "Workers", InThisProcess)


def swept(out: Path, *vary: str, seeds: int = 1) -> tuple[Sweep, list[dict[str, Any]]]:
    """What a sweep did, and the rows of its table."""
    result = run_sweep(plan(BENCH, parse_axes(vary), seeds, S), out)
    return result, pq.read_table(out).to_pylist()


def test_a_row_has_the_values_the_seed_and_the_figures_of_its_experiment(tmp_path: Path) -> None:
    result, rows = swept(tmp_path / "a.parquet", BITS, seeds=2)
    assert (result.experiments, result.done, result.resumed, result.failed) == (4, 4, 0, 0)
    assert [(row["wire.voltage.bits"], row["seed"]) for row in rows] == [(4, 0), (4, 1), (6, 0), (6, 1)]
    for row in rows:
        seeds = [f"plant.{part}.seed={row['seed']}" for part in ("wind", "sensors")]
        mine = [*seeds, f"wire.voltage.bits={row['wire.voltage.bits']}", "plant.sensors.rate=gyro"]
        figures = run_experiment(load(overrides=[*mine, "plant.sensors.gyro_noise=0.01"]), S)
        for name in ("z_track", "u_total", "max_error_deg", "final_error_deg", "skipped_ticks"):
            assert row[name] == getattr(figures, name)
        assert row["measurement_bits_per_s"] == figures.measurement.bits_per_s
        assert row["command_frames_per_s"] == figures.command.frames_per_s
        assert row["reason"] is None
    assert len({row["u_total"] for row in rows}) == 4


def test_a_run_that_trips_is_a_row_with_its_reason(tmp_path: Path) -> None:
    limits = "plant.limits.max_rate=0.001,10"
    result, (tripped, fine) = swept(tmp_path / "a.parquet", limits)
    assert result.failed == 1
    assert "the loop ended after" in tripped["reason"]
    assert tripped["z_track"] is tripped["skipped_ticks"] is fine["reason"] is None
    assert fine["z_track"] > 0


def test_a_sweep_that_gets_more_values_and_seeds_runs_those_alone_and_ends_in_the_same_table(tmp_path: Path) -> None:
    parts, whole = tmp_path / "parts.parquet", tmp_path / "whole.parquet"
    swept(parts, "wire.voltage.bits=6")
    again, _ = swept(parts, "wire.voltage.bits=6")
    assert (again.done, again.resumed, again.experiments_per_s) == (0, 1, None)
    more, _ = swept(parts, BITS, seeds=2)
    assert (more.done, more.resumed) == (3, 1)
    swept(whole, BITS, seeds=2)
    assert parts.read_bytes() == whole.read_bytes()


def test_rows_of_another_version_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "a.parquet"
    swept(out, BITS)
    monkeypatch.setattr(module, "fingerprint", lambda: "0.2.1+other")
    result, rows = swept(out, BITS)
    assert (result.done, result.resumed) == (2, 0)
    assert {row["version"] for row in rows} == {"0.2.1+other"}


def test_each_row_is_in_the_file_before_its_job_counts_as_done(tmp_path: Path) -> None:
    out = tmp_path / "a.parquet"
    counted = []

    def count(done: int, total: int) -> None:
        counted.append((done, total, len(out.with_suffix(".jsonl").read_bytes().splitlines()) - 1))

    run_sweep(plan(BENCH, parse_axes([BITS]), 1, S), out, progress=count)
    assert counted == [(0, 2, 0), (1, 2, 1), (2, 2, 2)]


def test_jobs_grow_to_what_fills_their_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workers = InThisProcess()
    monkeypatch.setattr(module, "Workers", lambda _: workers)
    monkeypatch.setattr(module, "run_tasks", _cheap)
    swept(tmp_path / "a.parquet", seeds=100)
    assert [len(tasks) for _, _, tasks, _ in workers.jobs] == [1, 10, 10, 10, 10, 10, 10, 10, 10, 10, 9]


def _cheap(_sweep: str, _config: str, tasks: list[Any], _duration_s: float) -> Any:
    return [measured("no run")] * len(tasks), module.Spent(1, len(tasks), module.JOB_S / 10 * len(tasks))


def test_the_command_prints_what_it_did_and_goes_on_without_force(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "a.parquet"
    command = ["lab", "sweep", "--vary", BITS, "--duration", "0.1", "--out", str(out)]
    assert execute([*command, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["done"] == 2
    assert execute(command) == 0
    text = capfd.readouterr().out
    assert "resumed                 2" in text
    assert str(out) in "".join(text.split())


FLOWN = ("--vary", BITS, "--seeds", "2", "--duration", "0.1")


@pytest.mark.parametrize(
    ("words", "replaces"),
    [
        pytest.param(FLOWN, True, id="the same sweep"),
        pytest.param(("--vary", "wire.voltage.bits=4,6,8", *FLOWN[2:]), True, id="more values"),
        pytest.param((*FLOWN[:2], "--seeds", "3", *FLOWN[4:]), True, id="more seeds"),
        pytest.param(("--vary", "wire.rate.bits=8,10", *FLOWN), True, id="a further axis"),
        pytest.param(("--vary", "wire.voltage.bits=6", *FLOWN[2:]), False, id="fewer values"),
        pytest.param((*FLOWN[:2], "--seeds", "1", *FLOWN[4:]), False, id="fewer seeds"),
        pytest.param(("--vary", "wire.rate.bits=8,10", *FLOWN[2:]), False, id="another axis"),
        pytest.param((*FLOWN, "--set", "law.C2=[0.2, 0.2, 0.2]"), False, id="another base configuration"),
        pytest.param((*FLOWN[:4], "--duration", "0.2"), False, id="another duration"),
    ],
)
def test_a_table_is_not_replaced_by_another_sweep_without_force(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, words: tuple[str, ...], replaces: bool
) -> None:
    out = tmp_path / "a.parquet"
    assert execute(["lab", "sweep", *FLOWN, "--out", str(out)]) == 0
    rows = pq.read_table(out).num_rows
    table = out.read_bytes()
    assert execute(["lab", "sweep", *words, "--out", str(out)]) == (0 if replaces else 2)
    assert ("name another file, or replace it with --force" in capfd.readouterr().err) != replaces
    assert pq.read_table(out).num_rows >= rows
    assert replaces or out.read_bytes() == table
    assert execute(["lab", "sweep", *words, "--out", str(out), "--force"]) == 0


@pytest.mark.parametrize("changed", ["the law's file", "aeroloop"])
def test_a_table_of_another_version_is_not_replaced_without_force(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    out, law = tmp_path / "a.parquet", tmp_path / "edited_law.py"
    text = "from tests.support.failing_laws import Runaway\nclass Mine(Runaway):\n    gain = 1.0\n"
    law.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    command = ["lab", "sweep", "--duration", "0.1", "--set", "law.kind=edited_law:Mine", "--out", str(out)]
    assert execute(command) == 0
    assert execute(command) == 0
    if changed == "aeroloop":
        monkeypatch.setattr("aeroloop.service.sweep.table.fingerprint", lambda: "0.2.1+other")
    else:
        law.write_text(text + "    other = 2.0\n")
    table = out.read_bytes()
    assert execute(command) == 2
    assert out.read_bytes() == table
    assert execute([*command, "--force"]) == 0


def test_files_of_others_are_left_alone(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "a.parquet"
    out.write_text("mine")
    assert execute(["lab", "sweep", "--duration", "0.1", "--out", str(out)]) == 2
    assert "exists already" in capfd.readouterr().err
    assert out.read_text() == "mine"
    assert execute(["lab", "sweep", "--duration", "0.1", "--out", str(tmp_path / "a.csv")]) == 2
    assert "a .parquet file" in capfd.readouterr().err
    (tmp_path / "b.jsonl").write_text("mine")
    assert execute(["lab", "sweep", "--duration", "0.1", "--out", str(tmp_path / "b.parquet")]) == 1
    assert "does not hold a sweep" in capfd.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.parquet", "b.jsonl"]


@pytest.mark.parametrize("verb", ["tables", "burden", "sweep --out a.parquet"])
def test_an_engine_that_is_none_is_refused(capfd: pytest.CaptureFixture[str], verb: str) -> None:
    assert execute(["lab", *verb.split(), "--engine", "spark"]) == 2
    assert capfd.readouterr().err == "aeroloop: --engine must be processes or dask:ADDRESS, not 'spark'\n"


def test_without_dask_the_extra_is_named(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "aeroloop.service.lab.dask_workers", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert execute(["lab", "tables", "--engine", "dask:127.0.0.1:1"]) == 1
    assert capfd.readouterr().err.endswith("pip install 'aeroloop[dask]'\n")


def test_two_sweeps_into_one_file_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "a.parquet"
    with Rows(tmp_path / "a.jsonl"), pytest.raises(SweepError, match="in use"):
        swept(out, BITS)
