"""What the controller hears of the plant, tick by tick: a frame, silence, or one that came late.

Where the plant sends every tick, a tick is due when its measurement arrives, so that the plant's clock leads. Where it
sends only what is new, silence is heard on a clock: the plant's grid as its frames arrive here, and half a period of
patience. What comes later than that is late: its tick was computed with the levels before, which is told, so that a log
can be computed again. With a grid of one's own the newest measurement is taken whenever a tick of that grid is due.
"""

from __future__ import annotations

import time
from typing import Final, NamedTuple

from protocol.clock import LoopSettings, TickGrid
from protocol.frames import TickCounter
from protocol.links import Arrival, Link
from protocol.transmit import SILENCE
from protocol.wire import WireSpec

MAILBOX: Final = 16
"""Frames that may wait where silence is heard: of one that another displaced, it could not be told that it was late."""

PATIENCE: Final = 0.5
"""How much of a period a frame may take longer than the fastest did, before there is none."""


class Heard(NamedTuple):
    """One tick of the plant as it was heard.

    Attributes:
        tick: Tick of the law that it is of.
        frame: The measurement; SILENCE if its levels are what they were.
        due_ns: Since when it could be answered, on `time.monotonic_ns()`.
        published_ns: When the frame was published, on the plant's wall clock; None for silence [ns].
        missed: Ticks between the last one and this, of which nothing was heard in time.
        late: Whether that tick is over already: only its levels are still of use.
    """

    tick: int
    frame: bytes
    due_ns: int
    published_ns: int | None
    missed: int = 0
    late: bool = False


class Pulse:
    """When the plant's ticks fall on this machine's monotonic clock: as early as the earliest frames say.

    Args:
        period_ns: Period of the plant's grid [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._origin_ns: int | None = None
        self._tick = 0

    @property
    def known(self) -> bool:
        """Whether a frame has told it."""
        return self._origin_ns is not None

    def heard(self, tick: int, at_ns: int) -> None:
        """The frame of a tick has arrived."""
        origin = at_ns - tick * self._period_ns
        if self._origin_ns is not None:
            # The two clocks drift apart; without this, one early frame would set the pulse for good.
            drift_ns = max(0, tick - self._tick) * self._period_ns // 10_000
            origin = min(self._origin_ns + drift_ns, origin)
        self._origin_ns, self._tick = origin, tick

    def over_ns(self, tick: int) -> int:
        """When it is too late for the frame of a tick [ns]."""
        assert self._origin_ns is not None
        return self._origin_ns + tick * self._period_ns + round(PATIENCE * self._period_ns)

    def last_over(self, now_ns: int) -> int:
        """The last tick for whose frame it is too late."""
        return (now_ns - self.over_ns(0)) // self._period_ns


class Hearing:
    """Listens to one session.

    The plant counts its measurements from 0 at the grant, so its counter is the law's tick, even after a gap.

    Args:
        link: Where its frames come from.
        loop: The grid.
        wire: How frames are read, and whether every tick has one.
        own_grid: Whether to tick on a grid of one's own.

    Attributes:
        tick: The last that was heard; −1 before the first.
        must_tell: Whether frames alone do not say which ticks were missed, since silence may mean that nothing is new.
    """

    def __init__(self, link: Link, loop: LoopSettings, wire: WireSpec, *, own_grid: bool) -> None:
        self._link = link
        self._counter = wire.measurement.counter
        self._grid = TickGrid(loop.period_ns) if own_grid else None
        self._ticks = TickCounter(loop.period_ns, lockstep=loop.lockstep)
        transmit = wire.transmit
        self._hears_silence = transmit.measurement == "on_change" and not loop.lockstep
        self.must_tell = "on_change" in (transmit.measurement, transmit.command) and not loop.lockstep
        self._pulse = Pulse(loop.period_ns)
        self.tick = -1

    def next(self, timeout_s: float) -> Heard | None:
        """The next tick, or None if there is none within a while.

        Args:
            timeout_s: The longest to wait [s].
        """
        arrival = self._receive(timeout_s)
        if arrival is None:
            return self._silence()
        counter = self._counter(arrival.frame)
        if counter is None:
            # Silence, in lockstep; or malformed: it counts as the measurement that was due, and is refused.
            tick = self.tick + 1
        else:
            at = self._ticks.advance(counter, arrival.published_ns)
            if at is None:
                return None
            self._pulse.heard(at, arrival.at_ns)
            if self._hears_silence:
                if at <= self.tick:
                    return Heard(at, arrival.frame, arrival.at_ns, arrival.published_ns, late=True)
                if self._link.pending:
                    return None  # a newer one is there, and wins; the tick of this one is missed
            tick = at
        due_ns = self._grid.due_ns if self._grid else arrival.at_ns
        return self._heard(tick, arrival.frame, due_ns, arrival.published_ns)

    def _receive(self, timeout_s: float) -> Arrival | None:
        if self._grid is not None:
            self._grid.wait()
            return self._link.take()
        if self._hears_silence and self._pulse.known:
            timeout_s = min(timeout_s, 1e-9 * max(0, self._pulse.over_ns(self.tick + 1) - time.monotonic_ns()))
        return self._link.wait(timeout_s)

    def _silence(self) -> Heard | None:
        """The last tick for whose frame it is too late now; those before it, if it is not the next, are missed."""
        if not (self._hears_silence and self._pulse.known):
            return None
        tick = self._pulse.last_over(time.monotonic_ns())
        if tick <= self.tick:
            return None
        return self._heard(tick, SILENCE, self._pulse.over_ns(tick), None)

    def _heard(self, tick: int, frame: bytes, due_ns: int, published_ns: int | None) -> Heard:
        missed, self.tick = max(0, tick - self.tick - 1), tick
        return Heard(tick, frame, due_ns, published_ns, missed)
