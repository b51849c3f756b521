"""Index of a run's traces: which sessions there are, what the log lacks of them, and what was in force when.

Rows are numbered per process of an end, so a jump in the numbers is the number of missing rows.

The tail of a controller's batch has the changes among its rows and, once a second, the record of what is in force with
the tick since when; the plant's batches repeat the last record that the controller sent. So a record proves what was in
force from that tick to its own, and from a proven tick on the rows of the controller prove it up to a gap. The
controller's state stands before each batch: after a gap its rows count from the first batch that begins with gains and
reference known. All other ticks are unknown, and no reader computes anything of them.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import ENDS, NEVER, Batch, End, Received, read_batch
from aeroloop.service.logs.session import NO_TICK, Entry, Extent, Integers, Missing, SessionKey, Unknown

_MOST: Final = 1 << 62
"""More rows than any process publishes, and more nanoseconds than any clock counts."""

Ranges = Sequence[tuple[int, int]]
"""First and last tick of each."""


class Source(NamedTuple):
    """A process of an end."""

    vehicle: str
    end: End
    run: int


class TraceIndex:
    """Which batches a run's traces have; after `finish`, also what they lack.

    Attributes:
        extents: Recorded extent of each session, in the order of recording.
        missing: Missing rows.
        changes: Changes of gains and reference of each session, in order.
        unknown: Ticks whose gains, reference or law's state the log does not hold.
        entries: Batches of each process, in the order of its rows, none twice.
        parts: Batches of each session and end, likewise.
        malformed: Batches that are malformed, or of no process of the session.
    """

    def __init__(self) -> None:
        self.extents: dict[SessionKey, Extent] = {}
        self.missing: list[Missing] = []
        self.changes: dict[SessionKey, list[Change]] = {}
        self.unknown: list[Unknown] = []
        self.entries: defaultdict[Source, list[Entry]] = defaultdict(list)
        self.parts: defaultdict[tuple[SessionKey, End], list[Entry]] = defaultdict(list)
        self.malformed = 0
        self._known: set[tuple[Source, bytes]] = set()

    def add(self, vehicle: str, payload: bytes) -> tuple[Source, str] | None:
        """Add a batch, once; returns its process and session. A malformed one is dropped and counted."""
        batch = read_batch(payload)
        if batch is None or max(batch.header.first_row, batch.header.monotonic_ns) >= _MOST:
            self.malformed += 1
            return None
        header, tail = batch.header, batch.tail
        source = Source(vehicle, header.end, header.run)
        if (source, payload) not in self._known:
            self._known.add((source, payload))
            changes = [change for change in tail.changes if change.session == header.session]
            record = tail.record if all(change.session == header.session for change in tail.record) else []
            self.entries[source].append(Entry(header, payload, *_ticks(batch), changes, record))
        return source, header.session

    def finish(self) -> None:
        """Find sessions, and what the log lacks of them, once all batches are added."""
        self._sort_out()
        for source, entries in self.entries.items():
            for entry in entries:
                if entry.header.session:
                    self.parts[(source.vehicle, entry.header.session), source.end].append(entry)
            self._find_gaps(source, [entry for entry in entries if entry.header.rows])
        for (which, end), part in self.parts.items():
            if having := [entry for entry in part if entry.header.rows]:
                extent = self.extents.setdefault(which, Extent(*(dict.fromkeys(ENDS, n) for n in (0, NO_TICK, 0))))
                extent.first[end] = min(entry.first for entry in having)
                extent.last[end] = max(entry.last for entry in having)
                extent.rows[end] = sum(entry.header.rows for entry in having)
        for which, extent in self.extents.items():
            proofs = {end: max((one.proof for one in self.parts[which, end]), default=NO_TICK) for end in ENDS}
            for end, other in zip(ENDS, reversed(ENDS), strict=True):
                if any((m.vehicle, m.session, m.end, m.last_tick) == (*which, end, None) for m in self.missing):
                    continue
                proof, last = proofs[other], extent.last[end]
                if proof > last:  # the other end proves rows after the last one
                    self._lacks(*which, end, last + 1, proof, proof - last)
                elif not any(entry.header.final for entry in self.parts[which, end]):
                    self._lacks(*which, end, last + 1, None, 0)
            self._find_unknown(which, max(extent.last["controller"], proofs["plant"]))

    def _sort_out(self) -> None:
        """Put batches in order, without those that no process of the session publishes.

        Those overlap others; or more rows of the session, of the same end, are of another process: a process claims a
        session or grants it, so batches of its name and of another process are untrusted.
        """
        rows: defaultdict[tuple[str, End, str], Counter[Source]] = defaultdict(Counter)
        kept = dict[Source, list[Entry]]()
        for source, entries in self.entries.items():
            kept[source], after = [], 0
            # one without rows precedes the batch that starts at the same row
            for entry in sorted(entries, key=lambda e: (e.header.first_row, e.header.rows > 0, e.header.monotonic_ns)):
                if not entry.header.rows or entry.header.first_row >= after:
                    kept[source].append(entry)
                    after = max(after, entry.after)
                    rows[source.vehicle, source.end, entry.header.session][source] += entry.header.rows
        owners = {which: counts.most_common(1)[0][0] for which, counts in rows.items()}
        for source, entries in kept.items():
            its = {which[2] for which, owner in owners.items() if owner == source} | {""}
            own = [entry for entry in entries if entry.header.session in its]
            self.malformed += len(self.entries[source]) - len(own)
            self.entries[source] = own

    def _find_gaps(self, source: Source, having: Sequence[Entry]) -> None:
        """Find missing rows before each batch of a process. It numbers the rows of all its sessions."""
        vehicle, end, _ = source
        if having and (rows := min(having[0].header.first_row, having[0].first)):
            self._lacks(vehicle, having[0].header.session, end, 0, having[0].first - 1, rows)
        for one, following in pairwise(having):
            if not (rows := following.header.first_row - one.after):
                continue
            before, session = one.header.session, following.header.session
            if before == session:
                self._lacks(vehicle, session, end, one.last + 1, following.first - 1, rows)
                continue
            head = min(rows, following.first)  # of the session that begins; it has no more rows before than ticks
            tail = rows - head  # of the one before, or of others after it, unless its end is known
            finals = [entry for entry in self.entries[source] if entry.header.final]
            if ends := [entry.after for entry in finals if entry.header.session == before]:
                tail = min(tail, max(ends) - one.after)
            if tail:
                self._lacks(vehicle, before, end, one.last + 1, None, tail)
            if others := rows - head - tail:
                self._lacks(vehicle, "", end, 0, None, others)
            if head:
                self._lacks(vehicle, session, end, 0, following.first - 1, head)

    def _lacks(self, vehicle: str, session: str, end: End, first: int, last: int | None, rows: int) -> None:
        lacks = Missing(vehicle=vehicle, session=session, end=end, first_tick=first, last_tick=last, rows=rows)
        self.missing.append(lacks)

    def _find_unknown(self, which: SessionKey, last_tick: int) -> None:
        """Find a session's changes, and the ticks up to the last answered one at which they are not known."""
        entries = [entry for end in ENDS for entry in self.parts[which, end]]
        self.changes[which] = _changes(entries)
        proven = [
            (max(change.tick for change in entry.record), max(entry.last, *(change.tick for change in entry.record)))
            for entry in entries
            if _is_whole(entry.record)
        ]
        having = [entry for entry in self.parts[which, "controller"] if entry.header.rows]
        begun = [change for entry in entries for change in entry.changes if change.tick == 0]
        # A session whose first row is of a later tick has found no attitude to hold before.
        if having and having[0].first == 0 and _is_whole(begun):
            proven.append((0, 0))
        gaps = [i for i in range(1, len(having)) if having[i].header.first_row > having[i - 1].after]
        recorded, known = list[tuple[int, int]](), list[tuple[int, int]]()
        for i, j in pairwise([0, *gaps, len(having)]) if having else ():  # rows without a gap
            rows = having[i:j]
            first, last = rows[0].first, max(entry.last for entry in rows)
            recorded.append((first, last))
            since = min((max(a, first) for a, b in proven if a <= last and b >= first), default=last + 1)
            since = next((entry.first for entry in rows if entry.first >= since), last + 1)
            known.append((since, last))
        extent = self.extents[which]
        begin = min(extent.first[end] for end in ENDS if extent.rows[end])
        if begin > last_tick:
            return
        edges = _edges((begin, last_tick), [*proven, *recorded, *known])
        unknown = ~_covered(edges, known) & (_covered(edges, recorded) | ~_covered(edges, proven))
        turns = np.flatnonzero(np.diff(unknown, prepend=False, append=False))
        for first, last in zip(edges[turns[::2]].tolist(), edges[turns[1::2]].tolist(), strict=True):
            self.unknown.append(Unknown(vehicle=which[0], session=which[1], first_tick=first, last_tick=last - 1))


def _ticks(batch: Batch) -> tuple[int, int, int]:
    """First and last tick of a batch, and a tick that it proves of the other end."""
    columns, end = batch.columns, batch.header.end
    if not batch.header.rows:
        return NO_TICK, NO_TICK, NO_TICK
    ticks = columns["tick" if end == "controller" else "session_tick"]
    first, last = int(ticks[0]), int(ticks.max())
    if end == "controller":
        return first, last, last if columns["received_as"][-1] == Received.FRAME else NO_TICK
    answered = int(columns["answered"][-1])
    return first, last, NO_TICK if answered == NEVER else answered


def _changes(entries: Sequence[Entry]) -> list[Change]:
    """All changes in order: those of the batches, and of records those that no batch has."""
    found = [change for entry in entries for change in entry.changes]
    had = {(change.tick, part) for change in found for part in _parts(change)}
    for change in (change for entry in entries for change in entry.record):
        if not had.issuperset(its := {(change.tick, part) for part in _parts(change)}):
            had |= its
            found.append(change)
    return sorted(found, key=lambda change: change.tick)


def _parts(change: Change) -> list[str]:
    return [name for name in ("gains", "reference") if getattr(change, name) is not None]


def _is_whole(changes: Iterable[Change]) -> bool:
    return {part for change in changes for part in _parts(change)} == {"gains", "reference"}


def _edges(span: tuple[int, int], ranges: Ranges) -> Integers:
    """Where any range begins or the next tick after it is, within a span and at both its edges."""
    first, last = span
    return np.unique(np.clip([first, last + 1, *(a for a, _ in ranges), *(b + 1 for _, b in ranges)], first, last + 1))


def _covered(edges: Integers, ranges: Ranges) -> npt.NDArray[np.bool_]:
    """Whether any range has the ticks from each edge to the next."""
    steps = np.zeros(len(edges) + 1, np.int64)
    for first, last in ranges:
        if last >= first:
            steps[np.searchsorted(edges, first)] += 1
            steps[np.searchsorted(edges, last + 1)] -= 1
    return np.cumsum(steps)[: len(edges) - 1] > 0
