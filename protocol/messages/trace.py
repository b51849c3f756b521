"""Trace: what each end did, tick by tick, published in columnar batches that numpy reads.

An end adds a row at every tick of a session. Rows gather in a preallocated buffer, as records; a batch turns them into
columns, which compress to two thirds of the records' size:

    header (112 bytes) · columns, one after another · tail (JSON)

`SPEC.md`, section 10, defines every byte, with golden vectors. Both writers are sans-I/O: the owner passes times and
publishes what `take` returns. Times in rows are whole microseconds after the header's `monotonic_ns`, on the end's own
monotonic clock; the clocks of two hosts are never compared.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field, ValidationError

from aeroloop.protocol.messages.models import PROTOCOL_VERSION, Claim
from aeroloop.protocol.messages.operator import Change, Message, in_force
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.wire.spec import MAX_ACTUATORS, LoopSettings, WireSpec

if TYPE_CHECKING:
    import numpy.typing as npt

End = Literal["controller", "plant"]
ENDS: Final[tuple[End, ...]] = ("controller", "plant")

MAX_ROWS: Final = 256
"""Rows of a batch at the most."""

STEPS: Final = ("tick", "session_tick", "answered", "received", "sent")
"""Columns that hold steps from row to row, modulo their type's range: ticks and times rise evenly, so they compress
to a fifth. The first row's step is from 0."""

NEVER: Final = 0xFFFF_FFFF
"""In a column of times or of session ticks: none."""

_BATCHES_BEYOND: Final = 1.25
"""Factor for batches beyond those of a steady loop: sessions that begin and end, operations between them."""

_FASTEST_HZ: Final = 10_000.0
"""Bound on the tick rate in lockstep, where the grid's rate does not apply."""

_HEADER: Final = struct.Struct("<BBBBHHIIQQqq64s")
HEADER_BYTES: Final = _HEADER.size
_FINAL: Final = 1
_MARGIN_NS: Final = 1_000_000_000
"""A batch's times start this long before its first row: a command may be received before the row begins."""

RECORD_S: Final = 1.0
"""How often a batch has the session's record [s]."""
_RECORD_BYTES_PER_S: Final = 16_384
"""A longer record, of many points, is in as many batches as take this much. A cache of a minute has the longest."""

_MASK: Final = 0xFFFF_FFFF
"""Times wrap after 71 minutes, longer than any batch: `due` is checked after every row."""


class Sent(IntEnum):
    """What an end did with the frame of a tick: a measurement at the plant, a command at the controller.

    The plant's `received_as` uses it for what was received since the last tick.
    """

    NONE = 0
    FRAME = 1
    SILENT = 2
    MALFORMED = 3
    """Received with a wrong length; the row has none of its bytes."""


class Received(IntEnum):
    """The measurement that the controller computed a tick with."""

    FRAME = 0
    SILENT = 1
    LATE = 2
    """The frame arrived after its tick, or stale: its levels hold from the next tick on, and nothing is sent."""
    MALFORMED = 3


class Outcome(IntEnum):
    """What the plant did with the command that it received since the last tick."""

    NONE = 0
    """No command was received; the one in force, if any, is held."""
    ACTED = 1
    MALFORMED = 2
    REPEATED = 3
    """Its echo is that of the last fresh command, or it answers an older measurement than that did."""
    STALE = 4
    """It answers a measurement that is older than the watchdog's time."""
    INVALID = 5
    """It has no valid value and answers a measurement that has one: the plant trips."""
    WITHHELD = 6
    """Withheld by an injected fault."""


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


_COLUMNS: Final[dict[End, dict[str, str]]] = {
    "controller": {"tick": "I", "received_as": "B", "sent_as": "B", "received": "I", "sent": "I"},
    "plant": {
        "tick": "Q",
        "session_tick": "I",
        "sent_as": "B",
        "received_as": "B",
        "outcome": "B",
        "trip": "B",
        "answered": "I",
        "sent": "I",
        "received": "I",
    },
}
"""Types of a row's columns, as `struct` and numpy name them, before the frames and, at the plant, the voltages."""


def row_dtype(end: End, measurement: int, command: int, actuators: int) -> np.dtype[np.void]:
    """Fields of a row, in the order of the columns. Sizes of the frames in bytes."""
    frames = [("measurement", f"V{measurement}"), ("command", f"V{command}")]
    voltages = [("voltages", "<f8", (actuators,))] if end == "plant" else []
    return np.dtype([*((name, f"<{kind}") for name, kind in _COLUMNS[end].items()), *frames, *voltages])


class Header(NamedTuple):
    """Header of a batch: what holds for all its rows.

    Attributes:
        end: Which end.
        final: Whether the session's rows end with it.
        actuators: Number of motors.
        measurement_bytes: Size of a measurement frame.
        command_bytes: Size of a command frame.
        rows: Rows in it.
        tail_bytes: Size of its tail.
        run: A random number of the end's process.
        first_row: Rows that this process published before this batch, in all its sessions.
        monotonic_ns: Base of the rows' times, on the end's monotonic clock [ns].
        wall_ns: The same instant on the end's wall clock [ns since 1970].
        session: Name of the session; empty where the plant has none.
    """

    end: End
    final: bool
    actuators: int
    measurement_bytes: int
    command_bytes: int
    rows: int
    tail_bytes: int
    run: int
    first_row: int
    monotonic_ns: int
    wall_ns: int
    session: str


class Batch(NamedTuple):
    """A decoded batch.

    Attributes:
        header: Its header.
        columns: A structured scalar with one field a column, each of shape (rows,) or (rows, actuators).
        tail: Its variable-size part.
    """

    header: Header
    columns: np.void
    tail: Tail

    def times_ns(self, column: Literal["received", "sent"]) -> npt.NDArray[np.int64]:
        """A column of times on the end's monotonic clock [ns]; −1 where there is none. Shape (rows,)."""
        values: npt.NDArray[np.uint32] = self.columns[column]
        ns = values.astype(np.int64) * 1000 + self.header.monotonic_ns
        return np.where(values == NEVER, -1, ns)


def read_header(payload: bytes) -> Header | None:
    """Parse a batch's header; None if it is malformed or of another version."""
    if len(payload) < HEADER_BYTES:
        return None
    version, end, flags, *figures, name = _HEADER.unpack_from(payload)
    actuators, measurement, command = figures[:3]
    session = _name(name)
    if version != PROTOCOL_VERSION or end >= len(ENDS) or flags & ~_FINAL or not 1 <= actuators <= MAX_ACTUATORS:
        return None
    if session is None or not measurement or not command:
        return None
    return Header._make((ENDS[end], bool(flags & _FINAL), *figures, session))


@lru_cache(maxsize=16)
def _name(padded: bytes) -> str | None:
    """Decode a session's name; None if it is not ASCII."""
    try:
        return padded.rstrip(b"\0").decode("ascii")
    except UnicodeDecodeError:
        return None


def read_batch(payload: bytes) -> Batch | None:
    """Parse a batch; None if it is malformed: another version, a wrong length, a tail that is no Tail."""
    header = read_header(payload)
    if header is None or header.rows > MAX_ROWS or len(payload) != batch_bytes(header):
        return None
    try:
        tail = Tail.model_validate_json(payload[-header.tail_bytes :]) if header.tail_bytes else Tail()
    except ValidationError:
        return None
    dtype = _columns_dtype(header.end, header.measurement_bytes, header.command_bytes, header.actuators, header.rows)
    columns: np.void = np.frombuffer(bytearray(payload), dtype, 1, HEADER_BYTES)[0]
    assert dtype.names is not None
    for name in dtype.names:
        if name in STEPS:
            column = columns[name]
            np.add.accumulate(column, out=column)
    return Batch(header, columns, tail)


def batch_bytes(header: Header) -> int:
    """Size of a batch by its header."""
    dtype = _columns_dtype(header.end, header.measurement_bytes, header.command_bytes, header.actuators, header.rows)
    return HEADER_BYTES + dtype.itemsize + header.tail_bytes


def join_columns(batches: Sequence[tuple[Header, bytes]]) -> dict[str, npt.NDArray[Any]]:
    """Concatenate the columns of batches of one end and wire. Shapes (rows,).

    There is at least one batch, as header and payload of the size that `batch_bytes` gives. Times stay relative to the
    base of their own batch; see `Batch.times_ns`.
    """
    first = batches[0][0]
    dtype = row_dtype(first.end, first.measurement_bytes, first.command_bytes, first.actuators)
    ends = np.cumsum([header.rows for header, _ in batches])
    columns: dict[str, npt.NDArray[Any]] = {}
    assert dtype.fields is not None
    for name, (kind, at, *_) in dtype.fields.items():
        size = at + kind.itemsize
        parts = [
            payload[HEADER_BYTES + header.rows * at : HEADER_BYTES + header.rows * size] for header, payload in batches
        ]
        column = np.frombuffer(b"".join(parts), kind.base).reshape(-1, *kind.shape)
        if name in STEPS:  # each batch begins with a step from 0
            column = np.add.accumulate(column, dtype=kind)
            before = np.concatenate([[0], column[ends[:-1] - 1]]).astype(kind)
            column -= np.repeat(before, np.diff(ends, prepend=0))
        columns[name] = column
    return columns


@lru_cache(maxsize=1024)
def _columns_dtype(end: End, measurement: int, command: int, actuators: int, rows: int) -> np.dtype[np.void]:
    """Dtype of a batch's columns. Cached: the batches of a long log have few different numbers of rows."""
    row = row_dtype(end, measurement, command, actuators)
    assert row.names is not None
    return np.dtype([(name, row[name].base, (rows, *row[name].shape)) for name in row.names])


class TraceWriter:
    """Buffers one end's rows and packs them into batches.

    `run` is a random number of this process, 64 bits; a batch is due `every_ns` after its first row [ns].

    Attributes:
        rows: Number of rows in the buffer.
        session: Name of their session; set between batches only.
        state: The controller's state before the first row in the buffer, as JSON; None at the plant.
        changes: Changes that belong to the rows in the buffer.
        operations: Operations likewise.
        record: The session's gains and reference in force, as the JSON of `Tail.record`; empty for none. A controller's
            is brought up to date by `take`, from the changes.
    """

    def __init__(self, end: End, wire: WireSpec, run: int, every_ns: int) -> None:
        self.end: End = end
        self.rows = 0
        self.session = ""
        self.state: dict[str, Any] | None = None
        self.changes: list[Change] = []
        self.operations: list[PlantChange] = []
        self.record = b""
        self._in_force: list[Change] = []
        self._record_due_ns = 0
        self._sizes = wire.measurement.size, wire.command.size
        self._actuators = wire.actuators
        self._dtype = row_dtype(end, *self._sizes, wire.actuators)
        record = struct.Struct(_record_format(end, *self._sizes, wire.actuators))
        assert record.size == self._dtype.itemsize
        self._pack, self._size = record.pack_into, record.size
        self._buffer = bytearray(MAX_ROWS * self._size)
        self._run = run
        self._published = 0
        self._every_ns = every_ns
        self._base_ns = 0

    @property
    def empty(self) -> bool:
        """Whether nothing is buffered."""
        return not (self.rows or self.changes or self.operations)

    def due(self, now_ns: int) -> bool:
        """Whether a batch is to be published: the buffer is full, or its first row is `every_ns` old."""
        if self.rows:
            return self.rows >= MAX_ROWS or now_ns - self._base_ns >= self._every_ns + _MARGIN_NS
        return not self.empty

    def controller_row(
        self,
        tick: int,
        received_as: int,
        sent_as: int,
        received_ns: int,
        sent_ns: int,
        measurement: bytes,
        command: bytes,
    ) -> None:
        """Add a row of the controller; at most MAX_ROWS until `take`. Times on its monotonic clock, 0 for none [ns]."""
        rows = self.rows
        if not rows:
            self._base_ns = received_ns - _MARGIN_NS
        base_ns = self._base_ns
        self._pack(
            self._buffer,
            rows * self._size,
            tick,
            received_as,
            sent_as,
            (received_ns - base_ns) // 1000 & _MASK,
            (sent_ns - base_ns) // 1000 & _MASK if sent_ns else NEVER,
            measurement,
            command,
        )
        self.rows = rows + 1

    def plant_row(
        self,
        tick: int,
        session_tick: int,
        sent_as: int,
        received_as: int,
        outcome: int,
        trip: int,
        answered: int,
        sent_ns: int,
        received_ns: int,
        measurement: bytes,
        command: bytes,
        voltages: Sequence[float],
    ) -> None:
        """Add a row of the plant end; at most MAX_ROWS until `take`. Times on its monotonic clock, 0 for none [ns].

        Args:
            tick: Tick of the plant since its process started.
            session_tick: The same since the session's first measurement.
            sent_as: What was done with the measurement; see Sent.
            received_as: What was received since the last tick; see Sent.
            outcome: What was done with it; see Outcome.
            trip: Place of the TripCause that ended the session at this tick, from 1; 0 for none.
            answered: Session tick that the command in force answers; −1 for none.
            sent_ns: When the measurement was sent.
            received_ns: When the command was received.
            measurement: The frame as the endpoint made it.
            command: The frame as it was received.
            voltages: In force from this tick's beginning to the next command [V]. Shape (actuators,).
        """
        rows = self.rows
        if not rows:
            self._base_ns = (sent_ns or received_ns) - _MARGIN_NS
        base_ns = self._base_ns
        self._pack(
            self._buffer,
            rows * self._size,
            tick,
            session_tick,
            sent_as,
            received_as,
            outcome,
            trip,
            answered & NEVER,
            (sent_ns - base_ns) // 1000 & _MASK if sent_ns else NEVER,
            (received_ns - base_ns) // 1000 & _MASK if received_ns else NEVER,
            measurement,
            command,
            *voltages,
        )
        self.rows = rows + 1

    def take(self, now_ns: int, wall_ns: int, *, final: bool = False) -> bytes:
        """Pack all that is buffered into a batch, and clear the buffer. If `final`, the session's rows end here.

        `now_ns` is the end's monotonic clock now [ns], `wall_ns` its wall clock now [ns since 1970].
        """
        rows = self.rows
        base_ns = self._base_ns if rows else now_ns
        tail = Tail(state=self.state, changes=self.changes, operations=self.operations)
        parts = [tail.model_dump_json(include={name})[1:-1].encode() for name, value in tail if value]
        if record := self._due_record(now_ns):
            parts.append(b'"record":' + record)
        text = b"{" + b",".join(parts) + b"}" if parts else b""
        header = _HEADER.pack(
            PROTOCOL_VERSION,
            ENDS.index(self.end),
            _FINAL if final else 0,
            self._actuators,
            *self._sizes,
            rows,
            len(text),
            self._run,
            self._published,
            base_ns,
            wall_ns - (now_ns - base_ns),
            self.session.encode("ascii"),
        )
        records = np.frombuffer(self._buffer, self._dtype, rows)
        names = self._dtype.names
        assert names is not None
        columns = []
        for name in names:
            column = records[name]
            if name in STEPS:
                column = column.copy()
                column[1:] -= records[name][:-1]
            columns.append(column.tobytes())
        self._published += rows
        self.rows = 0
        self.state, self.changes, self.operations = None, [], []
        return b"".join([header, *columns, text])

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


def batches_per_s(loop: LoopSettings) -> float:
    """Bound on the batches that an end publishes per second, in the long run."""
    rate_hz = _FASTEST_HZ if loop.lockstep else loop.rate_hz
    return _BATCHES_BEYOND * max(1 / loop.trace_s, rate_hz / MAX_ROWS)


def _record_format(end: End, measurement: int, command: int, actuators: int) -> str:
    """`row_dtype` as a format of struct."""
    voltages = f"{actuators}d" if end == "plant" else ""
    return f"<{''.join(_COLUMNS[end].values())}{measurement}s{command}s{voltages}"
