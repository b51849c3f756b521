"""What a log holds of gains and reference: every change of them, and the ticks at which they are known.

The tail of a controller's batch has the changes among its rows and, once a second, the record of what is in force with
the tick since when; the plant's batches repeat the last record that the controller sent. So a record proves what was in
force from that tick to its own, and from a proven tick on the rows of the controller prove it up to a gap. The
controller's state stands before each batch: after a gap its rows count from the first batch that begins with gains and
reference known. All other ticks are unknown, and no reader computes anything of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pydantic import BaseModel

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import Header, Tail

Range = tuple[int, int]
"""First and last tick."""


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


class Segment(NamedTuple):
    """Batches of a controller without a gap: the first tick of each, and the last tick of all."""

    begins: list[int]
    last: int


class InForce:
    """Changes of one session, and the ticks at which their effect is known."""

    def __init__(self) -> None:
        self._changes: list[tuple[int, Change]] = []  # with the first row of their batch
        self._records: list[tuple[int, list[Change]]] = []  # with the last tick of their batch

    def add(self, header: Header, tail: Tail, last_tick: int) -> None:
        """Add a batch; most have neither a change nor a record."""
        self._changes += [(header.first_row, change) for change in tail.changes if change.session == header.session]
        if tail.record and all(change.session == header.session for change in tail.record):
            self._records.append((max(last_tick, *(change.tick for change in tail.record)), tail.record))

    def update(self, other: InForce) -> None:
        """Add what another process of the session has published."""
        self._changes += other._changes
        self._records += other._records

    def changes(self) -> list[Change]:
        """All changes in order: those of the batches, and of records those that no batch has."""
        found: list[Change] = []
        for _, change in sorted(self._changes, key=lambda placed: (placed[1].tick, placed[0])):
            if change not in found[-4:]:  # recorded twice
                found.append(change)
        had = {(change.tick, part) for change in found for part in _parts(change)}
        for _, record in self._records:
            new = [change for change in record if not had.issuperset((change.tick, part) for part in _parts(change))]
            had |= {(change.tick, part) for change in new for part in _parts(change)}
            found += new
        return sorted(found, key=lambda change: change.tick)

    def unknown(self, segments: Sequence[Segment], ticks: Range) -> list[Range]:
        """Those of some ticks that are unknown."""
        proven = [(_since(record), tick) for tick, record in self._records]
        if _is_whole(change for _, change in self._changes if change.tick == 0):
            proven.append((0, 0))
        unknown: list[Range] = []
        after, until = ticks
        for begins, last in segments:
            unknown += _without((after, begins[0] - 1), proven)
            known = min((max(a, begins[0]) for a, b in proven if a <= last and b >= begins[0]), default=last + 1)
            known = next((begin for begin in begins if begin >= known), last + 1)
            unknown.append((begins[0], known - 1))
            after = last + 1
        unknown += _without((after, until), proven)
        joined: list[Range] = []
        for first, last in unknown:
            if first > last:
                continue
            if joined and joined[-1][1] + 1 == first:
                first = joined.pop()[0]
            joined.append((first, last))
        return joined


def _parts(change: Change) -> list[str]:
    return [name for name in ("gains", "reference") if getattr(change, name) is not None]


def _is_whole(changes: Iterable[Change]) -> bool:
    return {part for change in changes for part in _parts(change)} == {"gains", "reference"}


def _since(record: Sequence[Change]) -> int:
    """From when a record holds; never if it lacks gains or reference."""
    return max(change.tick for change in record) if _is_whole(record) else 1 << 62


def _without(ticks: Range, proven: Iterable[Range]) -> list[Range]:
    """What of a range no other range has."""
    (after, last), left = ticks, []
    for first, end in sorted(proven):
        if first > after:
            left.append((after, min(first - 1, last)))
        after = max(after, end + 1)
    return [*left, (after, last)]
