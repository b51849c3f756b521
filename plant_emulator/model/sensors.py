"""Sensors of the emulated plant.

Attitude: encoders that count steps of the joints, with a random zero within a step, or perfect. Angular velocity: the
filtered derivative of the encoders' angles, a gyro with noise and bias, or perfect.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, exp, floor, nan, pi, sin, sqrt
from typing import Literal

from pydantic import BaseModel, Field

from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.lazy import numpy as np
from aeroloop.protocol.wire.attitude import Quaternion, Vector

NO_MEASUREMENT = Measurement((nan, nan, nan, nan), (nan, nan, nan))
"""Measurement without a valid value, such as of a state that is not finite."""

_BLOCK = 4096  # random numbers are drawn this many samples at a time


class SensorSettings(BaseModel, extra="forbid"):
    """Sensors of attitude and angular velocity."""

    attitude: Literal["encoders", "perfect"] = Field(default="encoders", description="encoders need joints: the Aero")
    counts: tuple[int, int] = Field(
        default=(2048, 4096), description="encoder counts a turn, pitch and yaw; Aero 2 has 2880 in pitch"
    )
    rate: Literal["derivative", "gyro", "perfect"] = Field(
        default="derivative", description="derivative: of the encoders' angles, filtered"
    )
    bandwidth: float = Field(default=50.0, gt=0, description="ωn of the derivative's filter [rad/s]")
    damping_ratio: float = Field(default=0.8, gt=0, lt=1, description="ζ of the derivative's filter [1]")
    gyro_noise: float = Field(default=0.0, ge=0, description="standard deviation of a gyro sample [rad/s]")
    gyro_bias: Vector = Field(default=(0.0, 0.0, 0.0), description="constant error of the gyro, body frame [rad/s]")
    seed: int = Field(default=0, ge=0, description="of the encoders' zeros and of the gyro's noise")


class FilteredDerivative:
    """The rate of a sampled angle, by the filter ωn² s / (s² + 2ζωn s + ωn²), exact for an angle held over a period.

    `bandwidth` is ωn [rad/s], `damping_ratio` is ζ, 0…1, and `period` the time between samples [s].
    """

    def __init__(self, bandwidth: float, damping_ratio: float, period: float) -> None:
        decay = damping_ratio * bandwidth
        ringing = bandwidth * sqrt(1 - damping_ratio**2)
        envelope, c, s = exp(-decay * period), cos(ringing * period), sin(ringing * period) / ringing
        self._from_lag = envelope * (c + decay * s)
        self._from_rate = envelope * s
        self._rate_from_lag = -envelope * bandwidth**2 * s
        self._rate_from_rate = envelope * (c - decay * s)
        self._angle: float | None = None
        self._rate = 0.0

    def update(self, angle: float) -> float:
        """Filter a sample [rad] and return the rate [rad/s]. The filter starts at the first sample, at rest."""
        if self._angle is None:
            self._angle = angle
        lag = self._angle - angle
        self._angle = angle + self._from_lag * lag + self._from_rate * self._rate
        self._rate = self._rate_from_lag * lag + self._rate_from_rate * self._rate
        return self._rate


class Sensors:
    """Sensors of one plant, sampled once a `period` [s]."""

    def __init__(self, settings: SensorSettings, period: float) -> None:
        self._settings = settings
        self._attitude, self._rate = settings.attitude, settings.rate
        self._encoders = settings.attitude == "encoders" or settings.rate == "derivative"
        self._steps = [2 * pi / counts for counts in settings.counts]
        self._filters = [FilteredDerivative(settings.bandwidth, settings.damping_ratio, period) for _ in self._steps]
        self._random = np.random.default_rng(settings.seed)
        self._zeros: list[float] = self._random.random(len(self._steps)).tolist()
        self._noise: list[Vector] = []

    def read(self, attitude: Quaternion, rate: Vector, angles: Sequence[float]) -> Measurement:
        """Sample a true attitude q [1], rate ω [rad/s] and joint angles [rad]. Call it once a period."""
        if self._encoders:
            (pitch_step, yaw_step), (pitch_zero, yaw_zero) = self._steps, self._zeros
            try:
                pitch = pitch_step * floor(angles[0] / pitch_step + pitch_zero)
                yaw = yaw_step * floor(angles[1] / yaw_step + yaw_zero)
            except (OverflowError, ValueError):  # an infinite or undefined angle has no count
                return NO_MEASUREMENT
            if self._attitude == "encoders":
                attitude = attitude_of(pitch, yaw)
            if self._rate == "derivative":
                pitch_rate, yaw_rate = self._filters[0].update(pitch), self._filters[1].update(yaw)
                return Measurement(attitude, rate_of(pitch, pitch_rate, yaw_rate))
        return Measurement(attitude, self._gyro(rate) if self._rate == "gyro" else rate)

    def _gyro(self, rate: Vector) -> Vector:
        if not self._noise:
            drawn = self._random.standard_normal((_BLOCK, 3)) * self._settings.gyro_noise + self._settings.gyro_bias
            self._noise = [tuple(row) for row in drawn.tolist()]
        error = self._noise.pop()
        return rate[0] + error[0], rate[1] + error[1], rate[2] + error[2]


def attitude_of(pitch: float, yaw: float) -> Quaternion:
    """q of a body that first yaws, then pitches by these joint angles [rad]."""
    cp, sp, cy, sy = cos(pitch / 2), sin(pitch / 2), cos(yaw / 2), sin(yaw / 2)
    return cy * cp, -sy * sp, cy * sp, sy * cp


def rate_of(pitch: float, pitch_rate: float, yaw_rate: float) -> Vector:
    """ω in the body frame [rad/s] of joints that turn at these rates [rad/s], at this pitch [rad]."""
    return -sin(pitch) * yaw_rate, pitch_rate, cos(pitch) * yaw_rate
