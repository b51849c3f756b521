"""Schedule of a plant's faults: the ticks at which each begins and ends, and how much each has changed.

The plant's time is a whole number of periods, so both ticks follow from the fault and the tick of its injection alone.
"""

from __future__ import annotations

from math import inf
from typing import Final, Literal, NamedTuple

from aeroloop.plant_emulator.faults.language import Fault, first_tick
from aeroloop.plant_emulator.faults.signals import ValueFault
from aeroloop.plant_emulator.faults.streams import StreamFault
from aeroloop.protocol.messages.models import FaultStatus

MAX_FAULTS: Final = 64
"""Faults that may act or be to come at the same time; as many that are over are remembered."""

Source = Literal["configured", "injected"]


class Turn(NamedTuple):
    """A fault's begin, end or injection: when, in ticks of the plant's time, and one line that says what."""

    tick: int
    text: str


def begins(fault: str, source: Source) -> str:
    """Text of the event of a fault's begin."""
    return f"fault begins ({source}): {fault}"


def ends(fault: str, source: Source, changed: int, effect: str) -> str:
    """Text of the event of a fault's end, with what it changed."""
    return f"fault ends ({source}): {fault}, {changed} {effect}"


class _Scheduled:
    """A fault as it was written; what applies it; its ticks, of which `end` is None if there is none."""

    def __init__(self, fault: Fault, source: Source, applied: ValueFault | StreamFault, period: float) -> None:
        self.fault, self.source, self.applied = fault, source, applied
        end_s = applied.fault.end_s
        self.begin = first_tick(applied.fault.start_s, period)
        self.end = None if end_s is None else first_tick(end_s, period)
        self.begun = False
        self.over = self.begin == self.end  # it lies between two ticks

    @property
    def due(self) -> float:
        """Its next turn; infinity if none is left."""
        tick = self.end if self.begun else self.begin
        return inf if self.over or tick is None else tick

    def turns(self, now: int) -> list[Turn]:
        """Its turns up to now that were not yet taken."""
        turns = []
        if not self.begun and self.due <= now:
            self.begun = True
            turns.append(Turn(self.begin, begins(str(self.fault), self.source)))
        if self.begun and self.due <= now:
            self.over = True
            assert self.end is not None
            text = ends(str(self.fault), self.source, self.applied.changed, self.fault.effect)
            turns.append(Turn(self.end, text))
        return turns


class Schedule:
    """Schedule of all faults of a plant with this `period` [s]. Times are ticks since the first claim.

    Attributes:
        due: The next tick at which a fault begins or ends; infinity if there is none.
    """

    def __init__(self, period: float) -> None:
        self.due: float = inf
        self._period = period
        self._faults: list[_Scheduled] = []

    def make_room(self, count: int) -> None:
        """Make room for so many faults by forgetting those that are over. Raises ValueError if it does not do."""
        if sum(not fault.over for fault in self._faults) + count > MAX_FAULTS:
            raise ValueError(f"a plant takes {MAX_FAULTS} faults at a time: `aeroloop op inject --clear` removes them")
        over = [fault for fault in self._faults if fault.over]
        forgotten = over[: max(0, len(over) + count - MAX_FAULTS)]
        self._faults = [fault for fault in self._faults if fault not in forgotten]

    def add(self, fault: Fault, source: Source, applied: ValueFault | StreamFault) -> None:
        """Add a fault as it was written, with what applies it."""
        self._faults.append(added := _Scheduled(fault, source, applied, self._period))
        self.due = min(self.due, added.due)

    def turns(self, now: int) -> list[Turn]:
        """Begins and ends up to now that were not yet taken, in order of time."""
        turns = [turn for fault in self._faults for turn in fault.turns(now)]
        self.due = min((fault.due for fault in self._faults), default=inf)
        return sorted(turns, key=lambda turn: turn.tick)

    def clear(self, now: int) -> list[Turn]:
        """End all faults now, and forget those that have not begun. Returns the ends."""
        self._faults = [fault for fault in self._faults if fault.begun]
        for fault in self._faults:
            if not fault.over:
                fault.end = now
        return self.turns(now)

    def statuses(self, first: int | None) -> list[FaultStatus]:
        """The faults in order; `first` is the plant's tick at which its time began, None if it has not."""
        return [
            FaultStatus(
                fault=str(one.fault),
                source=one.source,
                begin_tick=None if first is None else first + one.begin,
                end_tick=None if first is None or one.end is None else first + one.end,
                changed=one.applied.changed,
                effect=one.fault.effect,
            )
            for one in self._faults
        ]
