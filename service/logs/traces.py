"""Index of a run's traces: which batches its files hold and which rows they lack, from the batches' headers alone.

Rows are numbered per process of an end. So a gap in the numbers is the number of missing rows, the first row identifies
a batch that was recorded twice, and every session's length is known before its rows are read.
"""

from __future__ import annotations

import struct
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final, Literal, NamedTuple
from zlib import crc32

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field, ValidationError

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import (
    ENDS,
    HEADER_BYTES,
    MAX_ROWS,
    NEVER,
    End,
    Header,
    Received,
    Tail,
    batch_bytes,
    read_header,
    row_dtype,
)
from aeroloop.service.logs.in_force import InForce, Segment, Unknown

SessionKey = tuple[str, str]
"""A vehicle and a session."""

Key = tuple[int, bool, int, int]
"""Place of a batch among those of its source: first row, whether it has rows, time and, where it has none, checksum."""

NO_TICK: Final = -1

_SESSION_TICK, _ANSWERED = (row_dtype("plant", 1, 1, 2).fields[name][1] for name in ("session_tick", "answered"))  # type: ignore[index]  # it has fields
"""Bytes of a row before these columns, whatever the frames' sizes."""

_MOST: Final = 1 << 62
"""More rows than any process publishes, and more nanoseconds than any clock counts."""

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


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


class Batches:
    """Batches of one source.

    After `finish`, `table` has a row each, sorted, and the columns of `_FIELDS`; `overlapping` were dropped.
    """

    def __init__(self) -> None:
        self._values = array("q")
        self.table: Integers = np.empty((0, len(_FIELDS)), dtype=np.int64)
        self.overlapping = 0

    def add(self, header: Header, payload: bytes, session: int) -> int:
        """Add a batch, with its session by number. Returns its last tick."""
        first, last, proof = _ticks(header, payload)
        self._values.extend((*key_of(header, payload), session, header.rows, header.final, first, last, proof))
        return last

    def finish(self) -> None:
        """Sort the batches and drop duplicates and overlapping ones, which no end publishes, once all are added."""
        table = np.array(self._values, dtype=np.int64).reshape(-1, len(_FIELDS))
        self._values = array("q")
        table = np.unique(table, axis=0)  # sorted by the key, which comes first
        same = (np.diff(table[:, :2], axis=0) == 0).all(axis=1) & (table[1:, 1] == 1)
        table = table[np.append(True, ~same)] if len(table) else table
        kept, after = [], 0
        for i, (first, rows) in enumerate(table[:, [0, _FIELDS.index("rows")]].tolist()):
            if not rows or first >= after:
                kept.append(i)
                after = max(after, first + rows)
        self.overlapping = len(table) - len(kept)
        self.table = table[kept]

    def column(self, name: str) -> Integers:
        """A column of the table. Shape (batches,)."""
        return self.table[:, _FIELDS.index(name)]

    def segments(self) -> Iterator[tuple[int, Segment]]:
        """Sessions by number, and what of each is without a gap, in order."""
        having = self.table[self.column("rows") > 0]
        column = {name: having[:, i] for i, name in enumerate(_FIELDS)}
        breaks = (np.diff(column["session"]) != 0) | (
            column["first_row"][1:] > (column["first_row"] + column["rows"])[:-1]
        )
        for its in np.split(np.arange(len(having)), np.flatnonzero(breaks) + 1) if len(having) else ():
            begins = column["first"][its].tolist()
            yield int(column["session"][its[0]]), Segment(begins, int(column["last"][its].max()))


_FIELDS: Final = ("first_row", "has_rows", "time", "checksum", "session", "rows", "final", "first", "last", "proof")


class Extent(NamedTuple):
    """Recorded extent of a session: first tick, last tick (−1 for none) and rows of each end."""

    first: dict[End, int]
    last: dict[End, int]
    rows: dict[End, int]

    @property
    def ticks(self) -> int:
        """Ticks from the first to the last row of the controller."""
        return self.last["controller"] - self.first["controller"] + 1 if self.rows["controller"] else 0

    def of(self, end: End) -> Extent:
        """The same with the rows of one end only."""
        return self._replace(rows={other: rows if other == end else 0 for other, rows in self.rows.items()})


class TraceIndex:
    """All batches of a run by source; after `finish`, also sessions in the order of recording, and missing rows.

    Attributes:
        sources: Batches of each process of an end.
        extents: Recorded extent of each session, in the order of recording.
        missing: Missing rows.
        changes: Changes of gains and reference of each session, in order.
        unknown: Ticks whose gains, reference or law's state the log does not hold.
        malformed: Batches that are malformed, or of no process of the session.
    """

    def __init__(self) -> None:
        self.sources: dict[Source, Batches] = {}
        self.extents: dict[SessionKey, Extent] = {}
        self.missing: list[Missing] = []
        self.changes: dict[SessionKey, list[Change]] = {}
        self.unknown: list[Unknown] = []
        self._in_force: dict[tuple[Source, int], InForce] = {}  # by process and session
        self.malformed = 0
        self._names: dict[str, int] = {"": 0}

    def add(self, vehicle: str, payload: bytes) -> Header | None:
        """Add a batch and return its header; a malformed one is dropped and counted."""
        if (found := identified(vehicle, payload)) is None:
            self.malformed += 1
            return None
        source, header = found
        batches = self.sources.setdefault(source, Batches())
        number = self._names.setdefault(header.session, len(self._names))
        last = batches.add(header, payload, number)
        text = payload[len(payload) - header.tail_bytes :]
        if b'"changes"' in text or b'"record"' in text:
            with suppress(ValidationError):
                tail = Tail.model_validate_json(text)
                self._in_force.setdefault((source, number), InForce()).add(header, tail, last)
        return header

    def finish(self) -> None:
        """Find sessions and their missing rows, once all batches are added."""
        proofs: dict[tuple[SessionKey, End], int] = {}
        ended: set[tuple[SessionKey, End]] = set()
        names = list(self._names)
        for batches in self.sources.values():
            batches.finish()
            self.malformed += batches.overlapping
        self._keep_one_process_a_session()
        segments: dict[SessionKey, list[Segment]] = {}
        for (vehicle, end, _), batches in self.sources.items():
            if end == "controller":
                for number, segment in batches.segments():
                    segments.setdefault((vehicle, names[number]), []).append(segment)
            session, rows, last = batches.column("session"), batches.column("rows"), batches.column("last")
            other: End = "plant" if end == "controller" else "controller"
            for number in dict.fromkeys(session.tolist()):
                which, its = (vehicle, names[number]), session == number
                if number and rows[its].any():
                    extent = self.extents.setdefault(which, Extent(*(dict.fromkeys(ENDS, n) for n in (0, NO_TICK, 0))))
                    extent.first[end] = int(batches.column("first")[its & (rows > 0)].min())
                    extent.last[end], extent.rows[end] = int(last[its].max()), int(rows[its].sum())
                    proofs[which, other] = int(batches.column("proof")[its].max())
                if batches.column("final")[its].any():
                    ended.add((which, end))
        for source, batches in self.sources.items():
            self._find_gaps(source, batches, names)
        for which, extent in self.extents.items():
            for end in ENDS:
                proof = proofs.get((which, end), NO_TICK)
                if any((m.vehicle, m.session, m.end, m.last_tick) == (*which, end, None) for m in self.missing):
                    continue
                if proof > extent.last[end]:  # the other end proves rows after the last one
                    self._lacks(*which, end, extent.last[end] + 1, proof, proof - extent.last[end])
                elif (which, end) not in ended:
                    self._lacks(*which, end, extent.last[end] + 1, None, 0)
            self._find_unknown(which, segments.get(which, []), proofs.get((which, "controller"), NO_TICK))

    def _find_unknown(self, which: SessionKey, segments: Sequence[Segment], proof: int) -> None:
        """Find a session's changes, and the ticks before the last answered one at which they are not known."""
        extent, number = self.extents[which], self._names[which[1]]
        in_force = InForce()
        for source, batches in self.sources.items():
            if source.vehicle == which[0] and (batches.column("session") == number).any():
                in_force.update(self._in_force.get((source, number), InForce()))
        self.changes[which] = in_force.changes()
        recorded = min(extent.first[end] for end in ENDS if extent.rows[end]), max(extent.last["controller"], proof)
        for first, last in in_force.unknown(segments, recorded):
            self.unknown.append(Unknown(vehicle=which[0], session=which[1], first_tick=first, last_tick=last))

    def _keep_one_process_a_session(self) -> None:
        """Drop batches of a session whose other batches, of the same end and more rows, are of another process.

        Why: a process claims a session or grants it. Batches of its name and of another process are a stranger's.
        """
        rows: dict[tuple[str, End, int], dict[Source, int]] = {}
        for source, batches in self.sources.items():
            for number in set(batches.column("session").tolist()) - {0}:
                its = rows.setdefault((source.vehicle, source.end, number), {})
                its[source] = int(batches.column("rows")[batches.column("session") == number].sum())
        for (*_, number), its in rows.items():
            for source in its.keys() - {max(its, key=its.__getitem__)}:
                strange = self.sources[source].column("session") == number
                self.sources[source].table = self.sources[source].table[~strange]
                self.malformed += int(strange.sum())

    def _find_gaps(self, source: Source, batches: Batches, names: list[str]) -> None:
        having = batches.table[batches.column("rows") > 0]
        if not len(having):
            return
        vehicle, end, _ = source
        column = {name: having[:, i] for i, name in enumerate(_FIELDS)}
        first, session = column["first"], [names[number] for number in column["session"].tolist()]
        if column["first_row"][0] and first[0] > 0:
            self._lacks(vehicle, session[0], end, 0, int(first[0]) - 1, min(int(column["first_row"][0]), int(first[0])))
        after = column["first_row"] + column["rows"]
        for i in np.flatnonzero(column["first_row"][1:] > after[:-1]).tolist():
            rows, begins, ends = int(column["first_row"][i + 1] - after[i]), int(first[i + 1]), int(column["last"][i])
            if session[i] == session[i + 1]:
                self._lacks(vehicle, session[i], end, ends + 1, begins - 1, rows)
                continue
            head = min(rows, begins)  # of the session that begins; it has no more rows before than ticks
            tail = rows - head  # of the one before, or of others after it, unless its end is known
            final = (batches.column("session") == column["session"][i]) & (batches.column("final") == 1)
            if final.any():
                tail = min(tail, int((batches.column("first_row") + batches.column("rows"))[final].max() - after[i]))
            if tail:
                self._lacks(vehicle, session[i], end, ends + 1, None, tail)
            if others := rows - head - tail:
                self._lacks(vehicle, "", end, 0, None, others)
            if head:
                self._lacks(vehicle, session[i + 1], end, 0, begins - 1, head)

    def _lacks(self, vehicle: str, session: str, end: End, first: int, last: int | None, rows: int) -> None:
        lacks = Missing(vehicle=vehicle, session=session, end=end, first_tick=first, last_tick=last, rows=rows)
        self.missing.append(lacks)


class Arrived(NamedTuple):
    """A batch in order, and the process that published it.

    Attributes:
        published_ns: When it was published, on its publisher's wall clock [ns since 1970].
        after_gap: Whether rows before it are missing.
        last_tick: Tick of its last row; −1 without rows.
        next_tick: Lowest tick of all later rows of its session; −1 if there are none.
    """

    source: Source
    header: Header
    payload: bytes
    published_ns: int
    after_gap: bool
    last_tick: int
    next_tick: int

    @property
    def tail(self) -> Tail:
        """Its tail; empty if malformed."""
        text = self.payload[len(self.payload) - self.header.tail_bytes :]
        try:
            return Tail.model_validate_json(text) if text else Tail()
        except ValidationError:
            return Tail()


class InOrder:
    """Puts the batches of one source in the order of their rows as they are read again, and drops duplicates."""

    def __init__(self, source: Source, batches: Batches) -> None:
        self._source = source
        self._keys: list[Key] = list(zip(*(column.tolist() for column in batches.table[:, :4].T), strict=True))
        self._last, self._next = batches.column("last").tolist(), _next_ticks(batches).tolist()
        self._waiting: dict[Key, tuple[Header, bytes, int]] = {}
        self._at = self._row = 0

    def take(self, header: Header, payload: bytes, published_ns: int) -> Iterator[Arrived]:
        """Add a batch; yields every batch that is next in order."""
        key, keys = key_of(header, payload), self._keys
        place = bisect_left(keys, key, lo=self._at)
        if keys[place : place + 1] != [key]:
            return  # a duplicate
        self._waiting[key] = header, payload, published_ns
        while (at := self._at) < len(keys) and keys[at] in self._waiting:
            header, payload, published_ns = self._waiting.pop(keys[at])
            gap = header.rows > 0 and header.first_row > self._row
            self._row, self._at = header.first_row + header.rows, at + 1
            yield Arrived(self._source, header, payload, published_ns, gap, self._last[at], self._next[at])


def identified(vehicle: str, payload: bytes) -> tuple[Source, Header] | None:
    """Source and header of a batch; None if it is malformed."""
    header = read_header(payload)
    if header is None or header.rows > MAX_ROWS or max(header.first_row, header.monotonic_ns) >= _MOST:
        return None
    if len(payload) != batch_bytes(header):
        return None
    return Source(vehicle, header.end, header.run), header


def key_of(header: Header, payload: bytes) -> Key:
    """Sort key of a batch within its source; one without rows precedes the batch that starts at the same row."""
    return header.first_row, header.rows > 0, header.monotonic_ns, 0 if header.rows else crc32(payload)


def _ticks(header: Header, payload: bytes) -> tuple[int, int, int]:
    """First and last tick of a batch, and a tick that it proves of the other end.

    Ticks are stored as steps, whose sum is the last row's tick.
    """
    rows = header.rows
    if not rows:
        return NO_TICK, NO_TICK, NO_TICK
    if header.end == "controller":
        (first, last), received_as = _ends(payload, HEADER_BYTES, rows), payload[HEADER_BYTES + 5 * rows - 1]
        if received_as == Received.LATE:  # it is of an earlier tick than the rows before it
            steps = np.frombuffer(payload, "<u4", rows, HEADER_BYTES)
            last = int(np.add.accumulate(steps).max())
        return first, last, last if received_as == Received.FRAME else NO_TICK
    _, answered = _ends(payload, HEADER_BYTES + _ANSWERED * rows, rows)
    first, last = _ends(payload, HEADER_BYTES + _SESSION_TICK * rows, rows)
    return first, last, NO_TICK if answered == NEVER else answered


def _ends(payload: bytes, at: int, rows: int) -> tuple[int, int]:
    """The first and last value of a column of steps."""
    steps = struct.unpack_from(f"<{rows}I", payload, at)
    return steps[0], sum(steps) & NEVER


def _next_ticks(batches: Batches) -> Integers:
    """After each batch, the lowest tick of any later one of its session; NO_TICK where there is none. Shape (batches,).

    A session's batches stand together; a late row may be of an earlier tick than the row before it.
    """
    following = np.full(len(batches.table), NO_TICK)
    session, first, rows = batches.column("session"), batches.column("first"), batches.column("rows")
    lowest, of = NO_TICK, NO_TICK
    for i in range(len(following) - 1, -1, -1):
        if session[i] != of and rows[i]:
            lowest, of = NO_TICK, int(session[i])
        following[i] = lowest
        if rows[i]:
            lowest = int(first[i]) if lowest == NO_TICK else min(lowest, int(first[i]))
    return following
