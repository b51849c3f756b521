"""Export of a log as a table, or as a log with everything decoded.

A table has a row for each tick that a review judges: what the controller received and computed at it (see `Ticks`), and
the emulator's latest truth. Parquet has each column's unit and description in its field's metadata, and the
configuration in the file's; CSV has a header row only, and 1 and 0 for booleans.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, Final, Literal

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import Event
from aeroloop.protocol.messages.trace import RECORD_S
from aeroloop.protocol.runtime.host import versions
from aeroloop.service.config import ConfigError
from aeroloop.service.logs.columns import Column, columns_of, latest_truth
from aeroloop.service.logs.copies import write_decoded
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.session import SessionKey, TrueStates, Unknown
from aeroloop.service.logs.ticks import recompute

Format = Literal["parquet", "csv", "mcap"]

AT_A_TIME: Final = 1 << 16  # rows that are turned into columns at a time


_BEFORE_NS: Final = round(1.2e9 * RECORD_S)


class ExportError(AeroloopError):
    """A log cannot be exported; one line with the reason."""


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
    left_out: list[str] = Field(default=[], description="other sessions of the log that the table does not have")
    around: list[str] = Field(default=[], description="events that `around` names; the export is around the first")


def export(
    paths: Sequence[Path],
    to: Format,
    out: Path | None = None,
    *,
    session: str | None = None,
    vehicle: str | None = None,
    since_s: float = -inf,
    until_s: float = inf,
    around: tuple[str, float] | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write a run's ticks as a table, or all of it as a log with everything decoded.

    The new file has the first log's name with another ending if `out` is None. Session and vehicle are as of
    `Recording.choose`, or all sessions of the vehicle; times are the law's. `around` is an event, `trip`, `fault`,
    `mark` or words of a mark, and how many seconds before and after it are exported.

    Raises:
        ExportError: There is nothing to export, or no such event.
        OutputError: The file must not be written, or cannot.
        ReviewError: The log cannot be read.
    """
    if to == "mcap" and (session, vehicle, since_s, until_s) != (None, None, -inf, inf):
        raise ExportError(
            "--session, --vehicle, --from and --to choose the rows of a table; --format mcap writes all of the log"
        )
    if around is not None and (since_s, until_s) != (-inf, inf):
        raise ExportError("--around chooses the time that is exported, and so do --from and --to: give one of them")
    log = paths[0].resolve() if paths[0].is_dir() else paths[0]  # "." has no name
    stem = log.name if log.is_dir() else log.stem
    out = out or log.with_name(stem + ("-decoded.mcap" if to == "mcap" else f".{to}"))
    chosen, events = list[SessionKey](), list[tuple[Event, SessionKey, int]]()
    try:
        with writing(out, paths, force=force) as part:
            recording = Recording(paths, progress)
            if around is not None:
                events = _events(recording, around[0], vehicle, tick=to != "mcap")
            if to == "mcap":
                span_ns = None
                if around is not None:  # from earlier on, so that it has a record of what was in force
                    at_ns, half_ns = events[0][2], round(around[1] * 1e9)
                    span_ns = at_ns - half_ns - _BEFORE_NS, at_ns + half_ns
                rows, columns, damages = write_decoded(recording, part, progress, span_ns)
            else:
                first = recording.choose(None if session == "all" else session, vehicle)
                if around is not None:
                    events = [one for one in events if session is None or one[1] == first]
                    if not events:
                        raise ExportError(f"{'/'.join(first)} has no event {around[0]!r}")
                    first, at_s = events[0][1], (events[0][0].tick or 0) * recording.settings(events[0][1]).loop.period
                    since_s, until_s = at_s - around[1], at_s + around[1]
                chosen = recording.sessions_of(first[0]) if session == "all" else [first]
                rows, columns, damages = _write_table(recording, to, part, chosen, (since_s, until_s))
            size = part.stat().st_size
    except ConfigError as error:
        raise ExportError(f"{paths[0]} is not a log of this version: {error}") from None
    return Exported(
        out=str(out),
        format=to,
        sessions=None if to == "mcap" else ["/".join(which) for which in chosen],
        rows=rows,
        columns=columns,
        bytes=size,
        damages=damages,
        unknown=[one for one in recording.unknown if (one.vehicle, one.session) in chosen],
        left_out=["/".join(which) for which in recording.extents if chosen and which not in chosen],
        around=[one.text for one, *_ in events],
    )


def _events(recording: Recording, what: str, vehicle: str | None, *, tick: bool) -> list[tuple[Event, SessionKey, int]]:
    """Events that are so named, each with its session and when it was recorded [ns]; with a `tick` if that is wanted.

    Raises ExportError if there is none.
    """
    found, kind = list[tuple[Event, SessionKey, int]](), {"trip": "tripped", "mark": "marked"}.get(what, what)
    for address, message in recording.messages:
        if address.topic.name == "event" and vehicle in (None, address.vehicle):
            with suppress(ValueError):  # malformed, which a review counts
                event = Event.model_validate_json(message.data)
                which = (address.vehicle, event.session or "")
                named = event.kind == kind or (event.kind == "marked" and what in event.text)
                if named and (not tick or (event.tick is not None and which in recording.extents)):
                    found.append((event, which, message.log_time))
    if not found:
        raise ExportError(f"{recording.name} has no event {what!r}: name trip, fault, mark, or words of a mark")
    return found


def _write_table(
    recording: Recording, to: Format, part: Path, chosen: Sequence[SessionKey], times_s: tuple[float, float]
) -> tuple[int, list[str], list[str]]:
    """Write a table; returns its number of rows, its columns' names, and what could not be read."""
    facts = {
        "config": recording.settings(chosen[0]).description(),
        "sessions": ["/".join(which) for which in chosen],
        "logs": [str(path) for path in recording.paths],
        "recorded_by": {role: found.versions for role, found in recording.described(chosen[0]).items()},
        "exported_by": versions(),
    }
    states, malformed = TrueStates({which[1]: recording.settings(which).wire.actuators for which in chosen}), 0
    for address, message in recording.messages:
        try:
            if (address.topic.name, address.vehicle) == ("truth", chosen[0][0]):
                states.add(message.data)
        except ValueError:
            malformed += 1
    pieces = _pieces(recording, chosen, times_s, states)
    if (first := next(pieces, None)) is None:
        raise ExportError(f"{recording.name} has no answered measurement to export")
    fields = [
        pa.field(column.name, _array(column).type, True, {"unit": column.unit, "description": column.description})
        for column in first
    ]
    schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
    if to == "csv":  # RFC 4180; numbers have all their digits. A reader takes `true` beside an empty cell for text
        schema = pa.schema([field.with_type(pa.int8()) if field.type == pa.bool_() else field for field in schema])
        options = pyarrow.csv.WriteOptions(eol="\r\n", quoting_header="none")
        writer: Any = pyarrow.csv.CSVWriter(part, schema, write_options=options)
    else:  # a dictionary of doubles makes the file a third larger and its writing slower, quantized or not
        texts = [field.name for field in schema if field.type == pa.string()]
        writer = pyarrow.parquet.ParquetWriter(part, schema, compression="zstd", use_dictionary=texts)
    rows = 0
    with writer:
        for one in chain([first], pieces):
            batch = pa.RecordBatch.from_arrays([*map(_array, one)], [column.name for column in one])
            writer.write_batch(batch.cast(schema))
            rows += len(batch)
    damages = [*recording.unread, *([f"malformed: {malformed} of truth"] if malformed else [])]
    return rows, [column.name for column in first], damages


def _pieces(
    recording: Recording, chosen: Sequence[SessionKey], times_s: tuple[float, float], states: TrueStates
) -> Iterator[list[Column]]:
    """The columns of some sessions of one vehicle, some rows at a time; a signal of any of them is a column of all."""
    names = sorted({name for which in chosen for name in states.signals(which[1])})
    for which in chosen:
        session = recording.session(which, *times_s)
        ticks = recompute(session).ticks
        for begin in range(0, len(ticks.k), AT_A_TIME):
            some = ticks.where(slice(begin, begin + AT_A_TIME))
            yield columns_of(which, some, latest_truth(states, which[1], names, some.k), session.settings, names)


def _array(column: Column) -> Any:
    """A column of an Arrow table; NaN is null."""
    values = pa.array(column.values, from_pandas=True)
    return values.cast(pa.bool_()) if column.boolean else values
