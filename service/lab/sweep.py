"""Sweep: an experiment for every combination of values and seeds, in rows that survive a crash, then as a table.

Each row is added to a file as it comes, so a sweep that was interrupted, or that gets more values, seeds or axes, runs
what is missing. The table depends on configurations and code alone: not on engine, order or interruptions.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol import wording
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures
from aeroloop.service.lab.axes import Axis, Configuration
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.workers import PROCESSES, Batch, Run, Workers, code_version, open_workers
from aeroloop.service.logs.outputs import OutputError, check_output, writing

Row: TypeAlias = dict[str, Any]
Sheets: TypeAlias = Iterator[tuple[str, list[dict[str, str]]]]
"""A result as text: tables, each a title and rows, column to text; without rows a paragraph."""
Progress: TypeAlias = Callable[[int, int], None]
"""Called with the number done and the number in all."""


class SweepError(AeroloopError):
    """A sweep cannot begin or go on; one line with the reason."""


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


# ── rows in a file ──


class Key(NamedTuple):
    """Name of a row: two rows with the same are the same."""

    configuration: str  # SHA-256 of what the experiment depends on, but for the seed
    seed: int
    version: str  # of aeroloop and its code


class RowFile:
    """Rows in a file of JSON lines that only grows, or in memory without a path. A context in which no other uses it.

    A line that a crash cut off is dropped. Raises SweepError if the file holds something else, is in use, or cannot be
    read or written.
    """

    _HEAD: Final = b'{"aeroloop": "sweep", "layout": 2}\n'

    def __init__(self, path: Path | None) -> None:
        self._path, self.found = path, dict[Key, Row]()
        self._file = None
        if path is None:
            return
        try:
            self._file = path.open("a+b", buffering=0)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._read()
        except BlockingIOError:
            self.close()
            raise SweepError(f"{path} is in use by another sweep") from None
        except OSError as error:
            self.close()
            raise SweepError(f"{path} cannot be used: {error.strerror}") from None
        except SweepError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def _read(self) -> None:
        assert self._file is not None
        self._file.seek(0)
        text = self._file.read()
        if not (text.startswith(self._HEAD) or self._HEAD.startswith(text)):
            raise SweepError(f"{self._path} does not hold a sweep: name another file")
        whole = text[: text.rfind(b"\n") + 1]
        os.ftruncate(self._file.fileno(), len(whole))
        if not whole:
            self._file.write(self._HEAD)
        for number, line in enumerate(whole.splitlines()[1:], 2):
            try:
                row = json.loads(line)
                key = Key(*(row.pop(name) for name in Key._fields))
                self.found[key] = {name: row.pop(name) for name in COLUMNS}
            except (ValueError, KeyError, TypeError, AttributeError):
                raise SweepError(f"{self._path}, line {number}, is no row of a sweep: remove it to go on") from None

    def append(self, key: Key, row: Row) -> None:
        """Add a row. Raises SweepError if the disk does not take it."""
        if self._file is not None:
            line = json.dumps(key._asdict() | row).encode() + b"\n"
            try:
                written = self._file.write(line)
            except OSError as error:
                raise SweepError(f"{self._path} cannot be written: {error.strerror}") from None
            if written != len(line):
                raise SweepError(f"{self._path} cannot be written: the disk is full")
        self.found[key] = row


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


def sweep_rows(plan: SweepPlan, workers: Workers[Row], file: RowFile, report: Progress) -> list[Row]:
    """Run what is missing in a file of rows; all rows of the plan, in its order. Raises as `Workers.stream` does."""
    keys, runs = plan.keys(), plan.runs()
    missing = [i for i, key in enumerate(keys) if key not in file.found]
    report(done := len(keys) - len(missing), len(keys))
    work = partial(figures_row, duration_s=plan.duration_s)
    for number, row in workers.stream(work, [runs[i] for i in missing]):
        file.append(keys[missing[number]], row)
        report(done := done + 1, len(keys))
    return [file.found[key] for key in keys]


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
    with RowFile(rows_file(out)) as file, open_workers(engine) as workers:
        rows = sweep_rows(plan, workers, file, progress)
    write_table(out, plan, rows)
    seconds, batches = time.monotonic() - began, [batch for batch, _ in workers.batches]
    done, waits = sum(count for _, count in workers.batches), list(_waits(batches))
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
        cpu_s_per_experiment=sum(batch.cpu for batch in batches) / done if done else None,
        experiments_per_job=done / len(batches) if done else None,
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


def _waits(batches: Iterable[Batch]) -> Iterator[float]:
    """Each worker's times from the end of a batch to the beginning of its next one [s]."""
    ordered = sorted(batches, key=lambda batch: (batch.worker, batch.began))
    return (after.began - before.ended for before, after in pairwise(ordered) if before.worker == after.worker)


# ── its table ──

_FORMATS: Final = (".parquet", ".csv")
_TEXTS: Final = {
    **_STREAMS,
    "seed": "of wind and sensors",
    "reason": "why there are no figures: why the plant tripped",
    "configuration": "SHA-256 of what the experiment depends on, but for the seed",
    "version": "of aeroloop, and a hash of its code",
}


def check_table(
    out: Path,
    plan: SweepPlan,
    inputs: Sequence[Path | None] = (),
    *,
    more: Mapping[str, Any] | None = None,
    force: bool = False,
) -> None:
    """Raise OutputError if the table cannot be written there, as `check_output` does.

    Without `force` a sweep replaces a table only if it has each of its rows and varied keys. `more` are columns with
    one value in the whole table, which must be the same.
    """
    if out.suffix not in _FORMATS:
        raise OutputError(f"--out must name a {' or '.join(_FORMATS)} file, not {out}")
    check_output(out, inputs, force=True)
    if out.exists() and not force and not _continues(plan, out, more or {}):
        raise OutputError(
            f"{out} exists already and is no table of this sweep; name another file, or replace it with --force"
        )


def _continues(plan: SweepPlan, out: Path, more: Mapping[str, Any]) -> bool:
    """Whether a sweep has each row and each varied key of the table in a file."""
    import pyarrow.csv
    import pyarrow.parquet

    try:
        table = pyarrow.csv.read_csv(out) if out.suffix == ".csv" else pyarrow.parquet.read_table(out)
        names: list[str] = table.column_names
        varied = names[: names.index("seed")]
        keys = set(zip(*(table[name].to_pylist() for name in Key._fields), strict=True))
    except (OSError, ValueError, KeyError):  # no table, or none of a sweep
        return False
    same = all(set(table[name].to_pylist()) == {value} for name, value in more.items() if name in names)
    return same and set(varied) <= {axis.key for axis in plan.axes} and keys <= set(plan.keys())


def write_table(
    out: Path, plan: SweepPlan, rows: Sequence[Row], more: Mapping[str, tuple[Sequence[Any], str]] | None = None
) -> None:
    """Write the table, in place of an older one: a row an experiment, in the order of the axes' values.

    The columns are the varied keys, the seed, the figures, and what names the row. A Parquet file has the description
    and unit of each in its field's metadata, and the configuration in its own.

    Args:
        out: A Parquet or CSV file.
        plan: What was run.
        rows: As of `sweep_rows`.
        more: Further columns of numbers, with their description.

    Raises:
        OutputError: It cannot be written.
    """
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    known, keys = wording.keys(Settings), plan.keys()
    varied = zip(*(each.values for each in plan.configurations for _ in range(plan.seeds)), strict=True)
    columns: dict[str, tuple[Any, str]] = {
        axis.key: (_varied(values), (axis.key in known and known[axis.key].description) or "")
        for axis, values in zip(plan.axes, varied, strict=True)
    }
    columns["seed"] = pa.array([key.seed for key in keys], pa.int64()), ""
    for name in COLUMNS:
        kind = {"reason": pa.string(), "skipped_ticks": pa.int64()}.get(name, pa.float64())
        field = Figures.model_fields.get(name)
        columns[name] = pa.array([row[name] for row in rows], kind), (field and field.description) or ""
    columns["configuration"] = pa.array([key.configuration for key in keys]), ""
    columns["version"] = pa.array([key.version for key in keys]), ""
    for name, (numbers, text) in (more or {}).items():
        columns[name] = pa.array(numbers, pa.float64()), text
    fields = [
        pa.field(name, values.type, metadata={"description": _TEXTS.get(name, text)})
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
