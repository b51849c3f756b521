"""Export of a log as a table, or as a log with everything decoded.

A table has a row for each tick that a review judges: what the controller received and computed at it (see `Ticks`), and
the emulator's latest truth. All formats have the same columns by the same names, each ending in its unit. Parquet has
each column's unit and description in its field's metadata, and the configuration in the file's; a MATLAB file has them
in the fields `units`, `descriptions` and `config` of its struct; CSV has a header row only, and 1 and 0 for booleans.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.runtime.host import versions
from aeroloop.service.config import ConfigError, Settings
from aeroloop.service.control.laws.registry import initial_state, law_of
from aeroloop.service.logs.copies import write_decoded
from aeroloop.service.logs.outputs import writing
from aeroloop.service.logs.recording import Progress, Recording
from aeroloop.service.logs.session import Array, SessionKey, TrueStates, Unknown
from aeroloop.service.logs.ticks import Ticks, euler_deg, recompute

Format = Literal["parquet", "csv", "mat", "mcap"]

AT_A_TIME: Final = 1 << 16
"""Rows that are turned into columns at a time."""

MAT_LIMIT: Final = 2**31 - 1
"""Bytes that a variable of a MATLAB v5 file may have."""


Kind = Literal["double", "int64", "int8", "bool", "string"]
"""Type of a column's values, by Arrow's name."""

AXES: Final = ("x", "y", "z")
EULER: Final = ("roll", "pitch", "yaw")

_PLAIN: Final = str.maketrans({"·": "", "/": "_", "²": "2", "°": "deg", " ": ""})
"""Characters of a unit in a column's name."""


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


def export(
    paths: Sequence[Path],
    to: Format,
    out: Path | None = None,
    *,
    session: str | None = None,
    vehicle: str | None = None,
    since_s: float = -inf,
    until_s: float = inf,
    force: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write a run's ticks as a table, or all of it as a log with everything decoded.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        to: Format.
        out: The file; the first log's name with another ending if None.
        session: As of `Recording.choose`, or `all` of the vehicle.
        vehicle: As of `Recording.choose`.
        since_s: From when on, on the law's clock [s].
        until_s: Until when [s].
        force: Replace an existing file, unless it is a log.
        progress: Called repeatedly with the share done, 0…1.

    Raises:
        ExportError: There is nothing to export.
        OutputError: The file must not be written, or cannot.
        ReviewError: The log cannot be read.
    """
    log = paths[0].resolve() if paths[0].is_dir() else paths[0]  # "." has no name
    stem = log.name if log.is_dir() else log.stem
    out = out or log.with_name(stem + ("-decoded.mcap" if to == "mcap" else f".{to}"))
    chosen: list[SessionKey] = []
    try:
        with writing(out, paths, force=force) as part:
            recording = Recording(paths, progress)
            if to == "mcap":
                if (session, vehicle, since_s, until_s) != (None, None, -inf, inf):
                    raise ExportError(
                        "--session, --vehicle, --from and --to choose the rows of a table; --format mcap writes all of "
                        "the log"
                    )
                rows, columns, damages = write_decoded(recording, part, progress)
            else:
                first = recording.choose(None if session == "all" else session, vehicle)
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
    )


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
        pa.field(
            column.name, pa.type_for_alias(column.kind), True, {"unit": column.unit, "description": column.description}
        )
        for column in first
    ]
    schema = pa.schema(fields, {f"aeroloop.{name}": json.dumps(fact) for name, fact in facts.items()})
    batches = (pa.RecordBatch.from_arrays(list(map(_values, one)), schema=schema) for one in chain([first], pieces))
    rows = _write_mat(part, schema, batches) if to == "mat" else _write_arrow(part, schema, batches, csv=to == "csv")
    damages = [*recording.unread, *([f"malformed: {malformed} of truth"] if malformed else [])]
    return rows, [column.name for column in first], damages


def _pieces(
    recording: Recording, chosen: Sequence[SessionKey], times_s: tuple[float, float], states: TrueStates
) -> Iterator[list[Column]]:
    """The columns of some sessions of one vehicle, some rows at a time; a signal of any of them is a column of all."""
    signals = {which: states.signals(which[1]) for which in chosen}
    names = sorted({name for its in signals.values() for name in its})
    for which in chosen:
        truth = states.rows(which[1])
        unknown = np.full(len(truth), np.nan)
        truth = np.column_stack([truth, *(signals[which].get(name, unknown) for name in names)])
        truth = np.insert(truth, 0, np.nan, axis=0)
        session = recording.session(which, *times_s)
        ticks = recompute(session).ticks
        for begin in range(0, len(ticks.k), AT_A_TIME):
            some = ticks.where(slice(begin, begin + AT_A_TIME))
            at = np.searchsorted(truth[1:, 0], some.k, side="right")  # 0: before the first
            yield columns_of(which, some, truth[at], session.settings, names)


# ── columns ──


class Column(NamedTuple):
    """A column and its values, NaN where a double is missing. Shape (n,).

    Its name ends in its unit; the unit is `1` for a number without, empty for what is no quantity.
    """

    name: str
    unit: str
    description: str
    values: npt.NDArray[Any]
    kind: Kind = "double"


def columns_of(
    which: SessionKey, ticks: Ticks, truth: Array, settings: Settings, signals: Sequence[str] = ()
) -> list[Column]:
    """Every column of the table of some ticks of a session, with the latest true state at each; NaN before the first.

    A row of `truth` is a tick, q, ω, the motors' voltages and the plant's `signals`: (n, 8 + actuators + signals).
    """
    wire, period = settings.wire, settings.loop.period
    n = len(ticks.k)
    motors = list(map(str, wire.motors))
    outermost = {name: getattr(wire, name).quantizer().outermost for name in ("attitude", "rate", "voltage")}
    # ε as received is not known where ‖ε‖ > 1: it was scaled to unit length, with η = 0 (Remark 2)
    received = np.where(ticks.attitude[:, :1] == 0.0, np.nan, ticks.attitude[:, 1:])
    lengths = np.sqrt(np.sum(np.square(ticks.attitude_error), axis=1))
    found = [
        Column("tick", "", "tick k of the law", ticks.k, "int64"),
        Column("time_s", "s", "the law's time, k times the period", ticks.k * period),
        Column("published_ns", "ns", "when the measurement was sent, on the plant's clock since 1970", ticks.wall_ns,
               "int64"),
        Column("vehicle", "", "name of the vehicle", np.full(n, which[0], dtype=object), "string"),
        Column("session", "", "name of the session", np.full(n, which[1], dtype=object), "string"),
        *_attitude("", "as measured", ticks.attitude),
        *_attitude("desired_", "as desired", ticks.desired),
        *_by("rate_{}_rad_s", "rad/s", "ω as measured, body frame, about {}", ticks.rate, AXES),
        *_by("desired_rate_{}_rad_s", "rad/s", "ω as desired, body frame, about {}", ticks.desired_rate, AXES),
        *_by("attitude_error_{}", "1", "ε̃ of the attitude as measured, {}", ticks.attitude_error, AXES),
        *_by("rate_error_{}_rad_s", "rad/s", "ω_e, body frame, about {}", ticks.rate_error, AXES),
        Column("error_angle_deg", "deg", "angle of the attitude error",
               np.degrees(2 * np.arcsin(np.minimum(1.0, lengths)))),
        *_by("voltage_{}_V", "V", "u{} as commanded; none where no command answered", ticks.voltages, motors),
        Column("latency_us", "µs", "from the measurement to the command that answers it, on the plant's clock",
               ticks.latency_ns * 1e-3),
        Column("measurement_delay_us", "µs", "from the plant to the controller, if both ways are equally fast",
               ticks.measurement_delay_ns * 1e-3),
        Column("command_delay_us", "µs", "from the controller to the plant, likewise", ticks.command_delay_ns * 1e-3),
        *_by("saturated_attitude_{}", "", "whether ε has the quantizer's outermost level, {}; unknown where η = 0",
             _reaches(received, outermost["attitude"]), AXES, "bool"),
        *_by("saturated_rate_{}", "", "whether ω has the quantizer's outermost level, {}",
             _reaches(ticks.rate, outermost["rate"]), AXES, "bool"),
        *_by("saturated_voltage_{}", "", "whether u{} has the quantizer's outermost level",
             _reaches(ticks.voltages, outermost["voltage"]), motors, "bool"),
    ]  # fmt: skip
    law, since = law_of(settings.law, period, wire.actuators), 0
    for name, initial in initial_state(law).items():
        until, unit = since + len(initial), law.units.get(name, "1")
        # by axis if it is three numbers, else counted
        axes = {1: [""], 3: [f"_{axis}" for axis in AXES]}.get(len(initial), [f"_{i + 1}" for i in range(len(initial))])
        suffix = "" if unit == "1" else "_" + unit.translate(_PLAIN)
        state = ticks.state[:, since:until]
        found += _by(f"{name}{{}}{suffix}", unit, f"{name} as the law used it, {{}}", state, axes)
        since = until
    return [
        *found,
        *_by("unquantized_voltage_{}_V", "V", "u{} before quantization", ticks.unquantized, motors),
        *_attitude("truth_", "as the emulator had it", truth[:, 1:5]),
        *_by("truth_rate_{}_rad_s", "rad/s", "ω as the emulator had it, about {}", truth[:, 5:8], AXES),
        *_by("truth_voltage_{}_V", "V", "at the emulator's motor {}", truth[:, 8 : 8 + len(motors)], motors),
        *_by("plant_{}", "", "{}, the plant's own signal", truth[:, 8 + len(motors) :], signals),
        Column("truth_age_s", "s", "from the tick of the truth to this one", (ticks.k - truth[:, 0]) * period),
    ]


def _by(name: str, unit: str, what: str, values: Array, axes: Sequence[str], kind: Kind = "double") -> Iterator[Column]:
    """A column per axis, which replaces the braces in its name and description."""
    for axis, column in zip(axes, values.T, strict=True):
        yield Column(name.format(axis), unit, what.format(axis), column, kind)


def _attitude(prefix: str, which: str, q: Array) -> Iterator[Column]:
    for i, part in enumerate(("η", "ε₁", "ε₂", "ε₃")):
        yield Column(f"{prefix}q{i}", "1", f"{part} {which}", q[:, i])
    yield from _by(f"{prefix}{{}}_deg", "deg", f"{{}} {which}, by Z–Y–X", euler_deg(q), EULER)


def _reaches(values: Array, level: float) -> Array:
    return np.where(np.isnan(values), np.nan, np.abs(values) >= level)


# ── files ──


def _values(column: Column) -> Any:
    """A column of an Arrow table; NaN is null."""
    values = column.values
    gaps = np.isnan(values) if values.dtype == np.float64 else None
    if column.kind == "bool":
        values = np.nan_to_num(values).astype(np.bool_)
    return pa.array(values, pa.type_for_alias(column.kind), mask=gaps)


def _write_arrow(path: Path, schema: Any, batches: Iterator[Any], *, csv: bool) -> int:
    """Write Parquet or CSV; returns the number of rows.

    CSV is as of RFC 4180. A number has enough digits to be read back exactly; a missing one is empty. Its booleans are
    numbers: a reader that guesses types takes `true` beside an empty cell for text.
    """
    if csv:
        schema = pa.schema([field.with_type(pa.int8()) if field.type == pa.bool_() else field for field in schema])
        options = pyarrow.csv.WriteOptions(eol="\r\n", quoting_header="none")
        writer: Any = pyarrow.csv.CSVWriter(path, schema, write_options=options)
    else:  # a dictionary of doubles makes the file a third larger and its writing slower, quantized or not
        texts = [field.name for field in schema if field.type == pa.string()]
        writer = pyarrow.parquet.ParquetWriter(path, schema, compression="zstd", use_dictionary=texts)
    rows = 0
    with writer:
        for batch in batches:
            writer.write_batch(batch.cast(schema))
            rows += len(batch)
    return rows


def _write_mat(path: Path, schema: Any, batches: Iterator[Any]) -> int:
    """Write a struct `aeroloop`, with a column vector of doubles for each column; returns the number of rows.

    Missing values are NaN. `published_ns` is int64, as a double does not hold it. `vehicle` and `session` are numbers,
    from 1, into the lists `vehicles` and `sessions`.
    """
    import scipy.io  # slow to import, and needed here only

    table, struct = pa.Table.from_batches(batches, schema), dict[str, Any]()
    for field, column in zip(schema, table.columns, strict=True):
        if field.type == pa.string():
            texts = column.combine_chunks().dictionary_encode()
            struct[f"{field.name}s"] = np.array(texts.dictionary.to_pylist(), dtype=object)
            column = pa.array(texts.indices.to_numpy() + 1)
        struct[field.name] = column.cast(pa.int64() if field.name == "published_ns" else pa.float64()).to_numpy()
    if (size := sum(values.nbytes for values in struct.values())) > MAT_LIMIT:
        raise ExportError(
            f"a MATLAB file holds 2 GiB, and these rows take {size / 2**30:.1f} GiB; use --format parquet, "
            "which MATLAB reads by parquetread"
        )
    for name in ("unit", "description"):
        struct[f"{name}s"] = {field.name: field.metadata[name.encode()].decode() for field in schema}
    facts = {key.decode().removeprefix("aeroloop."): value.decode() for key, value in schema.metadata.items()}
    struct |= {name: fact for name, fact in facts.items() if name not in struct}
    with path.open("wb") as file:
        scipy.io.savemat(file, {"aeroloop": struct}, long_field_names=True, oned_as="column")
    return int(table.num_rows)
