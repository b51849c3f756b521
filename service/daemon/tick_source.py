"""Tick source: turns received frames into ticks and classifies each as received, silent, late or malformed.

Where the plant sends every tick, a tick is due when its measurement arrives, so that the plant's clock leads. Where it
sends on change, a tick without a frame is silent once half a period has passed since the frame was due on the plant's
grid, as the earliest frames mark that grid on this end's monotonic clock. A frame that arrives later than that is late:
its tick was computed with the previous levels. One that arrives later than `stale_s` is stale and not answered.
"""

from __future__ import annotations

import time
from typing import Final, NamedTuple

from aeroloop.protocol.messages.trace import Received
from aeroloop.protocol.runtime.timing import Clock
from aeroloop.protocol.transport.link import Arrival, Link
from aeroloop.protocol.wire.frames import TickCounter
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED

MAILBOX: Final = 16
"""Frames that may wait where silence is allowed: a displaced frame could not be classified as late."""

LOCKSTEP_MAILBOX: Final = 1 << 17
"""Frames that may wait in lockstep: all that a fault of the plant holds back, 10 s at 10 kHz, if it lets go at once."""

PATIENCE: Final = 0.5  # share of a period by which a frame may be later than the fastest before its tick is silent


class PlantTick(NamedTuple):
    """One tick of the plant in a session, or a frame that arrived when its tick was over."""

    tick: int
    frame: bytes  # the measurement; UNCHANGED if its levels have not changed
    received_as: Received  # a late frame is no tick; only its levels are used
    at_ns: int  # when the frame arrived, or the tick became silent, on `time.monotonic_ns()`
    late_ns: int = 0  # how much later than the fastest the frame arrived; 0 for silence
    missed: int = 0  # ticks between the last one and this that were not received in time
    fresh: bool = False  # whether it shows that the plant is alive: not stale; in lockstep also an empty frame


class TickSource:
    """Ticks of one session, `tick` the last of them, −1 before the first; `clock` is that of the link's arrivals.

    The plant counts its measurements from 0 at the grant, so its counter is the law's tick, even after a gap.
    """

    def __init__(self, link: Link, loop: LoopSettings, wire: WireSpec, *, stale_s: float, clock: Clock = time) -> None:
        self._link, self._clock = link, clock
        self._counter = wire.measurement.counter
        self._ticks = TickCounter(loop.period_ns, wire.measurement.counters, lockstep=loop.lockstep)
        self._lockstep = loop.lockstep
        self._sparse = wire.transmit.measurement == "on_change" and not loop.lockstep
        self._patience_ns = round(PATIENCE * loop.period_ns)
        self._stale_ns = round(stale_s * 1e9)
        self._last_read = -1  # tick of the last frame that could be read
        self.tick = -1

    def next(self, timeout_s: float) -> PlantTick | None:
        """The next tick, or None if there is none within `timeout_s` [s]."""
        arrival = self._receive(timeout_s)
        if arrival is None:
            return self._silence()
        counter = self._counter(arrival.frame)
        if counter is None:
            return self._without_counter(arrival)
        tick = self._ticks.advance(counter, arrival.at_ns)
        if tick is None:
            return None
        self._last_read = tick
        late_ns = self._ticks.late_ns(tick, arrival.at_ns)
        stale = late_ns > self._stale_ns
        # The newer frame, or the silence of the next tick, wins: then the tick of this frame is missed.
        if stale or (self._sparse and (tick <= self.tick or self._link.pending or self._last_over() > tick)):
            return PlantTick(tick, arrival.frame, Received.LATE, arrival.at_ns, late_ns, fresh=not stale)
        return self._as_tick(tick, arrival, Received.FRAME, late_ns, fresh=True)

    def _without_counter(self, arrival: Arrival) -> PlantTick:
        """An empty frame in lockstep, or a malformed one, which counts as the measurement that was due."""
        if self._sparse:
            return PlantTick(self.tick, arrival.frame, Received.MALFORMED, arrival.at_ns)
        tick = self._ticks.advance_one() if self._lockstep else self.tick + 1
        empty = arrival.frame == UNCHANGED and self._lockstep
        return self._as_tick(tick, arrival, Received.SILENT if empty else Received.MALFORMED, 0, fresh=empty)

    def _receive(self, timeout_s: float) -> Arrival | None:
        if self._sparse and self._ticks.known:
            timeout_s = min(timeout_s, 1e-9 * max(0, self._over_ns(self.tick + 1) - self._clock.monotonic_ns()))
        return self._link.wait(timeout_s)

    def _over_ns(self, tick: int) -> int:
        return self._ticks.due_ns(tick) + self._patience_ns

    def _last_over(self) -> int:
        """The last tick that is silent if it has no frame by now."""
        return self._ticks.tick_at(self._clock.monotonic_ns() - self._patience_ns)

    def _silence(self) -> PlantTick | None:
        """The last tick that is silent now; those before it, back to the last one taken, are missed."""
        if not (self._sparse and self._ticks.known):
            return None
        # A frame not taken as a tick may be of a later one, by its counter: its levels are not of an earlier one.
        tick = max(self._last_over(), self._last_read)
        if tick <= self.tick:
            return None
        missed, self.tick = tick - self.tick - 1, tick
        return PlantTick(tick, UNCHANGED, Received.SILENT, self._over_ns(tick), missed=missed)

    def _as_tick(self, tick: int, arrival: Arrival, received_as: Received, late_ns: int, *, fresh: bool) -> PlantTick:
        missed, self.tick = max(0, tick - self.tick - 1), tick
        return PlantTick(tick, arrival.frame, received_as, arrival.at_ns, late_ns, missed, fresh)
