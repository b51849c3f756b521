"""Workers: processes that are interrupted or killed, and a Dask cluster of two workers whose scheduler runs here.

Nothing is timed: a test waits for rows or results, for at most PATIENCE_S, as a shared machine can be slow.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Final

import pytest
from distributed import Client, LocalCluster

from aeroloop.service.cli.main import execute
from aeroloop.service.config import Settings, load
from aeroloop.service.lab.axes import configurations, parse_axes
from aeroloop.service.lab.engine import Run, SweepError, code_version, open_workers, run_of
from aeroloop.service.lab.sweep import SweepPlan, run_sweep
from tests.support.in_this_process import run_here, workers_here

pytestmark = pytest.mark.processes

PATIENCE_S: Final = 60.0
VARY: Final = "wire.voltage.bits=4,6"
SEEDS: Final = 6
S: Final = 1.0


def planned() -> SweepPlan:
    settings = load(overrides=["plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01"])
    axes = parse_axes([VARY])
    return SweepPlan(settings, axes, configurations(settings, axes, SEEDS, S), SEEDS, S)


def rate_over(settings: Settings, divisor: int) -> float:
    return settings.loop.rate_hz / divisor


def rates(*hertz: int) -> list[Run]:
    return [run_of(load(), [f"loop.rate_hz={each}"]) for each in hertz]


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of the sweep, made in this process."""
    out = tmp_path_factory.mktemp("local") / "a.parquet"
    with pytest.MonkeyPatch.context() as patched:
        run_here(patched)
        run_sweep(planned(), out)
    return out.read_bytes()


def test_results_come_in_the_order_of_the_runs_whichever_ends_first() -> None:
    counted = list[int]()
    rows = workers_here(2).rows(partial(rate_over, divisor=2), rates(*range(400, 440)), counted.append)
    assert rows == [rate / 2 for rate in range(400, 440)]
    assert counted == list(range(1, 41))


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_a_sweep_that_is_stopped_runs_only_what_is_missing_and_ends_in_the_same_table(
    local: bytes, tmp_path: Path, stop: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, rows = tmp_path / "a.parquet", tmp_path / "a.jsonl"
    noise = ["--set", "plant.sensors.rate=gyro", "--set", "plant.sensors.gyro_noise=0.01"]
    options = ["--vary", VARY, "--seeds", str(SEEDS), "--duration", str(S), "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "aeroloop", "lab", "sweep", *options, *noise],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in a background job
    )
    deadline = time.monotonic() + PATIENCE_S
    while not rows.exists() or rows.read_bytes().count(b"\n") < 3:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(stop)
    process.wait()
    assert not out.exists()
    kept = rows.read_bytes().count(b"\n") - 1
    run_here(monkeypatch)
    result = run_sweep(planned(), out)
    assert (result.resumed, result.done) == (kept, 2 * SEEDS - kept)
    assert out.read_bytes() == local


def test_a_worker_process_that_ends_is_one_line() -> None:
    with (
        open_workers() as workers,
        pytest.raises(SweepError, match="a worker process ended in the middle of an experiment"),
    ):
        workers.rows(end, rates(400, 500))


def end(_settings: Settings) -> None:
    os._exit(1)


@pytest.mark.realtime  # a cluster of Dask's own processes
def test_a_worker_that_is_killed_costs_no_row_and_no_bit_and_one_with_other_code_ends_the_sweep(
    local: bytes, tmp_path: Path
) -> None:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        out, other, engine = tmp_path / "a.parquet", tmp_path / "b.parquet", f"dask:{cluster.scheduler_address}"
        pid = next(iter(cluster.workers.values())).pid

        def progress(done: int, _total: int) -> None:
            if done == 4:
                os.kill(pid, signal.SIGKILL)

        result = run_sweep(planned(), out, engine=engine, progress=progress)
        assert (result.done, result.resumed, result.failed) == (2 * SEEDS, 0, 0)
        assert out.read_bytes() == local
        with Client(cluster.scheduler_address, set_as_default=False) as client:
            client.run(exec, "from aeroloop.service.lab import engine as w; w.code_version = lambda: '0.2.0+other'", {})
        with pytest.raises(SweepError, match=rf"runs aeroloop 0\.2\.0\+other, this machine {code_version()[:5]}"):
            run_sweep(planned(), other, engine=engine)
        assert not other.exists()


@pytest.mark.realtime  # a cluster of Dask's own processes
def test_where_there_is_no_scheduler_or_no_worker_one_line_says_so(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert execute(["lab", "tables", "--engine", "dask:tcp://127.0.0.1:1"]) == 1
    assert capfd.readouterr().err.startswith("aeroloop: no Dask scheduler answers at tcp://127.0.0.1:1: ")
    none = pytest.raises(SweepError, match=r"no worker at tcp://.*--nthreads 1` starts one")
    with LocalCluster(n_workers=0, dashboard_address=":0") as empty, none:
        run_sweep(planned(), tmp_path / "a.parquet", engine=f"dask:{empty.scheduler_address}")


@pytest.mark.parametrize("verb", ["tables", "burden", "laws", "tune", "sweep --out a.parquet"])
def test_an_engine_that_is_none_is_refused(capfd: pytest.CaptureFixture[str], verb: str) -> None:
    assert execute(["lab", *verb.split(), "--engine", "spark"]) == 2
    assert capfd.readouterr().err == "aeroloop: --engine must be processes or dask:ADDRESS, not 'spark'\n"
