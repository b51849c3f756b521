"""What a job costs that does nothing: CPU time of the process that hands jobs out, and time a job.

python -m tests.benchmarks.jobs [jobs]

For Dask the scheduler runs in this process, so its CPU time counts. That CPU time limits how many jobs a second any
number of workers can do.
"""

from __future__ import annotations

import sys
import time

from distributed import LocalCluster

from aeroloop.service.config import Settings
from aeroloop.service.lab.workers import open_workers, run_of


def nothing(_settings: Settings) -> None:
    """Do nothing."""


def measure(engine: str, jobs: int) -> None:
    """Print the costs of an engine."""
    runs = [run_of(Settings())]
    with open_workers(engine) as workers:
        workers.rows(nothing, runs * 10)  # the workers have started
        began, cpu, before = time.monotonic(), time.process_time(), len(workers.batches)
        while len(workers.batches) < before + jobs:
            workers.rows(nothing, runs * 8)  # too few for batches of several
        cpu, took = time.process_time() - cpu, time.monotonic() - began
    print(f"{engine.partition(':')[0]}: {cpu / jobs * 1e3:.2f} ms of CPU here, {took / jobs * 1e3:.2f} ms a job")


def main(jobs: int = 2000) -> None:
    """Measure both engines with as many workers as two cores."""
    measure("processes", jobs)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        measure(f"dask:{cluster.scheduler_address}", jobs)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
