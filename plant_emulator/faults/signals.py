"""Faults of a plant's sensors and motors, repeatable from a seed.

A FaultyPlant wraps any plant for the endpoint. Motor faults change the voltages at the start of a period; sensor faults
change the sample at its end. Faults on one signal act one after another, in the order of injection. Each has its own
random numbers, so that another fault leaves their noise unchanged. Faults that have ended are removed.

Times are rounded to the nanosecond, so that a fault starts at exactly the tick of its start time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import cos, hypot, inf, nan, sin
from typing import Final, TypeAlias

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.lazy import numpy as np

Values: TypeAlias = tuple[float, ...]

GARBLED_RATE: Final = 10.0
"""Bound of a garbled angular velocity about each axis, ± [rad/s]."""


class ValueFault:
    """A fault of values sampled once a period: of an angular velocity [rad/s]; the other signals' are subclasses.

    `size` is the number of components of an error, `last` the values just before, if there are any, and `bound` the
    largest size of a garbled value.

    Attributes:
        fault: The fault, in the plant's time.
        changed: Samples, or voltages of a period, on which it has acted.
    """

    def __init__(
        self, fault: Fault, random: np.random.Generator, size: int, last: Values | None, bound: float = GARBLED_RATE
    ) -> None:
        self.fault = fault
        self.changed = 0
        self._bound = bound
        self._value = 0.0 if fault.value is None else fault.value
        self._random, self._size, self._last = random, size, last
        part = fault.target.part
        self._parts = range(size) if part is None else range(part, part + 1)
        self._history: deque[tuple[float, Values]] = deque() if last is None else deque([(-inf, last)])

    def apply(self, values: Values, t: float) -> Values:
        """Apply the fault to the values of time t [s]. Call it at every sample: before it starts, it keeps history."""
        kind = self.fault.kind
        delayed = self._delayed(values, t) if kind == "delay" else values
        if not self.fault.active(t):
            self._last = values
            return values
        if kind in ("drop", "garble") and self._random.random() >= self._value:
            return values
        self.changed += 1
        if kind == "delay":
            return self.replaced(values, delayed)
        if kind == "stuck":
            self._last = values if self._last is None else self._last
            return self.replaced(values, self._last)
        if kind == "bias":
            return self.shifted(values, self._within_parts([self._value] * self._size))
        if kind == "noise":
            noise: list[float] = (self._value * self._random.standard_normal(self._size)).tolist()
            return self.shifted(values, self._within_parts(noise))
        return self.replaced(values, self.garbled()) if kind == "garble" else self.missing(values)

    def missing(self, values: Values) -> Values:
        """No valid value, on all axes: a rate with one axis missing is invalid."""
        return (nan,) * len(values)

    def garbled(self) -> Values:
        """Uniformly distributed values within ±`bound`."""
        return tuple(self._random.uniform(-self._bound, self._bound, self._size).tolist())

    def shifted(self, values: Values, error: Sequence[float]) -> Values:
        """The values with an error added. Shape of error: (size,)."""
        return tuple(value + part for value, part in zip(values, error, strict=True))

    def replaced(self, values: Values, by: Values) -> Values:
        """The values with the fault's parts replaced by others."""
        return tuple(by[i] if i in self._parts else value for i, value in enumerate(values))

    def _within_parts(self, error: Sequence[float]) -> Sequence[float]:
        return [part if i in self._parts else 0.0 for i, part in enumerate(error)]

    def _delayed(self, values: Values, t: float) -> Values:
        history, then = self._history, round(t - self._value, 9)
        history.append((t, values))
        while len(history) > 1 and history[1][0] <= then:
            history.popleft()
        return history[0][1]


class AttitudeFault(ValueFault):
    """A fault of a quaternion. Errors are rotation vectors in the body frame [rad]."""

    def garbled(self) -> Values:
        """A uniformly distributed attitude."""
        w, x, y, z = self._random.standard_normal(4).tolist()
        length = hypot(w, x, y, z)
        return w / length, x / length, y / length, z / length

    def shifted(self, values: Values, error: Sequence[float]) -> Values:
        """`q ⊗ exp(error / 2)`: a further rotation about the body's axes."""
        angle = hypot(*error)
        if angle == 0.0:
            return values
        scale = sin(angle / 2) / angle
        (w, x, y, z), (a, b, c), d = values, (scale * part for part in error), cos(angle / 2)
        return (
            w * d - x * a - y * b - z * c,
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
        )

    def replaced(self, values: Values, by: Values) -> Values:
        """The other attitude as a whole: a fault that replaces it has no axis."""
        del values
        return by


class MotorFault(ValueFault):
    """A fault of the motors' voltages [V].

    `last` are the motors' present voltages [V], shape (actuators,); `limit` is the largest garbled voltage [V].
    """

    def __init__(self, fault: Fault, random: np.random.Generator, last: Values, limit: float) -> None:
        super().__init__(fault, random, len(last), last, limit)

    def missing(self, values: Values) -> Values:
        """0 V."""
        return self.replaced(values, (0.0,) * len(values))


class FaultyPlant(Plant):
    """A plant with faults. Before `start` its time is 0 and no fault acts.

    Faults of streams are ignored here; FaultyStream applies them. `period` is the time of one `advance` [s],
    `voltage_limit` the largest voltage of a garbled command [V]; `seed` is 0 or more.

    Raises:
        ValueError: A fault of a motor that the plant does not have.

    Attributes:
        plant: The plant without its faults.
        actuators: Number of motors.
        elapsed: Plant time since `start` [s]; 0 before.
    """

    def __init__(
        self, plant: Plant, faults: Sequence[Fault], period: float, *, voltage_limit: float, seed: int = 0
    ) -> None:
        self.plant = plant
        self.actuators, self.paces = plant.actuators, plant.paces
        self._period, self._limit, self._seed = period, voltage_limit, seed
        self._started = False
        self._ticks = 0
        self.elapsed = 0.0
        self._attached = 0
        self._commanded: Values = (0.0,) * plant.actuators
        self._applied = self._commanded
        self._actuated = False  # since the last period
        self._seen: Measurement | None = None
        self._motors: list[MotorFault] = []
        self._sensors: list[ValueFault] = []
        for fault in faults:
            self._attach(fault)

    @property
    def time(self) -> float:
        """`elapsed`, rounded to the nanosecond."""
        return round(self.elapsed, 9)

    def start(self) -> None:
        """Start the time at 0. A second call does nothing."""
        if not self._started:
            self._started = True
            self._seen = None

    @property
    def ticks(self) -> int:
        """Periods since `start`; −1 before."""
        return self._ticks if self._started else -1

    def check(self, fault: Fault) -> None:
        """Raise ValueError if it is a fault of a motor that the plant does not have."""
        if fault.target.whole == "motors" and (fault.target.part or 0) >= self.actuators:
            there = ", ".join(f"motor{i + 1}" for i in range(self.actuators))
            raise ValueError(f"fault '{fault}': the plant has no {fault.signal}, but {there}")

    def inject(self, fault: Fault) -> ValueFault | None:
        """Add a fault with start and end counted from now. The current sample stays unchanged.

        Returns:
            What applies it; None for a fault of a stream.

        Raises:
            ValueError: A fault of a motor that the plant does not have.
        """
        return self._attach(fault.later(self.time))

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
            t = self._now()
            for fault in self._motors:
                self._applied = fault.apply(self._applied, t)
            self._motors = [fault for fault in self._motors if not fault.fault.over(t)]
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

    def _now(self) -> float:
        return self.time if self._started else -inf

    def _sensed(self, seen: Measurement) -> Measurement:
        attitude: Values = seen.attitude
        rate: Values = seen.rate
        t = self._now()
        for fault in self._sensors:
            if fault.fault.target.whole == "attitude":
                attitude = fault.apply(attitude, t)
            else:
                rate = fault.apply(rate, t)
        self._sensors = [fault for fault in self._sensors if not fault.fault.over(t)]
        w, x, y, z = attitude
        a, b, c = rate
        return Measurement((w, x, y, z), (a, b, c))

    def _attach(self, fault: Fault) -> ValueFault | None:
        self.check(fault)
        whole, seen = fault.target.whole, self._seen
        random = generator(self._seed, self._attached, fault)
        self._attached += 1
        if whole == "motors":
            self._motors.append(motor := MotorFault(fault, random, self._applied, self._limit))
            return motor
        if whole not in ("attitude", "rate"):
            return None
        sensor = (
            AttitudeFault(fault, random, 3, seen.attitude if seen else None)
            if whole == "attitude"
            else ValueFault(fault, random, 3, seen.rate if seen else None)
        )
        self._sensors.append(sensor)
        return sensor


def generator(seed: int, number: int, fault: Fault) -> np.random.Generator:
    """Random numbers of one fault; they differ by signal, so that the two streams do not lose the same ticks."""
    return np.random.default_rng([seed, number, *fault.signal.encode()])
