"""Join of both ends' traces: sessions as blocks of ticks, each tick with the rows of both ends.

The join key is (vehicle, session, session tick). The files are read three times: first the headers of the trace's
batches (traces.py), then the JSON messages that are wanted, which are sorted in memory, then the rows. A block is
yielded once both ends have reached its last tick.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.models import Description
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.messages.trace import NEVER, End, Header, Outcome, Received, join_columns
from aeroloop.service.config import Settings, from_description
from aeroloop.service.logs.files import LogFiles, Progress, ReviewError
from aeroloop.service.logs.in_force import Range
from aeroloop.service.logs.mcap_file import Logged
from aeroloop.service.logs.prelude import read_description
from aeroloop.service.logs.traces import (
    NO_TICK,
    Arrived,
    Extent,
    InOrder,
    Integers,
    SessionKey,
    TraceIndex,
    identified,
)

BLOCK: Final = 4096
"""Approximate ticks of a block: enough for numpy to be fast, few enough for the CPU cache."""

ANSWER_S: Final = 1.2
"""Longest time from a measurement until its command acts; a session's first may take a second [s]."""

_INDEXING: Final = 0.15
"""Share of reading that each of the first two passes takes."""

OWNED: Final = {"plant": ("plant", "can"), "recorder": ("recorder",)}
"""Sections of the configuration by the role that owns them; the others are the controller's."""

Taker = Callable[[bytes, int], None]
"""Callback for a JSON message: its content, and its time of publication [ns]."""

_Beside = tuple[tuple[str, str], Taker]
"""Vehicle and role of the end that published a message, and what takes it."""

Rows = dict[str, npt.NDArray[Any]]
"""Rows of one end, by column: those of its trace, with times in ns on its monotonic clock, −1 for none; and `wall`, the
offset from such a time to its wall clock [ns]."""


class Block(NamedTuple):
    """Ticks of a session, in order, and rows of both ends.

    Attributes:
        which: The session.
        k: Session ticks with a row of either end. Shape (n,).
        controller: The controller's rows in order, including those that compute no tick, such as late frames.
        plant: The plant's rows of this block, then later ones, which may act on commands that answer its ticks.
        at_controller: Index of the row that computed each tick, or −1. Shape (n,).
        at_plant: Index of the plant's row of each tick, or −1. Shape (n,).
        acted: Index of the plant's row that first acted on the command that answers each tick, or −1. Shape (n,).
        changes: Changes of gains and reference since the block before.
        state: Where rows before this block's are missing, the controller's state before its first row; else None.
    """

    which: SessionKey
    k: Integers
    controller: Rows
    plant: Rows
    at_controller: Integers
    at_plant: Integers
    acted: Integers
    changes: list[Change]
    state: dict[str, Any] | None


class Run:
    """The traces of a run.

    Args:
        paths: Logs, folders of logs, or the files of a rotated run.
        progress: Called repeatedly with the share done, 0…1.

    Attributes:
        extents: Recorded extent of each session, in the order of recording.
        missing: Missing rows.
        unknown: Ticks that `read` leaves out, as the log does not hold what was in force then.

    Raises:
        ReviewError: Not a log of this version.
    """

    def __init__(self, paths: Sequence[Path], progress: Progress | None = None) -> None:
        self.files = LogFiles(paths)
        self._progress = progress
        self._index = TraceIndex()
        self._described: dict[SessionKey, dict[str, Description]] = {}

        def of(address: Address) -> Address | None:
            return address if address.topic.name in ("trace", "description") else None

        known: dict[tuple[str, str], Description] = {}
        for found in self.files.routed(of, self._share(0.0, _INDEXING)):
            vehicle = found.answer.vehicle
            if found.answer.topic.name == "description":
                with suppress(ValueError):  # the prelude has reported it
                    description = read_description(found.data, found.answer)
                    known[vehicle, description.role] = description
            elif (header := self._index.add(vehicle, found.data)) and (vehicle, header.session) not in self._described:
                now = {role: description for (whose, role), description in known.items() if whose == vehicle}
                self._described[vehicle, header.session] = now
        self._index.finish()
        self.extents, self.missing, self.unknown = self._index.extents, self._index.missing, self._index.unknown
        self.files.malformed["trace"] = self._index.malformed

    def choose(self, session: str | None = None, vehicle: str | None = None) -> SessionKey:
        """A session. Raises ReviewError if there is none.

        Args:
            session: Its name, alone or as `vehicle/session`, or its number, from 1 in the order of recording; the one
                with the most ticks if None.
            vehicle: Its vehicle; any if None, and that of the longest session for a number.
        """
        known = self.extents if vehicle is None else self.sessions_of(vehicle)
        if not self.extents:
            raise ReviewError(f"{self.files.name} holds no session: no trace of a controller or a plant was recorded")
        if not known:
            vehicles = ", ".join(dict.fromkeys(vehicle for vehicle, _ in self.extents))
            raise ReviewError(f"{self.files.name} holds no session of {vehicle}, only of {vehicles}")
        longest = max(known, key=lambda which: self.extents[which].ticks)
        if session is None:
            return longest
        for which in known:
            if session in (which[1], "/".join(which)):
                return which
        numbered = self.sessions_of(longest[0])
        if session.isdecimal() and 0 < int(session) <= len(numbered):
            return numbered[int(session) - 1]
        names = ", ".join(f"{i} {which[1]}" for i, which in enumerate(numbered[:20], 1))
        more = f" and {len(numbered) - 20} more" if len(numbered) > 20 else ""
        raise ReviewError(f"{self.files.name} holds no session {session!r}; of {longest[0]} it holds {names}{more}")

    def sessions_of(self, vehicle: str) -> list[SessionKey]:
        """Sessions of a vehicle, in the order of recording."""
        return [which for which in self.extents if which[0] == vehicle]

    def described(self, which: SessionKey) -> dict[str, Description]:
        """Descriptions of a session's vehicle when it began, by role; and of the recorder."""
        found = {role: found for (_, role), found in self.files.descriptions.items() if role == "recorder"}
        found |= {role: found for (vehicle, role), found in self.files.descriptions.items() if vehicle == which[0]}
        return found | self._described.get(which, {})

    def settings(self, which: SessionKey) -> Settings:
        """The configuration of a session, each section from the role that owns it, as far as the log has the role.

        Why: every process is configured by itself: the controller's copy of `plant.mass` may differ from the plant's.

        Raises:
            ReviewError: The logs have no description of its controller or plant.
            ConfigError: One is not of this version.
        """
        found = {role: described.config for role, described in self.described(which).items()}
        if (config := found.get("controller", found.get("plant"))) is None:
            damaged = "".join(f"; not read, {line}" for line in self.files.unread[:1])
            raise ReviewError(
                f"{self.files.name} has no description of {which[0]}'s controller or plant: its frames cannot be read"
                f"{damaged}"
            )
        owners = {role: from_description(found[role]) for role in OWNED if role in found}
        owned = {section: getattr(its, section) for role, its in owners.items() for section in OWNED[role]}
        return from_description(config).model_copy(update=owned)  # not validated again: each role ran by its own

    def batches(self, route: Callable[[Address], Taker | None] = lambda _: None) -> Iterator[Arrived]:
        """Batches of the traces, each end's in the order of its rows and none twice.

        `route` is called once per key that is not a trace's; it returns a callback for its messages, or None. States,
        statuses and descriptions come before the first batch that was published after them, by the clock of the end
        that published both; frames, events and losses in the order of recording.
        """
        order = {source: InOrder(source, batches) for source, batches in self._index.sources.items()}
        beside = self._beside(route)

        def of(address: Address) -> tuple[str, Taker | None] | None:
            if address.topic.name == "trace":
                return address.vehicle, None
            taker = None if _is_sorted(address) else route(address)
            return None if taker is None else (address.vehicle, taker)

        for found in self.files.routed(of, self._share(2 * _INDEXING, 1.0)):
            vehicle, taker = found.answer
            if taker is not None:
                taker(found.data, found.publish_time)
            elif known := identified(vehicle, found.data):
                source, header = known
                for arrived in order[source].take(header, found.data, found.publish_time):
                    for waiting in (beside[vehicle, source.end], beside["", ""]):
                        while waiting and waiting[0].publish_time <= arrived.published_ns:
                            message = waiting.popleft()
                            message.answer[1](message.data, message.publish_time)
                    yield arrived
        for waiting in beside.values():
            for message in waiting:
                message.answer[1](message.data, message.publish_time)

    def _beside(self, route: Callable[[Address], Taker | None]) -> dict[tuple[str, str], deque[Logged[_Beside]]]:
        """Messages by the end that published them, those of others under no name, by time of publication."""
        ends = {(source.vehicle, str(source.end)) for source in self._index.sources}
        beside: dict[tuple[str, str], deque[Logged[_Beside]]] = defaultdict(deque)

        def of(address: Address) -> _Beside | None:
            taker = route(address) if _is_sorted(address) else None
            end = address.vehicle, address.role or address.topic.senders[0]
            return None if taker is None else (end if end in ends else ("", ""), taker)

        found = self.files.routed(of, self._share(_INDEXING, 2 * _INDEXING))
        for message in sorted(found, key=lambda each: each.publish_time):
            beside[message.answer[0]].append(message)
        return beside

    def read(
        self, sessions: Collection[SessionKey], route: Callable[[Address], Taker | None] = lambda _: None
    ) -> Iterator[Block]:
        """Blocks of some sessions; those of a session in order. `route` is as in `batches`."""
        joins = {which: self.join(which) for which in sessions}
        for arrived in self.batches(route):
            which = arrived.source.vehicle, arrived.header.session
            if (join := joins.get(which)) is not None and join.add(arrived):
                yield from join.blocks()
        for join in joins.values():
            yield from join.blocks(finished=True)

    def join(self, which: SessionKey, *, alone: bool = False) -> TraceJoin:
        """The join of a session; if `alone`, without the plant's rows."""
        extent = self.extents[which]
        unknown = [(one.first_tick, one.last_tick) for one in self.unknown if (one.vehicle, one.session) == which]
        margin = self.settings(which).loop.ticks(ANSWER_S)
        changes = self._index.changes[which]
        return TraceJoin(which, margin, extent.of("controller") if alone else extent, changes, unknown)

    def _share(self, begin: float, end: float) -> Progress | None:
        progress = self._progress
        return None if progress is None else lambda share: progress(begin + share * (end - begin))


def _is_sorted(address: Address) -> bool:
    return address.topic.kind == "json" and address.topic.name not in ("event", "loss")


class _Segment:
    """Waiting rows of one end, without a gap; `state` is the controller's before them, where rows are missing."""

    def __init__(self, end: End, state: dict[str, Any] | None = None, unknown: Sequence[Range] = ()) -> None:
        self.state = state
        self._unknown = unknown
        self._column = "tick" if end == "controller" else "session_tick"
        self._batches: list[tuple[Header, bytes]] = []
        self._rows: Rows = {}

    def add(self, arrived: Arrived) -> None:
        self._batches.append((arrived.header, arrived.payload))

    @property
    def rows(self) -> Rows:
        """All rows; empty if there are none."""
        if self._batches:
            known = [self._rows] if self._rows else []
            parts = [*known, self._known(_joined(self._batches))]
            self._rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            self._batches.clear()
        return self._rows

    def _known(self, rows: Rows) -> Rows:
        ticks = rows[self._column]
        left = np.ones(len(ticks), dtype=np.bool_)
        for first, last in self._unknown:
            left &= (ticks < first) | (ticks > last)
        return rows if left.all() else {name: column[left] for name, column in rows.items()}

    @property
    def ticks(self) -> Integers:
        """Highest tick up to each row; a late row is of a lower one. Shape (rows,)."""
        rows = self.rows
        return np.maximum.accumulate(rows[self._column]) if rows else np.empty(0, dtype=np.int64)

    def drop(self, n: int) -> None:
        self._rows = {name: column[n:] for name, column in self.rows.items()}
        if n:
            self.state = None


class TraceJoin:
    """Joins the rows of one session's two ends into blocks.

    After a tick it waits for `margin` ticks of the plant, in which the command that answers it may act. `changes` are
    all of the session, in order; rows of `unknown` ticks are left out.
    """

    def __init__(
        self,
        which: SessionKey,
        margin: int,
        extent: Extent,
        changes: Sequence[Change] = (),
        unknown: Sequence[Range] = (),
    ) -> None:
        self._which = which
        self._margin = margin
        self._controller: deque[_Segment] = deque()
        self._plant = _Segment("plant", unknown=unknown)
        self._changes = deque(changes)
        self._unknown = unknown
        self._left_out = False  # whether the controller's last batch was
        # Up to which tick each end has been read; infinity where nothing more comes.
        self._settled: dict[End, float] = {
            end: extent.first[end] - 1 if extent.rows[end] else inf for end in extent.rows
        }
        self._yielded: float = min(self._settled.values())

    def add(self, arrived: Arrived) -> bool:
        """Add a batch; returns whether a block is complete."""
        end, has_rows = arrived.source.end, arrived.header.rows > 0
        if end == "controller" and has_rows:
            left_out = any(first <= arrived.last_tick <= last for first, last in self._unknown)
            if not left_out:
                if arrived.after_gap or self._left_out or not self._controller:
                    self._controller.append(_Segment(end, arrived.tail.state))
                self._controller[-1].add(arrived)
            self._left_out = left_out
        elif has_rows:
            self._plant.add(arrived)
        self._settled[end] = inf if arrived.next_tick == NO_TICK else arrived.next_tick - 1
        return self._limit - self._yielded >= BLOCK

    @property
    def _limit(self) -> float:
        """The tick up to which both ends have been read."""
        return min(self._settled["controller"], self._settled["plant"] - self._margin)

    def blocks(self, *, finished: bool = False) -> Iterator[Block]:
        """Complete blocks; with `finished`, all remaining rows."""
        limit = inf if finished else self._limit
        while len(self._controller) > 1:  # a block has no gap within it
            ticks = self._controller[0].ticks
            if len(ticks):  # else all of them were in earlier blocks
                last = float(ticks[-1])
                if last > limit:
                    break
                yield from self._until(last)
            self._controller.popleft()
        yield from self._until(limit)
        self._yielded = limit

    def _until(self, limit: float) -> Iterator[Block]:
        plant, p = self._plant.rows, int(np.searchsorted(self._plant.ticks, limit, side="right"))
        segment = self._controller[0] if self._controller else _Segment("controller")
        n = int(np.searchsorted(segment.ticks, limit, side="right"))
        if n or p:
            controller = {name: column[:n] for name, column in segment.rows.items()}
            changes = []
            while self._changes and self._changes[0].tick <= limit:
                changes.append(self._changes.popleft())
            yield _block(self._which, controller, plant, p, changes, segment.state)
            segment.drop(n)
            self._plant.drop(p)


def _block(
    which: SessionKey, controller: Rows, plant: Rows, p: int, changes: list[Change], state: dict[str, Any] | None
) -> Block:
    """The block of these rows of the controller and the first p rows of the plant."""
    ticks = computed = measured = acting = answers = np.empty(0, dtype=np.int64)
    if controller:
        received_as = controller["received_as"]
        computed = np.flatnonzero((received_as == Received.FRAME) | (received_as == Received.SILENT))
        ticks = controller["tick"][computed]
    if plant:
        measured = plant["session_tick"][:p]
        acting = np.flatnonzero((plant["outcome"] == Outcome.ACTED) & (plant["answered"] != NEVER))
        answers, first = np.unique(plant["answered"][acting], return_index=True)
        acting = acting[first]
    k = np.union1d(ticks, measured)
    at_controller, at_plant = _places(ticks, computed, k), _places(measured, np.arange(len(measured)), k)
    return Block(which, k, controller, plant, at_controller, at_plant, _places(answers, acting, k), changes, state)


def _places(ticks: Integers, places: Integers, k: Integers) -> Integers:
    """Index of the row of each tick k, or −1. Ticks ascend."""
    if not len(ticks):
        return np.full(len(k), -1)
    at = np.minimum(np.searchsorted(ticks, k), len(ticks) - 1)
    return np.where(ticks[at] == k, places[at], -1)


def _joined(batches: Sequence[tuple[Header, bytes]]) -> Rows:
    """Rows of one end's batches, concatenated."""
    rows = join_columns(batches)
    headers = [header for header, _ in batches]
    counts = [header.rows for header in headers]
    base = np.repeat([header.monotonic_ns for header in headers], counts)
    for name in ("received", "sent"):
        rows[name] = np.where(rows[name] == NEVER, -1, rows[name].astype(np.int64) * 1000 + base)
    for name in ("tick", "session_tick", "answered"):
        if name in rows:
            rows[name] = rows[name].astype(np.int64)
    rows["wall"] = np.repeat([header.wall_ns - header.monotonic_ns for header in headers], counts)
    return rows
