"""Frames of a log in words: the bits of each signal, its code and level, and what differs between two frames."""

from __future__ import annotations

from collections.abc import Iterator
from math import isnan
from typing import Literal, NamedTuple

from pydantic import BaseModel, Field

from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

Direction = Literal["measurement", "command"]
AXES = ("x", "y", "z")


class FrameSignal(BaseModel, frozen=True):
    """A signal of a frame."""

    name: str = Field(description="attitude_x … rate_z, voltage_2 …")
    unit: str
    bits: str = Field(description="its bits, most significant first")
    code: float = Field(description="a whole number; the value itself where the signal is not quantized")
    level: float | None = Field(description="what the code stands for; null: no valid value")


class SignalDifference(NamedTuple):
    """A signal that differs between two frames: both levels, and their distance in the quantizer's steps."""

    name: str
    unit: str
    first: float | None
    second: float | None
    steps: int | None

    def __str__(self) -> str:
        values = (" and ".join("none" if each is None else f"{each:.6g}" for each in self[2:4])) + f" {self.unit}"
        many = "" if self.steps is None else f", {abs(self.steps)} step{'s' * (abs(self.steps) != 1)} apart"
        return f"{self.name} {values.rstrip(' 1') if self.unit == '1' else values}{many}"


def specs(wire: WireSpec, direction: Direction) -> Iterator[tuple[str, str, SignalSpec]]:
    """Name, unit and specification of each signal of a frame, in order."""
    if direction == "measurement":
        yield from ((f"attitude_{axis}", "1", wire.attitude) for axis in AXES)
        yield from ((f"rate_{axis}", "rad/s", wire.rate) for axis in AXES)
    else:
        yield from ((f"voltage_{motor}", "V", wire.voltage) for motor in wire.motors)


def read_frame(wire: WireSpec, direction: Direction, frame: bytes) -> tuple[int, list[FrameSignal]] | None:
    """Counter and signals of a frame; None if it is malformed."""
    form = wire.measurement if direction == "measurement" else wire.command
    if (read := form.unpack(frame)) is None:
        return None
    bits, at, found = "".join(f"{octet:08b}" for octet in frame), form.first_bit, list[FrameSignal]()
    for (name, unit, spec), width, code in zip(specs(wire, direction), form.widths, read[1], strict=True):
        level, size = spec.quantizer().level(code), width or 64
        value = None if isnan(level) else level
        found.append(FrameSignal(name=name, unit=unit, bits=bits[at : at + size], code=code, level=value))
        at += size
    return read[0], found


def differences(wire: WireSpec, direction: Direction, first: bytes, second: bytes) -> list[SignalDifference]:
    """Signals that differ between two well-formed frames; of other bytes there are none."""
    one, other = (read_frame(wire, direction, frame) for frame in (first, second))
    if one is None or other is None:
        return []
    return [
        SignalDifference(a.name, a.unit, a.level, b.level, _steps(spec, a, b))
        for (_, _, spec), a, b in zip(specs(wire, direction), one[1], other[1], strict=True)
        if a.bits != b.bits
    ]


def _steps(spec: SignalSpec, a: FrameSignal, b: FrameSignal) -> int | None:
    known = spec.bits is not None and a.level is not None and b.level is not None
    return int(b.code - a.code) if known else None
