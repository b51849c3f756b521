"""Events of a session: published events, changes, recorder losses, and the age of measurements.

An event with a session tick is placed at that tick; any other at the tick that the plant's trace had reached in the
file when the event was recorded. The first few hundred of each kind become marks and the rest are counted, so that a
log with a storm of events fits in memory and can be read.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Final

from pydantic import ValidationError

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Event, Loss, Status
from aeroloop.protocol.messages.operator import Change, in_words
from aeroloop.protocol.messages.topics import Address
from aeroloop.protocol.runtime.timing import Histogram
from aeroloop.service.logs.runs import Taker
from aeroloop.service.logs.traces import SessionKey
from aeroloop.service.review.faults import FaultLog
from aeroloop.service.review.report import Mark

MAX_MARKS: Final = 300
"""Marks kept per kind and role."""

_RECENT: Final = 100_000
"""Messages kept to find duplicates: a restarted recorder records some messages again."""

Place = tuple[int, float]
"""Sort key of a mark: −1 before the session, 0 and a time [s] within it, 1 after it."""


class _Kind:
    """Marks of one kind: the first few hundred, and the count of the rest."""

    def __init__(self) -> None:
        self.first: list[tuple[Place, Mark]] = []
        self.more = 0
        self.last: tuple[Place, Mark] | None = None

    def add(self, place: Place, mark: Mark) -> None:
        if len(self.first) < MAX_MARKS:
            self.first.append((place, mark))
        else:
            self.more += 1
            self.last = place, mark

    def all(self) -> list[tuple[Place, Mark]]:
        """The marks kept, and one that stands for the rest."""
        if self.last is None:
            return self.first
        place, mark = self.last
        return [*self.first, (place, mark.model_copy(update={"text": f"{self.more} more, the last: {mark.text}"}))]


class EventLog:
    """Messages beside the traces, of the session that is judged and its vehicle.

    Args:
        which: The session.
        period: Time between its ticks [s].
        reached: As of `Run`.
        open_sessions: As of `Run`.
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
        reached: Mapping[SessionKey, int],
        open_sessions: Mapping[str, str],
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
        self._reached = reached
        self._open = open_sessions
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
            except ValidationError:  # a stranger may publish anything
                self.unreadable[name] += 1

        return checked

    def changed(self, changes: Sequence[Change]) -> None:
        """Add changes of gains and reference."""
        for change in changes:
            self._add("change", "controller", described(change), change.tick)

    @property
    def age_us(self) -> dict[str, float] | None:
        """Age of measurements when used: median of all medians, worst p99 and maximum [µs]; None without."""
        medians, p99, most = self._ages
        return {"p50": round(medians.percentile(50), 1), "p99": p99, "max": most} if medians.count else None

    def marks(self) -> list[Mark]:
        """Marks of the vehicle in order of time; those outside of the session come first or last."""
        found = [placed for kind in self._kinds.values() for placed in kind.all()]
        return [mark for _, mark in sorted(found, key=lambda placed: placed[0])]

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
        tick = event.tick if of_session else None
        self._add(event.kind, role, event.text, tick, event.session)

    def _loss(self, address: Address, payload: bytes, at_ns: int) -> None:
        if address.vehicle != self._which[0] or self._is_duplicate(address.vehicle, payload, at_ns):
            return
        loss = Loss.model_validate_json(payload)
        lost = topics.read_key(loss.key)
        name = lost.topic.name if lost else loss.key
        self.losses[name] = self.losses.get(name, 0) + loss.count
        self._add("lost", "recorder", f"{loss.count} of {name} lost: {_WHERE[loss.reason]}")

    def _status(self, address: Address, payload: bytes, at_ns: int) -> None:
        vehicle, role = address.vehicle, address.role
        if role is None or at_ns <= self._status_ns.get((vehicle, role), 0):
            return  # a duplicate
        self._status_ns[vehicle, role] = at_ns
        status = self.statuses[vehicle, role] = Status.model_validate_json(payload)
        if (vehicle, role) == (self._which[0], "plant"):
            self.faults.status(status)
        age = status.age_us
        if (vehicle, status.session) == self._which and role == "controller" and age is not None:
            medians, p99, most = self._ages
            medians.add(round(age.p50 * 1e3))
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

    def _add(self, kind: str, role: str, text: str, tick: int | None = None, session: str | None = None) -> None:
        reached = self._reached.get(self._which)
        within = self._open.get(self._which[0]) == self._which[1] and session in (None, self._which[1])
        if tick is None and (within or session == self._which[1]):
            tick = reached or 0
        time_s = None if tick is None else round(tick * self._period, 9)
        place = (-1 if reached is None else 1, 0.0) if time_s is None else (0, time_s)
        self._kinds[role, kind].add(place, Mark(time_s=time_s, kind=kind, role=role, text=text))


_WHERE: Final = {
    "network": "not received",
    "queue": "received faster than written",
    "disk": "the log could not be written",
}


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
