"""Events of a session: published events, changes, recorder losses, and the age of measurements.

An event is shown at its sender's time, wherever it stands in the file: with a session tick at that tick, any other by
its time of publication on the session's clock, as the sender's own trace relates the two (`SenderClocks`). For a
sender without a trace, such as a recorder, the plant's trace does, so two hosts' clocks are compared there: that is for
showing only, nothing is decided by it. The first few hundred of each kind become marks and the rest are counted, so
that a log with a storm of events fits in memory and can be read.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from math import inf
from operator import attrgetter, itemgetter
from typing import Final, NamedTuple

import numpy as np

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LOSS_REASONS, Event, Loss, Status
from aeroloop.protocol.messages.operator import Change, in_words
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.messages.trace import ENDS
from aeroloop.protocol.runtime.timing import Histogram
from aeroloop.service.logs.runs import Block, Taker
from aeroloop.service.logs.traces import NO_TICK, Extent, Integers, SessionKey
from aeroloop.service.review.faults import FaultLog
from aeroloop.service.review.report import Mark

MAX_MARKS: Final = 300
"""Marks kept per kind and role."""

_RECENT: Final = 100_000
"""Messages kept to find duplicates: a restarted recorder records some messages again."""

Place = tuple[int, float]
"""Sort key of a mark: −1 before the session, 0 within it, 1 after it; then its tick, on its sender's clock."""


class _Happened(NamedTuple):
    """What becomes a mark: its sender's time [ns], its text, its tick where it has one, else whether it is within."""

    at_ns: int
    text: str
    tick: int | None = None
    within: bool = False


class _Kind:
    """What happened of one kind: the first few hundred by the sender's time, and the count of the rest."""

    def __init__(self) -> None:
        self._first: list[_Happened] = []
        self._more = 0
        self._last: _Happened | None = None

    def add(self, one: _Happened) -> None:
        self._first.append(one)
        if len(self._first) > 2 * MAX_MARKS:
            self._prune()

    def all(self) -> list[_Happened]:
        """Those kept, in order, and one that stands for the rest."""
        self._prune()
        if self._last is None:
            return self._first
        return [*self._first, self._last._replace(text=f"{self._more} more, the last: {self._last.text}")]

    def _prune(self) -> None:
        self._first.sort(key=attrgetter("at_ns"))
        if rest := self._first[MAX_MARKS:]:
            self._more += len(rest)
            self._last = max(rest[-1], self._last or rest[-1], key=attrgetter("at_ns"))
            del self._first[MAX_MARKS:]


class SenderClocks:
    """Senders' wall clocks against one session's ticks, by the first and the last row of each block of either end.

    Between them a time is interpolated, since a session in lockstep runs faster or slower than any clock; outside of
    the session it is counted in periods.
    """

    def __init__(self, period: float) -> None:
        self._period_ns = period * 1e9
        self._known: dict[str, list[tuple[int, int]]] = {end: [] for end in ENDS}  # wall time [ns] and tick

    def take(self, block: Block) -> None:
        """Add the session's next block."""
        for end, rows, at in (
            ("controller", block.controller, block.at_controller),
            ("plant", block.plant, block.at_plant),
        ):
            if rows and len(there := np.flatnonzero(at >= 0)):
                ends: Integers = there[[0, -1]]
                time = np.maximum(rows["received"][at[ends]], rows["sent"][at[ends]])
                walls = (time + rows["wall"][at[ends]])[time >= 0]
                self._known[end] += zip(walls.tolist(), block.k[ends][time >= 0].tolist(), strict=True)

    def tick(self, role: str, at_ns: int) -> float:
        """The session's tick at a time on a role's wall clock; negative before the session. ∞ without any row."""
        known = sorted(self._known.get(role) or self._known["plant"] or self._known["controller"])
        if not known:
            return inf
        (first_ns, first), (last_ns, last) = known[0], known[-1]
        if at_ns <= first_ns:
            return first + (at_ns - first_ns) / self._period_ns
        if at_ns >= last_ns:
            return last + (at_ns - last_ns) / self._period_ns
        walls, ticks = zip(*((wall - first_ns, tick) for wall, tick in known), strict=True)
        return float(np.interp(at_ns - first_ns, walls, ticks))


class EventLog:
    """Messages beside the traces, of the session that is judged and its vehicle.

    Args:
        which: The session.
        period: Time between its ticks [s].
        extent: Its recorded extent.
        alone: Leave out the trips of other sessions.

    Attributes:
        statuses: The last status of every vehicle and role.
        trips: Reason of every trip of the vehicle, in which the plant goes to 0 V by itself.
        losses: Messages of the vehicle that the recorder lost, by topic.
        faults: Faults of its plant.
        unreadable: Malformed messages, by topic.
    """

    def __init__(
        self,
        which: SessionKey,
        period: float,
        extent: Extent,
        *,
        alone: bool = False,
    ) -> None:
        self.unreadable: Counter[str] = Counter()
        self._alone = alone
        self.statuses: dict[tuple[str, str], Status] = {}
        self.trips: list[str] = []
        self.losses: dict[str, int] = {}
        self.faults = FaultLog(which[1], period)
        self._which = which
        self._period = period
        self._last_tick = max(extent.last.values(), default=NO_TICK)
        self._clocks = SenderClocks(period)
        self._kinds: defaultdict[tuple[str, str], _Kind] = defaultdict(_Kind)
        self._ages: tuple[Histogram, float, float] = Histogram(), 0.0, 0.0  # medians, largest p99, largest maximum
        self._recent: dict[int, None] = {}
        self._status_ns: dict[tuple[str, str], int] = {}

    def route(self, address: Address) -> Taker | None:
        """Callback for the messages of a key; None if they are not used."""
        name = address.topic.name
        take = {"event": self._event, "loss": self._loss, "status": self._status}.get(name)
        if take is None:
            return None

        def checked(payload: bytes, at_ns: int) -> None:
            try:
                take(address, payload, at_ns)
            except (ValueError, OverflowError):  # a stranger may publish anything, such as 1e999
                self.unreadable[name] += 1

        return checked

    def take(self, block: Block) -> None:
        """Add the session's next block: its changes of gains and reference, and its times."""
        self._clocks.take(block)
        self.faults.take(block)
        for change in block.changes:
            self._add("change", "controller", _Happened(change.tick, described(change), change.tick))

    @property
    def age_us(self) -> dict[str, float] | None:
        """Age of measurements when used: median of all medians, worst p99 and maximum [µs]; None without."""
        medians, p99, most = self._ages
        return {"p50": round(medians.percentile(50), 1), "p99": p99, "max": most} if medians.count else None

    def marks(self) -> list[Mark]:
        """Marks of the vehicle in order of time; those outside of the session come first or last."""
        found = [
            self._placed(kind, role, one) for (role, kind), happened in self._kinds.items() for one in happened.all()
        ]
        return [mark for _, mark in sorted(found, key=itemgetter(0))]

    def _event(self, address: Address, payload: bytes, at_ns: int) -> None:
        if self._is_duplicate(address.vehicle, payload, at_ns):
            return
        event, role = Event.model_validate_json(payload), address.role or ""
        of_session = event.session == self._which[1]
        repeats_a_change = event.kind == "changed" and role == "controller" and of_session
        if address.vehicle != self._which[0] or repeats_a_change:
            return
        if event.kind == "tripped" and role == "plant" and (of_session or not self._alone):
            self.trips.append(event.text)
        tick = event.tick if of_session and event.tick is not None and 0 <= event.tick <= self._last_tick + 1 else None
        self._add(event.kind, role, _Happened(at_ns, event.text, tick, event.tick is None and of_session))

    def _loss(self, address: Address, payload: bytes, at_ns: int) -> None:
        if address.vehicle != self._which[0] or self._is_duplicate(address.vehicle, payload, at_ns):
            return
        loss = Loss.model_validate_json(payload)
        lost = topics.read_key(loss.key)
        name = lost.topic.name if lost else loss.key
        self.losses[name] = self.losses.get(name, 0) + loss.count
        self._add("lost", "recorder", _Happened(at_ns, f"{loss.count} of {name} lost: {LOSS_REASONS[loss.reason]}"))

    def _status(self, address: Address, payload: bytes, at_ns: int) -> None:
        vehicle, role = address.vehicle, address.role
        if role is None or self._is_duplicate(vehicle, payload, at_ns):
            return
        status = Status.model_validate_json(payload)
        age = status.age_us
        median_ns = 0 if age is None else round(age.p50 * 1e3)
        if at_ns > self._status_ns.get((vehicle, role), 0):
            self._status_ns[vehicle, role], self.statuses[vehicle, role] = at_ns, status
        if (vehicle, role) == (self._which[0], "plant"):
            self.faults.status(status, at_ns)
        if (vehicle, status.session) == self._which and role == "controller" and age is not None:
            medians, p99, most = self._ages
            medians.add(median_ns)
            self._ages = medians, max(p99, age.p99), max(most, age.max)

    def _is_duplicate(self, vehicle: str, payload: bytes, at_ns: int) -> bool:
        """Whether the very same message was recorded before."""
        message = hash((vehicle, payload, at_ns))
        if message in self._recent:
            return True
        self._recent[message] = None
        if len(self._recent) > _RECENT:
            del self._recent[next(iter(self._recent))]
        return False

    def _add(self, kind: str, role: str, one: _Happened) -> None:
        self._kinds[role, kind].add(one)

    def _placed(self, kind: str, role: str, one: _Happened) -> tuple[Place, Mark]:
        """The mark of what happened. What is of the session is within it, even if published just before or after."""
        tick = self._clocks.tick(role, one.at_ns) if one.tick is None else one.tick
        shown = min(max(tick, 0), self._last_tick) if one.within else tick
        outside = -1 if shown < 0 else 1 if shown > self._last_tick + 1 else 0
        time_s = None if outside else round(shown * self._period, 9)
        return (outside, tick), Mark(time_s=time_s, kind=kind, role=role, text=one.text)


def described(change: Change) -> str:
    """A change in words."""
    parts = []
    if change.gains is not None:
        parts.append(
            ", ".join(f"{name} = [{', '.join(f'{x:g}' for x in xs)}]" for name, xs in change.gains.named.items())
        )
    if change.reference is not None:
        within = f" within {change.within_s:g} s" if change.within_s else ""
        parts.append(f"follows {in_words(change.reference)}{within}")
    return "; ".join(parts)
