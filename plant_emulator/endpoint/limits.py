"""Limits of a plant, judged by its own sensors once a tick; beyond one it trips."""

from __future__ import annotations

from collections.abc import Sequence
from math import acos, cos, degrees, hypot, isfinite, radians

from pydantic import BaseModel, Field

from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.states import TripCause


class LimitSettings(BaseModel, extra="forbid"):
    """Limits; beyond any of them the plant trips."""

    max_tilt_deg: float = Field(default=75.0, gt=0, le=180, description="largest tilt of the body's z axis [deg]")
    max_rate: float = Field(default=20.0, gt=0, description="largest angular velocity [rad/s]")
    max_saturated_s: float = Field(default=3.0, gt=0, le=600, description="longest time at full voltage [s]")
    max_invalid_s: float = Field(default=0.1, gt=0, le=60, description="longest time without valid sensor values [s]")


class LimitMonitor:
    """Checks a plant once a tick, by its own sensors; at `voltage_limit` [V] a motor counts as saturated."""

    def __init__(self, settings: LimitSettings, period_ns: int, voltage_limit: float) -> None:
        self._settings, self._period_ns, self._full = settings, period_ns, voltage_limit
        # At 180° no attitude is beyond it: rounding and a length off 1 take the cosine below −1, but not to −2.
        self.least_upright = -2.0 if settings.max_tilt_deg == 180.0 else cos(radians(settings.max_tilt_deg))
        self.reset()

    def reset(self) -> None:
        """Begin a session."""
        self._saturated = self._invalid = 0

    def check(self, seen: Measurement, voltages: Sequence[float]) -> tuple[TripCause, str] | None:
        """Cause and reason to trip at a measurement and commanded voltages [V], (actuators,); None for neither."""
        limits = self._settings
        (w, x, y, z), (wx, wy, wz) = seen
        if not isfinite(w + x + y + z + wx + wy + wz):
            self._invalid += 1
            if (invalid_s := self._invalid * self._period_ns * 1e-9) > limits.max_invalid_s:
                return TripCause.SENSORS, f"the sensors have had no valid value for {invalid_s * 1e3:.0f} ms"
            return None
        self._invalid = 0
        upright = 1 - 2 * (x * x + y * y)  # cosine of the tilt
        if upright < self.least_upright:
            tilt = degrees(acos(max(-1.0, upright)))
            reason = f"tilted by {tilt:.1f}°, more than limits.max_tilt_deg = {limits.max_tilt_deg:g}°"
            return TripCause.ENVELOPE, reason
        if (speed := hypot(wx, wy, wz)) > limits.max_rate:
            reason = f"turns at {speed:.2f} rad/s, more than limits.max_rate = {limits.max_rate:g} rad/s"
            return TripCause.ENVELOPE, reason
        self._saturated = self._saturated + 1 if max(map(abs, voltages)) >= self._full else 0
        if (saturated_s := self._saturated * self._period_ns * 1e-9) > limits.max_saturated_s:
            return TripCause.SATURATION, f"a motor has been at its voltage limit for {saturated_s:.1f} s"
        return None
