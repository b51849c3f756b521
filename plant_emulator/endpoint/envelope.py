"""Limits of the plant: tilt, rate, time at full voltage, time without valid sensor values.

Once a tick a Guard checks the measurement and the commanded voltages and returns a reason to trip or None. It uses only
the plant's own sensors, and counts durations in ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import acos, cos, degrees, hypot, isfinite, radians

from pydantic import BaseModel, Field

from aeroloop.plant_emulator.endpoint.tenancy import Trip
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.states import TripCause


class LimitSettings(BaseModel, extra="forbid"):
    """Limits; beyond any of them the plant trips."""

    max_tilt_deg: float = Field(
        default=75.0, gt=0, le=180, description="largest angle between the body's z axis and the vertical [deg]"
    )
    max_rate: float = Field(default=20.0, gt=0, description="largest angular velocity [rad/s]")
    max_saturated_s: float = Field(
        default=3.0, gt=0, le=600, description="longest time a motor may stay at its voltage limit [s]"
    )
    max_invalid_s: float = Field(
        default=0.1, gt=0, le=60, description="longest time the sensors may have no valid value [s]"
    )


class Guard:
    """Checks one plant against its limits. At `voltage_limit` [V] a motor counts as saturated."""

    def __init__(self, settings: LimitSettings, period_ns: int, voltage_limit: float) -> None:
        self._settings = settings
        self._period_ns = period_ns
        self._full = voltage_limit
        self._least_upright = cos(radians(settings.max_tilt_deg))
        self._saturated = self._invalid = 0

    def reset(self) -> None:
        """Reset the counts for a new session."""
        self._saturated = self._invalid = 0

    def check(self, seen: Measurement, voltages: Sequence[float]) -> Trip | None:
        """Return a reason to trip, or None, for this tick's measurement and commanded voltages [V] (actuators,)."""
        limits = self._settings
        (w, x, y, z), (wx, wy, wz) = seen
        if not isfinite(w + x + y + z + wx + wy + wz):
            self._invalid += 1
            if (invalid_s := self._seconds(self._invalid)) > limits.max_invalid_s:
                reason = f"the sensors have had no valid value for {invalid_s * 1e3:.0f} ms"
                return Trip(TripCause.SENSORS, reason)
            return None
        self._invalid = 0
        upright = 1 - 2 * (x * x + y * y)  # cosine of the tilt
        if upright < self._least_upright:
            tilt = degrees(acos(max(-1.0, upright)))
            reason = f"tilted by {tilt:.1f}°, more than limits.max_tilt_deg = {limits.max_tilt_deg:g}°"
            return Trip(TripCause.ENVELOPE, reason)
        if (speed := hypot(wx, wy, wz)) > limits.max_rate:
            reason = f"turns at {speed:.2f} rad/s, more than limits.max_rate = {limits.max_rate:g} rad/s"
            return Trip(TripCause.ENVELOPE, reason)
        if max(voltages) < self._full and min(voltages) > -self._full:
            self._saturated = 0
            return None
        self._saturated += 1
        if (saturated_s := self._seconds(self._saturated)) > limits.max_saturated_s:
            reason = f"a motor has been at its voltage limit for {saturated_s:.1f} s"
            return Trip(TripCause.SATURATION, reason)
        return None

    def _seconds(self, ticks: int) -> float:
        return ticks * self._period_ns * 1e-9
