"""Schedule of a plant's faults: the ticks at which each begins and ends, and how much each has changed.

The plant's time is a whole number of periods, so both ticks follow from the fault and the tick of its injection alone.
"""

from __future__ import annotations

from math import ceil, inf
from typing import Final, Literal, NamedTuple, TypeAlias

from aeroloop.plant_emulator.faults.injection import ActingFault
from aeroloop.protocol.messages.models import FaultStatus

MAX_FAULTS: Final = 64
"""Faults that may act or be to come at the same time; as many that are over are remembered."""

Source: TypeAlias = Literal["configured", "injected"]


class FaultTransition(NamedTuple):
    """A fault's begin, end or injection: when, in ticks of the plant's time, and one line that says what."""

    tick: int
    text: str


class _Scheduled:
    """A fault with its ticks, of which `end` is None if there is none."""

    def __init__(self, acting: ActingFault, source: Source, period: float) -> None:
        self.acting, self.source = acting, source
        self.begin = first_tick(acting.start, period)
        self.end = None if acting.end == inf else first_tick(acting.end, period)
        self.begun = False
        self.over = self.begin == self.end  # it lies between two ticks

    @property
    def due(self) -> float:
        """Its next transition; infinity if none is left."""
        tick = self.end if self.begun else self.begin
        return inf if self.over or tick is None else tick

    def transitions(self, now: int) -> list[FaultTransition]:
        """Its transitions up to now that were not yet taken."""
        found, fault = [], f"({self.source}): {self.acting.fault}"
        if not self.begun and self.due <= now:
            self.begun = True
            found.append(FaultTransition(self.begin, f"fault begins {fault}"))
        if self.begun and self.end is not None and self.due <= now:
            self.over = True
            text = f"fault ends {fault}, {self.acting.changed} {self.acting.fault.effect}"
            found.append(FaultTransition(self.end, text))
        return found


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

    def add(self, acting: ActingFault, source: Source) -> None:
        """Add a fault at work."""
        self._faults.append(added := _Scheduled(acting, source, self._period))
        self.due = min(self.due, added.due)

    def transitions(self, now: int) -> list[FaultTransition]:
        """Begins and ends up to now that were not yet taken, in order of time."""
        found = [transition for fault in self._faults for transition in fault.transitions(now)]
        self.due = min((fault.due for fault in self._faults), default=inf)
        return sorted(found, key=lambda transition: transition.tick)

    def clear(self, now: int) -> list[FaultTransition]:
        """End all faults now, and forget those that have not begun. Returns the ends."""
        self._faults = [fault for fault in self._faults if fault.begun]
        for fault in self._faults:
            if not fault.over:
                fault.end = now
        return self.transitions(now)

    def statuses(self, first: int | None) -> list[FaultStatus]:
        """The faults in order; `first` is the plant's tick at which its time began, None if it has not."""
        return [
            FaultStatus(
                fault=str(one.acting.fault),
                source=one.source,
                begin_tick=None if first is None else first + one.begin,
                end_tick=None if first is None or one.end is None else first + one.end,
                changed=one.acting.changed,
                effect=one.acting.fault.effect,
            )
            for one in self._faults
        ]


def first_tick(time_s: float, period: float) -> int:
    """The first tick at or after a time [s]. Tick n is at n·period, rounded to the nanosecond."""
    tick = max(0, ceil(time_s / period) - 1)
    while round(tick * period, 9) < time_s:
        tick += 1
    return tick
