"""What a plant is to the loop: something to measure and to actuate, in fixed steps.

The emulator, a USB board and the doubles in tests all implement these four methods. The endpoint calls them in turn,
once a tick: actuate → advance → measure.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from aeroloop.protocol.wire.attitude import Quaternion, Vector


class Measurement(NamedTuple):
    """What the sensors say, unquantized. A failed sensor says NaN, never its last value.

    Attributes:
        attitude: q, body relative to inertial [1].
        rate: ω in the body frame [rad/s].
    """

    attitude: Quaternion
    rate: Vector


class State(NamedTuple):
    """What is true of an emulated plant, which sensors need not say.

    Attributes:
        attitude: q, body relative to inertial [1].
        rate: ω in the body frame [rad/s].
        voltages: Voltages at the motors, after their limits [V].
    """

    attitude: Quaternion
    rate: Vector
    voltages: tuple[float, ...]


class Plant(ABC):
    """A plant, advanced by its owner.

    Attributes:
        actuators: Number of its motors, 2 or 3.
        paces: Whether `advance` returns when the next sample is there, and so paces the loop.
        passed: How many periods the last `advance` let pass; more than one where its owner was late, who then raises
            his tick by so many, and `advance` returns at once for those that are over.
    """

    actuators: int
    paces: bool = False
    passed: int = 1

    @abstractmethod
    def actuate(self, voltages: Sequence[float]) -> None:
        """Put voltages [V] on the motors until told otherwise; the plant clips to its limits. Shape (actuators,)."""

    @abstractmethod
    def advance(self) -> None:
        """Let one period pass. An emulator integrates; hardware waits for its next sample."""

    @abstractmethod
    def measure(self) -> Measurement:
        """What the sensors say now."""

    @abstractmethod
    def close(self) -> None:
        """Leave the plant safe: 0 V, nothing held. Closing twice does no harm."""
