"""Faults at work on a plant's sensors, motors and frames, repeatable from a seed.

A FaultyPlant wraps any plant: motor faults change the voltages at the start of a period, sensor faults the sample at
its end. A FaultyStream passes the frames of one direction. Faults on one signal act one after another, in the order of
injection. Each has its own random numbers, so that another fault leaves its noise unchanged. What each kind does is in
two tables, VALUE_FAULTS and FRAME_FAULTS.

Times are the plant's, rounded to the nanosecond: a fault starts at exactly the tick of its start time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import cos, hypot, inf, nan, sin
from typing import Final, Literal, TypeAlias

import numpy as np

from aeroloop.plant_emulator.faults.language import Fault, Kind
from aeroloop.plant_emulator.plant import Measurement, Plant

Values: TypeAlias = tuple[float, ...]

GARBLED_RATE: Final = 10.0
"""Bound of a garbled angular velocity about each axis, ± [rad/s]."""


class ActingFault:
    """A fault in the plant's time: what is left to do, and what it has done.

    Attributes:
        fault: The fault as it was written.
        start: Start [s].
        end: End [s]; infinity for none.
        changed: Samples, voltages of a period, or frames that it has changed.
    """

    def __init__(self, fault: Fault, random: np.random.Generator, now: float) -> None:
        self.fault, self.random = fault, random
        self.start = round(fault.start_s + now, 9)
        self.end = inf if fault.end_s is None else round(fault.end_s + now, 9)
        self.value = fault.value or 0.0
        self.changed = 0

    def active(self, t: float) -> bool:
        """Whether it acts at time t [s]: start ≤ t < end."""
        return self.start <= t < self.end


# ── sensors and motors ──


class ValueFault(ActingFault):
    """A fault of attitude, rate or voltages, sampled once a period.

    `last` are the values just before, if there are any; `bound` is the largest size of a garbled value.
    """

    def __init__(
        self, fault: Fault, random: np.random.Generator, now: float, last: Values | None, bound: float = GARBLED_RATE
    ) -> None:
        super().__init__(fault, random, now)
        whole, part, _ = fault.target
        self.is_attitude, self.is_motor = whole == "attitude", whole == "motors"
        self.size = len(last) if self.is_motor and last is not None else 3  # components of an error
        self.parts = range(self.size) if part is None else range(part, part + 1)
        self.last, self.bound = last, bound
        self.history: deque[tuple[float, Values]] = deque() if last is None else deque([(-inf, last)])

    def apply(self, values: Values, t: float) -> Values:
        """Apply the fault to the values of time t [s]. Call it at every sample: before it starts, it keeps history."""
        kind, history = self.fault.kind, self.history
        if kind == "delay":
            history.append((t, values))
            while len(history) > 1 and history[1][0] <= round(t - self.value, 9):
                history.popleft()
        if not self.active(t):
            self.last = values
            return values
        if kind in ("drop", "garble") and self.random.random() >= self.value:
            return values
        self.changed += 1
        return VALUE_FAULTS[kind](self, values)

    def missing(self, values: Values) -> Values:
        """0 V; else no valid value, on all axes: a rate with one axis missing is invalid."""
        return self.replaced(values, (0.0,) * self.size) if self.is_motor else (nan,) * len(values)

    def stuck(self, values: Values) -> Values:
        """The last values before the fault."""
        self.last = values if self.last is None else self.last
        return self.replaced(values, self.last)

    def garbled(self, values: Values) -> Values:
        """A uniformly distributed attitude, or values uniformly distributed within ±`bound`."""
        if not self.is_attitude:
            return self.replaced(values, tuple(self.random.uniform(-self.bound, self.bound, self.size).tolist()))
        w, x, y, z = self.random.standard_normal(4).tolist()
        length = hypot(w, x, y, z)
        return w / length, x / length, y / length, z / length

    def shifted(self, values: Values, error: Sequence[float]) -> Values:
        """The values with the fault's parts of an error added: of an attitude, a rotation about the body's axes."""
        error = [part if i in self.parts else 0.0 for i, part in enumerate(error)]
        if self.is_attitude:
            return _rotated(values, error)
        return tuple(value + part for value, part in zip(values, error, strict=True))

    def replaced(self, values: Values, by: Values) -> Values:
        """The values with the fault's parts replaced by others; an attitude is replaced as a whole."""
        if self.is_attitude:
            return by
        return tuple(by[i] if i in self.parts else value for i, value in enumerate(values))


def _rotated(q: Values, error: Sequence[float]) -> Values:
    """`q ⊗ exp(error / 2)`; the error is a rotation vector in the body frame [rad]."""
    angle = hypot(*error)
    if angle == 0.0:
        return q
    scale = sin(angle / 2) / angle
    (w, x, y, z), (a, b, c), d = q, (scale * part for part in error), cos(angle / 2)
    return (
        w * d - x * a - y * b - z * c,
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
    )


VALUE_FAULTS: Final[dict[Kind, Callable[[ValueFault, Values], Values]]] = {
    "off": ValueFault.missing,
    "drop": ValueFault.missing,
    "stuck": ValueFault.stuck,
    "garble": ValueFault.garbled,
    "bias": lambda fault, values: fault.shifted(values, [fault.value] * fault.size),
    "noise": lambda fault, values: fault.shifted(
        values, (fault.value * fault.random.standard_normal(fault.size)).tolist()
    ),
    "delay": lambda fault, values: fault.replaced(values, fault.history[0][1]),
}
"""What each kind does to values while it acts, and where it has a probability, when chance has it act."""


class FaultyPlant(Plant):
    """A plant with faults of its sensors and motors. Before `start` its time is 0 and no fault acts.

    Faults of streams are ignored here. `period` is the time of one `advance` [s], `voltage_limit` the largest voltage
    of a garbled command [V]; `seed` is 0 or more.

    Raises:
        ValueError: A fault of a motor that the plant does not have.

    Attributes:
        plant: The plant without its faults.
        elapsed: Plant time since `start` [s]; 0 before.
    """

    def __init__(
        self, plant: Plant, faults: Sequence[Fault], period: float, *, voltage_limit: float, seed: int = 0
    ) -> None:
        self.plant = plant
        self.actuators, self.paces = plant.actuators, plant.paces
        self._period, self._limit, self._seed = period, voltage_limit, seed
        self._started = False
        self._ticks = self._attached = 0
        self.elapsed = 0.0
        self._commanded: Values = (0.0,) * plant.actuators
        self._applied = self._commanded
        self._actuated = False  # since the last period
        self._seen: Measurement | None = None
        self._motors: list[ValueFault] = []
        self._sensors: list[ValueFault] = []
        for fault in faults:
            self.inject(fault)

    @property
    def time(self) -> float:
        """`elapsed`, rounded to the nanosecond."""
        return round(self.elapsed, 9)

    @property
    def ticks(self) -> int:
        """Periods since `start`; −1 before."""
        return self._ticks if self._started else -1

    def start(self) -> None:
        """Start the time at 0. A second call does nothing."""
        if not self._started:
            self._started = True
            self._seen = None

    def check(self, fault: Fault) -> None:
        """Raise ValueError if it is a fault of a motor that the plant does not have."""
        if fault.target.whole == "motors" and (fault.target.part or 0) >= self.actuators:
            there = ", ".join(f"motor{i + 1}" for i in range(self.actuators))
            raise ValueError(f"fault '{fault}': the plant has no {fault.signal}, but {there}")

    def inject(self, fault: Fault) -> ValueFault | None:
        """Add a fault with start and end counted from now. The current sample stays unchanged.

        Returns:
            The fault at work; None for one of a stream.

        Raises:
            ValueError: A fault of a motor that the plant does not have.
        """
        self.check(fault)
        whole, seen = fault.target.whole, self._seen
        random = _generator(self._seed, self._attached, fault)
        self._attached += 1
        if whole == "motors":
            self._motors.append(added := ValueFault(fault, random, self.time, self._applied, self._limit))
        elif whole == "attitude" or whole == "rate":
            last: Values | None = seen and (seen.attitude if whole == "attitude" else seen.rate)
            self._sensors.append(added := ValueFault(fault, random, self.time, last))
        else:
            return None
        return added

    def clear(self) -> None:
        """Remove all faults and put the commanded voltages on the motors."""
        self._sensors = []
        if self._motors:
            self._motors = []
            self.plant.actuate(self._commanded)
            self._applied = self._commanded

    def actuate(self, voltages: Sequence[float]) -> None:
        """Put voltages [V] through the motor faults on the motors. Shape (actuators,)."""
        self._commanded = self._applied = tuple(voltages)
        self._actuated = True
        if self._motors:
            t = self.time if self._started else -inf
            for fault in self._motors:
                self._applied = fault.apply(self._applied, t)
            self._motors = [fault for fault in self._motors if t < fault.end]
        self.plant.actuate(self._applied)

    def advance(self) -> None:
        """Let one period pass."""
        if self._motors and not self._actuated:
            self.actuate(self._commanded)  # a motor also fails and recovers while a voltage is held
        self._actuated = False
        self.plant.advance()
        self.passed = self.plant.passed
        if self._started:
            self._ticks += 1
            self.elapsed = self._ticks * self._period
        self._seen = None
        if self._sensors:
            self.measure()  # faults that hold or delay values need every sample

    def measure(self) -> Measurement:
        """Sensor values with their faults; the same until the next `advance`."""
        if self._seen is None:
            self._seen = self.plant.measure()
            if self._sensors:
                self._seen = self._sensed(self._seen)
        return self._seen

    def close(self) -> None:
        """Remove all faults and set 0 V."""
        self._motors, self._sensors = [], []
        self._commanded = self._applied = (0.0,) * self.actuators
        self.plant.close()

    def _sensed(self, seen: Measurement) -> Measurement:
        attitude: Values = seen.attitude
        rate: Values = seen.rate
        t = self.time if self._started else -inf
        for fault in self._sensors:
            if fault.is_attitude:
                attitude = fault.apply(attitude, t)
            else:
                rate = fault.apply(rate, t)
        self._sensors = [fault for fault in self._sensors if t < fault.end]
        w, x, y, z = attitude
        a, b, c = rate
        return Measurement((w, x, y, z), (a, b, c))


# ── frames ──


class FrameFault(ActingFault):
    """A fault of frames; `last` is the frame that passed last, if there was one."""

    def __init__(self, fault: Fault, random: np.random.Generator, now: float, last: bytes | None) -> None:
        super().__init__(fault, random, now)
        self.last = last
        self.held: deque[tuple[float, bytes]] = deque()  # due time [s] and frame

    def acts(self, t: float) -> bool:
        """Whether it acts on a frame, which is counted, whatever it is."""
        acts = self.active(t)
        self.changed += acts
        return acts

    def happens(self, t: float) -> bool:
        """Whether chance has it act on a frame, which is counted."""
        happens = self.active(t) and bool(self.random.random() < self.value)
        self.changed += happens
        return happens

    def delayed(self, frames: list[bytes], t: float) -> list[bytes]:
        """When the fault ends, all held frames pass at once, ahead of the newer ones."""
        active = self.active(t)
        self.changed += active * len(frames)
        self.held.extend((round(t + self.value, 9), frame) for frame in frames)
        passed = []
        while self.held and (not active or self.held[0][0] <= t):
            passed.append(self.held.popleft()[1])
        return passed

    def duplicated(self, frames: list[bytes], t: float) -> list[bytes]:
        """A frame passes again a tick later."""
        again = [frame for _, frame in self.held]
        self.held = deque((t, frame) for frame in frames if self.happens(t))
        return again + frames

    def reordered(self, frames: list[bytes], t: float) -> list[bytes]:
        """A frame passes after the next one."""
        passed = []
        for frame in frames:
            if self.held:
                passed += [frame, self.held.popleft()[1]]
            elif self.happens(t):
                self.held.append((t, frame))
            else:
                passed.append(frame)
        return passed

    def stuck(self, frames: list[bytes], t: float) -> list[bytes]:
        """The last frame before the fault, for each new one."""
        if frames and not self.active(t):
            self.last = frames[-1]
        elif frames:
            self.changed += len(frames)
            self.last = frames[0] if self.last is None else self.last
            return [self.last] * len(frames)
        return frames

    def garbled(self, frame: bytes) -> bytes:
        """The frame with one random bit flipped."""
        bit = int(self.random.integers(8 * len(frame)))
        flipped = bytearray(frame)
        flipped[bit // 8] ^= 0x80 >> bit % 8
        return bytes(flipped)


FRAME_FAULTS: Final[dict[Kind, Callable[[FrameFault, list[bytes], float], list[bytes]]]] = {
    "off": lambda fault, frames, t: [frame for frame in frames if not fault.acts(t)],
    "drop": lambda fault, frames, t: [frame for frame in frames if not fault.happens(t)],
    "garble": lambda fault, frames, t: [
        fault.garbled(frame) if frame and fault.happens(t) else frame for frame in frames
    ],
    "stuck": FrameFault.stuck,
    "delay": FrameFault.delayed,
    "duplicate": FrameFault.duplicated,
    "reorder": FrameFault.reordered,
}
"""The frames that pass at time t [s], of those of this tick and those held back."""


class FaultyStream:
    """Frames of one direction, with faults; those of other signals are ignored here. `seed` is 0 or more."""

    def __init__(self, signal: Literal["measurement", "command"], faults: Sequence[Fault], seed: int = 0) -> None:
        self._signal, self._seed = signal, seed
        self._attached = 0
        self._last: bytes | None = None
        self._faults: list[FrameFault] = []
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
                frames = FRAME_FAULTS[fault.fault.kind](fault, frames, t)
            self._faults = [fault for fault in self._faults if t < fault.end or fault.held]
        if frames:
            self._last = frames[-1]
        return frames

    def inject(self, fault: Fault, now: float) -> FrameFault | None:
        """Add a fault with start and end counted from `now` [s]; None if it is not of this signal."""
        if fault.signal != self._signal:
            return None
        random = _generator(self._seed, self._attached, fault)
        self._faults.append(added := FrameFault(fault, random, now, self._last))
        self._attached += 1
        return added

    def forget(self) -> None:
        """Drop the frames held back: they belong to the last session's keys."""
        for fault in self._faults:
            fault.held.clear()

    def clear(self) -> None:
        """Remove all faults; frames held back are lost."""
        self._faults = []


def _generator(seed: int, number: int, fault: Fault) -> np.random.Generator:
    """Random numbers of one fault; they differ by signal, so that the two streams do not lose the same ticks."""
    return np.random.default_rng([seed, number, *fault.signal.encode()])
