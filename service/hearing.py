"""What the controller hears of the plant, tick by tick: a frame, silence, or one that came late.

Where the plant sends every tick, a tick is due when its measurement arrives, so that the plant's clock leads. Where it
sends only what is new, silence is heard on a clock: the plant's grid as its frames arrive here, and half a period of
patience. What comes later than that is late: its tick was computed with the levels before, which is told, so that a log
can be computed again. With a grid of one's own the newest that was heard counts whenever a tick of that grid is due.
"""

from __future__ import annotations

import time
from typing import Final, Literal, NamedTuple

from protocol.clock import LoopSettings, TickGrid
from protocol.frames import TickCounter
from protocol.links import Arrival, Link
from protocol.transmit import SILENCE
from protocol.wire import WireSpec

MAILBOX: Final = 16
"""Frames that may wait where silence is heard: of one that another displaced, it could not be told that it was late."""

NUMBERS: Final = 1 << 32
"""Senders number their messages modulo this."""

PATIENCE: Final = 0.5
"""How much of a period a frame may take longer than the fastest did, before there is none."""

OWN_PATIENCE: Final = 0.1
"""The same where a grid of one's own says when to look: silence that is heard a tick later is displaced by a frame."""


Slip = tuple[Literal["late", "lost", "missed"], int, int]
"""Kind, tick and ticks of a lapse."""


class Heard(NamedTuple):
    """One tick of the plant as it was heard.

    Attributes:
        tick: Tick of the law that it is of.
        frame: The measurement; SILENCE if its levels are what they were.
        due_ns: Since when it could be answered, on `time.monotonic_ns()`.
        published_ns: When the frame was published, on the plant's wall clock; None for silence and nonsense [ns].
        missed: Ticks between the last one and this, of which nothing was heard in time.
        late: Whether it is no tick of its own: of its frame only the levels are still of use, if it has any.
        lost_since: Tick of the frame before this one, if others between them were sent and did not come; else None.
    """

    tick: int
    frame: bytes
    due_ns: int
    published_ns: int | None
    missed: int = 0
    late: bool = False
    lost_since: int | None = None


class Pulse:
    """When the plant's ticks fall on this machine's monotonic clock: as early as the earliest frames say.

    Args:
        period_ns: Period of the plant's grid [ns].
        patience: How much of it to wait for a frame.
    """

    def __init__(self, period_ns: int, patience: float) -> None:
        self._period_ns = period_ns
        self._patience_ns = round(patience * period_ns)
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
        return self._origin_ns + tick * self._period_ns + self._patience_ns

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
        self._ticks = TickCounter(loop.period_ns, wire.measurement.counters, lockstep=loop.lockstep)
        transmit = wire.transmit
        self._lockstep = loop.lockstep
        self._hears_silence = transmit.measurement == "on_change" and not loop.lockstep
        self.must_tell = "on_change" in (transmit.measurement, transmit.command) and not loop.lockstep
        self._pulse = Pulse(loop.period_ns, OWN_PATIENCE if own_grid else PATIENCE)
        self._goes_on = False  # whether what was taken last was no tick
        self._number = -1  # of the last frame
        self._gap = False  # whether some were lost since the last that could be read
        self._framed = -1  # tick of that
        self.tick = -1

    def next(self, timeout_s: float) -> Heard | None:
        """The next tick, or None if there is none within a while.

        Args:
            timeout_s: The longest to wait [s].
        """
        arrival = self._receive(timeout_s)
        if arrival is None:
            return self._silence()
        if arrival.number is not None:
            self._gap = self._gap or (arrival.number - self._number) % NUMBERS != 1
            self._number = arrival.number
        lost_since = None
        counter = self._counter(arrival.frame)
        if counter is None:
            if self._hears_silence:
                return self._in_passing(Heard(self.tick, arrival.frame, arrival.at_ns, None))
            # Silence, in lockstep; or malformed: it counts as the measurement that was due, and is refused.
            tick = self.tick + 1
            if self._lockstep:
                self._ticks.tick = tick
        else:
            at = self._ticks.advance(counter, arrival.published_ns)
            if at is None:
                return None
            self._pulse.heard(at, arrival.at_ns)
            if self._gap and self._hears_silence:
                lost_since = self._framed
            self._framed, self._gap = at, False
            heard = Heard(at, arrival.frame, arrival.at_ns, arrival.published_ns, lost_since=lost_since)
            if self._hears_silence and (at <= self.tick or self._link.pending or self._is_over(at)):
                # Late; or what is newer wins, a frame or silence: then the tick of this one is missed.
                return self._in_passing(heard)
            tick = at
        due_ns = self._grid.due_ns if self._grid else arrival.at_ns
        return self._heard(tick, arrival.frame, due_ns, arrival.published_ns, lost_since)

    def lapses(self, heard: Heard, k: int, *, used: bool) -> list[Slip]:
        """What a log must be told of it; see `Lapse`.

        Args:
            heard: What was heard.
            k: The tick before it that was computed, or counted as such.
            used: Whether its frame was not malformed.
        """
        told: list[Slip] = []
        if heard.lost_since is not None:
            told.append(("lost", heard.lost_since, heard.tick - heard.lost_since))
        if heard.late:
            if used and heard.tick <= k:
                told.append(("late", heard.tick, k + 1 - heard.tick))
        elif (missed := heard.missed + (not used)) and self.must_tell:
            told.append(("missed", k + 1, missed))
        return told

    def _receive(self, timeout_s: float) -> Arrival | None:
        if self._grid is not None:
            if not self._goes_on:
                self._grid.wait()
            self._goes_on = False
            return self._link.take()
        if self._hears_silence and self._pulse.known:
            timeout_s = min(timeout_s, 1e-9 * max(0, self._pulse.over_ns(self.tick + 1) - time.monotonic_ns()))
        return self._link.wait(timeout_s)

    def _is_over(self, tick: int) -> bool:
        """Whether it is too late for the frame of the next tick, too."""
        return self._pulse.last_over(time.monotonic_ns()) > tick

    def _in_passing(self, heard: Heard) -> Heard:
        self._goes_on = True
        return heard._replace(late=True)

    def _silence(self) -> Heard | None:
        """The last tick for whose frame it is too late now; those before it, if it is not the next, are missed."""
        if not (self._hears_silence and self._pulse.known):
            return None
        # A frame that was taken in passing may be of a later tick, by its counter: its levels are not of one before.
        tick = max(self._pulse.last_over(time.monotonic_ns()), self._framed)
        if tick <= self.tick:
            return None
        return self._heard(tick, SILENCE, self._pulse.over_ns(tick), None)

    def _heard(
        self, tick: int, frame: bytes, due_ns: int, published_ns: int | None, lost_since: int | None = None
    ) -> Heard:
        missed, self.tick = max(0, tick - self.tick - 1), tick
        return Heard(tick, frame, due_ns, published_ns, missed, lost_since=lost_since)
