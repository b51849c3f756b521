"""Export of a log as a table.

A table has a row for each tick that a review judges: what the controller received and computed at it (see `Ticks`), and
the emulator's latest truth. Parquet has each column's unit and description in its field's metadata, and the
configuration in the file's; CSV has a header row only, and 1 and 0 for booleans.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any, Final, Literal

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from aeroloop.protocol.runtime.host import versions
from aeroloop.service.config import ConfigError
from aeroloop.service.logs.columns import Column, columns_of
from aeroloop.service.logs.copies import Exported, ExportError, beside, events_named
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.session import SessionKey
from aeroloop.service.logs.ticks import recompute, with_known_law

Format = Literal["parquet", "csv"]

AT_A_TIME: Final = 1 << 16  # rows that are turned into columns at a time


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
    """Write a session's ticks as a table.

    The new file has the first log's name with another ending if `out` is None. Session and vehicle are as of
    `Recording.choose`, times are the law's. `around` is an event, as of `events_named`, and how many seconds before and
    after it are exported.

    Raises:
        ExportError: There is nothing to export, or no such event.
        OutputError: The file must not be written, or cannot.
        ReviewError: The log cannot be read.
    """
    if around is not None and (since_s, until_s) != (-inf, inf):
        raise ExportError("--around chooses the time that is exported, and so do --from and --to: give one of them")
    out, events = out or beside(paths, f".{to}"), []
    try:
        with writing(out, paths, force=force) as part:
            recording = Recording(paths, progress)
            which = recording.choose(session, vehicle)
            if around is not None:
                of_sessions = recording.extents if session is None else [which]
                named = events_named(recording, around[0], vehicle)
                events = [(one, its) for one, its, _ in named if one.tick is not None and its in of_sessions]
                if not events:
                    raise ExportError(f"{'/'.join(which)} has no event {around[0]!r}")
                event, which = events[0]
                at_s = (event.tick or 0) * recording.settings(which).loop.period
                since_s, until_s = at_s - around[1], at_s + around[1]
            rows, columns, law_unknown = _write_table(recording, to, part, which, (since_s, until_s))
            size = part.stat().st_size
    except ConfigError as error:
        raise ExportError(f"{paths[0]} is not a log of this version: {error}") from None
    return Exported(
        out=str(out), format=to, sessions=["/".join(which)], rows=rows, columns=columns, bytes=size,
        damages=recording.unread,
        unknown=[one for one in recording.unknown if (one.vehicle, one.session) == which],
        left_out=["/".join(other) for other in recording.extents if other != which],
        law_unknown=law_unknown, around=[one.text for one, _ in events],
    )  # fmt: skip


def _write_table(
    recording: Recording, to: Format, part: Path, which: SessionKey, times_s: tuple[float, float]
) -> tuple[int, list[str], str | None]:
    """Write a table, some rows at a time.

    Returns its number of rows, its columns' names, and why it lacks those of the law, if it does.
    """
    session, law_unknown = with_known_law(recording.session(which, *times_s))
    truths = recording.true_states(which, session.settings.wire.actuators)
    ticks = recompute(session).ticks
    if not len(ticks.k):
        raise ExportError(f"{recording.name} has no answered measurement to export")
    pieces = (ticks.where(slice(begin, begin + AT_A_TIME)) for begin in range(0, len(ticks.k), AT_A_TIME))
    facts = {
        "config": session.settings.description(),
        "sessions": ["/".join(which)],
        "logs": [str(path) for path in recording.paths],
        "recorded_by": {role: found.versions for role, found in session.descriptions.items()},
        "exported_by": versions(),
    }
    fields = [
        pa.field(column.name, _array(column).type, True, {"unit": column.unit, "description": column.description})
        for column in columns_of(which, ticks.where(slice(1)), truths, session.settings)
    ]
    schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
    if to == "csv":  # RFC 4180; numbers have all their digits. A reader takes `true` beside an empty cell for text
        schema = pa.schema([field.with_type(pa.int8()) if field.type == pa.bool_() else field for field in schema])
        options = pyarrow.csv.WriteOptions(eol="\r\n", quoting_header="none")
        writer: Any = pyarrow.csv.CSVWriter(part, schema, write_options=options)
    else:  # a dictionary of doubles makes the file a third larger and its writing slower, quantized or not
        texts = [field.name for field in schema if field.type == pa.string()]
        writer = pyarrow.parquet.ParquetWriter(part, schema, compression="zstd", use_dictionary=texts)
    with writer:
        for piece in pieces:
            columns = columns_of(which, piece, truths, session.settings)
            writer.write_batch(pa.RecordBatch.from_arrays([*map(_array, columns)], schema.names).cast(schema))
    return len(ticks.k), schema.names, law_unknown


def _array(column: Column) -> Any:
    """A column of an Arrow table; NaN is null."""
    values = pa.array(column.values, from_pandas=True)
    return values.cast(pa.bool_()) if column.boolean else values
