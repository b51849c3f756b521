"""Every tick's frame, also of those that were not sent because they would have said what the last one said.

A `Filler` puts one direction's silent ticks back between the frames of a log: of how many there were, counters and
times of publication tell; in lockstep each is in the log as an empty frame. What reads a log then has a frame a tick,
whatever was sent. What the controller did otherwise than that, because a measurement came late or it missed ticks, its
lapses tell.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import floor
from typing import Final, NamedTuple

from protocol.clock import LoopSettings
from protocol.frames import FrameFormat, TickCounter
from protocol.messages import Lapse
from protocol.transmit import SILENCE

_DRIFT: Final = 10_000
"""Two clocks that keep the same grid part by less than a part in this."""


class Read(NamedTuple):
    """A frame out of the log that is not malformed, or what stands for one that was not sent.

    Attributes:
        counter: Its counter, or echo.
        frame: Its bytes.
        published_ns: When it was published; of one that was not sent, about when it would have been.
        since_ns: From when on it can be answered: who hears silence answers before a frame that is sent late.
        sent: Whether it was.
    """

    counter: int
    frame: bytes
    published_ns: int
    since_ns: int
    sent: bool = True


class Filler:
    """Fills in one direction of a session.

    A measurement that was not sent was due on the plant's grid; a command that was not sent, before the next that was.

    Args:
        kind: What the frames are.
        loop: The plant's grid.
        on_grid: Whether they are measurements.
    """

    def __init__(self, kind: FrameFormat, loop: LoopSettings, *, on_grid: bool) -> None:
        self._kind = kind
        self._counter = kind.counter
        self._period_ns = loop.period_ns
        self._lockstep = loop.lockstep
        self._on_grid = on_grid and not loop.lockstep
        self._last: Read | None = None
        self._grid_ns = 0  # when the tick of the last frame was due, by the earliest publications
        self._ticks = TickCounter(loop.period_ns, kind.counters, lockstep=loop.lockstep)  # as the controller has it

    def reads(self, frame: bytes, published_ns: int) -> list[Read] | None:
        """The frame with those before it that were not sent, in order; None if it is malformed.

        Args:
            frame: As it is in the log.
            published_ns: When it was published [ns].
        """
        last = self._last
        if frame == SILENCE:  # in lockstep
            if last is not None:
                self._last = _silent(self._kind, last, last.counter + 1, published_ns)
            return [] if self._last is None else [self._last]
        counter = self._counter(frame)
        if counter is None:
            return None
        before, now = self._ticks.tick, self._ticks.advance(counter, published_ns) if self._on_grid else None
        if self._on_grid and now is None:
            return []  # not newer than the last, so the controller did not hear it either
        if last is None or self._lockstep:  # where each silent tick has its message, there is nothing to fill in
            self._grid_ns = published_ns
            self._last = Read(counter, frame, published_ns, published_ns)
            return [self._last]
        ticks = self._ticks_since(last, counter, published_ns) if now is None else now - before
        before_ns = self._grid_ns
        elapsed_ns = ticks * self._period_ns
        self._grid_ns = min(before_ns + elapsed_ns + elapsed_ns // _DRIFT, published_ns)
        if self._on_grid:
            times = [before_ns + (self._grid_ns - before_ns) * i // ticks for i in range(1, ticks)]
        else:
            times = [published_ns - ticks + i for i in range(1, ticks)]
        self._last = Read(counter, frame, published_ns, self._grid_ns if self._on_grid else published_ns)
        return [*(_silent(self._kind, last, last.counter + i, at_ns) for i, at_ns in enumerate(times, 1)), self._last]

    def _ticks_since(self, last: Read, counter: int, published_ns: int) -> int:
        """How many ticks a frame is after the last: as many as its counter and its time, if it is late, allow."""
        steps = (counter - last.counter - 1) % self._kind.counters + 1
        elapsed = (published_ns - self._grid_ns) / self._period_ns
        early = self._kind.counters // 4 - 1
        return max(steps, steps + floor((elapsed + early - steps) / self._kind.counters) * self._kind.counters)


def _silent(kind: FrameFormat, last: Read, counter: int, at_ns: int) -> Read:
    return Read(counter % kind.counters, _as_of(kind, last, counter), at_ns, at_ns, sent=False)


def _as_of(kind: FrameFormat, read: Read, counter: int) -> bytes:
    """The frame with another counter."""
    said = kind.unpack(read.frame)
    assert said is not None
    return kind.pack(counter % kind.counters, said[1])


class Lapses:
    """Where a controller did not compute a tick with the plant's levels at that tick.

    Args:
        lapses: What it told.
        kind: What the measurements are.
    """

    def __init__(self, lapses: Sequence[Lapse], kind: FrameFormat) -> None:
        self._kind = kind
        self._lapses = deque(sorted(lapses, key=lambda lapse: lapse.tick))
        self._missed_before = 0  # ticks before this one
        self._lost = -1, -1  # of the frames between these ticks none came
        self._late: dict[int, int] = {}  # from which tick on the measurement of a tick was used
        self._coming: deque[tuple[int, Read]] = deque()
        self._used: Read | None = None  # the measurement whose levels the last tick had

    def at(self, k: int, measurement: Read) -> Read | None:
        """What the controller used at tick k for that tick's measurement; None if it did not compute that tick.

        Args:
            k: The tick; rising from call to call.
            measurement: What the plant measured then, sent or not.
        """
        while self._lapses and self._lapses[0].tick <= k:
            lapse = self._lapses.popleft()
            if lapse.kind == "missed":
                self._missed_before = max(self._missed_before, lapse.tick + lapse.ticks)
            elif lapse.kind == "lost":
                self._lost = lapse.tick, lapse.tick + lapse.ticks
            else:
                self._late[lapse.tick] = lapse.tick + lapse.ticks
        while self._coming and self._coming[0][0] <= k:
            self._used = self._coming.popleft()[1]
        if (since := self._late.pop(k, None)) is not None:
            self._coming.append((since, measurement))
        elif (measurement.sent and not self._lost[0] < k < self._lost[1]) or self._used is None:
            self._used = measurement
            self._coming.clear()
        if k < self._missed_before:
            return None
        return measurement if self._used is None else measurement._replace(frame=_as_of(self._kind, self._used, k))
