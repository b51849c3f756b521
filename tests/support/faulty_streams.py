"""Frames through a stream of commands with faults."""

from __future__ import annotations

from collections.abc import Sequence

from aeroloop.plant_emulator.faults.injection import FaultyStream
from aeroloop.plant_emulator.faults.language import Fault
from tests.support.faulty_plant import PERIOD


def passed(*faults: str, frames: Sequence[bytes | None], seed: int = 0, period: float = PERIOD) -> list[list[bytes]]:
    """What comes out at 0 s, 0.1 s, 0.2 s and so on."""
    stream = FaultyStream("command", [Fault.parse(text) for text in faults], seed)
    return [stream.passes(frame, k * period) for k, frame in enumerate(frames)]


def letters(count: int) -> list[bytes | None]:
    """Frames a, b, c and so on."""
    return [bytes([ord("a") + k]) for k in range(count)]


def numbered(count: int) -> list[bytes]:
    """Frames that are their own index."""
    return [k.to_bytes(4, "big") for k in range(count)]


def flat(ticks: list[list[bytes]]) -> list[bytes]:
    """All frames, in order."""
    return [frame for tick in ticks for frame in tick]
