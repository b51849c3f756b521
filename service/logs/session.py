"""A session of a log: a table of rows for each end, joined on the tick.

Rows are numbered per process of an end. So a gap in the numbers is the number of missing rows, the first row identifies
a batch that was recorded twice, and `TraceIndex` knows every session's length before its rows are read into tables.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Final, Literal, NamedTuple
from zlib import crc32

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from aeroloop.protocol.messages.models import Description
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import (
    ENDS,
    NEVER,
    Batch,
    End,
    Header,
    Outcome,
    Received,
    read_batch,
    row_dtype,
)
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.logs.in_force import InForce, Range, Segment, Unknown

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Table = npt.NDArray[np.void]

SessionKey = tuple[str, str]
"""A vehicle and a session."""

BatchKey = tuple[int, bool, int, int]
"""Place of a batch among those of its source: first row, whether it has rows, time and, where it has none, checksum."""

NO_TICK: Final = -1

ANSWER_S: Final = 1.2
"""Longest time from a measurement until its command acts; a session's first may take a second [s]."""

_MOST: Final = 1 << 62
"""More rows than any process publishes, and more nanoseconds than any clock counts."""


class Source(NamedTuple):
    """A process of an end."""

    vehicle: str
    end: End
    run: int


class Missing(BaseModel, frozen=True):
    """Rows of one end that the log lacks."""

    vehicle: str
    session: str = Field(description="empty where the rows are of sessions of which the log has nothing")
    end: Literal["controller", "plant"]
    first_tick: int = Field(description="the first tick of the session that may lack its row")
    last_tick: int | None = Field(description="the last; null where the session's length is not known")
    rows: int = Field(description="how many are known to be missing; 0 where only the session's last batch is")

    def __str__(self) -> str:
        if not self.session:
            return f"{self.rows} of the {self.end}'s ticks in sessions of which the log has nothing"
        if self.last_tick is None:
            what = f"{self.rows} or more" if self.rows else "the last"
            return f"{what} of the {self.end}'s ticks, from tick {self.first_tick} of {self.session} on"
        return f"{self.rows} of the {self.end}'s ticks in {self.session}, ticks {self.first_tick} to {self.last_tick}"


class Extent(NamedTuple):
    """Recorded extent of a session: first tick, last tick (−1 for none) and rows of each end."""

    first: dict[End, int]
    last: dict[End, int]
    rows: dict[End, int]

    @property
    def ticks(self) -> int:
        """Ticks from the first to the last row of the controller."""
        return self.last["controller"] - self.first["controller"] + 1 if self.rows["controller"] else 0


@dataclass(frozen=True)
class Session:
    """Both ends' rows of a session in order, and their join on the tick. Rows of unknown ticks are left out.

    Times are on the end's monotonic clock, −1 for none [ns]; with `wall` added they are on its wall clock.

    Attributes:
        which: The session.
        settings: The configuration, each section from the role that owns it.
        descriptions: Of the roles as the session began.
        extent: What was recorded of it.
        controller: Columns tick, received_as, sent_as, received, sent, wall, measurement, command.
        plant: Columns tick, session_tick, sent_as, received_as, outcome, trip, answered (−1 for none), sent, received,
            wall, measurement, command, voltages [V].
        changes: Changes of gains and reference, in the order of their ticks.
        states: The controller's state before its first row and each first row after a gap, by the row's index.
        missing: Rows that the log lacks.
        unknown: Ticks that are left out, as the log does not hold what was in force then.
        k: Ticks with a row of either end. Shape (n,).
        at_controller: Index of the controller's row that computed each tick, or −1. Shape (n,).
        at_plant: Index of the plant's row of each tick, or −1. Shape (n,).
        acted: Index of the plant's row that first acted on the command that answers each tick, or −1. Shape (n,).
    """

    which: SessionKey
    settings: Settings
    descriptions: dict[str, Description]
    extent: Extent
    controller: Table
    plant: Table
    changes: list[Change]
    states: dict[int, dict[str, Any]]
    missing: list[Missing]
    unknown: list[Unknown]
    k: Integers
    at_controller: Integers
    at_plant: Integers
    acted: Integers


class TraceIndex:
    """Which batches a run's traces have, from one look at each; after `finish`, also what they lack.

    Attributes:
        extents: Recorded extent of each session, in the order of recording.
        missing: Missing rows.
        changes: Changes of gains and reference of each session, in order.
        unknown: Ticks whose gains, reference or law's state the log does not hold.
        malformed: Batches that are malformed, or of no process of the session.
    """

    def __init__(self) -> None:
        self.extents: dict[SessionKey, Extent] = {}
        self.missing: list[Missing] = []
        self.changes: dict[SessionKey, list[Change]] = {}
        self.unknown: list[Unknown] = []
        self.malformed = 0
        self._names: dict[str, int] = {"": 0}
        self._values: dict[Source, array[int]] = {}
        self._tables: dict[Source, Table] = {}
        self._in_force: dict[tuple[Source, int], InForce] = {}  # by process and session

    def add(self, vehicle: str, payload: bytes) -> tuple[Source, str] | None:
        """Add a batch; returns its process and session. A malformed one is dropped and counted."""
        if (batch := checked_batch(payload)) is None:
            self.malformed += 1
            return None
        header = batch.header
        source = Source(vehicle, header.end, header.run)
        session = self._names.setdefault(header.session, len(self._names))
        first, last, proof = _ticks(batch)
        values = self._values.setdefault(source, array("q"))
        values.extend((*key_of(header, payload), session, header.rows, header.final, first, last, proof))
        self._in_force.setdefault((source, session), InForce()).add(header, batch.tail, last)
        return source, header.session

    def finish(self) -> None:
        """Find sessions, and what the log lacks of them, once all batches are added."""
        for source, values in self._values.items():
            self._tables[source] = self._sorted(values)
        self._keep_one_process_a_session()
        names = list(self._names)
        proofs: dict[tuple[SessionKey, End], int] = {}
        ended: set[tuple[SessionKey, End]] = set()
        for (vehicle, end, _), table in self._tables.items():
            other: End = "plant" if end == "controller" else "controller"
            for number in dict.fromkeys(table["session"].tolist()):
                which, its = (vehicle, names[number]), table[table["session"] == number]
                if number and its["rows"].any():
                    extent = self.extents.setdefault(which, Extent(*(dict.fromkeys(ENDS, n) for n in (0, NO_TICK, 0))))
                    extent.first[end] = int(its["first"][its["rows"] > 0].min())
                    extent.last[end], extent.rows[end] = int(its["last"].max()), int(its["rows"].sum())
                    proofs[which, other] = int(its["proof"].max())
                if its["final"].any():
                    ended.add((which, end))
        for source, table in self._tables.items():
            self._find_gaps(source, table, names)
        for which, extent in self.extents.items():
            for end in ENDS:
                proof = proofs.get((which, end), NO_TICK)
                if any((m.vehicle, m.session, m.end, m.last_tick) == (*which, end, None) for m in self.missing):
                    continue
                if proof > extent.last[end]:  # the other end proves rows after the last one
                    self._lacks(*which, end, extent.last[end] + 1, proof, proof - extent.last[end])
                elif (which, end) not in ended:
                    self._lacks(*which, end, extent.last[end] + 1, None, 0)
            self._find_unknown(which, proofs.get((which, "controller"), NO_TICK))

    def sources(self, end: End) -> list[Source]:
        """Processes of an end, in the order of recording."""
        return [source for source in self._tables if source.end == end]

    def rows(self, source: Source) -> int:
        """Recorded rows of a process."""
        return int(self._tables[source]["rows"].sum())

    def keys(self, source: Source) -> list[BatchKey]:
        """All batches of a process, in the order of its rows."""
        return _keys(self._tables[source])

    def chosen(
        self, which: SessionKey, end: End, ticks: tuple[float, float]
    ) -> dict[Source, tuple[list[BatchKey], int]]:
        """A session's batches with rows of some ticks, in order, and their rows; of the controller those known."""
        found = {}
        for source, table in self._tables.items():
            if (source.vehicle, source.end) == (which[0], end):
                its = table[(table["session"] == self._names[which[1]]) & (table["rows"] > 0)]
                its = its[(its["first"] <= ticks[1]) & (its["last"] >= ticks[0])]
                if end == "controller":
                    its = its[~_within(its["last"], self.unknown_ranges(which))]
                if len(its):
                    found[source] = _keys(its), int(its["rows"].sum())
        return found

    def unknown_ranges(self, which: SessionKey) -> list[Range]:
        """Unknown ticks of a session."""
        return [(one.first_tick, one.last_tick) for one in self.unknown if (one.vehicle, one.session) == which]

    def _sorted(self, values: array[int]) -> Table:
        """The batches in order, without duplicates and overlapping ones, which no end publishes."""
        rows = np.unique(np.array(values, dtype=np.int64).reshape(-1, len(_FIELDS)), axis=0)  # the key comes first
        table: Table = rows.view(np.dtype([(name, np.int64) for name in _FIELDS])).ravel()
        same = (np.diff(rows[:, :2], axis=0) == 0).all(axis=1) & (rows[1:, 1] == 1)
        table = table[np.append(True, ~same)]
        kept, after = [], 0
        for i, (first, n) in enumerate(zip(table["first_row"].tolist(), table["rows"].tolist(), strict=True)):
            if not n or first >= after:
                kept.append(i)
                after = max(after, first + n)
        self.malformed += len(table) - len(kept)
        return table[kept]

    def _keep_one_process_a_session(self) -> None:
        """Drop batches of a session whose other batches, of the same end and more rows, are of another process.

        Why: a process claims a session or grants it. Batches of its name and of another process are a stranger's.
        """
        rows: dict[tuple[str, End, int], dict[Source, int]] = {}
        for source, table in self._tables.items():
            for number in set(table["session"].tolist()) - {0}:
                its = rows.setdefault((source.vehicle, source.end, number), {})
                its[source] = int(table["rows"][table["session"] == number].sum())
        for (*_, number), its in rows.items():
            for source in its.keys() - {max(its, key=its.__getitem__)}:
                strange = self._tables[source]["session"] == number
                self._tables[source] = self._tables[source][~strange]
                self.malformed += int(strange.sum())

    def _find_gaps(self, source: Source, table: Table, names: list[str]) -> None:
        having = table[table["rows"] > 0]
        if not len(having):
            return
        vehicle, end, _ = source
        first, session = having["first"], [names[number] for number in having["session"].tolist()]
        if having["first_row"][0] and first[0] > 0:
            self._lacks(vehicle, session[0], end, 0, int(first[0]) - 1, min(int(having["first_row"][0]), int(first[0])))
        after = having["first_row"] + having["rows"]
        for i in np.flatnonzero(having["first_row"][1:] > after[:-1]).tolist():
            rows, begins, ends = int(having["first_row"][i + 1] - after[i]), int(first[i + 1]), int(having["last"][i])
            if session[i] == session[i + 1]:
                self._lacks(vehicle, session[i], end, ends + 1, begins - 1, rows)
                continue
            head = min(rows, begins)  # of the session that begins; it has no more rows before than ticks
            tail = rows - head  # of the one before, or of others after it, unless its end is known
            final = table[(table["session"] == having["session"][i]) & (table["final"] == 1)]
            if len(final):
                tail = min(tail, int((final["first_row"] + final["rows"]).max() - after[i]))
            if tail:
                self._lacks(vehicle, session[i], end, ends + 1, None, tail)
            if others := rows - head - tail:
                self._lacks(vehicle, "", end, 0, None, others)
            if head:
                self._lacks(vehicle, session[i + 1], end, 0, begins - 1, head)

    def _lacks(self, vehicle: str, session: str, end: End, first: int, last: int | None, rows: int) -> None:
        lacks = Missing(vehicle=vehicle, session=session, end=end, first_tick=first, last_tick=last, rows=rows)
        self.missing.append(lacks)

    def _find_unknown(self, which: SessionKey, proof: int) -> None:
        """Find a session's changes, and the ticks before the last answered one at which they are not known."""
        extent, number = self.extents[which], self._names[which[1]]
        in_force, segments = InForce(), list[Segment]()
        for source, table in self._tables.items():
            its = table[table["session"] == number]
            if source.vehicle != which[0] or not len(its):
                continue
            in_force.update(self._in_force[source, number])
            having = its[its["rows"] > 0]
            if source.end == "controller" and len(having):
                breaks = np.flatnonzero(having["first_row"][1:] > (having["first_row"] + having["rows"])[:-1]) + 1
                for part in np.split(having, breaks):
                    segments.append(Segment(part["first"].tolist(), int(part["last"].max())))
        self.changes[which] = in_force.changes()
        recorded = min(extent.first[end] for end in ENDS if extent.rows[end]), max(extent.last["controller"], proof)
        for first, last in in_force.unknown(segments, recorded):
            self.unknown.append(Unknown(vehicle=which[0], session=which[1], first_tick=first, last_tick=last))


_FIELDS: Final = ("first_row", "has_rows", "time", "checksum", "session", "rows", "final", "first", "last", "proof")


def _keys(table: Table) -> list[BatchKey]:
    return list(zip(*(table[name].tolist() for name in _FIELDS[:4]), strict=True))


def checked_batch(payload: bytes) -> Batch | None:
    """A parsed batch; None if it is malformed, or of numbers that no process reaches."""
    batch = read_batch(payload)
    if batch is None or max(batch.header.first_row, batch.header.monotonic_ns) >= _MOST:
        return None
    return batch


def key_of(header: Header, payload: bytes) -> BatchKey:
    """Sort key of a batch within its source; one without rows precedes the batch that starts at the same row."""
    return header.first_row, header.rows > 0, header.monotonic_ns, 0 if header.rows else crc32(payload)


def _ticks(batch: Batch) -> tuple[int, int, int]:
    """First and last tick of a batch, and a tick that it proves of the other end. A late row is of an earlier tick."""
    columns, end = batch.columns, batch.header.end
    if not batch.header.rows:
        return NO_TICK, NO_TICK, NO_TICK
    ticks = columns["tick" if end == "controller" else "session_tick"]
    last = int(ticks.max())
    if end == "controller":
        return int(ticks[0]), last, last if columns["received_as"][-1] == Received.FRAME else NO_TICK
    answered = int(columns["answered"][-1])
    return int(ticks[0]), last, NO_TICK if answered == NEVER else answered


def _within(ticks: Integers, ranges: Sequence[Range]) -> npt.NDArray[np.bool_]:
    found = np.zeros(len(ticks), dtype=np.bool_)
    for first, last in ranges:
        found |= (ticks >= first) & (ticks <= last)
    return found


# ── Tables ──


class TableBuilder:
    """Fills the table of one end's rows, batch by batch in order; at most `rows` of them.

    `states` has the controller's state before its first row and each first row after a gap. A batch of another wire is
    left out and counted in `malformed`.
    """

    def __init__(self, end: End, wire: WireSpec, rows: int) -> None:
        self.states: dict[int, dict[str, Any]] = {}
        self.malformed = 0
        self._wire = wire.measurement.size, wire.command.size, wire.actuators
        self._filled, self._next_row = 0, -1
        self._table = np.zeros(rows, table_dtype(end, wire))

    def add(self, batch: Batch) -> None:
        """Add the next batch."""
        header, names = batch.header, self._table.dtype.names
        assert names is not None
        if (header.measurement_bytes, header.command_bytes, header.actuators) != self._wire:
            self.malformed += 1
            return
        begin, end = self._filled, self._filled + header.rows
        if header.first_row != self._next_row and batch.tail.state is not None:
            self.states[begin] = batch.tail.state
        rows = self._table[begin:end]
        for name in set(names) - {"received", "sent", "wall"}:
            rows[name] = batch.columns[name]
        rows["received"], rows["sent"] = batch.times_ns("received"), batch.times_ns("sent")
        rows["wall"] = header.wall_ns - header.monotonic_ns
        if "answered" in names:
            rows["answered"][rows["answered"] == NEVER] = NO_TICK
        self._filled, self._next_row = end, header.first_row + header.rows

    def table(self, unknown: Sequence[Range] = ()) -> Table:
        """All rows, without those of the plant at unknown ticks."""
        table = self._table[: self._filled]
        if "session_tick" in (table.dtype.names or ()) and (left_out := _within(table["session_tick"], unknown)).any():
            return table[~left_out]
        return table


def table_dtype(end: End, wire: WireSpec) -> np.dtype[np.void]:
    """Columns of a trace's rows, with 64 bits for ticks and times, and `wall`."""
    rows = row_dtype(end, wire.measurement.size, wire.command.size, wire.actuators)
    wide = {"tick", "session_tick", "answered", "received", "sent"}
    names = rows.names or ()
    return np.dtype([*((name, np.dtype(np.int64) if name in wide else rows[name]) for name in names), ("wall", "<i8")])


def join(controller: Table, plant: Table, first: float = -inf, last: float = inf) -> tuple[Integers, ...]:
    """Ticks from `first` to `last` and the rows of each: k, at_controller, at_plant and acted of `Session`."""
    received_as = controller["received_as"]
    computed = np.flatnonzero((received_as == Received.FRAME) | (received_as == Received.SILENT))
    acting = np.flatnonzero((plant["outcome"] == Outcome.ACTED) & (plant["answered"] != NO_TICK))
    k = np.union1d(controller["tick"][computed], plant["session_tick"])
    k = k[(k >= first) & (k <= last)]
    return (
        k,
        _places(controller["tick"][computed], computed, k),
        _places(plant["session_tick"], np.arange(len(plant)), k),
        _places(plant["answered"][acting], acting, k),
    )


def _places(ticks: Integers, places: Integers, k: Integers) -> Integers:
    """Of each tick k, where it stands first, or −1."""
    ticks, first = np.unique(ticks, return_index=True)
    if not len(ticks):
        return np.full(len(k), -1)
    at = np.minimum(np.searchsorted(ticks, k), len(ticks) - 1)
    return np.where(ticks[at] == k, places[first][at], -1)
