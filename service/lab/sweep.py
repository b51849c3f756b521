"""The engine of every study: a function of many configurations, on every core or on a Dask cluster; and `lab sweep`.

Configurations go to other processes as JSON with overrides, and results come back as plain data. `lab sweep` runs an
experiment for every combination of values and seeds. Each row is added to a file as it comes, so a sweep that was
interrupted, or that gets more values, seeds or axes, runs what is missing. The table at the end depends on
configurations and code alone: not on engine, order or interruptions.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import ExitStack, closing, contextmanager
from functools import cache, lru_cache, partial
from hashlib import sha256
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol import wording
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, load_over
from aeroloop.service.figures import Figures
from aeroloop.service.lab.axes import Axis, Configuration
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.logs.outputs import OutputError, check_output, writing

Result = TypeVar("Result")
Row: TypeAlias = dict[str, Any]
Sheets: TypeAlias = Iterator[tuple[str, list[dict[str, str]]]]
"""A result as text: tables, each a title and rows, column to text; without rows a paragraph."""
Progress: TypeAlias = Callable[[int, int], None]
"""Called with the number done and the number in all."""


class Column(NamedTuple):
    """A column of a printed table: a figure of a row as text."""

    title: str
    name: str
    form: str  # as of `str.format`
    scale: float = 1
    missing: str = "–"

    def text(self, row: Row) -> str:
        """The cell of a row."""
        value = row[self.name]
        return self.missing if value is None else self.form.format(value * self.scale)


class SweepError(AeroloopError):
    """Runs cannot begin or go on: no worker, another version, a file of rows in use; one line with the reason."""


# ── the engine ──

PROCESSES: Final = "processes"
_DASK: Final = "dask:"
_PATIENCE_S: Final = 10.0
_MOST: Final = 32
"""Runs of a job on a cluster, at most: one scheduler hands jobs out to thousands of cores."""


class Run(NamedTuple):
    """A configuration to run, as plain data: it goes to other processes."""

    config: str  # JSON of a configuration
    overrides: tuple[str, ...] = ()
    seed: int | None = None  # of wind and sensors; None as configured

    def settings(self) -> Settings:
        """The configuration."""
        settings = load_over(_base(self.config), self.overrides) if self.overrides else _base(self.config)
        return settings if self.seed is None else with_seed(settings, self.seed)


@lru_cache(maxsize=2)
def _base(config: str) -> Settings:
    return Settings.model_validate_json(config)


def run_of(settings: Settings, overrides: Sequence[str] = (), seed: int | None = None) -> Run:
    """The run of a configuration."""
    return Run(json.dumps(settings.description()), tuple(overrides), seed)


def with_seed(settings: Settings, seed: int) -> Settings:
    """The configuration with this seed of wind and sensors; a plant without ours stays as it is."""
    plant = settings.plant
    if not plant.emulated:
        return settings
    drawn = {name: getattr(plant, name).model_copy(update={"seed": seed}) for name in ("wind", "sensors")}
    return settings.model_copy(update={"plant": plant.model_copy(update=drawn)})


@cache
def code_version() -> str:
    """The version of aeroloop, and a hash of its code and of Python, NumPy and CasADi, such as `0.2.0+1f0c83a6be25`."""
    digest = sha256(repr([sys.version, version("numpy"), version("casadi")]).encode())
    for package in ("protocol", "plant_emulator", "service"):
        folder = Path(str(sys.modules[f"aeroloop.{package}"].__file__)).parent
        for file in sorted(filter(Path.is_file, folder.rglob("*.py"))):  # an editable install may have dead links
            digest.update(f"{package}/{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return f"{version('aeroloop')}+{digest.hexdigest()[:12]}"


class Job(NamedTuple):
    """Results of some runs, and what they cost in their worker."""

    results: list[Any]
    worker: str
    began: float  # monotonic time of the worker [s]
    ended: float
    cpu: float  # [s]


_one_at_a_time = threading.Lock()


def _run_job(expected: str, work: Callable[[Settings], Any], runs: Sequence[Run]) -> Job:
    """Run a job, in any process. A thread at a time, as compiled loops are shared by the threads of a process."""
    worker = f"{os.uname().nodename}:{os.getpid()}"
    if (mine := code_version()) != expected:
        raise SweepError(f"worker {worker} runs aeroloop {mine}, this machine {expected}: install the same on both")
    with _one_at_a_time:
        began, cpu = time.monotonic(), time.process_time()
        results = [work(run.settings()) for run in runs]
        return Job(results, worker, began, time.monotonic(), time.process_time() - cpu)


class Workers:
    """Workers that do a function of a configuration.

    Attributes:
        jobs: What each job cost so far.
    """

    def __init__(self, executor: Executor, count: int, most: int = 1) -> None:
        self._executor, self._count, self._most = executor, count, most
        self.jobs = list[Job]()

    def stream(self, work: Callable[[Settings], Result], runs: Sequence[Run]) -> Iterator[tuple[int, Result]]:
        """Number and result of each run, as they finish.

        Args:
            work: Function at the top level of a module, or a `partial` of one.
            runs: Configurations.

        Raises:
            SweepError: A worker ended, or has another version of aeroloop, or Dask's scheduler is gone.
            Exception: The first exception that the function raised.
        """
        pending, sent = dict[Future[Job], int](), 0
        while pending or sent < len(runs):
            while sent < len(runs) and len(pending) < 2 * self._count:
                size = max(1, min(self._most, (len(runs) - sent) // (4 * self._count)))
                with _uninterrupted():
                    job = self._executor.submit(_run_job, code_version(), work, runs[sent : sent + size])
                pending[job] = sent
                sent += size
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                first, done = pending.pop(future), _result_of(future)
                self.jobs.append(done)
                yield from enumerate(done.results, first)

    def rows(
        self, work: Callable[[Settings], Result], runs: Sequence[Run], progress: Callable[[int], None] = lambda _: None
    ) -> list[Result]:
        """Results as of `stream`, in the order of the runs; `progress` is called with the number done."""
        results = dict[int, Result]()
        for number, result in self.stream(work, runs):
            results[number] = result
            progress(len(results))
        return [results[number] for number in range(len(runs))]


def _result_of(future: Future[Job]) -> Job:
    try:
        return future.result()
    except BrokenExecutor:
        raise SweepError("a worker process ended in the middle of a job: killed, or no memory") from None
    except CancelledError:
        raise SweepError("the Dask scheduler is gone, or has dropped the jobs") from None
    except Exception as error:
        if type(error).__module__.startswith("distributed"):  # such as KilledWorker, after several workers
            raise SweepError(f"a job failed on the Dask cluster: {str(error).splitlines()[0]}") from None
        raise


def check_engine(engine: str) -> None:
    """Raise SweepError unless an engine is `processes` or `dask:ADDRESS`."""
    if engine != PROCESSES and not (engine.startswith(_DASK) and engine != _DASK):
        raise SweepError(f"--engine must be {PROCESSES} or {_DASK}ADDRESS, not {engine!r}")


@contextmanager
def open_workers(engine: str = PROCESSES) -> Iterator[Workers]:
    """Workers of an engine, ended with the context.

    Raises:
        SweepError: No such engine, or no scheduler or worker answers.
        ModuleNotFoundError: Dask is not installed.
    """
    check_engine(engine)
    with _processes() if engine == PROCESSES else _dask(engine.removeprefix(_DASK)) as workers:
        yield workers


@contextmanager
def _processes() -> Iterator[Workers]:
    """A process a core, forked from a server that has imported what they need and has no threads."""
    count, context = os.cpu_count() or 1, multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent) as executor:
        try:
            yield Workers(executor, count)
        except BaseException:  # a failure or ^C: what the others compute has no use
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _end_with_parent() -> None:
    """End this worker when its parent is killed, which would leave it waiting for jobs."""

    def wait_for_end() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_end, daemon=True).start()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Put ^C off while processes start: one that starts half prints a traceback. They inherit the mask of signals.

    Why not a mask alone: another thread would take the signal, and Python handles it in the main thread all the same.
    """
    arrived: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, lambda number, _: arrived.append(number)) if main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if main:
            signal.signal(signal.SIGINT, before)
    if arrived:
        signal.raise_signal(signal.SIGINT)


@contextmanager
def _dask(address: str) -> Iterator[Workers]:
    """Workers of a Dask cluster, such as at `tcp://10.0.0.1:8786`; TLS as Dask's own configuration says."""
    from distributed import Client, Security
    from distributed.comm.core import connect

    for name in ("distributed", "distributed.client"):  # what matters is raised here
        logging.getLogger(name).setLevel(logging.CRITICAL)

    async def connect_once() -> None:  # a client that fails but for want of an answer, such as for TLS, never ends
        comm = await connect(address, timeout=_PATIENCE_S, **Security().get_connection_args("client"))
        await comm.close()

    try:
        asyncio.run(connect_once())
        client = Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except Exception as error:  # whatever the transport raises
        raise SweepError(f"no Dask scheduler answers at {address}: {str(error).splitlines()[0]}") from None
    with client:
        if not (cores := sum(client.ncores().values())):
            raise SweepError(f"no worker at {address}: `dask worker {address} --nthreads 1` starts one")
        yield Workers(client.get_executor(retries=2, pure=False), cores, _MOST)


# ── rows of experiments, in a file ──

_STREAMS: Final = {
    "measurement_frames_per_s": "frames sent by the plant end [1/s]",
    "measurement_bits_per_s": "their payload bits, padding included [1/s]",
    "command_frames_per_s": "frames sent by the controller [1/s]",
    "command_bits_per_s": "their payload bits, padding included [1/s]",
}
_FIGURES: Final = (
    "z_track", "u_total", "max_error_deg", "final_error_deg", "second_half_error_deg", "command_changes_per_s",
    "skipped_ticks",
)  # fmt: skip
COLUMNS: Final = (*_FIGURES, *_STREAMS, "reason")
"""Figures in a row of an experiment, by the names of `Figures`; `reason` is why there are none."""


def figures_row(settings: Settings, duration_s: float) -> Row:
    """Figures of an experiment, or the reason why it has none, such as a trip."""
    try:
        found = run_experiment(settings, duration_s)
    except (AeroloopError, ValueError) as error:  # the plant tripped, a law or plant failed, the ends do not fit
        return {**dict.fromkeys(COLUMNS), "reason": str(error).splitlines()[0]}
    streams = {name: getattr(getattr(found, name.partition("_")[0]), name.partition("_")[2]) for name in _STREAMS}
    return {**{name: getattr(found, name) for name in _FIGURES}, **streams, "reason": None}


class Key(NamedTuple):
    """Name of a row: two rows with the same are the same."""

    configuration: str  # SHA-256 of what the experiment depends on, but for the seed
    seed: int
    version: str  # of aeroloop and its code


class RowFile:
    """Rows in a file of JSON lines that only grows, for one sweep at a time.

    A line that a crash cut off is dropped. Raises SweepError if the file holds something else, is in use, or cannot be
    read or written.
    """

    _HEAD: Final = b'{"aeroloop": "sweep", "layout": 2}\n'

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, dict[Key, Row]()
        with ExitStack() as on_failure:
            try:
                self._file = on_failure.enter_context(path.open("a+b", buffering=0))
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise SweepError(f"{path} is in use by another sweep") from None
            except OSError as error:
                raise SweepError(f"{path} cannot be used: {error.strerror}") from None
            self._read()
            on_failure.pop_all()

    def _read(self) -> None:
        self._file.seek(0)
        text = self._file.read()
        if not (text.startswith(self._HEAD) or self._HEAD.startswith(text)):
            raise SweepError(f"{self.path} does not hold a sweep: name another file")
        whole = text[: text.rfind(b"\n") + 1]
        os.ftruncate(self._file.fileno(), len(whole))
        if not whole:
            self._write(self._HEAD)
        for number, line in enumerate(whole.splitlines()[1:], 2):
            try:
                row = json.loads(line)
                self.rows[Key(*(row[name] for name in Key._fields))] = {name: row[name] for name in COLUMNS}
            except (ValueError, KeyError, TypeError):
                raise SweepError(f"{self.path}, line {number}, is no row of a sweep: remove it to go on") from None

    def append(self, key: Key, row: Row) -> None:
        """Add a row. Raises SweepError if the disk does not take it."""
        self._write(json.dumps(key._asdict() | row).encode() + b"\n")
        self.rows[key] = row

    def _write(self, line: bytes) -> None:
        try:
            written = self._file.write(line)
        except OSError as error:
            raise SweepError(f"{self.path} cannot be written: {error.strerror}") from None
        if written != len(line):
            raise SweepError(f"{self.path} cannot be written: the disk is full")

    def close(self) -> None:
        """Let another sweep have the file."""
        self._file.close()


# ── a sweep ──


class SweepPlan(NamedTuple):
    """What a sweep runs: every configuration with every seed, the seed fastest."""

    settings: Settings
    axes: list[Axis]
    configurations: list[Configuration]
    seeds: int
    duration_s: float

    def keys(self) -> list[Key]:
        """Names of all rows."""
        version = code_version()
        return [Key(each.digest, seed, version) for each in self.configurations for seed in range(self.seeds)]

    def runs(self) -> list[Run]:
        """All experiments."""
        config = json.dumps(self.settings.description())
        return [Run(config, each.overrides, seed) for each in self.configurations for seed in range(self.seeds)]


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
    version: str = Field(description="of aeroloop, and a hash of its code")
    engine: str
    seconds: float = Field(description="time that it took, start of the workers included [s]")
    experiments_per_s: float | None = Field(description="done/seconds; null if all were found [1/s]")
    cpu_s_per_experiment: float | None = Field(description="CPU time in a worker, mean [s]")
    experiments_per_job: float | None = Field(description="mean")
    overhead_ms_per_job: float | None = Field(
        description="a worker's wait from the end of a job to the beginning of its next, mean; null without one [ms]"
    )


def rows_file(out: Path) -> Path:
    """The file of rows of a table."""
    return out.with_suffix(".jsonl")


def sweep_rows(plan: SweepPlan, workers: Workers, out: Path | None, report: Progress) -> list[Row]:
    """All rows of a plan, in its order; what is missing in the file of rows beside `out` is run and added.

    Raises:
        SweepError: As of `RowFile` and `Workers.stream`.
    """
    with ExitStack() as at_end:
        file = None if out is None else at_end.enter_context(closing(RowFile(rows_file(out))))
        rows, keys, runs = file.rows if file else {}, plan.keys(), plan.runs()
        missing = [i for i, key in enumerate(keys) if key not in rows]
        report(done := len(keys) - len(missing), len(keys))
        work = partial(figures_row, duration_s=plan.duration_s)
        for number, row in workers.stream(work, [runs[i] for i in missing]):
            if file:
                file.append(keys[missing[number]], row)
            rows[keys[missing[number]]] = row
            report(done := done + 1, len(keys))
    return [rows[key] for key in keys]


def run_sweep(
    plan: SweepPlan, out: Path, *, engine: str = PROCESSES, progress: Progress = lambda _done, _total: None
) -> Sweep:
    """Run what is missing in the file of rows beside a table, and write the table, in place of an older one.

    Args:
        plan: What to run.
        out: The table, a Parquet or CSV file.
        engine: As of `open_workers`.
        progress: Called with experiments done, those found included, and experiments in all.

    Raises:
        SweepError: The file of rows cannot be used, or workers fail.
        OutputError: The table cannot be written.
    """
    began = time.monotonic()
    with open_workers(engine) as workers:
        rows = sweep_rows(plan, workers, out, progress)
    write_table(out, plan, rows)
    seconds, jobs, done = time.monotonic() - began, workers.jobs, sum(len(job.results) for job in workers.jobs)
    by_worker = pairwise(sorted(jobs, key=lambda job: (job.worker, job.began)))
    waits = [after.began - before.ended for before, after in by_worker if before.worker == after.worker]
    return Sweep(
        experiments=len(rows),
        configurations=len(plan.configurations),
        done=done,
        resumed=len(rows) - done,
        failed=sum(row["reason"] is not None for row in rows),
        out=str(out),
        rows=str(rows_file(out)),
        version=code_version(),
        engine=engine,
        seconds=seconds,
        experiments_per_s=done / seconds if done else None,
        cpu_s_per_experiment=sum(job.cpu for job in jobs) / done if done else None,
        experiments_per_job=done / len(jobs) if done else None,
        overhead_ms_per_job=1e3 * sum(waits) / len(waits) if waits else None,
    )


def sheets(sweep: Sweep) -> Sheets:
    """What was run, what it cost, where the rows are."""
    seeds = sweep.experiments // sweep.configurations
    facts = {
        "experiments": f"{sweep.experiments}: {sweep.configurations} configurations × {seeds} seeds",
        "run now": f"{sweep.done} in {sweep.seconds:.1f} s",
        "resumed": str(sweep.resumed),
        "failed": f"{sweep.failed}{' (column reason says why)' if sweep.failed else ''}",
        "table": sweep.out,
        "rows": sweep.rows,
    }
    if sweep.cpu_s_per_experiment is not None:
        facts["cost of an experiment"] = f"{sweep.cpu_s_per_experiment:.3g} s of a core"
    if sweep.overhead_ms_per_job is not None:
        facts["between two jobs"] = f"{sweep.overhead_ms_per_job:.2g} ms"
    yield "", [{"": name, "sweep": text} for name, text in facts.items()]


# ── its table ──

_TEXTS: Final = {
    **_STREAMS,
    "seed": "of wind and sensors",
    "reason": "why there are no figures: why the plant tripped",
    "configuration": "SHA-256 of what the experiment depends on, but for the seed",
    "version": "of aeroloop, and a hash of its code",
}


def check_table(
    out: Path, plan: SweepPlan, inputs: Sequence[Path | None] = (), *, force: bool = False, **same: float
) -> None:
    """Raise OutputError if the table cannot be written there, as `check_output` does.

    Without `force` a sweep replaces a table only if it has each of its rows and varied keys. `same` are columns with
    one value in the whole table, which must be the same.
    """
    if out.suffix not in (".parquet", ".csv"):
        raise OutputError(f"--out must name a .parquet or .csv file, not {out}")
    check_output(out, inputs, force=True)
    if out.exists() and not force and not _continues(plan, out, same):
        raise OutputError(
            f"{out} exists already and is no table of this sweep; name another file, or replace it with --force"
        )


def _continues(plan: SweepPlan, out: Path, same: Mapping[str, float]) -> bool:
    import pyarrow.csv
    import pyarrow.parquet

    try:
        table = pyarrow.csv.read_csv(out) if out.suffix == ".csv" else pyarrow.parquet.read_table(out)
        varied = table.column_names[: table.column_names.index("seed")]
        keys = set(zip(*(table[name].to_pylist() for name in Key._fields), strict=True))
        others = [name for name, value in same.items() if set(table[name].to_pylist()) != {value}]
    except (OSError, ValueError, KeyError):  # no table, or none of a sweep
        return False
    return not others and set(varied) <= {axis.key for axis in plan.axes} and keys <= set(plan.keys())


def write_table(out: Path, plan: SweepPlan, rows: Sequence[Row], more: Mapping[str, str] | None = None) -> None:
    """Write the table, in place of an older one: a row an experiment, in the order of the axes' values.

    The columns are the varied keys, the seed, the figures, and what names the row. A Parquet file has the description
    and unit of each in its field's metadata, and the configuration in its own.

    Args:
        out: A Parquet or CSV file.
        plan: What was run.
        rows: As of `sweep_rows`.
        more: Further columns of numbers in these rows, with their description.

    Raises:
        OutputError: It cannot be written.
    """
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    known, keys, columns = wording.keys(Settings), plan.keys(), dict[str, tuple[Any, str | None]]()
    varied = zip(*(each.values for each in plan.configurations for _ in range(plan.seeds)), strict=True)
    for axis, values in zip(plan.axes, varied, strict=True):
        columns[axis.key] = _varied(values), (axis.key in known and known[axis.key].description) or ""
    columns["seed"] = pa.array([key.seed for key in keys], pa.int64()), None
    for name in COLUMNS:
        kind = {"reason": pa.string(), "skipped_ticks": pa.int64()}.get(name, pa.float64())
        field = Figures.model_fields.get(name)
        columns[name] = pa.array([row[name] for row in rows], kind), field and field.description
    columns["configuration"] = pa.array([key.configuration for key in keys]), None
    columns["version"] = pa.array([key.version for key in keys]), None
    for name, text in (more or {}).items():
        columns[name] = pa.array([row[name] for row in rows], pa.float64()), text
    fields = [
        pa.field(name, values.type, metadata={"description": _TEXTS.get(name, text or "")})
        for name, (values, text) in columns.items()
    ]
    facts = {"config": plan.settings.description(), "duration_s": plan.duration_s}
    schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
    table = pa.Table.from_arrays([values for values, _ in columns.values()], schema=schema)
    with writing(out, force=True) as part:
        if out.suffix == ".csv":
            pyarrow.csv.write_csv(table, part)
        else:
            pyarrow.parquet.write_table(table, part, compression="zstd")


def _varied(values: Sequence[Any]) -> Any:
    """A column of values; of texts where they are of several kinds."""
    import pyarrow as pa

    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        return pa.array([None if value is None else str(value) for value in values])
