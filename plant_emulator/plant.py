"""Plant interface: actuate, advance, measure and close.

The emulated plant, the USB board and a user's own class implement it; `plant.kind = "package.module:Class"` names the
latter. The endpoint calls actuate → advance → measure once a tick. Frames, claims, watchdog, limits and faults are the
endpoint's and the same for every plant. A plant of one's own:

    class Settings(BaseModel, extra="forbid"):
        inertia: float = Field(default=0.02, gt=0, description="about z [kg·m²]")

    class Turntable(Plant):
        Settings = Settings
        actuators = 1
        repeatable = True

        def __init__(self, settings: Settings, period: float) -> None:
            self._inertia, self._period = settings.inertia, period
            self._angle = self._rate = self._volts = 0.0

        def actuate(self, voltages: Sequence[float]) -> None:
            (self._volts,) = voltages

        def advance(self) -> None:
            self._rate += 0.01 * self._volts / self._inertia * self._period
            self._angle += self._rate * self._period

        def measure(self) -> Measurement:
            half = self._angle / 2
            return Measurement((cos(half), 0.0, 0.0, sin(half)), (0.0, 0.0, self._rate))

        def close(self) -> None:
            self._volts = 0.0
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

from pydantic import BaseModel

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


class NoSettings(BaseModel, extra="forbid"):
    """Settings of a plant that has none."""


class Plant(ABC):
    """A plant that its caller advances period by period.

    Args:
        settings: An instance of the class's `Settings`.
        period: Time of one `advance` [s].

    Attributes:
        Settings: Model of its settings, which the section `[plant.own]` fills; `extra="forbid"` finds wrong keys.
        repeatable: Whether equal settings and voltages give equal measurements and nothing moves: then a log replays.
        actuators: Number of motors, 1 to 8; of the class, or set by its constructor. The wire's must be the same.
        paces: Whether `advance` blocks until the next sample, and so paces the loop.
        passed: Periods that passed in the last `advance`; more than one if the call came late. The caller then raises
            its tick index by `passed`, and `advance` returns at once for the periods already over.
    """

    Settings: ClassVar[type[BaseModel]] = NoSettings
    repeatable: ClassVar[bool] = False
    actuators: int
    paces: bool = False
    passed: int = 1

    def __init__(self, settings: Any, period: float) -> None:
        self.settings = settings
        self.period = period

    @abstractmethod
    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V] on the motors until the next call. Shape (actuators,).

        They are within `plant.voltage_limit` where the plant is one of a user's; others clip to their own limits.
        """

    @abstractmethod
    def advance(self) -> None:
        """Let one period pass. An emulator integrates; hardware waits for its next sample."""

    @abstractmethod
    def measure(self) -> Measurement:
        """Return the sensors' present values. The first call may come before any `advance`."""

    def truth(self) -> State | None:
        """The present true state; None where it is not known."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Set 0 V and release all resources. A second call does nothing."""
