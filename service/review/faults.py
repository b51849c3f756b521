"""Faults of an emulated plant during a session: when each acted, on the law's clock, and how much it changed.

The plant's status has every fault with its begin and end in ticks of the plant, and the trace has the plant's tick of
the session's first measurement. So a log has all intervals to the tick, whatever event was lost and whenever recording
began.
"""

from __future__ import annotations

from aeroloop.protocol.messages.models import FaultStatus, Status
from aeroloop.service.logs.runs import Block
from aeroloop.service.review.report import FaultInterval


class FaultLog:
    """Faults of one session, by its name and the time between its ticks [s]."""

    def __init__(self, session: str, period: float) -> None:
        self._session = session
        self._period = period
        self._before: Status | None = None  # the plant's last status before the session
        self._last: Status | None = None  # its last in the session, or the first after it
        self._over = False
        self._first: int | None = None  # plant's tick of the session's first measurement
        self._ticks = 0

    def status(self, status: Status) -> None:
        """Add a status of the plant; in order."""
        if status.session == self._session:
            self._last = status
        elif self._last is None:
            self._before = status
        elif not self._over and status.uptime_s >= self._last.uptime_s:
            self._last, self._over = status, True

    def take(self, block: Block) -> None:
        """Add the session's next block."""
        if block.plant and self._first is None:
            self._first = int(block.plant["tick"][0] - block.plant["session_tick"][0])
        if len(block.k):
            self._ticks = int(block.k[-1]) + 1

    def intervals(self) -> list[FaultInterval]:
        """Faults that acted in the session, in order of time."""
        if self._last is None:
            return []
        before = self._before
        same_process = before is not None and before.uptime_s <= self._last.uptime_s
        changed = {_key(fault): fault.changed for fault in before.faults} if before and same_process else {}
        found = [self._interval(fault, changed.get(_key(fault), 0)) for fault in self._last.faults]
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
