"""Plant interface: actuate, advance, measure and close.

The emulated plant, the USB board and the doubles in tests implement it. The endpoint calls actuate → advance → measure
once a tick.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from aeroloop.protocol.wire.attitude import Quaternion, Vector


class Measurement(NamedTuple):
    """Sensor values, unquantized. A failed sensor yields NaN, never its last value.

    Attributes:
        attitude: q, body relative to inertial [1].
        rate: ω in the body frame [rad/s].
    """

    attitude: Quaternion
    rate: Vector


class State(NamedTuple):
    """True state of an emulated plant, free of sensor errors.

    Attributes:
        attitude: q, body relative to inertial [1].
        rate: ω in the body frame [rad/s].
        voltages: Voltages at the motors, after their limits [V].
    """

    attitude: Quaternion
    rate: Vector
    voltages: tuple[float, ...]


class Plant(ABC):
    """A plant that its caller advances period by period.

    Attributes:
        actuators: Number of motors, 2 or 3.
        paces: Whether `advance` blocks until the next sample, and so paces the loop.
        passed: Periods that passed in the last `advance`; more than one if the call came late. The caller then raises
            its tick index by `passed`, and `advance` returns at once for the periods already over.
    """

    actuators: int
    paces: bool = False
    passed: int = 1

    @abstractmethod
    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V] on the motors until the next call; the plant clips to its limits. Shape (actuators,)."""

    @abstractmethod
    def advance(self) -> None:
        """Let one period pass. An emulator integrates; hardware waits for its next sample."""

    @abstractmethod
    def measure(self) -> Measurement:
        """Return the sensors' present values."""

    @abstractmethod
    def close(self) -> None:
        """Set 0 V and release all resources. A second call does nothing."""
