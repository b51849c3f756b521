"""Join of both ends' traces: sessions as blocks of ticks, each tick with the rows of both ends.

The join key is (vehicle, session, session tick). The files are read twice: first the headers of the trace's batches
(traces.py), then the rows. A block is yielded once both ends have reached its last tick, so memory stays bounded
however long a session is.
"""

from __future__ import annotations

from collections import deque
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
"""Share of reading that the first pass takes."""

OWNED: Final = {"plant": ("plant", "can"), "recorder": ("recorder",)}
"""Sections of the configuration by the role that owns them; the others are the controller's."""

Taker = Callable[[bytes, int], None]
"""Callback for a JSON message: its content, and its time of publication [ns]."""

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
        reached: The last tick of each session that `read` has reached.
        open_sessions: The session of each vehicle that is open at that point of the files.

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
        self.extents, self.missing = self._index.extents, self._index.missing
        self.reached: dict[SessionKey, int] = {}
        self.open_sessions: dict[str, str] = {}

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

        `route` is called once per key that is not a trace's; it returns a callback for its messages, or None.
        """
        order = {source: InOrder(source, batches) for source, batches in self._index.sources.items()}

        def of(address: Address) -> tuple[str, Taker | None] | None:
            if address.topic.name == "trace":
                return address.vehicle, None
            taker = route(address)
            return None if taker is None else (address.vehicle, taker)

        for found in self.files.routed(of, self._share(_INDEXING, 1.0)):
            vehicle, taker = found.answer
            if taker is not None:
                taker(found.data, found.publish_time)
            elif known := identified(vehicle, found.data):
                source, header = known
                yield from order[source].take(header, found.data)

    def read(
        self, sessions: Collection[SessionKey], route: Callable[[Address], Taker | None] = lambda _: None
    ) -> Iterator[Block]:
        """Blocks of some sessions; those of a session in order. `route` is as in `batches`."""
        joins = {which: self.join(which) for which in sessions}
        for arrived in self.batches(route):
            which = arrived.source.vehicle, arrived.header.session
            self._follow(which, arrived)
            if (join := joins.get(which)) is not None and join.add(arrived):
                yield from join.blocks()
        for join in joins.values():
            yield from join.blocks(finished=True)

    def join(self, which: SessionKey, *, alone: bool = False) -> TraceJoin:
        """The join of a session; if `alone`, without the plant's rows."""
        extent = self.extents[which]
        begins = extent.first["controller"]
        before = [change for change in self.files.changes.get(which, ()) if change.tick < begins]
        margin = self.settings(which).loop.ticks(ANSWER_S)
        return TraceJoin(which, margin, extent.of("controller") if alone else extent, before)

    def _follow(self, which: SessionKey, arrived: Arrived) -> None:
        """Track the last tick of the plant's trace; of the controller's, if the log has none of the plant."""
        vehicle, session = which
        header = arrived.header
        if header.end == "controller" and which in self.extents and self.extents[which].rows["plant"]:
            return
        if header.rows:
            self.reached[which], self.open_sessions[vehicle] = arrived.last_tick, session
        if header.final or not session:
            self.open_sessions.pop(vehicle, None)

    def _share(self, begin: float, end: float) -> Progress | None:
        progress = self._progress
        return None if progress is None else lambda share: progress(begin + share * (end - begin))


class _Segment:
    """Waiting rows of one end, without a gap; `state` is the controller's before them, where rows are missing."""

    def __init__(self, end: End, state: dict[str, Any] | None = None) -> None:
        self.state = state
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
            parts = [*known, _joined(self._batches)]
            self._rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            self._batches.clear()
        return self._rows

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

    After a tick it waits for `margin` ticks of the plant, in which the command that answers it may act; `changes` are
    in force before the first row.
    """

    def __init__(self, which: SessionKey, margin: int, extent: Extent, changes: Sequence[Change] = ()) -> None:
        self._which = which
        self._margin = margin
        self._controller: deque[_Segment] = deque()
        self._plant = _Segment("plant")
        self._changes = list(changes)
        # Up to which tick each end has been read; infinity where nothing more comes.
        self._settled: dict[End, float] = {
            end: extent.first[end] - 1 if extent.rows[end] else inf for end in extent.rows
        }
        self._yielded: float = min(self._settled.values())

    def add(self, arrived: Arrived) -> bool:
        """Add a batch; returns whether a block is complete."""
        end, has_rows = arrived.source.end, arrived.header.rows > 0
        if end == "controller":
            if has_rows:
                if arrived.after_gap or not self._controller:
                    self._controller.append(_Segment(end, arrived.tail.state))
                self._controller[-1].add(arrived)
            self._changes += arrived.changes
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
            changes, self._changes = self._changes, []
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
