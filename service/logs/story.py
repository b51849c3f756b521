"""What happened, as roles told it: events, changes, losses, and how old measurements were when they were used.

Of each kind of thing the first few hundred become marks, the rest are counted; so a log with a storm of them can still
be read, and held in memory.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from protocol import topics
from protocol.clock import Histogram
from protocol.messages import Event, Loss, Status
from protocol.verbs import Change, Gains, Hold, Points, Reference, Sinusoid
from service.logs.files import Which
from service.logs.report import Mark

MAX_MARKS: Final = 300
"""Of one kind of one role."""

AROUND_S: Final = 1.0
"""What happened this long before or after a session belongs to it: what led to it, and what came of it [s]."""

Clock = Callable[[int], float | None]


class Happening(NamedTuple):
    """Something that happened at a time of publication [ns]."""

    published_ns: int
    kind: str
    role: str
    text: str
    session: str | None = None


class Kind:
    """All of one kind: the first few hundred, and how many more."""

    def __init__(self) -> None:
        self.first: list[Happening] = []
        self.more = 0
        self.last: Happening | None = None

    def add(self, happening: Happening) -> None:
        """One more."""
        if len(self.first) < MAX_MARKS:
            self.first.append(happening)
        else:
            self.more += 1
            self.last = happening

    def all(self) -> list[Happening]:
        """As many as were kept, and one that tells of the others."""
        if self.last is None:
            return self.first
        return [*self.first, self.last._replace(text=f"{self.more} more, the last: {self.last.text}")]


class Ages:
    """What a controller told of the age of measurements, each time over ten seconds."""

    def __init__(self) -> None:
        self._p50 = Histogram()
        self._p99 = self._max = 0.0

    def add(self, status: Status) -> None:
        """One more status."""
        if status.age_us is not None:
            self._p50.add(round(status.age_us.p50 * 1e3))
            self._p99, self._max = max(self._p99, status.age_us.p99), max(self._max, status.age_us.max)

    def figures(self) -> dict[str, float] | None:
        """The median of all tens of seconds, and the worst p99 and maximum of any [µs]; None if nothing was told."""
        if not self._p50.count:
            return None
        return {"p50": round(self._p50.percentile(50), 1), "p99": self._p99, "max": self._max}


class Story:
    """What a log tells beside its frames.

    Attributes:
        statuses: The last of every vehicle and role.
        trips: Why a plant went to 0 V by itself, each time one did.
    """

    def __init__(self) -> None:
        self.statuses: dict[tuple[str, str], Status] = {}
        self.trips: list[str] = []
        self._kinds: defaultdict[tuple[str, str, str], Kind] = defaultdict(Kind)
        self._ages: defaultdict[Which, Ages] = defaultdict(Ages)
        self._losses: defaultdict[str, defaultdict[str, int]] = defaultdict(lambda: defaultdict(int))

    def event(self, vehicle: str, event: Event, published_ns: int) -> None:
        """An event of any role."""
        if event.kind == "tripped":
            self.trips.append(event.text)
        happening = Happening(published_ns, event.kind, event.role, event.text, event.session)
        self._kinds[vehicle, event.role, event.kind].add(happening)

    def status(self, vehicle: str, role: str, status: Status) -> None:
        """A status of any role."""
        self.statuses[vehicle, role] = status
        if status.session is not None and role == "controller":
            self._ages[vehicle, status.session].add(status)

    def loss(self, vehicle: str, loss: Loss) -> None:
        """What the recorder knows it has lost."""
        address = topics.read_key(loss.key)
        name = address.topic.name if address else loss.key
        self._losses[vehicle][name] += loss.count
        text = f"{loss.count} of {name} lost: {_WHERE[loss.reason]}"
        self._kinds[vehicle, "recorder", f"loss of {name}"].add(Happening(loss.until_ns, "lost", "recorder", text))

    def losses(self, vehicle: str) -> dict[str, int]:
        """Messages lost, by topic."""
        return dict(self._losses[vehicle])

    def age_us(self, which: Which) -> dict[str, float] | None:
        """Age of measurements when they were used [µs]; None if it was not told."""
        return self._ages[which].figures() if which in self._ages else None

    def marks(self, which: Which, changes: Sequence[Change], period: float, clock: Clock) -> list[Mark]:
        """Everything that happened to a vehicle, in order of time.

        Args:
            which: The session that is judged.
            changes: What its controller followed from which tick on, in order.
            period: Time between ticks [s].
            clock: The session's clock [s] at a time of publication [ns].
        """
        vehicle, session = which
        told = [
            happening
            for (whose, _, _), kind in self._kinds.items()
            if whose == vehicle
            for happening in kind.all()
            # A controller tells of a change in words, too, but only the change itself has the tick.
            if not (changes and happening.kind == "changed" and happening.session == session)
        ]
        placed = [
            (happening.published_ns, Mark(time_s=clock(happening.published_ns), kind=happening.kind,
                                          role=happening.role, text=happening.text))
            for happening in sorted(told, key=lambda happening: happening.published_ns)
        ]  # fmt: skip
        within = [i for i, (_, mark) in enumerate(placed) if mark.time_s is not None]
        first, end = (within[0], within[-1] + 1) if within else (len(placed), len(placed))
        between = [mark for _, mark in placed[first:end]] + _changes(changes, period)
        between.sort(key=lambda mark: mark.time_s if mark.time_s is not None else 0.0)
        return [*(mark for _, mark in placed[:first]), *between, *(mark for _, mark in placed[end:])]


_WHERE: Final = {
    "network": "they never came",
    "queue": "they came faster than they could be written",
    "disk": "the log could not be written",
}


def _changes(changes: Sequence[Change], period: float) -> list[Mark]:
    told = [(change.tick, described(change)) for change in changes[:MAX_MARKS]]
    if len(changes) > MAX_MARKS:
        last = changes[-1]
        told.append((last.tick, f"{len(changes) - MAX_MARKS} more, the last: {described(last)}"))
    return [Mark(time_s=round(k * period, 9), kind="change", role="controller", text=text) for k, text in told]


def described(change: Change) -> str:
    """A change in words."""
    said = []
    if change.gains is not None:
        said.append(_gains(change.gains))
    if change.reference is not None:
        within = f" within {change.within_s:g} s" if change.within_s else ""
        said.append(f"follows {_reference(change.reference)}{within}")
    return "; ".join(said)


def _gains(gains: Gains) -> str:
    diagonals: dict[str, Any] = {name: value for name, value in gains if value is not None}
    return ", ".join(f"{name} = diag({', '.join(f'{x:g}' for x in value)})" for name, value in diagonals.items())


def _reference(reference: Reference) -> str:
    match reference:
        case Sinusoid(amplitude=amplitude):
            return f"a sinusoid of {_degrees(amplitude)}"
        case Hold(attitude=None):
            return "where it is"
        case Hold(attitude=attitude) if attitude is not None:
            return _degrees(attitude)
        case Points(times=times):
            return f"{len(times)} points over {times[-1]:g} s"
        case _:
            return "a stream of set-points"


def _degrees(angles: tuple[float, float, float]) -> str:
    return "roll, pitch, yaw " + ", ".join(f"{angle:.4g}°" for angle in angles)
