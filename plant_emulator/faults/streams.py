"""Faults of frames in one direction: lost, delayed, repeated, reordered and garbled frames.

Faults act one after another, in the order of injection, each with its own random numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Literal

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.faults.signals import generator
from aeroloop.protocol.lazy import numpy as np


class StreamFault:
    """A fault of frames; `last` is the frame that passed last, if there was one.

    Attributes:
        fault: The fault, in the plant's time.
        changed: Frames that it has dropped, delayed, garbled and so on.
    """

    def __init__(self, fault: Fault, random: np.random.Generator, last: bytes | None) -> None:
        self.fault = fault
        self.changed = 0
        self._value = 0.0 if fault.value is None else fault.value
        self._random, self._last = random, last
        self._held: deque[tuple[float, bytes]] = deque()  # due time [s] and frame

    def apply(self, frames: list[bytes], t: float) -> list[bytes]:
        """Return the frames that pass at time t [s], of these and of those held back. Call it once a tick."""
        match self.fault.kind:
            case "delay":
                return self._delayed(frames, t)
            case "duplicate":
                return self._duplicated(frames, t)
            case "reorder":
                return self._reordered(frames, t)
            case "stuck":
                return self._stuck(frames, t)
            case "garble":
                return [self._flipped(frame) if frame and self._happens(t) else frame for frame in frames]
            case "drop":
                return [frame for frame in frames if not self._happens(t)]
            case _:
                return [frame for frame in frames if not self._active(t)]

    def done(self, t: float) -> bool:
        """Whether it has ended by time t [s] and holds nothing back."""
        return self.fault.over(t) and not self._held

    def forget(self) -> None:
        """Drop the frames held back."""
        self._held.clear()

    def _active(self, t: float) -> bool:
        """Whether it acts on a frame, which is counted, whatever it is."""
        active = self.fault.active(t)
        self.changed += active
        return active

    def _happens(self, t: float) -> bool:
        """Whether chance has it act on a frame, which is counted."""
        happens = self.fault.active(t) and bool(self._random.random() < self._value)
        self.changed += happens
        return happens

    def _delayed(self, frames: list[bytes], t: float) -> list[bytes]:
        """When the fault ends, all held frames pass at once, ahead of the newer ones."""
        active = self.fault.active(t)
        self.changed += active * len(frames)
        self._held.extend((round(t + self._value, 9), frame) for frame in frames)
        passed = []
        while self._held and (not active or self._held[0][0] <= t):
            passed.append(self._held.popleft()[1])
        return passed

    def _duplicated(self, frames: list[bytes], t: float) -> list[bytes]:
        again = [frame for _, frame in self._held]
        self._held = deque((t, frame) for frame in frames if self._happens(t))
        return again + frames

    def _reordered(self, frames: list[bytes], t: float) -> list[bytes]:
        passed = []
        for frame in frames:
            if self._held:
                passed += [frame, self._held.popleft()[1]]
            elif self._happens(t):
                self._held.append((t, frame))
            else:
                passed.append(frame)
        return passed

    def _stuck(self, frames: list[bytes], t: float) -> list[bytes]:
        if not frames:
            return []
        if not self.fault.active(t):
            self._last = frames[-1]
            return frames
        self.changed += len(frames)
        if self._last is None:
            self._last = frames[0]
        return [self._last] * len(frames)

    def _flipped(self, frame: bytes) -> bytes:
        bit = int(self._random.integers(8 * len(frame)))
        flipped = bytearray(frame)
        flipped[bit // 8] ^= 0x80 >> bit % 8
        return bytes(flipped)


class FaultyStream:
    """Frames of one direction, with faults; those of other signals are ignored here. `seed` is 0 or more."""

    def __init__(self, signal: Literal["measurement", "command"], faults: Sequence[Fault], seed: int = 0) -> None:
        self._signal, self._seed = signal, seed
        self._attached = 0
        self._last: bytes | None = None
        self._faults: list[StreamFault] = []
        for fault in faults:
            self.inject(fault, 0.0)

    def passes(self, frame: bytes | None, t: float) -> list[bytes]:
        """Pass the frame of a tick, if any, through the faults at time t [s], which rises. It is rounded here.

        Returns:
            The frames that pass at this tick, in order.
        """
        frames = [] if frame is None else [frame]
        if self._faults:
            t = round(t, 9)
            for fault in self._faults:
                frames = fault.apply(frames, t)
            self._faults = [fault for fault in self._faults if not fault.done(t)]
        if frames:
            self._last = frames[-1]
        return frames

    def inject(self, fault: Fault, now: float) -> StreamFault | None:
        """Add a fault with start and end counted from `now` [s]; None if it is not of this signal."""
        if fault.signal != self._signal:
            return None
        random = generator(self._seed, self._attached, fault)
        self._faults.append(added := StreamFault(fault.later(now), random, self._last))
        self._attached += 1
        return added

    def forget(self) -> None:
        """Drop the frames held back: they belong to the last session's keys."""
        for fault in self._faults:
            fault.forget()

    def clear(self) -> None:
        """Remove all faults; frames held back are lost."""
        self._faults = []
