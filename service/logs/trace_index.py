"""Index of a run's traces: which batches there are, which sessions, what is missing, and what was in force when.

Rows are numbered per process of an end. So a gap in the numbers is the number of missing rows, and every session's
length is known before its rows are read into tables.

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

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import ENDS, NEVER, Batch, End, Received, read_batch
from aeroloop.service.logs.session import NO_TICK, Extent, Missing, Range, SessionKey, Source, Unknown

_MOST: Final = 1 << 62
"""More rows than any process publishes, and more nanoseconds than any clock counts."""


class Entry(NamedTuple):
    """A batch in the index. One without rows precedes the batch that starts at the same row."""

    first_row: int
    has_rows: bool
    time_ns: int
    rows: int
    session: str
    final: bool
    first: int  # tick of the first row
    last: int  # highest tick; a late row is of an earlier one
    proof: int  # a tick of the other end whose row there must be
    identity: int
    changes: list[Change]
    record: list[Change]

    @property
    def after(self) -> int:
        """Number of the first row after it."""
        return self.first_row + self.rows


class TraceIndex:
    """Which batches a run's traces have, from one look at each; after `finish`, also what they lack.

    Attributes:
        extents: Recorded extent of each session, in the order of recording.
        missing: Missing rows.
        changes: Changes of gains and reference of each session, in order.
        unknown: Ticks whose gains, reference or law's state the log does not hold.
        entries: Batches of each process, in the order of its rows.
        malformed: Batches that are malformed, or of no process of the session.
    """

    def __init__(self) -> None:
        self.extents: dict[SessionKey, Extent] = {}
        self.missing: list[Missing] = []
        self.changes: dict[SessionKey, list[Change]] = {}
        self.unknown: list[Unknown] = []
        self.entries: dict[Source, list[Entry]] = {}
        self.malformed = 0
        self._known: set[int] = set()
        self._parts: defaultdict[tuple[SessionKey, End], list[Entry]] = defaultdict(list)

    def add(self, vehicle: str, payload: bytes) -> tuple[Source, str] | None:
        """Add a batch, once; returns its process and session. A malformed one is dropped and counted."""
        batch = read_batch(payload)
        if batch is None or max(batch.header.first_row, batch.header.monotonic_ns) >= _MOST:
            self.malformed += 1
            return None
        header, tail, identity = batch.header, batch.tail, identity_of(vehicle, payload)
        source = Source(vehicle, header.end, header.run)
        if identity not in self._known:
            self._known.add(identity)
            first, last, proof = _ticks(batch)
            changes = [change for change in tail.changes if change.session == header.session]
            record = tail.record if all(change.session == header.session for change in tail.record) else []
            entry = Entry(
                header.first_row, header.rows > 0, header.monotonic_ns, header.rows, header.session, header.final,
                first, last, proof, identity, changes, record,
            )  # fmt: skip
            self.entries.setdefault(source, []).append(entry)
        return source, header.session

    def finish(self) -> None:
        """Find sessions, and what the log lacks of them, once all batches are added."""
        self._sort_out()
        for source, entries in self.entries.items():
            for entry in entries:
                if entry.session:
                    self._parts[(source.vehicle, entry.session), source.end].append(entry)
            self._find_gaps(source, entries)
        for (which, end), part in self._parts.items():
            if having := [entry for entry in part if entry.rows]:
                extent = self.extents.setdefault(which, Extent(*(dict.fromkeys(ENDS, n) for n in (0, NO_TICK, 0))))
                extent.first[end] = min(entry.first for entry in having)
                extent.last[end] = max(entry.last for entry in having)
                extent.rows[end] = sum(entry.rows for entry in having)
        for which, extent in self.extents.items():
            proofs = {end: max((one.proof for one in self._parts[which, end]), default=NO_TICK) for end in ENDS}
            for end, other in zip(ENDS, reversed(ENDS), strict=True):
                if any((m.vehicle, m.session, m.end, m.last_tick) == (*which, end, None) for m in self.missing):
                    continue
                proof, last = proofs[other], extent.last[end]
                if proof > last:  # the other end proves rows after the last one
                    self._lacks(*which, end, last + 1, proof, proof - last)
                elif not any(entry.final for entry in self._parts[which, end]):
                    self._lacks(*which, end, last + 1, None, 0)
            self._find_unknown(which, max(extent.last["controller"], proofs["plant"]))

    def part(self, which: SessionKey, end: End, first: float, last: float) -> list[Entry]:
        """A session's batches of an end with rows of some ticks, in order; no unknown ones."""
        unknown = [(one.first_tick, one.last_tick) for one in self.unknown if (one.vehicle, one.session) == which]
        return [
            entry
            for entry in self._parts[which, end]
            if entry.rows and entry.first <= last and entry.last >= first
            if end == "plant" or not any(a <= entry.last <= b for a, b in unknown)
        ]

    def _sort_out(self) -> None:
        """Put batches in order, without those that no process of the session publishes.

        Those overlap others; or more rows of the session, of the same end, are of another process: a process claims a
        session or grants it, so batches of its name and of another process are a stranger's.
        """
        owners: dict[tuple[str, End, str], tuple[int, Source]] = {}
        for source, entries in self.entries.items():
            own: list[Entry] = []
            after = 0
            for entry in sorted(entries, key=lambda one: one[:3]):
                if not entry.rows or entry.first_row >= after:
                    own.append(entry)
                    after = max(after, entry.after)
            self._replace(source, own)
            rows = Counter[str]()
            for entry in own:
                rows[entry.session] += entry.rows
            for session, count in rows.items():
                which = source.vehicle, source.end, session
                if which not in owners or count > owners[which][0]:
                    owners[which] = count, source
        for source, entries in self.entries.items():
            ours = {session for (*_, session), (_, owner) in owners.items() if owner == source} | {""}
            self._replace(source, [entry for entry in entries if entry.session in ours])

    def _replace(self, source: Source, entries: list[Entry]) -> None:
        self.malformed += len(self.entries[source]) - len(entries)
        self.entries[source] = entries

    def _find_gaps(self, source: Source, entries: Sequence[Entry]) -> None:
        """Find missing rows before each batch of a process. It numbers the rows of all its sessions."""
        vehicle, end, _ = source
        having = [entry for entry in entries if entry.rows]
        if having and (rows := min(having[0].first_row, having[0].first)):
            self._lacks(vehicle, having[0].session, end, 0, having[0].first - 1, rows)
        for one, following in pairwise(having):
            if not (rows := following.first_row - one.after):
                continue
            if one.session == following.session:
                self._lacks(vehicle, one.session, end, one.last + 1, following.first - 1, rows)
                continue
            head = min(rows, following.first)  # of the session that begins; it has no more rows before than ticks
            tail = rows - head  # of the one before, or of others after it, unless its end is known
            if ends := [entry.after for entry in entries if entry.final and entry.session == one.session]:
                tail = min(tail, max(ends) - one.after)
            if tail:
                self._lacks(vehicle, one.session, end, one.last + 1, None, tail)
            if others := rows - head - tail:
                self._lacks(vehicle, "", end, 0, None, others)
            if head:
                self._lacks(vehicle, following.session, end, 0, following.first - 1, head)

    def _lacks(self, vehicle: str, session: str, end: End, first: int, last: int | None, rows: int) -> None:
        lacks = Missing(vehicle=vehicle, session=session, end=end, first_tick=first, last_tick=last, rows=rows)
        self.missing.append(lacks)

    # ── What was in force ──

    def _find_unknown(self, which: SessionKey, last_tick: int) -> None:
        """Find a session's changes, and the ticks up to the last answered one at which they are not known."""
        entries = [entry for end in ENDS for entry in self._parts[which, end]]
        self.changes[which] = _changes(entries)
        proven = [
            (_since(entry.record), max(entry.last, *(change.tick for change in entry.record)))
            for entry in entries
            if entry.record
        ]
        if _is_whole(change for entry in entries for change in entry.changes if change.tick == 0):
            proven.append((0, 0))
        segments: list[list[Entry]] = []  # of the controller, without a gap
        after = NO_TICK
        for entry in self._parts[which, "controller"]:
            if entry.rows and entry.first_row > after:
                segments.append([])
            if entry.rows:
                segments[-1].append(entry)
                after = entry.after
        extent = self.extents[which]
        begin, unknown = min(extent.first[end] for end in ENDS if extent.rows[end]), list[Range]()
        for segment in segments:
            first, last = segment[0].first, max(entry.last for entry in segment)
            unknown += _without((begin, first - 1), proven)
            known = min((max(a, first) for a, b in proven if a <= last and b >= first), default=last + 1)
            known = next((entry.first for entry in segment if entry.first >= known), last + 1)
            unknown.append((first, known - 1))
            begin = last + 1
        unknown += _without((begin, last_tick), proven)
        for first, last in _joined(unknown):
            self.unknown.append(Unknown(vehicle=which[0], session=which[1], first_tick=first, last_tick=last))


def identity_of(vehicle: str, payload: bytes) -> int:
    """What identifies a batch within this process, wherever and however often it was recorded."""
    return hash((vehicle, payload))


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


def _changes(entries: Iterable[Entry]) -> list[Change]:
    """All changes in order: those of the batches, and of records those that no batch has."""
    found = sorted((change for entry in entries for change in entry.changes), key=lambda change: change.tick)
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


def _since(record: Sequence[Change]) -> int:
    """From when a record holds; never if it lacks gains or reference."""
    return max(change.tick for change in record) if _is_whole(record) else _MOST


def _without(ticks: Range, proven: Iterable[Range]) -> list[Range]:
    """What of a range no other range has."""
    (after, last), left = ticks, []
    for first, end in sorted(proven):
        if first > after:
            left.append((after, min(first - 1, last)))
        after = max(after, end + 1)
    return [*left, (after, last)]


def _joined(ranges: Iterable[Range]) -> list[Range]:
    """Ranges in order, without empty ones, adjacent ones as one."""
    joined: list[Range] = []
    for first, last in ranges:
        if joined and first <= last and joined[-1][1] + 1 == first:
            first = joined.pop()[0]
        if first <= last:
            joined.append((first, last))
    return joined
