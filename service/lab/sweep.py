"""`lab sweep`: an experiment for every combination of values and seeds, as a table.

Each row is added to a file as it comes, so a sweep that was interrupted, or that gets more values, seeds or axes, runs
what is missing. The table at the end depends on configurations and code alone: not on engine, order or interruptions.
"""

from __future__ import annotations

import fcntl
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from aeroloop.service.config import Settings
from aeroloop.service.figures import Figures
from aeroloop.service.lab.axes import Axis, Configuration
from aeroloop.service.lab.engine import (
    COLUMNS,
    PROCESSES,
    Progress,
    Row,
    Run,
    Sheets,
    SweepError,
    code_version,
    figures_row,
    open_workers,
)
from aeroloop.service.logs.outputs import OutputError, check_output, writing

# ── rows of experiments, in a file ──


class Key(NamedTuple):
    """Name of a row: two rows with the same are the same."""

    configuration: str  # SHA-256 of what the experiment depends on, but for the seed
    seed: int
    version: str  # of aeroloop and its code


class RowFile:
    """Rows in a file of JSON lines that only grows. A line that a crash cut off is dropped.

    Raises SweepError if the file holds something else, or cannot be written.
    """

    _HEAD: Final = b'{"aeroloop": "sweep", "layout": 2}\n'

    def __init__(self, path: Path, file: FileIO) -> None:
        self.path, self.rows, self._file = path, dict[Key, Row](), file
        file.seek(0)
        text = file.read()
        if not (text.startswith(self._HEAD) or self._HEAD.startswith(text)):
            raise SweepError(f"{path} does not hold a sweep: name another file")
        whole = text[: text.rfind(b"\n") + 1]
        file.truncate(len(whole))
        if not whole:
            self._write(self._HEAD)
        for number, line in enumerate(whole.splitlines()[1:], 2):
            try:
                row = json.loads(line)
                self.rows[Key(*(row[name] for name in Key._fields))] = {name: row[name] for name in COLUMNS}
            except (ValueError, KeyError, TypeError):
                raise SweepError(f"{path}, line {number}, is no row of a sweep: remove it to go on") from None

    def append(self, key: Key, row: Row) -> None:
        """Add a row."""
        self._write(json.dumps(key._asdict() | row).encode() + b"\n")
        self.rows[key] = row

    def _write(self, line: bytes) -> None:
        try:
            written = self._file.write(line)
        except OSError as error:
            raise SweepError(f"{self.path} cannot be written: {error.strerror}") from None
        if written != len(line):
            raise SweepError(f"{self.path} cannot be written: the disk is full")


@contextmanager
def open_rows(path: Path) -> Iterator[RowFile]:
    """The rows in a file, for one sweep at a time. Raises SweepError as of `RowFile`, or if it is in use."""
    try:
        file = path.open("a+b", buffering=0)
    except OSError as error:
        raise SweepError(f"{path} cannot be used: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SweepError(f"{path} is in use by another sweep") from None
        yield RowFile(path, file)


# ── a sweep ──


class SweepPlan(NamedTuple):
    """What a sweep runs: every configuration with every seed, the seed fastest."""

    settings: Settings
    axes: list[Axis]
    configurations: list[Configuration]
    seeds: int
    duration_s: float


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


def rows_file(out: Path) -> Path:
    """The file of rows of a table."""
    return out.with_suffix(".jsonl")


def check_table(out: Path, inputs: Sequence[Path | None] = (), *, force: bool = False) -> None:
    """Raise OutputError if the table cannot be written there, as `check_output` does."""
    if out.suffix not in (".parquet", ".csv"):
        raise OutputError(f"--out must name a .parquet or .csv file, not {out}")
    check_output(out, inputs, force=force)


def run_sweep(
    plan: SweepPlan, out: Path, *, engine: str = PROCESSES, progress: Progress = lambda _done, _total: None
) -> Sweep:
    """Run what is missing in the file of rows beside a table, and write the table, in place of an older one.

    Experiments found count as done in `progress`. Raises SweepError if the file of rows cannot be used or workers fail,
    OutputError if the table, a Parquet or CSV file, cannot be written.
    """
    began, config = time.monotonic(), json.dumps(plan.settings.description())
    each = [(configuration, seed) for configuration in plan.configurations for seed in range(plan.seeds)]
    keys = [Key(configuration.digest, seed, code_version()) for configuration, seed in each]
    with open_rows(rows_file(out)) as file:
        missing = [i for i, key in enumerate(keys) if key not in file.rows]
        progress(resumed := len(keys) - len(missing), len(keys))
        runs = [Run(config, each[i][0].overrides, each[i][1]) for i in missing]
        if missing:
            with open_workers(engine) as workers:
                work = partial(figures_row, duration_s=plan.duration_s)
                for done, (number, row) in enumerate(workers.stream(work, runs), resumed + 1):
                    file.append(keys[missing[number]], row)
                    progress(done, len(keys))
        rows = [file.rows[key] for key in keys]
    _write_table(out, plan, keys, rows)
    failed = sum(row["reason"] is not None for row in rows)
    return Sweep(
        experiments=len(rows), configurations=len(plan.configurations), done=len(missing), resumed=resumed,
        failed=failed, out=str(out), rows=str(rows_file(out)), version=code_version(), engine=engine,
        seconds=time.monotonic() - began,
    )  # fmt: skip


def _write_table(out: Path, plan: SweepPlan, keys: Sequence[Key], rows: Sequence[Row]) -> None:
    """A row an experiment: the varied keys, the seed, the figures, and what names the row.

    A Parquet file has the description and unit of each figure in its field's metadata, the configuration in its own.
    """
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    varied = zip(*(each.values for each in plan.configurations for _ in range(plan.seeds)), strict=True)
    columns: dict[str, Any] = {axis.key: _varied(values) for axis, values in zip(plan.axes, varied, strict=True)}
    columns["seed"] = pa.array([key.seed for key in keys], pa.int64())
    for name in COLUMNS:
        kind = {"reason": pa.string(), "skipped_ticks": pa.int64()}.get(name, pa.float64())
        columns[name] = pa.array([row[name] for row in rows], kind)
    columns |= {name: pa.array([getattr(key, name) for key in keys]) for name in ("configuration", "version")}
    described = {name: field.description or "" for name, field in Figures.model_fields.items()}
    facts = {"config": plan.settings.description(), "duration_s": plan.duration_s}
    fields = [pa.field(n, each.type, metadata={"description": described.get(n, "")}) for n, each in columns.items()]
    schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
    table = pa.Table.from_arrays(list(columns.values()), schema=schema)
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


def sheets(sweep: Sweep) -> Sheets:
    """What was run, and where the rows are."""
    seeds = sweep.experiments // sweep.configurations
    facts = {
        "experiments": f"{sweep.experiments}: {sweep.configurations} configurations × {seeds} seeds",
        "run now": f"{sweep.done} in {sweep.seconds:.1f} s",
        "resumed": str(sweep.resumed),
        "failed": f"{sweep.failed}{' (column reason says why)' if sweep.failed else ''}",
        "table": sweep.out,
        "rows": sweep.rows,
    }
    yield "", [{"": name, "sweep": text} for name, text in facts.items()]
