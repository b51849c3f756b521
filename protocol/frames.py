"""Frames: level indices ↔ bytes, and the spec from which every scale and width derives.

Sans-I/O. A frame is a 4-bit counter and R-bit codes, most significant bit first, with zero bits up to the byte:

    measurement  counter:4 · ε₁ ε₂ ε₃ : R_ε each · ω₁ ω₂ ω₃ : R_ω each
    command      echo:4    · u … : R_u each             (echo: the counter of the measurement it answers)

A signal without quantization travels as big-endian doubles; in a frame that holds any, four zero bits follow the
counter. What arrives malformed is refused whole, with None and never an exception;
what a caller passes wrongly raises ValueError.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import isinf
from typing import Annotated, Any, Final, Literal, TypeAlias

from bitstruct.c import compile as compile_bits
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from protocol.hysteresis import HysteresisQuantizer
from protocol.logarithmic import LogarithmicQuantizer
from protocol.quantizer import MAX_BITS, MIN_BITS, Continuous, Quantizer, UniformQuantizer
from protocol.transmit import Transmit

COUNTER_BITS: Final = 4
COUNTERS: Final = 1 << COUNTER_BITS
"""The counter runs 0…15 and round again."""


def bits_or_continuous(value: object) -> object:
    """The word "cont" stands for no quantization wherever a person writes bits (TOML has no null)."""
    return None if value == "cont" else value


Bits: TypeAlias = Annotated[
    Annotated[int, Field(ge=MIN_BITS, le=MAX_BITS)] | None,
    BeforeValidator(bits_or_continuous),
]


Kind: TypeAlias = Literal["uniform", "hysteresis-uniform", "logarithmic-uniform"]

_OWNER: Final[dict[str, Kind]] = {"hysteresis": "hysteresis-uniform", "threshold": "logarithmic-uniform"}
"""Parameters that only one kind of quantizer has."""


class SignalSpec(BaseModel):
    """How one signal is quantized. The range runs from −limit to +limit, in the signal's unit."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bits: Bits = Field(description="bits R of a code, 2…16; 'cont' sends float64")
    limit: float = Field(gt=0, allow_inf_nan=False, description="edge of the range [signal's unit]")
    deadzone: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="y0 of (C.14) [signal's unit]; half a step if left out, a quarter of that if logarithmic-uniform",
    )
    kind: Kind = Field(default="uniform", description="which quantizer; SPEC.md, section 2")
    hysteresis: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="h: how much farther a level is held [signal's unit]; half a step if left out; hysteresis-uniform",
    )
    threshold: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="where steps stop growing [signal's unit]; limit/4 if left out; logarithmic-uniform",
    )

    @model_validator(mode="after")
    def _makes_a_quantizer(self) -> SignalSpec:
        if self.deadzone is not None and self.deadzone >= self.limit:
            raise ValueError(f"the dead zone {self.deadzone} must be smaller than the limit {self.limit}")
        for name, owner in _OWNER.items():
            if getattr(self, name) is not None and self.kind != owner:
                raise ValueError(f'{name} belongs to kind = "{owner}", and kind is "{self.kind}"')
        if self.kind != "uniform":
            self.quantizer()  # has bounds of its own, which depend on the bits
        return self

    def quantizer(self) -> Quantizer:
        """A quantizer of one element of this signal, with its own count of saturations and its own memory."""
        if self.bits is None:
            return Continuous(self.limit)
        if self.kind == "hysteresis-uniform":
            return HysteresisQuantizer(self.bits, self.limit, self.deadzone, self.hysteresis)
        if self.kind == "logarithmic-uniform":
            return LogarithmicQuantizer(self.bits, self.limit, self.deadzone, self.threshold)
        return UniformQuantizer(self.bits, self.limit, self.deadzone)

    def with_bits(self, bits: int | None) -> SignalSpec:
        """The same with other bits. Raises ValueError where the kind takes no such number, or not with the rest."""
        changed = self.model_copy(update={"bits": bits})
        if self.kind != "uniform":
            changed.quantizer()
        return changed


class WireSpec(BaseModel):
    """Everything the two ends must agree on to read each other's frames. The default is the paper's 8/6-bit Aero."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    attitude: SignalSpec = Field(
        default=SignalSpec(bits=8, limit=1.0), description="ε, the quaternion's vector part [1]"
    )
    rate: SignalSpec = Field(
        default=SignalSpec(bits=8, limit=1.0), description="ω, angular velocity, body frame [rad/s]"
    )
    voltage: SignalSpec = Field(default=SignalSpec(bits=6, limit=24.0), description="u, the command [V]")
    actuators: Literal[2, 3] = Field(default=2, description="2: the Aero's u₂ and u₃; 3: a free rigid body's u₁…u₃")
    transmit: Transmit = Field(default=Transmit(), description="when frames are sent")

    @cached_property
    def measurement(self) -> FrameFormat:
        """Format of a measurement frame: ε₁ ε₂ ε₃ ω₁ ω₂ ω₃."""
        return FrameFormat([self.attitude.bits] * 3 + [self.rate.bits] * 3)

    @cached_property
    def command(self) -> FrameFormat:
        """Format of a command frame: u₂ u₃, or u₁ u₂ u₃."""
        return FrameFormat([self.voltage.bits] * self.actuators)

    def with_bits(self, out: int | None, inp: int | None) -> WireSpec:
        """The same spec with R bits for both outputs (ε and ω) and for the inputs (u); None is the paper's "cont.".

        Raises:
            ValueError: A signal's kind takes no such number of bits.
        """
        return WireSpec(
            attitude=self.attitude.with_bits(out),
            rate=self.rate.with_bits(out),
            voltage=self.voltage.with_bits(inp),
            actuators=self.actuators,
            transmit=self.transmit,
        )

    def agreed(self) -> dict[str, Any]:
        """What two ends tell each other of it, as JSON: what they use, so that one that knows no more understands it.

        A uniform signal tells nothing of other kinds, and frames that are sent as ever nothing of when.
        """
        told = self.model_dump(mode="json")
        for name in ("attitude", "rate", "voltage"):
            if told[name]["kind"] == "uniform":
                for unused in ("kind", *_OWNER):
                    del told[name][unused]
        if self.transmit == Transmit():
            del told["transmit"]
        return told

    def differences(self, other: WireSpec) -> list[str]:
        """Where two specs differ, one line a field: `rate.bits: 8, not 10`. Empty if they are the same wire."""
        mine, theirs = _flat(self.model_dump()), _flat(other.model_dump())
        return [f"{name}: {mine[name]}, not {theirs[name]}" for name in mine if mine[name] != theirs[name]]


def _flat(tree: dict[str, object], prefix: str = "") -> dict[str, object]:
    leaves: dict[str, object] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            leaves |= _flat(value, f"{prefix}{name}.")
        else:
            leaves[prefix + name] = value
    return leaves


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
