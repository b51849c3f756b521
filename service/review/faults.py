"""Faults of an emulated plant during a session: when each acted, on the law's clock, and how much it changed.

The plant's status has every fault with its begin and end in ticks of the plant, and the trace has the plant's tick of
the session's first measurement. So a log has all intervals to the tick, whatever event was lost and whenever recording
began.
"""

from __future__ import annotations

from bisect import bisect_left
from math import inf
from operator import itemgetter
from typing import Final

from aeroloop.protocol.messages.models import FaultStatus, Status
from aeroloop.service.logs.runs import Block
from aeroloop.service.review.report import FaultInterval

OUTSIDE: Final = 300
"""Statuses kept on either side of the session: a recorder may write what it recovers minutes late."""


class FaultLog:
    """Faults of one session, by its name and the time between its ticks [s]."""

    def __init__(self, session: str, period: float) -> None:
        self._session = session
        self._period = period
        self._last: Status | None = None  # the plant's last status in the session
        self._first_ns, self._last_ns = inf, -inf  # of its first and last status in the session
        self._outside: list[tuple[int, Status]] = []  # the nearest of those outside of it
        self._first: int | None = None  # plant's tick of the session's first measurement
        self._ticks = 0

    def status(self, status: Status, at_ns: int) -> None:
        """Add a status of the plant, published at a time on its wall clock [ns]; in any order."""
        if status.session == self._session:
            self._first_ns = min(self._first_ns, at_ns)
            if at_ns >= self._last_ns:
                self._last, self._last_ns = status, at_ns
            return
        self._outside.append((at_ns, status))
        if len(self._outside) > 2 * OUTSIDE:
            self._outside.sort(key=itemgetter(0))
            begin = bisect_left(self._outside, self._first_ns, key=itemgetter(0))
            self._outside = self._outside[max(0, begin - OUTSIDE) : begin + OUTSIDE]

    def take(self, block: Block) -> None:
        """Add the session's next block."""
        if block.plant and self._first is None:
            self._first = int(block.plant["tick"][0] - block.plant["session_tick"][0])
        if len(block.k):
            self._ticks = int(block.k[-1]) + 1

    def intervals(self) -> list[FaultInterval]:
        """Faults that acted in the session, in order of time."""
        if (last := self._last) is None:
            return []
        outside = sorted(self._outside, key=itemgetter(0))
        before = next((one for at_ns, one in reversed(outside) if at_ns < self._first_ns), None)
        later = (one for at_ns, one in outside if at_ns > self._last_ns and one.uptime_s >= last.uptime_s)
        last = next(later, last)  # the first after the session has its final counts
        same_process = before is not None and before.uptime_s <= last.uptime_s
        changed = {_key(fault): fault.changed for fault in before.faults} if before and same_process else {}
        found = [self._interval(fault, changed.get(_key(fault), 0)) for fault in last.faults]
        return sorted((interval for interval in found if interval), key=lambda interval: interval.begin_s)

    def _interval(self, fault: FaultStatus, changed_before: int) -> FaultInterval | None:
        if fault.begin_tick is None or self._first is None:
            return None
        begin = max(0, fault.begin_tick - self._first)
        end = None if fault.end_tick is None else fault.end_tick - self._first
        if begin >= self._ticks or (end is not None and end <= begin):
            return None
        lasts = end is None or end >= self._ticks
        return FaultInterval(
            fault=fault.fault,
            source=fault.source,
            begin_s=round(begin * self._period, 9),
            end_s=None if lasts or end is None else round(end * self._period, 9),
            changed=fault.changed - changed_before,
            effect=fault.effect,
        )


def _key(fault: FaultStatus) -> tuple[str, str, int | None]:
    return fault.fault, fault.source, fault.begin_tick
