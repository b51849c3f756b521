"""A session of a log: a table of rows for each end, joined on the tick.

Rows are numbered per process of an end. So a gap in the numbers is the number of missing rows, the first row identifies
a batch that was recorded twice, and `TraceIndex` knows every session's length before its rows are read into tables.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
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
Places = npt.NDArray[np.int32]
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
    at_controller: Places
    at_plant: Places
    acted: Places


class TraceIndex:
    """Which batches a run's traces have, from one look at each; after `finish`, also what they lack.

    Attributes:
        extents: Recorded extent of each session, in the order of recording.
        missing: Missing rows.
        changes: Changes of gains and reference of each session, in order.
        unknown: Ticks whose gains, reference or law's state the log does not hold.
        plants: Processes of plants, with their recorded rows.
        malformed: Batches that are malformed, or of no process of the session.
    """

    def __init__(self) -> None:
        self.extents: dict[SessionKey, Extent] = {}
        self.missing: list[Missing] = []
        self.changes: dict[SessionKey, list[Change]] = {}
        self.unknown: list[Unknown] = []
        self.plants: dict[Source, int] = {}
        self.malformed = 0
        self._names: dict[str, int] = {"": 0}
        self._values: dict[Source, array[int]] = {}
        self._tables: dict[Source, Table] = {}
        self._parts: dict[tuple[SessionKey, End], tuple[Source, Table]] = {}  # the batches of a session's end
        self._in_force: defaultdict[tuple[Source, str], InForce] = defaultdict(InForce)

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
        self._in_force[source, header.session].add(header, batch.tail, last)
        return source, header.session

    def finish(self) -> None:
        """Find sessions, and what the log lacks of them, once all batches are added."""
        self._sort_out()
        names = list(self._names)
        for source, table in self._tables.items():
            for number in dict.fromkeys(table["session"].tolist()):
                its, which = table[table["session"] == number], (source.vehicle, names[number])
                if number:
                    self._parts[which, source.end] = source, its
                if number and its["rows"].any():
                    extent = self.extents.setdefault(which, Extent(*(dict.fromkeys(ENDS, n) for n in (0, NO_TICK, 0))))
                    extent.first[source.end] = int(its["first"][its["rows"] > 0].min())
                    extent.last[source.end], extent.rows[source.end] = int(its["last"].max()), int(its["rows"].sum())
            if source.end == "plant" and len(table):
                self.plants[source] = int(table["rows"].sum())
            self._find_gaps(source, table, names)
        for which, extent in self.extents.items():
            parts = {end: self._parts[which, end][1] for end in ENDS if (which, end) in self._parts}
            proofs = {end: int(part["proof"].max()) for end, part in parts.items()}
            for end, other in zip(ENDS, reversed(ENDS), strict=True):
                proof = proofs.get(other, NO_TICK)
                if any((m.vehicle, m.session, m.end, m.last_tick) == (*which, end, None) for m in self.missing):
                    continue
                if proof > extent.last[end]:  # the other end proves rows after the last one
                    self._lacks(*which, end, extent.last[end] + 1, proof, proof - extent.last[end])
                elif end not in parts or not parts[end]["final"].any():
                    self._lacks(*which, end, extent.last[end] + 1, None, 0)
            self._find_unknown(which, max(extent.last["controller"], proofs.get("plant", NO_TICK)))

    def keys(self, source: Source) -> list[BatchKey]:
        """All batches of a process, in the order of its rows."""
        return _keys(self._tables[source])

    def chosen(
        self, which: SessionKey, end: End, first: float, last: float
    ) -> tuple[Source | None, list[BatchKey], int]:
        """A session's batches with rows of some ticks: their process, keys in order, and rows; no unknown ones."""
        if (which, end) not in self._parts:
            return None, [], 0
        source, its = self._parts[which, end]
        its = its[(its["rows"] > 0) & (its["first"] <= last) & (its["last"] >= first)]
        if end == "controller":
            its = its[~within(its["last"], self.unknown_of(which))]
        return source, _keys(its), int(its["rows"].sum())

    def unknown_of(self, which: SessionKey) -> list[Range]:
        """Unknown ticks of a session."""
        return [(one.first_tick, one.last_tick) for one in self.unknown if (one.vehicle, one.session) == which]

    def _sort_out(self) -> None:
        """Put batches in order, without duplicates and without those that no process of the session publishes.

        Those overlap others; or more rows of the session, of the same end, are of another process: a process claims a
        session or grants it, so batches of its name and of another process are a stranger's.
        """
        owners: dict[tuple[str, End, int], tuple[int, Source]] = {}
        for source, values in self._values.items():
            rows = np.unique(np.array(values, dtype=np.int64).reshape(-1, len(_FIELDS)), axis=0)  # by the key
            same = (np.diff(rows[:, :2], axis=0) == 0).all(axis=1) & (rows[1:, 1] == 1)
            table: Table = rows.view(np.dtype([(name, np.int64) for name in _FIELDS])).ravel()[np.append(True, ~same)]
            strange, after = np.zeros(len(table), dtype=np.bool_), 0
            for i, (first, n) in enumerate(zip(table["first_row"].tolist(), table["rows"].tolist(), strict=True)):
                strange[i] = n and first < after
                after = after if strange[i] else max(after, first + n)
            table = self._without(table, strange)
            self._tables[source] = table
            for number in set(table["session"].tolist()):
                which = source.vehicle, source.end, number
                count = int(table["rows"][table["session"] == number].sum())
                owners[which] = max(owners.get(which, (-1, source)), (count, source), key=lambda one: one[0])
        for source, table in self._tables.items():
            foreign = [
                number
                for number in set(table["session"].tolist()) - {0}
                if owners[source.vehicle, source.end, number][1] != source
            ]
            self._tables[source] = self._without(table, np.isin(table["session"], foreign))

    def _without(self, table: Table, strange: npt.NDArray[np.bool_]) -> Table:
        self.malformed += int(strange.sum())
        return table[~strange]

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

    def _find_unknown(self, which: SessionKey, last_tick: int) -> None:
        """Find a session's changes, and the ticks up to the last answered one at which they are not known."""
        in_force, segments = InForce(), list[Segment]()
        for end in ENDS:
            if (which, end) in self._parts:
                source, its = self._parts[which, end]
                in_force.update(self._in_force[source, which[1]])
                having = its[its["rows"] > 0]
                if end == "controller" and len(having):
                    gaps = having["first_row"][1:] > (having["first_row"] + having["rows"])[:-1]
                    for part in np.split(having, np.flatnonzero(gaps) + 1):
                        segments.append(Segment(part["first"].tolist(), int(part["last"].max())))
        self.changes[which] = in_force.changes()
        extent = self.extents[which]
        recorded = min(extent.first[end] for end in ENDS if extent.rows[end]), last_tick
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


def within(ticks: Integers, ranges: Sequence[Range]) -> npt.NDArray[np.bool_]:
    """Which ticks any of some ranges has."""
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
        if "session_tick" in (table.dtype.names or ()) and (left_out := within(table["session_tick"], unknown)).any():
            return table[~left_out]
        return table


def table_dtype(end: End, wire: WireSpec) -> np.dtype[np.void]:
    """Columns of a trace's rows, with 64 bits for ticks and times, and `wall`."""
    rows = row_dtype(end, wire.measurement.size, wire.command.size, wire.actuators)
    wide = {"tick", "session_tick", "answered", "received", "sent"}
    names = rows.names or ()
    return np.dtype([*((name, np.dtype(np.int64) if name in wide else rows[name]) for name in names), ("wall", "<i8")])


def join(
    controller: Table, plant: Table, first: float = -inf, last: float = inf
) -> tuple[Integers, Places, Places, Places]:
    """Ticks from `first` to `last` and the rows of each: k, at_controller, at_plant and acted of `Session`."""
    computed = np.flatnonzero(np.isin(controller["received_as"], (Received.FRAME, Received.SILENT)))
    acting = np.flatnonzero((plant["outcome"] == Outcome.ACTED) & (plant["answered"] != NO_TICK))
    k = np.unique(np.concatenate([controller["tick"][computed], plant["session_tick"]]))
    k = k[(k >= first) & (k <= last)]
    return (
        k,
        _places(controller["tick"][computed], computed, k),
        _places(plant["session_tick"], np.arange(len(plant)), k),
        _places(plant["answered"][acting], acting, k),
    )


def _places(ticks: Integers, places: npt.NDArray[np.intp], k: Integers) -> Places:
    """Of each tick k, where it stands first, or −1."""
    ticks, first = np.unique(ticks, return_index=True)
    if not len(ticks):
        return np.full(len(k), -1, dtype=np.int32)
    at = np.minimum(np.searchsorted(ticks, k), len(ticks) - 1)
    return np.where(ticks[at] == k, places[first][at], -1).astype(np.int32)
