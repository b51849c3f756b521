"""Export of a log as a table, or as a log with everything decoded.

A table has the ticks that a review judges: both use `TickReader`. Each block is written as soon as it is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.runtime.host import versions
from aeroloop.service.config import ConfigError, Settings
from aeroloop.service.control.laws.registry import law_of
from aeroloop.service.logs.files import LogFiles, Progress
from aeroloop.service.logs.in_force import Unknown
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.runs import Block, Run, Taker
from aeroloop.service.logs.table import Rows, TruthColumns, groups, is_of_tick
from aeroloop.service.logs.table_files import FILES, ExportError, TableFile
from aeroloop.service.logs.tick_reader import TickReader
from aeroloop.service.logs.traces import Integers, SessionKey

Format = Literal["parquet", "csv", "mat", "mcap"]
ALL: Final = "all"

ENDINGS: Final[dict[Format, str]] = {"parquet": ".parquet", "csv": ".csv", "mat": ".mat", "mcap": "-decoded.mcap"}
"""Ending of a new file's name."""


class Exported(BaseModel, frozen=True):
    """What was exported."""

    out: str
    format: str
    sessions: list[str] | None = Field(description="`vehicle/session`, in the order of the rows; null of a log")
    rows: int = Field(description="rows of a table, messages of a log")
    columns: list[str] = Field(description="names of a table's columns, topics of a log's channels")
    bytes: int
    damages: list[str] = Field(description="what of the log could not be read")
    unknown: list[Unknown] = Field(default=[], description="ticks left out: the log does not hold what was in force")


def export(
    paths: Sequence[Path],
    to: Format,
    out: Path | None = None,
    *,
    session: str | None = None,
    vehicle: str | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write a run's ticks as a table, or all of it as a log with everything decoded.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        to: Format.
        out: The file; the first log's name with another ending if None.
        session: As of `Run.choose`, or `all` of the vehicle.
        vehicle: As of `Run.choose`.
        force: Replace an existing file, unless it is a log.
        progress: Called repeatedly with the share done, 0…1.

    Raises:
        ExportError: There is nothing to export.
        OutputError: The file must not be written, or cannot.
        ReviewError: The log cannot be read.
    """
    out = out or beside(paths[0], ENDINGS[to])
    sessions: list[str] | None = None
    unknown: list[Unknown] = []
    try:
        with writing(out, paths, force=force) as part:
            if to == "mcap":
                from aeroloop.service.logs.decoded_log import write_decoded

                if session is not None or vehicle is not None:
                    raise ExportError(
                        "--session and --vehicle choose the rows of a table; --to mcap writes the log with all of them"
                    )
                rows, columns, damages = write_decoded(LogFiles(paths), part, progress or (lambda _: None))
            else:
                run = Run(paths, progress)
                sessions, rows, columns, damages = _table(run, to, part, session, vehicle)
                unknown = [one for one in run.unknown if f"{one.vehicle}/{one.session}" in sessions]
            size = part.stat().st_size
    except ConfigError as error:
        raise ExportError(f"{paths[0]} is not a log of this version: {error}") from None
    return Exported(
        out=str(out),
        format=to,
        sessions=sessions,
        rows=rows,
        columns=columns,
        bytes=size,
        damages=damages,
        unknown=unknown,
    )


def _table(
    run: Run, to: Format, part: Path, session: str | None, vehicle: str | None
) -> tuple[list[str], int, list[str], list[str]]:
    """Write a table; returns its sessions, number of rows and columns' names, and what could not be read."""
    first = run.choose(None if session == ALL else session, vehicle)
    chosen = run.sessions_of(first[0]) if session == ALL else [first]
    settings = run.settings(first)
    table = groups(
        settings.wire, settings.loop.period, law_of(settings.law, settings.loop.period, settings.wire.actuators)
    )
    names = ["/".join(which) for which in chosen]
    facts = {
        "config": settings.description(),
        "sessions": names,
        "logs": [str(path) for path in run.files.paths],
        "recorded_by": {role: found.versions for role, found in run.described(first).items()},
        "exported_by": versions(),
    }
    file = FILES[to](part, table, facts)
    writers = {which: _Writer(which, file, run.settings(which)) for which in chosen}

    malformed = Counter[str]()

    def truth(vehicle: str, payload: bytes, _: int) -> None:
        try:
            true = Truth.model_validate_json(payload)
        except ValidationError:  # a stranger may publish anything
            malformed[vehicle] += 1
            return
        writer = writers.get((vehicle, true.session or ""))
        if writer is not None and not is_of_tick(true, writer.actuators):
            malformed[vehicle] += 1
        elif writer is not None and true.session_tick is not None:
            writer.truths.append((true.session_tick, *true.attitude, *true.rate, *true.voltages))

    def route(address: Address) -> Taker | None:
        return partial(truth, address.vehicle) if address.topic.name == "truth" else None

    for block in run.read(chosen, route):
        writers[block.which].take(block)
    rows = sum(writer.rows for writer in writers.values())
    if not rows:
        raise ExportError(f"{run.files.name} has no answered measurement to export")
    file.close()
    damages = [*run.files.unread, *([f"malformed: {malformed.total()} of truth"] if malformed else [])]
    return names, rows, [column.name for group in table for column in group.columns], damages


class _Writer:
    """Writes one session's ticks into a table."""

    def __init__(self, which: SessionKey, file: TableFile, settings: Settings) -> None:
        self.truths: list[tuple[float, ...]] = []  # tick, attitude, rate, voltages
        self.rows = 0
        self._which = which
        self._file = file
        self.actuators = settings.wire.actuators
        self._lockstep = settings.loop.lockstep
        self._reader = TickReader(settings)

    def take(self, block: Block) -> None:
        judged = self._reader.take(block).judged
        if self._lockstep:  # the plant waits for each command
            unknown = np.full(len(judged.k), np.nan)
            judged = judged._replace(latency_ns=unknown, measurement_delay_ns=unknown, command_delay_ns=unknown)
        if len(judged.k):
            self._file.write(Rows(*self._which, judged, self._true_at(judged.k)))
            self.rows += len(judged.k)

    def _true_at(self, k: Integers) -> TruthColumns:
        """Latest truth at each tick. Shapes (n, columns)."""
        columns = 8 + self.actuators
        self.truths.sort()  # a recorder writes late what it recovers
        known = np.array(self.truths, dtype=np.float64).reshape(-1, columns)
        at = np.searchsorted(known[:, 0], k, side="right")
        self.truths = self.truths[max(0, int(at[-1]) - 1) :]
        true = np.vstack([np.full((1, columns), np.nan), known])[at]
        return TruthColumns(true[:, 0], true[:, 1:5], true[:, 5:8], true[:, 8:])


def beside(log: Path, ending: str) -> Path:
    """A log's name, or its folder's, with another ending."""
    if log.is_dir():
        log = log.resolve()  # "." has no name
        return log.with_name(log.name + ending)
    return log.with_name(log.stem + ending)
