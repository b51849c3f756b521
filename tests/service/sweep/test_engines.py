"""Sweeps by processes: interrupted, killed, and on a Dask cluster of two workers whose scheduler runs here.

Nothing is timed: a test waits for rows or results, for at most PATIENCE_S, as a shared machine can be slow.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest
from distributed import Client, LocalCluster

from aeroloop.service.config import load
from aeroloop.service.lab import dask_workers
from aeroloop.service.lab.sentinel import fingerprint
from aeroloop.service.lab.workers import Workers, WorkersError
from aeroloop.service.sweep import sweep as module
from aeroloop.service.sweep.axes import parse_axes
from aeroloop.service.sweep.sweep import Plan, Sweep, plan, run_sweep
from tests.support.in_this_process import InThisProcess

pytestmark = pytest.mark.processes

PATIENCE_S: Final = 60.0
VARY: Final = "wire.voltage.bits=4,6"
SEEDS: Final = 6
S: Final = 1.0


def planned() -> Plan:
    noise = ["plant.sensors.rate=gyro", "plant.sensors.gyro_noise=0.01"]
    return plan(load(overrides=noise), parse_axes([VARY]), SEEDS, S)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table of the sweep, made in this process."""
    out = tmp_path_factory.mktemp("local") / "a.parquet"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "Workers", InThisProcess)
        run_sweep(planned(), out)
    return out.read_bytes()


def test_a_sweep_that_is_killed_runs_only_what_is_missing_and_ends_in_the_same_table(
    local: bytes, tmp_path: Path
) -> None:
    out, rows = tmp_path / "a.parquet", tmp_path / "a.jsonl"
    noise = ["--set", "plant.sensors.rate=gyro", "--set", "plant.sensors.gyro_noise=0.01"]
    options = ["--vary", VARY, "--seeds", str(SEEDS), "--duration", str(S), "--out", str(out)]
    process = subprocess.Popen([sys.executable, "-P", "-m", "aeroloop", "lab", "sweep", *options, *noise])
    deadline = time.monotonic() + PATIENCE_S
    while not rows.exists() or rows.read_bytes().count(b"\n") < 4:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert not out.exists()
    kept = rows.read_bytes().count(b"\n") - 1
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "Workers", InThisProcess)
        result = run_sweep(planned(), out)
    assert (result.resumed, result.done) == (kept, 2 * SEEDS - kept)
    assert out.read_bytes() == local


@pytest.fixture(autouse=True)
def _patience() -> Iterator[None]:
    """A job that is lost would be waited for without end."""

    def end(*_: object) -> None:
        raise TimeoutError("the sweep does not end")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(4 * int(PATIENCE_S))
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def swept(cluster: LocalCluster, out: Path, kill: str | None = None) -> Sweep:
    """The sweep on the cluster, of which the worker at an address is killed once four experiments are done."""

    def progress(done: int, _total: int) -> None:
        if done == 4 and kill is not None:
            [pid] = [each.pid for each in cluster.workers.values() if each.worker_address == kill]
            os.kill(pid, signal.SIGKILL)

    return run_sweep(planned(), out, engine=f"dask:{cluster.scheduler_address}", progress=progress)


def addresses(cluster: LocalCluster) -> list[str]:
    """Addresses of both workers, once Dask has put another one in place of a killed one."""
    deadline = time.monotonic() + PATIENCE_S
    scheduler: Any = cluster.scheduler
    while len(known := {each.worker_address for each in cluster.workers.values()} & set(scheduler.workers)) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return sorted(known)


@contextmanager
def different(cluster: LocalCluster, *addresses: str) -> Iterator[None]:
    """Workers at these addresses compute other figures."""
    name = "from aeroloop.service.lab import dask_workers as d; d.fingerprint ="
    with Client(cluster.scheduler_address, set_as_default=False) as client:
        client.run(exec, f"{name} lambda: '0.2.0+other'", {}, workers=addresses)
        yield
        client.run(exec, f"{name} lambda: {fingerprint()!r}", {}, workers=addresses)


def test_results_come_in_order_and_a_failing_job_fails(cluster: LocalCluster) -> None:
    with Workers(f"dask:{cluster.scheduler_address}") as workers:
        assert workers.each(divmod, [(7, 2), (9, 4), (8, 3)]) == [(3, 1), (2, 1), (2, 2)]
        with pytest.raises(ZeroDivisionError):
            workers.each(divmod, [(1, 1), (1, 0)])


def test_a_worker_killed_midway_costs_no_row_and_no_bit(cluster: LocalCluster, local: bytes, tmp_path: Path) -> None:
    out = tmp_path / "a.parquet"
    result = swept(cluster, out, kill=addresses(cluster)[0])
    assert (result.done, result.resumed, result.failed) == (2 * SEEDS, 0, 0)
    assert out.read_bytes() == local


def test_a_worker_that_computes_something_else_is_named_and_its_jobs_are_done_elsewhere(
    cluster: LocalCluster, local: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "a.parquet"
    address, other = addresses(cluster)
    with caplog.at_level(logging.WARNING, "aeroloop"), different(cluster, address):
        swept(cluster, out, kill=other)  # the jobs that were sent there then go to the one in its place
    assert out.read_bytes() == local
    [line] = [record.getMessage() for record in caplog.records if record.name == "aeroloop"]
    assert line.startswith(f"worker {address} does not count: it computes other figures than this machine: 0.2.0+other")


def test_a_sweep_ends_where_no_worker_computes_what_this_machine_does(
    cluster: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_workers, "_ALONE_S", 0.0)
    out = tmp_path / "a.parquet"
    with different(cluster, *addresses(cluster)), pytest.raises(WorkersError, match=r"^no worker at tcp://\S+ is left"):
        swept(cluster, out)
    assert not out.exists()
