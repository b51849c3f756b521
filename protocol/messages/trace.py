"""Trace: what each end did, tick by tick, published in columnar batches that numpy reads.

A batch is a header, the columns of some rows one after another, and a tail in JSON; `SPEC.md`, section 10, defines
every byte. Its times are whole microseconds after the header's `monotonic_ns`, on the end's own monotonic clock; the
clocks of two hosts are never compared.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from functools import lru_cache
from math import prod
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Claim
from aeroloop.protocol.messages.operator import AS_PUBLISHED, Change, Message, in_force
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.wire.spec import MAX_ACTUATORS, WireSpec

Columns = dict[str, npt.NDArray[Any]]
End = Literal["controller", "plant"]
ENDS: Final[tuple[End, ...]] = ("controller", "plant")

TRACE_NS: Final = 100_000_000  # a batch is published so long after its first row: a killed process loses no more
MAX_ROWS: Final = 256
STEPS: Final = ("tick", "session_tick", "answered", "received", "sent")
"""Columns that hold steps from row to row, modulo their type's range: ticks and times rise evenly, so they compress
to a fifth. The first row's step is from 0."""
NEVER: Final = 0xFFFF_FFFF
"""In a column of times or of session ticks: none. Times wrap after 71 minutes, longer than any batch: `due` is checked
after every row."""
RECORD_S: Final = 1.0  # how often a batch has the session's record
_RECORD_BYTES_PER_S: Final = 16_384  # a longer record, of many points, is in as many batches as take this much
_HEADER: Final = struct.Struct("<BBBBHHIIQQqq64s")
HEADER_BYTES: Final = _HEADER.size
_FINAL: Final = 1
_MARGIN_NS: Final = 1_000_000_000  # times start this long before the first row: a command may be received before it


class Sent(IntEnum):
    """What an end did with the frame of a tick: a measurement at the plant, a command at the controller.

    The plant's `received_as` uses it for what was received since the last tick.
    """

    NONE = 0
    FRAME = 1
    SILENT = 2
    MALFORMED = 3  # received with a wrong length; the row has none of its bytes


class Received(IntEnum):
    """The measurement that the controller computed a tick with."""

    FRAME = 0
    SILENT = 1
    LATE = 2  # the frame arrived after its tick, or stale: its levels hold from the next tick on, and nothing is sent
    MALFORMED = 3


class Outcome(IntEnum):
    """What the plant did with the command that it received since the last tick."""

    NONE = 0  # no command was received; the one in force, if any, is held
    ACTED = 1
    MALFORMED = 2
    REPEATED = 3  # its echo is that of the last fresh command, or it answers an older measurement than that did
    STALE = 4  # it answers a measurement that is older than the watchdog's time
    INVALID = 5  # it has no valid value and answers a measurement that has one: the plant trips
    WITHHELD = 6  # by an injected fault


PlantChangeKind = Literal["claim", "release", "arm", "stop", "lost", "expire", "inject"]


class PlantChange(Message):
    """A change at the plant end between two ticks. With the rows, the end's run can be computed again."""

    tick: int = Field(ge=-1, description="the last tick of the plant before it; −1: before the first")
    kind: PlantChangeKind
    claim: Claim | None = Field(default=None, description="claim: as it was granted")
    name: str | None = Field(default=None, description="release: session; lost: controller; inject: fault, null: none")
    cause: TripCause | None = Field(default=None, description="stop, expire: the cause")
    reason: str | None = Field(default=None, description="stop, expire: the reason")


class Tail(Message):
    """Variable-size part of a batch."""

    state: dict[str, Any] | None = Field(
        default=None, description="controller: its state before the batch's first row; a replay can begin there"
    )
    changes: list[Change] = Field(default_factory=list, description="controller: applied before their ticks' rows")
    operations: list[PlantChange] = Field(default_factory=list, description="plant: between its ticks")
    record: list[Change] = Field(
        default_factory=list,
        description="the session's gains and reference in force after the batch's rows, each with the tick since when; "
        "of the plant as the controller's last record has them",
    )


class ControllerRow(NamedTuple):
    """A tick of the controller. Times on its monotonic clock; `sent_ns` is 0 where no command was sent [ns]."""

    tick: int
    received_as: int  # see Received
    sent_as: int  # see Sent
    received_ns: int
    sent_ns: int
    measurement: bytes
    command: bytes


class PlantRow(NamedTuple):
    """A tick of the plant end. Times on its monotonic clock, 0 for none [ns]."""

    tick: int  # since the end's process started
    session_tick: int  # since the session's first measurement
    sent_as: int  # the measurement; see Sent
    received_as: int  # what was received since the last tick; see Sent
    outcome: int  # what was done with it; see Outcome
    trip: int  # number of the TripCause that ended the session at this tick; 0 for none
    answered: int  # session tick that the command in force answers; −1 for none
    sent_ns: int
    received_ns: int
    measurement: bytes
    command: bytes
    voltages: Sequence[float]  # in force from this tick's beginning to the next command [V]


_COLUMNS: Final[dict[End, list[tuple[str, str]]]] = {
    "controller": [("tick", "<u4"), ("received_as", "u1"), ("sent_as", "u1"), ("received", "<u4"), ("sent", "<u4")],
    "plant": [
        ("tick", "<u8"), ("session_tick", "<u4"), ("sent_as", "u1"), ("received_as", "u1"), ("outcome", "u1"),
        ("trip", "u1"), ("answered", "<u4"), ("sent", "<u4"), ("received", "<u4"),
    ],
}  # fmt: skip
"""Types of a row's columns before the frames and, at the plant, the voltages."""
_WIDE: Final = dict.fromkeys(("answered", "sent", "received"), "<i8")
"""Types of columns as they are added: −1 for none, and times in ns."""


@lru_cache(maxsize=16)
def row_dtype(end: End, actuators: int, measurement: int, command: int, *, added: bool = False) -> np.dtype[np.void]:
    """Fields of a row, in the order of the columns; if `added`, as it is added. Sizes of the frames in bytes."""
    columns = [(name, _WIDE.get(name, kind) if added else kind) for name, kind in _COLUMNS[end]]
    frames = [("measurement", f"V{measurement}"), ("command", f"V{command}")]
    voltages = [("voltages", "<f8", (actuators,))] if end == "plant" else []
    return np.dtype([*columns, *frames, *voltages])


class Header(NamedTuple):
    """Header of a batch: what holds for all its rows."""

    end: End
    final: bool  # whether the session's rows end with it
    actuators: int
    measurement_bytes: int  # size of a frame
    command_bytes: int
    rows: int
    tail_bytes: int
    run: int  # a random number of the end's process
    first_row: int  # rows that this process published before this batch, in all its sessions
    monotonic_ns: int  # base of the rows' times, on the end's monotonic clock
    wall_ns: int  # the same instant on the end's wall clock, since 1970
    session: str  # empty where the plant has none

    @property
    def row_dtype(self) -> np.dtype[np.void]:
        """Fields of the rows."""
        return row_dtype(self.end, self.actuators, self.measurement_bytes, self.command_bytes)


class Batch(NamedTuple):
    """A decoded batch. Columns by name have shape (rows,); voltages (rows, actuators)."""

    header: Header
    columns: Columns
    tail: Tail

    def times_ns(self, column: Literal["received", "sent"]) -> npt.NDArray[np.int64]:
        """A column of times on the end's monotonic clock [ns]; −1 where there is none. Shape (rows,)."""
        values = self.columns[column]
        ns = values.astype(np.int64) * 1000 + self.header.monotonic_ns
        return np.where(values == NEVER, -1, ns)


def read_batch(payload: bytes) -> Batch | None:
    """Parse a batch; None if it is malformed: another version, a wrong length, a tail that is no Tail."""
    if len(payload) < HEADER_BYTES:
        return None
    version, end, flags, *figures, name = _HEADER.unpack_from(payload)
    actuators, measurement, command, rows, tail_bytes = figures[:5]
    if version != PROTOCOL_VERSION or end >= len(ENDS) or flags & ~_FINAL or not 1 <= actuators <= MAX_ACTUATORS:
        return None
    if not name.isascii() or not measurement or not command or rows > MAX_ROWS:
        return None
    header = Header._make((ENDS[end], bool(flags & _FINAL), *figures, name.rstrip(b"\0").decode()))
    kinds = header.row_dtype
    if len(payload) != HEADER_BYTES + rows * kinds.itemsize + tail_bytes:
        return None
    try:
        tail = Tail.model_validate_json(payload[-tail_bytes:], context=AS_PUBLISHED) if tail_bytes else Tail()
    except ValidationError:
        return None
    return Batch(header, read_columns(header, payload), tail)


def read_columns(header: Header, payload: bytes) -> Columns:
    """Columns of a well-formed batch, by name; read-only but for those of steps."""
    columns, kinds, at = Columns(), header.row_dtype, HEADER_BYTES
    for field in kinds.names or ():
        kind = kinds[field]
        column = np.frombuffer(payload, kind.base, header.rows * prod(kind.shape), at)
        at += column.nbytes
        columns[field] = np.add.accumulate(column, dtype=kind) if field in STEPS else column.reshape(-1, *kind.shape)
    return columns


class TraceWriter:
    """Buffers one end's rows and packs them into batches. `run` is a random number of this process, 64 bits.

    `session` names the rows' session and is set between batches only; `state`, `changes` and `operations` go into the
    tail of the next batch. `record` is the session's gains and reference in force, as the JSON of `Tail.record`; empty
    for none. A controller's is brought up to date by `take`, from the changes.
    """

    def __init__(self, end: End, wire: WireSpec, run: int) -> None:
        self.end: End = end
        self.session = ""
        self.state: dict[str, Any] | None = None
        self.changes: list[Change] = []
        self.operations: list[PlantChange] = []
        self.record = b""
        self._in_force: list[Change] = []
        self._record_due_ns = 0
        self._wire = wire
        self._rows: list[ControllerRow | PlantRow] = []
        self._run = run
        self._published = 0
        self._base_ns = 0
        self._first_ns = 0  # of the first row that is buffered, on this end's monotonic clock

    @property
    def empty(self) -> bool:
        """Whether nothing is buffered."""
        return not (self._rows or self.changes or self.operations)

    def due(self, now_ns: int) -> bool:
        """Whether a batch is to be published: the buffer is full, or its first row is `TRACE_NS` old."""
        if self._rows:
            return len(self._rows) >= MAX_ROWS or now_ns - self._first_ns >= TRACE_NS
        return not self.empty

    def row(self, row: ControllerRow | PlantRow) -> None:
        """Add a row of this end; at most MAX_ROWS until `take`."""
        if not self._rows:
            first_ns = row.received_ns if isinstance(row, ControllerRow) else row.sent_ns or row.received_ns
            self._first_ns = first_ns
            # A plant that was halted may act on a command that it received long before: no time is before the base.
            self._base_ns = min(first_ns - _MARGIN_NS, row.received_ns or first_ns)
        self._rows.append(row)

    def take(self, now_ns: int, wall_ns: int, *, final: bool = False) -> bytes:
        """Pack all that is buffered into a batch, and clear the buffer. If `final`, the session's rows end here.

        `now_ns` is the end's monotonic clock now [ns], `wall_ns` its wall clock now [ns since 1970].
        """
        rows = self._rows
        base_ns = self._base_ns if rows else now_ns
        tail = Tail(state=self.state, changes=self.changes, operations=self.operations)
        parts = [tail.model_dump_json(include={name})[1:-1].encode() for name, value in tail if value]
        if record := self._due_record(now_ns):
            parts.append(b'"record":' + record)
        text = b"{" + b",".join(parts) + b"}" if parts else b""
        wire = self._wire
        sizes = wire.actuators, wire.measurement.size, wire.command.size
        counts = len(rows), len(text), self._run, self._published
        session = self.session.encode("ascii")
        flags, wall_base_ns = _FINAL if final else 0, wall_ns - (now_ns - base_ns)
        head = PROTOCOL_VERSION, ENDS.index(self.end), flags, *sizes, *counts, base_ns, wall_base_ns, session
        added, kinds = np.array(rows, row_dtype(self.end, *sizes, added=True)), row_dtype(self.end, *sizes)
        columns = []
        for name in kinds.names or ():
            column = added[name]
            if name in ("received", "sent"):
                column = np.where(column, (column - base_ns) // 1000, NEVER)
            if name in STEPS:
                column = np.diff(column.astype(kinds[name]), prepend=kinds[name].type(0))
            columns.append(column.tobytes())
        self._published += len(rows)
        self._rows = []
        self.state, self.changes, self.operations = None, [], []
        return b"".join([_HEADER.pack(*head), *columns, text])

    def _due_record(self, now_ns: int) -> bytes:
        """Bring the controller's record up to date, and return the record if it is due."""
        if self.changes:
            before = [change for change in self._in_force if change.session == self.session]
            self._in_force = in_force([*before, *self.changes])
            self.record = record_json(self._in_force)
            soon = now_ns + round(1e9 * RECORD_S)  # this batch has the changes themselves
            self._record_due_ns = min(self._record_due_ns or soon, soon)
        if not (self.session and self.record) or now_ns < self._record_due_ns:
            return b""
        self._record_due_ns = now_ns + round(1e9 * max(RECORD_S, len(self.record) / _RECORD_BYTES_PER_S))
        return self.record


def record_json(changes: Sequence[Change]) -> bytes:
    """Changes in force as `TraceWriter.record` has them; empty for none."""
    return b"[" + b",".join(change.encode() for change in changes) + b"]" if changes else b""
