"""Sessions of a log: which batches there are, what the log lacks, what was in force when, and both ends' joined tables.

Rows are numbered per process of an end, so a jump in the numbers is the number of missing rows.

The tail of a controller's batch has the changes among its rows and, once a second, the record of what is in force with
the tick since when; the plant's batches repeat the last record that the controller sent. So a record proves what was in
force from that tick to its own, and from a proven tick on the rows of the controller prove it up to a gap, after which
they count from the first batch that begins with gains and reference known. No reader computes anything of other ticks.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from aeroloop.protocol.messages.models import MAX_SIGNALS, Description, Truth
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import (
    ENDS,
    NEVER,
    Batch,
    End,
    Header,
    Outcome,
    Received,
    Tail,
    read_batch,
    read_columns,
    row_dtype,
)
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Places = npt.NDArray[np.int32]
Table = npt.NDArray[np.void]

SessionKey = tuple[str, str]  # a vehicle and a session

NO_TICK: Final = -1


class Missing(BaseModel, frozen=True):
    """Rows of one end that the log lacks."""

    vehicle: str
    session: str = Field(description="empty where the rows are of sessions of which the log has nothing")
    end: Literal["controller", "plant"]
    first_tick: int = Field(description="the first tick of the session that may lack its row")
    last_tick: int | None = Field(description="the last; null where the session's length is not known")
    rows: int = Field(
        description="how many are known to be missing, at least 1 where the session ended without its last batch; 0 "
        "where the recording ended first"
    )

    def __str__(self) -> str:
        if not self.session:
            return f"{self.rows} of the {self.end}'s ticks in sessions of which the log has nothing"
        if self.last_tick is None:
            what = f"{self.rows} or more" if self.rows else "the last"
            return f"{what} of the {self.end}'s ticks, from tick {self.first_tick} of {self.session} on"
        return f"{self.rows} of the {self.end}'s ticks in {self.session}, ticks {self.first_tick} to {self.last_tick}"


class Unknown(BaseModel, frozen=True):
    """Ticks of a session that no figure counts, as the log does not hold what was in force then."""

    vehicle: str
    session: str
    first_tick: int
    last_tick: int

    def __str__(self) -> str:
        return (
            f"ticks {self.first_tick} to {self.last_tick} of {self.session} are left out: the log does not hold the "
            "gains, the reference and the law's state of them"
        )


class Extent(NamedTuple):
    """Recorded extent of a session: first tick, last tick (−1 for none) and rows of each end."""

    first: dict[End, int]
    last: dict[End, int]
    rows: dict[End, int]

    @property
    def ticks(self) -> int:
        """Ticks from the first to the last row of the controller."""
        return self.last["controller"] - self.first["controller"] + 1 if self.rows["controller"] else 0


# ── index of the batches ──

_MOST: Final = 1 << 62  # more rows than any process publishes, and more nanoseconds than any clock counts

WENT_ON_NS: Final = 2_000_000_000
"""A recording that goes on for longer after a session's last batch than batches take has lost the session's end: a
process publishes ten batches a second, and a recorder writes twice a second."""

Ranges = Sequence[tuple[int, int]]  # first and last tick of each


class Source(NamedTuple):
    """A process of an end."""

    vehicle: str
    end: End
    run: int


class Entry(NamedTuple):
    """A batch of a trace, as it was recorded."""

    header: Header
    place: slice  # of its bytes in `TraceIndex.payloads`
    published_ns: int
    first: int  # tick of the first row
    last: int  # highest tick; a late row is of an earlier one
    proof: int  # a tick of the other end whose row there must be
    changes: list[Change]
    record: list[Change]
    has_state: bool  # of the controller, before the first row; a session's first row needs none

    @property
    def after(self) -> int:
        """Number of the first row after it."""
        return self.header.first_row + self.header.rows


class _Newest(NamedTuple):
    """The last batch of a process's session: the row after it, and when each recording wrote it [ns since 1970]."""

    after: int
    recorded_ns: dict[object, int]


class TraceIndex:
    """Which batches a run's traces have; after `finish`, also what they lack."""

    def __init__(self) -> None:
        self.extents: dict[SessionKey, Extent] = {}  # in the order of publication
        self.missing: list[Missing] = []
        self.changes: dict[SessionKey, list[Change]] = {}  # of gains and reference, in order
        self.unknown: list[Unknown] = []  # ticks whose gains, reference or law's state the log does not hold
        self.entries: defaultdict[Source, list[Entry]] = defaultdict(list)  # of a process, in the order of its rows
        self.parts: defaultdict[tuple[SessionKey, End], list[Entry]] = defaultdict(list)  # likewise
        self.payloads = bytearray()  # one object: many small ones would not return 140 MB an hour to the system
        self.malformed = 0  # batches that are malformed, or of no process of the session
        self.owners: defaultdict[SessionKey, dict[End, Source]] = defaultdict(dict)  # the process of each end
        self.corroborated: set[SessionKey] = set()  # sessions of which both ends have rows
        self._known: set[int] = set()
        self._newest: dict[tuple[Source, str], _Newest] = {}  # of a process's session

    def add(
        self, vehicle: str, payload: bytes, published_ns: int, recording: object = None, recorded_ns: int = 0
    ) -> set[object]:
        """Add a batch, once; returns its process and session. A malformed one is dropped and counted.

        `recorded_ns` is when a recording wrote it, on the clock of its recorder.
        """
        batch = read_batch(payload)
        if batch is None or max(batch.header.first_row, batch.header.monotonic_ns) >= _MOST:
            self.malformed += 1
            return set()
        header, tail = batch.header, batch.tail
        source, session = Source(vehicle, header.end, header.run), header.session
        after = header.first_row + header.rows
        newest = self._newest.setdefault((source, session), _Newest(after, {}))
        if after > newest.after:
            newest = self._newest[source, session] = _Newest(after, {})
        if after == newest.after:
            newest.recorded_ns[recording] = recorded_ns
        if (identity := hash((source, payload))) not in self._known:
            self._known.add(identity)
            changes = [change for change in tail.changes if change.session == session]
            record = tail.record if all(change.session == session for change in tail.record) else []
            place = slice(len(self.payloads), len(self.payloads) + len(payload))
            self.payloads += payload
            first, last, proof = _ticks(batch)
            has_state = tail.state is not None or first == 0
            entry = Entry(header, place, published_ns, first, last, proof, changes, record, has_state)
            self.entries[source].append(entry)
        return {source, (vehicle, session)} if session else {source}

    def finish(self, ends_ns: Mapping[object, int] = MappingProxyType({})) -> None:
        """Find sessions, and what the log lacks of them, once all batches are added.

        `ends_ns` is when each recording wrote its last message.
        """
        self._sort_out()
        self._leave_out_strays()
        for source, entries in self.entries.items():
            for entry in entries:
                if entry.header.session:
                    self.parts[(source.vehicle, entry.header.session), source.end].append(entry)
            self._find_gaps(source, [entry for entry in entries if entry.header.rows or entry.header.final])
        begun = sorted(self.parts.items(), key=lambda its: min(entry.published_ns for entry in its[1]))
        for (which, end), part in begun:
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
                    self._lacks(*which, end, last + 1, None, 1 if self._went_on(which, end, ends_ns) else 0)
            self._find_unknown(which, max(extent.last["controller"], proofs["plant"]))

    def _sort_out(self) -> None:
        """Put batches in order, without those that overlap others and those of a session that is another process's.

        A process claims a session or grants it, so the one with most of its rows at an end owns it.
        """
        rows: defaultdict[tuple[str, End, str], Counter[Source]] = defaultdict(Counter)
        for source, entries in self.entries.items():
            after, kept = 0, list[Entry]()
            # one without rows precedes the batch that starts at the same row
            for entry in sorted(entries, key=lambda e: (e.header.first_row, e.header.rows > 0, e.header.monotonic_ns)):
                if entry.header.first_row >= after:
                    kept.append(entry)
                    after = max(after, entry.after)
                    rows[source.vehicle, source.end, entry.header.session][source] += entry.header.rows
            self.malformed += len(entries) - len(kept)
            self.entries[source] = kept
        for (vehicle, end, session), counts in rows.items():
            if session:
                self.owners[vehicle, session][end] = counts.most_common(1)[0][0]
        for source, entries in self.entries.items():
            its = {""} | {session for (_, session), owners in self.owners.items() if owners.get(source.end) == source}
            self.entries[source] = [entry for entry in entries if entry.header.session in its]
            self.malformed += len(entries) - len(self.entries[source])

    def _leave_out_strays(self) -> None:
        """Leave out batches of which the rest of their process's trace shows that it did not publish them.

        One is of a session that had ended before the rows that are missing before it. Another is alone between missing
        rows and of a session of which the log has nothing else, while both ends have rows of others of the process.
        """
        batches: Counter[tuple[SessionKey, End]] = Counter()
        for source, entries in self.entries.items():
            batches.update(((source.vehicle, one.header.session), source.end) for one in entries if one.header.rows)
        for session in self.owners:
            if all(batches[session, end] for end in ENDS):
                self.corroborated.add(session)
        for source, entries in self.entries.items():
            keys = [(source.vehicle, entry.header.session) for entry in entries]
            is_corroborated = not self.corroborated.isdisjoint(keys)
            first_rows = {entry.header.first_row for entry in entries if entry.header.rows}
            next_rows = {entry.after for entry in entries if entry.header.rows} | {0}
            ended_at: dict[SessionKey, int] = {}  # the row after a session's last one
            kept: list[Entry] = []
            for key, entry in zip(keys, entries, strict=True):
                is_after_end = entry.header.first_row > ended_at.get(key, _MOST)
                is_alone = entry.header.first_row not in next_rows and entry.after not in first_rows
                is_only_one = key not in self.corroborated and batches[key, source.end] == 1
                if is_after_end or (is_corroborated and is_alone and is_only_one):
                    continue
                kept.append(entry)
                if entry.header.final:
                    ended_at[key] = entry.after
            self.malformed += len(entries) - len(kept)
            self.entries[source] = kept

    def _went_on(self, session: SessionKey, end: End, ends_ns: Mapping[object, int]) -> bool:
        """Whether the recording went on after the last batch of a session, which has no end in it."""
        vehicle, name = session
        if (owner := self.owners[session].get(end)) is None:
            return False
        newest = self._newest[owner, name]
        if any(ends_ns.get(recording, at_ns) - at_ns > WENT_ON_NS for recording, at_ns in newest.recorded_ns.items()):
            return True
        # A plant has one session at a time, so a later one shows that this one has ended.
        last_ns = max((entry.published_ns for entry in self.parts[session, "plant"]), default=_MOST)
        later = (other for other in self.corroborated if other[0] == vehicle and other != session)
        return any(min(entry.published_ns for entry in self.parts[other, "plant"]) > last_ns for other in later)

    def _find_gaps(self, source: Source, having: Sequence[Entry]) -> None:
        """Find missing rows between the batches of a process that have rows or end a session."""
        vehicle, end, _ = source
        if having and (rows := min(having[0].header.first_row, having[0].first)) > 0:
            self._lacks(vehicle, having[0].header.session, end, 0, having[0].first - 1, rows)
        for one, following in pairwise(having):
            rows = following.header.first_row - one.after
            before, session = one.header.session, following.header.session
            if rows and before == session:
                last = following.first - 1 if following.header.rows else None
                self._lacks(vehicle, session, end, one.last + 1, last, rows)
            elif rows:
                head = min(rows, max(0, following.first))  # it has no more rows before than ticks
                tail = 0 if one.header.final else rows - head  # of the session before, or of others after it
                if tail:
                    self._lacks(vehicle, before, end, one.last + 1, None, tail)
                elif rows > head:
                    self._lacks(vehicle, "", end, 0, None, rows - head)
                if head:
                    self._lacks(vehicle, session, end, 0, following.first - 1, head)

    def _lacks(self, vehicle: str, session: str, end: End, first: int, last: int | None, rows: int) -> None:
        lacks = Missing(vehicle=vehicle, session=session, end=end, first_tick=first, last_tick=last, rows=rows)
        self.missing.append(lacks)

    def _find_unknown(self, which: SessionKey, last_tick: int) -> None:
        """Find a session's changes, and the ticks up to the last answered one at which they are not known."""
        entries = [entry for end in ENDS for entry in self.parts[which, end]]
        self.changes[which] = _changes(entries)
        records = [(max(change.tick for change in one.record), one.last) for one in entries if _is_whole(one.record)]
        proven = [(first, max(first, last)) for first, last in records]
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
            since = next((entry.first for entry in rows if entry.first >= since and entry.has_state), last + 1)
            known.append((since, last))
        extent = self.extents[which]
        begin = min(extent.first[end] for end in ENDS if extent.rows[end])
        if begin > last_tick:
            return
        turns = [turn for first, last in (*proven, *recorded, *known) for turn in (first, last + 1)]
        edges = np.unique(np.clip([begin, *turns, last_tick + 1], begin, last_tick + 1))
        unknown = ~_within(edges, known) & (_within(edges, recorded) | ~_within(edges, proven))
        unknown[-1] = False
        begins, ends = edges[np.flatnonzero(np.diff(unknown, prepend=False))].reshape(-1, 2).T.tolist()
        for first, last in zip(begins, ends, strict=True):
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
    recorded_gains: dict[int, Change] = {}  # by the tick since when they are in force
    for change in (change for entry in entries for change in entry.record):
        if change.gains is not None:
            recorded_gains[change.tick] = change
        if not had.issuperset(its := {(change.tick, part) for part in _parts(change)}):
            had |= its
            found.append(change)
    return _with_whole_gains(sorted(found, key=lambda change: change.tick), recorded_gains)


def _with_whole_gains(changes: Sequence[Change], recorded: Mapping[int, Change]) -> list[Change]:
    """Changes in order of which those that a record contradicts have its gains: the batch of an earlier one is lost.

    A change may set some of the gains; a record has all of them, as they are after the last change of its tick.
    """
    last_of_tick = {change.tick: i for i, change in enumerate(changes) if change.gains is not None}
    whole = list(changes)
    gains: dict[str, tuple[float, ...]] = {}
    for i, change in enumerate(changes):
        if change.gains is None:
            continue
        gains |= change.gains.named
        record = recorded.get(change.tick) if last_of_tick[change.tick] == i else None
        if record is not None and record.gains is not None and record.gains.named != gains:
            gains = dict(record.gains.named)
            whole[i] = change.model_copy(update={"gains": record.gains})
    return whole


def _parts(change: Change) -> list[str]:
    return [name for name in ("gains", "reference") if getattr(change, name) is not None]


def _is_whole(changes: Iterable[Change]) -> bool:
    return {part for change in changes for part in _parts(change)} == {"gains", "reference"}


def _within(ticks: Integers, ranges: Ranges) -> npt.NDArray[np.bool_]:
    """Whether any range has each tick."""
    firsts, lasts = np.array(ranges, np.int64).reshape(-1, 2).T
    return np.searchsorted(np.sort(firsts), ticks, "right") > np.searchsorted(np.sort(lasts), ticks, "left")


# ── tables ──


@dataclass(frozen=True)
class Session:
    """Both ends' rows of a session in order, and their join on the tick. Rows of unknown ticks are left out.

    Times are on the end's monotonic clock, −1 for none [ns]; with `wall` added they are on its wall clock.
    """

    which: SessionKey
    settings: Settings  # each section from the role that owns it
    descriptions: dict[str, Description]  # of the roles as the session began
    extent: Extent
    controller: Table  # tick, received_as, sent_as, received, sent, measurement, command, wall
    plant: Table  # tick, session_tick, sent_as, received_as, outcome, trip, answered (−1: none), sent, received, …
    changes: list[Change]  # of gains and reference, in the order of their ticks
    states: dict[int, dict[str, Any]]  # the controller's before its first row and each after a gap, by the row's index
    missing: list[Missing]  # rows that the log lacks
    unknown: list[Unknown]
    k: Integers  # ticks with a row of either end. Shape (n,)
    at_controller: Places  # index of the controller's row that computed each tick, or −1. Shape (n,)
    at_plant: Places  # index of the plant's row of each tick, or −1. Shape (n,)
    acted: Places  # index of the plant's row that first acted on the command that answers it, or −1. Shape (n,)


def table_of(
    end: End, wire: WireSpec, entries: Sequence[Entry], payloads: bytearray
) -> tuple[Table, dict[int, dict[str, Any]], int]:
    """One end's rows, from batches in order.

    Returns:
        The table, the controller's states as of `Session.states`, and how many batches of another wire are left out.
    """
    kinds = row_dtype(end, wire.actuators, wire.measurement.size, wire.command.size)
    fitting = [one for one in entries if one.header.row_dtype == kinds]
    columns = [name for name in kinds.names or () if name != "voltages"]
    wide = {"tick", "session_tick", "answered", "received", "sent", "wall"}
    form = [(name, np.dtype(np.int64) if name in wide else kinds[name]) for name in (*columns, "wall")]
    table = np.zeros(sum(one.header.rows for one in fitting), np.dtype(form))
    states = dict[int, dict[str, Any]]()
    filled, next_row = 0, -1
    for header, place, *_ in fitting:
        payload = bytes(payloads[place])
        batch = Batch(header, read_columns(header, payload), Tail())
        if header.first_row != next_row and (whole := read_batch(payload)) is not None and whole.tail.state is not None:
            states[filled] = whole.tail.state
        next_row = header.first_row + header.rows
        rows = table[filled : filled + header.rows]
        for name in columns:
            rows[name] = batch.columns[name]
        rows["received"], rows["sent"] = batch.times_ns("received"), batch.times_ns("sent")
        rows["wall"] = header.wall_ns - header.monotonic_ns
        filled += header.rows
    if end == "plant":
        table["answered"][table["answered"] == NEVER] = NO_TICK
    return table, states, len(entries) - len(fitting)


def join(
    controller: Table, plant: Table, first: float = -inf, last: float = inf
) -> tuple[Integers, Places, Places, Places]:
    """Ticks from `first` to `last` and the rows of each: k, at_controller, at_plant and acted of `Session`."""
    computed = np.flatnonzero(np.isin(controller["received_as"], (Received.FRAME, Received.SILENT)))
    acting = np.flatnonzero((plant["outcome"] == Outcome.ACTED) & (plant["answered"] != NO_TICK))
    k = np.sort(np.concatenate([controller["tick"][computed], plant["session_tick"]]))
    k = k[(np.diff(k, prepend=NO_TICK) > 0) & (k >= first) & (k <= last)]  # `unique` would keep 30 bytes a tick
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


class Truths(NamedTuple):
    """True states by tick, ascending, none twice, with the plant's further signals; a signal is NaN if not known."""

    k: Integers  # Shape (n,)
    attitude: Array  # q. Shape (n, 4)
    rate: Array  # ω, body frame [rad/s]. Shape (n, 3)
    voltages: Array  # at the motors [V]. Shape (n, actuators)
    signals: Mapping[str, Array] = {}  # by name. Shapes (n,)


def true_states(messages: Iterable[bytes], session: str, actuators: int) -> tuple[Truths, int]:
    """True states of a session, of a tick the first, and how many of the messages are malformed.

    Anyone on the network may publish one, of any tick, of any plant's motors and with any signals.
    """
    found, names, malformed = dict[int, tuple[tuple[float, ...], dict[str, float | None]]](), set[str](), 0
    for data in messages:
        try:
            truth = Truth.model_validate_json(data)
        except ValueError:
            malformed += 1
            continue
        if truth.session != session or (k := truth.session_tick) is None:
            continue
        possible = 0 <= k < NEVER and len(truth.voltages) == actuators
        if not possible or len(names | truth.signals.keys()) > MAX_SIGNALS:
            malformed += 1
        elif k not in found:
            found[k] = (k, *truth.attitude, *truth.rate, *truth.voltages), truth.signals
            names |= truth.signals.keys()
    ordered = [found[k] for k in sorted(found)]
    rows = np.array([row for row, _ in ordered], np.float64).reshape(-1, 8 + actuators)
    signals = {name: np.array([its.get(name) for _, its in ordered], np.float64) for name in sorted(names)}
    return Truths(rows[:, 0].astype(np.int64), rows[:, 1:5], rows[:, 5:8], rows[:, 8:], signals), malformed
