"""Plants of a user's own, named by tests as `tests.support.own_plants:Class`: small bodies, and some that fail."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, degrees, nan, sin
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, Field

from aeroloop import Measurement, Plant
from aeroloop.plant_emulator.plant import State
from aeroloop.protocol.wire.attitude import Vector


class TurntableSettings(BaseModel, extra="forbid"):
    """A table on a motor, and the method that fails."""

    inertia: float = Field(default=0.02, gt=0, description="about z [kg·m²]")
    fails_in: Literal["", "__init__", "actuate", "advance", "measure", "truth", "close"] = ""
    fails_after: int = Field(default=3, description="periods before it fails")
    gives: Literal["values", "few", "long", "nothing"] = "values"
    signals: Any = None


class Turntable(Plant):
    """Turns about z by the mean of its voltages; `latest` is the one made last."""

    Settings = TurntableSettings
    repeatable: ClassVar[bool] = True
    latest: ClassVar[Turntable]
    actuators = 1

    def __init__(self, settings: TurntableSettings, period: float) -> None:
        Turntable.latest = self
        self._own, self._period = settings, period
        self._angle = self._rate = 0.0
        self._ticks = 0
        self.volts: tuple[float, ...] = (0.0,) * self.actuators
        self.closed = 0
        if settings.fails_in == "__init__":
            raise RuntimeError("no such table")

    def actuate(self, voltages: Sequence[float]) -> None:
        self._may("actuate")
        assert len(voltages) == self.actuators
        self.volts = tuple(voltages)

    def advance(self) -> None:
        self._may("advance")
        self._ticks += 1
        self._rate += 0.001 * sum(self.volts) / self.actuators / self._own.inertia * self._period
        self._angle += self._rate * self._period

    def measure(self) -> Measurement:
        self._may("measure")
        half, rate = self._angle / 2, (0.0, 0.0, self._rate)
        gives = self._own.gives if self._ticks > self._own.fails_after else "values"
        if gives == "few":
            return Measurement((cos(half), 0.0, 0.0), rate)  # type: ignore[arg-type]  # that is the point
        if gives == "nothing":
            return None  # type: ignore[return-value]  # likewise
        long = 2.0 if gives == "long" else 1.0
        return Measurement((long * cos(half), 0.0, 0.0, long * sin(half)), rate)

    def truth(self) -> State | None:
        self._may("truth")
        rate: Vector = (0.0, 0.0, self._rate)
        signals = self._own.signals or {"angle_deg": degrees(self._angle), "battery_V": nan}
        return State((cos(self._angle / 2), 0.0, 0.0, sin(self._angle / 2)), rate, self.volts, signals)

    def close(self) -> None:
        self.closed += 1
        self.volts = (0.0,) * self.actuators
        self._may("close")

    def _may(self, method: str) -> None:
        if method == self._own.fails_in and self._ticks >= self._own.fails_after:
            raise RuntimeError(f"the table broke\nin {method}")


class Pair(Turntable):
    actuators = 2


class Octoturntable(Turntable):
    actuators = 8


class Hardware(Pair):
    repeatable = False

    def truth(self) -> State | None:
        return None


class Legless(Turntable):
    actuators = 0


class NoPlant:
    """Is no plant."""
