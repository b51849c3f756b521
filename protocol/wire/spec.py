"""Wire spec and loop settings: what both ends must agree on, and how each end keeps its tick grid.

Claims, fingerprints, frames, the DBC and log readers derive every scale and width from the wire spec.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeAlias

from pydantic import BaseModel, BeforeValidator, Field, model_validator

from aeroloop.protocol.wire.frames import MAX_COUNTER_BITS, MIN_COUNTER_BITS, FrameFormat
from aeroloop.protocol.wire.quantizer import (
    MAX_BITS,
    MIN_BITS,
    Continuous,
    HysteresisQuantizer,
    LogarithmicQuantizer,
    Quantizer,
    UniformQuantizer,
)
from aeroloop.protocol.wire.transmit import Transmit

MAX_ACTUATORS: Final = 8

WATCHDOG_S: Final = 0.1  # 0 V after this long without a fresh command [s], unless configured; as industrial drives do
FIRST_COMMAND_S: Final = 1.0  # how long a granted claim may wait for its first command [s]


class SignalBits(NamedTuple):
    """Bits of ε, ω and u; None is the paper's "cont."."""

    attitude: int | None
    rate: int | None
    voltage: int | None

    @classmethod
    def parse(cls, text: str) -> SignalBits:
        """Of three numbers, such as 10/6/6; of two, out and in as in the paper's tables, such as 8/6; of `cont`.

        Raises ValueError if it is none of these, or a number is out of range.
        """
        words = ["cont"] * 3 if text == "cont" else text.split("/")
        good = all(word == "cont" or (word.isdecimal() and MIN_BITS <= int(word) <= MAX_BITS) for word in words)
        if len(words) not in (2, 3) or not good:
            raise ValueError(
                f"bits are of attitude, rate and voltage, such as 10/6/6, or out and in, such as 8/6, each "
                f"{MIN_BITS} to {MAX_BITS} or cont, not {text!r}"
            )
        out, *rest = (None if word == "cont" else int(word) for word in words)
        return cls(out, out, rest[0]) if len(rest) == 1 else cls(out, *rest)

    def __str__(self) -> str:
        few = self[1:] if self.attitude == self.rate else self
        return "/".join("cont" if bits is None else str(bits) for bits in few)


_Number: TypeAlias = Annotated[int, Field(ge=MIN_BITS, le=MAX_BITS)]
Bits: TypeAlias = Annotated[
    _Number | None,
    BeforeValidator(
        lambda value: None if value == "cont" else value, json_schema_input_type=_Number | Literal["cont"] | None
    ),
]
"""TOML has no null: the word "cont" stands for no quantization in configuration."""
Positive: TypeAlias = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Kind: TypeAlias = Literal["uniform", "hysteresis-uniform", "logarithmic-uniform"]

_OWNER: Final[dict[str, Kind]] = {"hysteresis": "hysteresis-uniform", "threshold": "logarithmic-uniform"}
"""Parameters that only one kind of quantizer has."""


class SignalSpec(BaseModel, frozen=True, extra="forbid"):
    """How one signal is quantized. The range runs from −limit to +limit, in the signal's unit."""

    bits: Bits = Field(description="bits R of a code, 2…16; 'cont' sends float64")
    limit: Positive = Field(description="edge of the range [signal's unit]")
    deadzone: Positive | None = Field(
        default=None, description="y0 of (C.14) [signal's unit]; half a step if left out, less if logarithmic-uniform"
    )
    kind: Kind = Field(default="uniform", description="which quantizer; SPEC.md, section 2")
    hysteresis: Positive | None = Field(
        default=None, description="hysteresis-uniform: h, widens a held interval [signal's unit]; half a step"
    )
    threshold: Positive | None = Field(default=None, description="logarithmic-uniform: y_t [signal's unit]; limit/4")

    @model_validator(mode="after")
    def _makes_a_quantizer(self) -> SignalSpec:
        if self.deadzone is not None and self.deadzone >= self.limit:
            raise ValueError(f"the dead zone {self.deadzone} must be smaller than the limit {self.limit}")
        for name, owner in _OWNER.items():
            if getattr(self, name) is not None and self.kind != owner:
                raise ValueError(f'{name} belongs to kind = "{owner}", and kind is "{self.kind}"')
        if self.kind != "uniform":
            self.quantizer()  # raises: its bounds depend on the bits
        return self

    def quantizer(self) -> Quantizer:
        """A new quantizer for one element of this signal."""
        if self.bits is None:
            return Continuous(self.limit)
        if self.kind == "hysteresis-uniform":
            return HysteresisQuantizer(self.bits, self.limit, self.deadzone, self.hysteresis)
        if self.kind == "logarithmic-uniform":
            return LogarithmicQuantizer(self.bits, self.limit, self.deadzone, self.threshold)
        return UniformQuantizer(self.bits, self.limit, self.deadzone)

    def with_bits(self, bits: int | None) -> SignalSpec:
        """The same signal with other bits. Raises ValueError if they do not fit its kind or its other parameters."""
        changed = self.model_copy(update={"bits": bits})
        if self.kind != "uniform":
            changed.quantizer()
        return changed


class WireSpec(BaseModel, frozen=True, extra="forbid"):
    """Everything the two ends must agree on to read each other's frames. The default is the paper's 8/6-bit Aero."""

    attitude: SignalSpec = Field(
        default=SignalSpec(bits=8, limit=1.0), description="ε, the quaternion's vector part [1]"
    )
    rate: SignalSpec = Field(default=SignalSpec(bits=8, limit=1.0), description="ω, body frame [rad/s]")
    voltage: SignalSpec = Field(default=SignalSpec(bits=6, limit=24.0), description="u, the command [V]")
    actuators: int = Field(
        default=2, ge=1, le=MAX_ACTUATORS, description="number of motors: 2 for the Aero's u₂ and u₃, n for u₁…uₙ"
    )
    transmit: Transmit = Field(default=Transmit(), description="when frames are sent")
    counter_bits: int = Field(
        default=8,
        ge=MIN_COUNTER_BITS,
        le=MAX_COUNTER_BITS,
        description="bits of the counter in each frame; a frame 2^bits periods late may be taken for a newer one",
    )

    @cached_property
    def measurement(self) -> FrameFormat:
        """Format of a measurement frame: ε₁ ε₂ ε₃ ω₁ ω₂ ω₃."""
        return FrameFormat([self.attitude.bits] * 3 + [self.rate.bits] * 3, self.counter_bits)

    @cached_property
    def command(self) -> FrameFormat:
        """Format of a command frame: u₁…uₙ, or u₂ u₃ if there are two."""
        return FrameFormat([self.voltage.bits] * self.actuators, self.counter_bits)

    def acceptance(self, direction: Literal["measurement", "command"], *, lockstep: bool) -> Callable[[bytes], bool]:
        """A function: whether a received frame may take the place of one that waits to be taken.

        In real time a well-formed one may. In lockstep any of the right length may, as each frame is waited for: a
        malformed one counts as the one that was due, and so does an empty one, which stands for silence on change.
        """
        layout = self.measurement if direction == "measurement" else self.command
        if not lockstep:
            return layout.is_well_formed
        lengths = {layout.size}
        if getattr(self.transmit, direction) == "on_change":
            lengths.add(0)
        return lambda frame: len(frame) in lengths

    @property
    def motors(self) -> range:
        """Numbers of the motors, as in u₁: of two they are the paper's 2 and 3, else they begin at 1."""
        return range(2, 4) if self.actuators == 2 else range(1, self.actuators + 1)

    def with_bits(self, text: str) -> WireSpec:
        """The same spec with other bits, as of `SignalBits.parse`. Raises ValueError."""
        signals = {name: getattr(self, name).with_bits(bits) for name, bits in SignalBits.parse(text)._asdict().items()}
        return WireSpec(**{name: getattr(self, name) for name in WireSpec.model_fields} | signals)

    def agreed(self) -> dict[str, Any]:
        """The spec as JSON, for claims and fingerprints, without what is not in use.

        That is parameters of other kinds in a uniform signal, and `transmit` if all of it is by default.
        """
        tree = self.model_dump(mode="json")
        for name in ("attitude", "rate", "voltage"):
            if tree[name]["kind"] == "uniform":
                for unused in ("kind", *_OWNER):
                    del tree[name][unused]
        if self.transmit == Transmit():
            del tree["transmit"]
        return tree

    def differences(self, other: WireSpec) -> list[str]:
        """Where two specs differ, one line a field: `rate.bits: 8, not 10`. Empty if they are the same wire."""
        mine, theirs = flat(self.model_dump()), flat(other.model_dump())
        return [f"{name}: {mine[name]}, not {theirs[name]}" for name in mine if mine[name] != theirs[name]]


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested sections, by `section.key`."""
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        leaves |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return leaves


class LoopSettings(BaseModel, extra="forbid"):
    """Tick grid and process set-up of an end."""

    rate_hz: float = Field(default=500.0, ge=1, le=10_000, description="ticks a second [Hz]")
    lockstep: bool = Field(
        default=False, description="the plant waits for each command before it steps: repeatable, as fast as possible"
    )
    realtime: Literal["strict", "try", "off"] = Field(
        default="try",
        description="request SCHED_FIFO, locked memory, affinity, awake CPUs; strict: stop without the first three",
    )
    cpus: list[int] = Field(default=[], description="CPUs to run on; all if empty")

    @property
    def period_ns(self) -> int:
        """Period of the grid [ns]."""
        return round(1e9 / self.rate_hz)

    @property
    def period(self) -> float:
        """Period of the grid [s]: the law's time step."""
        return self.period_ns * 1e-9

    def ticks(self, seconds: float) -> int:
        """How many ticks make up this time, rounded."""
        return round(seconds * 1e9 / self.period_ns)
