"""What a job costs that does nothing: CPU time of the process that hands jobs out, and time a job.

python -m tests.benchmarks.jobs [jobs]

For Dask the scheduler runs in this process, so its CPU time counts. That CPU time limits how many jobs a second any
number of workers can do.
"""

from __future__ import annotations

import sys
import time

from distributed import LocalCluster

from aeroloop.service.lab.workers import Workers


def measure(engine: str, jobs: int) -> None:
    """Print the costs of an engine."""
    with Workers(engine) as workers:
        workers.each(divmod, [(1, 1)] * 10)  # the workers have started
        began, cpu = time.monotonic(), time.process_time()
        workers.each(divmod, [(1, 1)] * jobs)
        cpu, took = time.process_time() - cpu, time.monotonic() - began
    print(f"{engine.partition(':')[0]}: {cpu / jobs * 1e3:.2f} ms of CPU here, {took / jobs * 1e3:.2f} ms a job")


def main(jobs: int = 2000) -> None:
    """Measure both engines with as many workers as two cores."""
    measure("processes", jobs)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        measure(f"dask:{cluster.scheduler_address}", jobs)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
