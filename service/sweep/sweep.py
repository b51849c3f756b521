"""Sweep: runs what is missing of a full factorial, in jobs of several experiments, and writes the table of all rows.

Each row is in the file of rows before its job counts as done, so a crash costs the jobs that ran. The table depends on
the configurations alone: not on engine, order or interruptions. An experiment costs from milliseconds to seconds, so
a job holds as many as fill `JOB_S`, by what those before have cost; then the scheduler's overhead does not count.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import count, islice
from pathlib import Path
from secrets import token_hex
from typing import Any, Final, NamedTuple, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings, load_over
from aeroloop.service.lab.cells import with_seed
from aeroloop.service.lab.sentinel import fingerprint, run_each
from aeroloop.service.lab.workers import PROCESSES, Workers
from aeroloop.service.sweep.axes import Axis, Configuration, configurations
from aeroloop.service.sweep.rows import Key, Measured, Rows, measured
from aeroloop.service.sweep.table import write_table

JOB_S: Final = 20.0
"""Computing time of a job, about: thousands of cores then need no more jobs than one scheduler hands out [s]."""
Task: TypeAlias = tuple[tuple[str, ...], int]
"""Overrides and seed of an experiment."""


class Sweep(BaseModel):
    """What a sweep did."""

    model_config = ConfigDict(frozen=True)

    experiments: int = Field(description="rows of the table: configurations × seeds")
    configurations: int
    done: int = Field(description="experiments run, this time")
    resumed: int = Field(description="experiments found in the file of rows")
    failed: int = Field(description="rows with a reason instead of figures, such as a trip")
    out: str = Field(description="the table")
    rows: str = Field(description="the file of rows, from which a sweep resumes")
    version: str = Field(description="of aeroloop, and a digest of what it computes")
    engine: str
    seconds: float = Field(description="time that it took, start of the workers included [s]")
    experiments_per_s: float | None = Field(description="done/seconds; null if all were found [1/s]")
    cpu_s_per_experiment: float | None = Field(description="CPU time in a worker, mean [s]")
    experiments_per_job: float | None = Field(description="mean")
    overhead_ms_per_job: float | None = Field(
        description="a worker's wait from the end of a job to the beginning of its next, mean; null without one [ms]"
    )


class Spent(NamedTuple):
    """Time that jobs took in their workers."""

    jobs: int = 0
    experiments: int = 0
    cpu: float = 0.0  # [s]
    waits: int = 0
    waited: float = 0.0  # from the end of a job to the beginning of the next one in the same worker, in all [s]

    def __add__(self, other: Any) -> Spent:
        """Both together."""
        return Spent(*(mine + its for mine, its in zip(self, other, strict=True)))

    @property
    def next_job(self) -> int:
        """Experiments that fill a job: one, until the first jobs say what an experiment costs."""
        return max(1, int(JOB_S * self.experiments / self.cpu)) if self.cpu else 1


_ended: dict[str, float] = {}
"""By sweep, when this process ended its last job [s]. A worker has one thread."""


def run_tasks(sweep: str, config: str, tasks: Sequence[Task], duration_s: float) -> tuple[list[Measured], Spent]:
    """Run experiments, in any process; `config` is the JSON of the configuration that they override."""
    began, cpu = time.monotonic(), time.process_time()
    waits, waited = (1, began - _ended[sweep]) if sweep in _ended else (0, 0.0)
    found = run_each([with_seed(_settings(config, overrides), seed) for overrides, seed in tasks], duration_s)
    _ended[sweep] = time.monotonic()
    return [measured(each) for each in found], Spent(1, len(tasks), time.process_time() - cpu, waits, waited)


@lru_cache(maxsize=4)
def _settings(config: str, overrides: tuple[str, ...]) -> Settings:
    return load_over(_base(config), overrides)


@lru_cache(maxsize=1)
def _base(config: str) -> Settings:
    return Settings.model_validate_json(config)


class Plan(NamedTuple):
    """What a sweep runs."""

    settings: Settings
    axes: list[Axis]
    found: list[Configuration]
    seeds: int
    duration_s: float

    def tasks(self, version: str) -> Iterator[tuple[Key, Task]]:
        """Every experiment, the seed fastest."""
        for each in self.found:
            for seed in range(self.seeds):
                yield Key(each.digest, seed, version), (each.overrides, seed)


def plan(settings: Settings, axes: Sequence[Axis], seeds: int, duration_s: float) -> Plan:
    """Every experiment of a sweep. Raises ConfigError as `configurations` does."""
    return Plan(settings, list(axes), configurations(settings, axes, seeds, duration_s), seeds, duration_s)


def rows_file(out: Path) -> Path:
    """The file of rows of a table."""
    return out.with_suffix(".jsonl")


def run_sweep(
    planned: Plan, out: Path, *, engine: str = PROCESSES, progress: Callable[[int, int], None] | None = None
) -> Sweep:
    """Run what is missing in the file of rows, and write the table, in place of an older one.

    Args:
        planned: What to run.
        out: The table, a Parquet file; the file of rows stands beside it.
        engine: As of `Workers`.
        progress: Called with experiments done, those found included, and experiments in all.

    Raises:
        SweepError: The file of rows cannot be used.
        OutputError: The table cannot be written.
        WorkersError: As of `Workers`.
    """
    began, version = time.monotonic(), fingerprint()
    sweep, config = token_hex(8), json.dumps(planned.settings.description())
    spent, sent = Spent(), dict[int, list[Key]]()
    report = progress or (lambda _done, _total: None)
    keys = [key for key, _ in planned.tasks(version)]
    with Rows(rows_file(out)) as rows:
        resumed = sum(key in rows.found for key in keys)
        report(resumed, len(keys))

        def jobs() -> Iterator[tuple[str, str, list[Task], float]]:
            missing = (each for each in planned.tasks(version) if each[0] not in rows.found)
            for number in count():
                if not (job := list(islice(missing, spent.next_job))):
                    return
                sent[number] = [key for key, _ in job]
                yield sweep, config, [task for _, task in job], planned.duration_s

        if resumed < len(keys):
            with Workers(engine) as workers:
                for number, (found, took) in workers.stream(run_tasks, jobs()):
                    rows.append(zip(sent.pop(number), found, strict=True))
                    spent += took
                    report(resumed + spent.experiments, len(keys))
        table = [rows.found[key] for key in keys]
    write_table(out, planned, keys, table)
    seconds = time.monotonic() - began
    return Sweep(
        experiments=len(keys),
        configurations=len(planned.found),
        done=spent.experiments,
        resumed=resumed,
        failed=sum(row.reason is not None for row in table),
        out=str(out),
        rows=str(rows_file(out)),
        version=version,
        engine=engine,
        seconds=seconds,
        experiments_per_s=spent.experiments / seconds if spent.jobs else None,
        cpu_s_per_experiment=spent.cpu / spent.experiments if spent.jobs else None,
        experiments_per_job=spent.experiments / spent.jobs if spent.jobs else None,
        overhead_ms_per_job=spent.waited / spent.waits * 1e3 if spent.waits else None,
    )
