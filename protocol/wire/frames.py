"""Frames: pack level indices into bytes, unpack them, and find the tick of a received measurement.

A frame is a counter and R-bit codes, most significant bit first, with zero bits up to the byte:

    measurement  counter · ε₁ ε₂ ε₃ : R_ε each · ω₁ ω₂ ω₃ : R_ω each
    command      echo    · u … : R_u each             (echo: the counter of the measurement it answers)
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isinf
from typing import Final

from bitstruct.c import compile as compile_bits

MIN_COUNTER_BITS: Final = 4
MAX_COUNTER_BITS: Final = 16


class FrameFormat:
    """One kind of frame: a counter of 4…16 bits, and a code for each of `widths` [bit]; None is a big-endian float64.

    The counter runs 0…`counters` − 1 and wraps. In a frame with floats zero bits fill its last byte. `bits` are those
    of counter and codes, `first_bit` is the offset of the first code, and `size` the bytes of a frame with padding.
    """

    def __init__(self, widths: Sequence[int | None], counter_bits: int) -> None:
        self.widths = tuple(widths)
        self.counter_bits = counter_bits
        self.counters = 1 << counter_bits
        self._floats = [i for i, width in enumerate(widths) if width is None]
        gap = -counter_bits % 8 if self._floats else 0
        self.first_bit = counter_bits + gap
        self.bits = counter_bits + sum(64 if width is None else width for width in widths)
        self.size = -(-(self.bits + gap) // 8)
        tail = 8 * self.size - self.bits - gap
        fields = ["f64" if width is None else f"s{width}" for width in widths]
        zeros = [f"p{n}" if n else "" for n in (gap, tail)]
        layout = compile_bits("".join([f"u{counter_bits}", zeros[0], *fields, zeros[1]]))
        self._pack, self._unpack = layout.pack, layout.unpack
        after_counter = ((1 << gap) - 1) << (8 * self.size - self.first_bit)
        at_the_end = (1 << tail) - 1
        self._padding = after_counter | at_the_end  # bits of a frame that are zero

    def pack(self, counter: int, codes: Sequence[float]) -> bytes:
        """Bytes of a frame. Codes are ints within R-bit two's complement, or floats where nothing is quantized.

        Raises:
            ValueError: A counter or code that does not fit, a wrong number of codes, an infinite float.
        """
        if len(codes) != len(self.widths):
            raise ValueError(f"this frame holds {len(self.widths)} codes, not {len(codes)}")
        try:
            for i in self._floats:
                if isinf(codes[i]):
                    raise ValueError("an infinite value does not travel; clip it, or send NaN for 'no valid value'")
            frame: bytes = self._pack(counter, *codes)
        except (OverflowError, TypeError) as error:
            raise ValueError(f"counter {counter!r} with codes {tuple(codes)!r} does not fit: {error}") from None
        return frame

    def counter(self, frame: bytes) -> int | None:
        """Counter of a frame, or None if it is malformed."""
        read = self.unpack(frame)
        return None if read is None else read[0]

    def is_well_formed(self, frame: bytes) -> bool:
        """Whether a frame can be unpacked. Cheap where nothing is a float: then only its length and padding count."""
        if self._floats:
            return self.unpack(frame) is not None
        return len(frame) == self.size and not int.from_bytes(frame) & self._padding

    def unpack(self, frame: bytes) -> tuple[int, tuple[float, ...]] | None:
        """Counter and codes of a frame, or None if it is malformed: wrong length, non-zero padding, infinite float."""
        if len(frame) != self.size or int.from_bytes(frame) & self._padding:
            return None
        values = self._unpack(frame)
        codes = values[1:]
        for i in self._floats:
            if isinf(codes[i]):
                return None
        return values[0], codes


class TickCounter:
    """Finds the tick of each received measurement from its counter and its arrival time on the receiver's own clock.

    The plant's grid is absolute, and frames arrive late, never early, so the earliest arrivals mark the grid. A counter
    stands for the one tick with that counter between 3/4 of the counter's range before the grid's present tick and 1/4
    after it (4 bits: from 12 ticks before to 3 after). One frame that is assigned to a wrong tick does not affect the
    next. As the two clocks drift apart, the mark may move later by 2 % of the elapsed periods: twice the error of a
    clock that runs 1 % fast, so that it follows either clock and still recovers from a mark that is too early.

    In lockstep the counter alone gives the tick: the next one that has it, unless that is more than 3/4 of the
    counter's range ahead; then the frame repeats the last one, or is older. `tick` is that of the last measurement that
    was newer than all before it; −1 at a session's start.
    """

    DRIFT: Final = 50  # the mark may move later by one period in this many
    OLD: Final = 0.75  # share of the counter's range: in lockstep a frame that seems further ahead is an older one

    def __init__(self, period_ns: int, counters: int, *, lockstep: bool, tick: int = -1) -> None:
        self._period_ns = period_ns
        self._counters = counters
        self._early = counters // 4 - 1
        self._lockstep = lockstep
        self._origin_ns: int | None = None  # arrival time of tick 0 at the lowest latency seen; None in lockstep
        self.tick = tick

    def advance(self, counter: int, at_ns: int) -> int | None:
        """The tick of a measurement that arrived at `at_ns` on the receiver's monotonic clock [ns].

        None if it is not newer than the last one.
        """
        if self._lockstep and self.tick >= 0:
            ahead = (counter - self.tick) % self._counters
            if ahead == 0 or ahead > self.OLD * self._counters:
                return None
        if self._origin_ns is None:
            tick = self.tick + 1 + (counter - self.tick - 1) % self._counters
            if not self._lockstep:
                self._origin_ns = at_ns - tick * self._period_ns
        else:
            latest = round((at_ns - self._origin_ns) / self._period_ns) + self._early
            tick = latest - (latest - counter) % self._counters
            if tick <= self.tick:
                return None
            drift_ns = (tick - self.tick) * self._period_ns // self.DRIFT
            self._origin_ns = min(self._origin_ns + drift_ns, at_ns - tick * self._period_ns)
        self.tick = tick
        return tick

    def advance_one(self) -> int:
        """The tick of a measurement without a counter in lockstep, such as an empty frame: the one that is due."""
        self.tick += 1
        return self.tick

    @property
    def known(self) -> bool:
        """Whether a frame has marked the grid; never in lockstep."""
        return self._origin_ns is not None

    def due_ns(self, tick: int) -> int:
        """Arrival time of a tick's frame at the lowest latency seen; only where `known` [ns]."""
        assert self._origin_ns is not None
        return self._origin_ns + tick * self._period_ns

    def tick_at(self, now_ns: int) -> int:
        """The last tick whose frame is due by now; only where `known`."""
        return (now_ns - self.due_ns(0)) // self._period_ns

    def late_ns(self, tick: int, at_ns: int) -> int:
        """Latency of a tick's frame above the lowest seen [ns]; 0 in lockstep and before any frame.

        `at_ns` is its arrival time on the receiver's monotonic clock [ns].
        """
        if self._origin_ns is None:
            return 0
        return max(0, at_ns - self._origin_ns - tick * self._period_ns)
