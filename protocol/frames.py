"""Frames: level indices ↔ bytes, and which tick a frame is of.

Sans-I/O. A frame is a 4-bit counter and R-bit codes, most significant bit first, with zero bits up to the byte:

    measurement  counter:4 · ε₁ ε₂ ε₃ : R_ε each · ω₁ ω₂ ω₃ : R_ω each
    command      echo:4    · u … : R_u each             (echo: the counter of the measurement it answers)

A signal without quantization travels as big-endian doubles; in a frame that holds any, four zero bits follow the
counter. What arrives malformed is refused whole, with None and never an exception;
what a caller passes wrongly raises ValueError.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isinf
from typing import TYPE_CHECKING, Final

from bitstruct.c import compile as compile_bits

if TYPE_CHECKING:
    from protocol.wire import WireSpec

COUNTER_BITS: Final = 4
COUNTERS: Final = 1 << COUNTER_BITS
"""The counter runs 0…15 and round again."""


class FrameFormat:
    """One kind of frame: a counter and `widths` codes; a width of None is a float64.

    Attributes:
        bits: Bits that carry something: counter and codes.
        first_bit: Where the first code begins.
        size: Bytes of a frame, padding included.
    """

    def __init__(self, widths: Sequence[int | None]) -> None:
        floats = any(width is None for width in widths)
        gap = 4 if floats else 0
        self.bits = COUNTER_BITS + sum(64 if width is None else width for width in widths)
        self.first_bit = COUNTER_BITS + gap
        self.size = -(-(self.bits + gap) // 8)
        tail = 8 * self.size - self.bits - gap
        self._padding = (1 << tail) - 1  # of the last byte
        fields = ["f64" if width is None else f"s{width}" for width in widths]
        self._format = compile_bits(
            "".join([f"u{COUNTER_BITS}", *([f"u{gap}"] if gap else []), *fields, *([f"u{tail}"] if tail else [])])
        )
        self._gap = (0,) if gap else ()
        self._tail = (0,) if tail else ()
        self._first = 2 if gap else 1
        self._last = self._first + len(widths)
        self._floats = [i for i, width in enumerate(widths) if width is None]
        self.widths = tuple(widths)

    def pack(self, counter: int, codes: Sequence[float]) -> bytes:
        """Bytes of a frame.

        Args:
            counter: 0…15.
            codes: One a signal: ints within R-bit two's complement, or floats where the signal is not quantized.

        Raises:
            ValueError: A counter or code that does not fit, a wrong number of codes, an infinite float.
        """
        if len(codes) != len(self.widths):
            raise ValueError(f"this frame holds {len(self.widths)} codes, not {len(codes)}")
        try:
            for i in self._floats:
                if isinf(codes[i]):
                    raise ValueError("an infinite value does not travel; clip it, or send NaN for 'no valid value'")
            frame: bytes = self._format.pack(counter, *self._gap, *codes, *self._tail)
        except (OverflowError, TypeError) as error:
            raise ValueError(f"counter {counter!r} with codes {tuple(codes)!r} does not fit: {error}") from None
        return frame

    def counter(self, frame: bytes) -> int | None:
        """The counter of a frame, or None if it is malformed, as `unpack` says but cheaper."""
        if self._floats:
            read = self.unpack(frame)
            return None if read is None else read[0]
        if len(frame) != self.size or frame[-1] & self._padding:
            return None
        return frame[0] >> (8 - COUNTER_BITS)

    def unpack(self, frame: bytes) -> tuple[int, tuple[float, ...]] | None:
        """Counter and codes of a frame, or None if it is malformed: wrong length, non-zero padding, infinite float."""
        if len(frame) != self.size:
            return None
        values = self._format.unpack(frame)
        if (self._gap and values[1]) or (self._tail and values[-1]):
            return None
        codes = values[self._first : self._last]
        for i in self._floats:
            if isinf(codes[i]):
                return None
        return values[0], codes


class TickCounter:
    """The tick of each measurement, from its four bits and the time it was published.

    The plant's grid is absolute and its frames go out on time or late, never early. So the earliest publications mark
    the grid, and a counter stands for the one tick that has it from 12 before to 3 after where the grid is now: a frame
    may be held up by 12 ticks, and one judged wrongly does not mislead the next.

    Args:
        period_ns: Period of the plant's grid [ns].
        lockstep: Whether nothing is ever skipped, so that no time is needed.
        tick: Tick of the last measurement before the first one given; −1 at a session's start.

    Attributes:
        tick: Tick of the last measurement that was newer than all before it.
    """

    LATE: Final = 12

    def __init__(self, period_ns: int, *, lockstep: bool, tick: int = -1) -> None:
        self._period_ns = period_ns
        self._lockstep = lockstep
        self._origin_ns: int | None = None  # when tick 0 was due, on the plant's wall clock
        self.tick = tick

    def advance(self, counter: int, published_ns: int) -> int | None:
        """The tick of a measurement; None if it is not newer than the last one.

        Args:
            counter: Its counter, 0…15.
            published_ns: When it was published, on the plant's wall clock [ns].
        """
        if self._lockstep or self._origin_ns is None:
            tick = self.tick + 1 + (counter - self.tick - 1) % COUNTERS
            self._origin_ns = published_ns - tick * self._period_ns
        else:
            latest = round((published_ns - self._origin_ns) / self._period_ns) + COUNTERS - 1 - self.LATE
            tick = latest - (latest - counter) % COUNTERS
            if tick <= self.tick:
                return None
            # A clock that is set, or runs slower than the grid, must not leave the mark behind for good.
            drift_ns = (tick - self.tick) * self._period_ns // 10_000
            self._origin_ns = min(self._origin_ns + drift_ns, published_ns - tick * self._period_ns)
        self.tick = tick
        return tick


def pack_measurement(spec: WireSpec, counter: int, codes: Sequence[float]) -> bytes:
    """A measurement frame of codes (ε₁ ε₂ ε₃ ω₁ ω₂ ω₃). Raises ValueError for what does not fit."""
    return spec.measurement.pack(counter, codes)


def unpack_measurement(spec: WireSpec, frame: bytes) -> tuple[int, tuple[float, ...]] | None:
    """(counter, codes) of a measurement frame, or None if it is malformed."""
    return spec.measurement.unpack(frame)


def pack_command(spec: WireSpec, counter: int, codes: Sequence[float]) -> bytes:
    """A command frame of codes u that answers measurement `counter`. Raises ValueError for what does not fit."""
    return spec.command.pack(counter, codes)


def unpack_command(spec: WireSpec, frame: bytes) -> tuple[int, tuple[float, ...]] | None:
    """(echo, codes) of a command frame, or None if it is malformed."""
    return spec.command.unpack(frame)
