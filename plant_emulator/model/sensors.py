"""Sensors of the emulated plant.

Attitude: encoders that count steps of the joints, with a random zero within a step, or perfect. Angular velocity: the
filtered derivative of the encoders' angles, a gyro with noise and bias, or perfect. A sample is one CasADi function.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from math import cos, exp, isfinite, nan, pi, sin, sqrt
from typing import Any, Final, Literal, TypeVar

import casadi as ca
import numpy as np
from pydantic import BaseModel, Field

from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wire.symbolic import Compiled

Scalar = TypeVar("Scalar", float, "ca.SX")

NO_MEASUREMENT = Measurement((nan, nan, nan, nan), (nan, nan, nan))
"""Measurement without a valid value, such as of a state that is not finite."""

DAMPING_RATIO: Final = 0.8
"""ζ of the derivative's filter [1]; usual on the Aero, where Quanser's own examples have it."""

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
    gyro_noise: float = Field(default=0.0, ge=0, description="standard deviation of a gyro sample [rad/s]")
    gyro_bias: Vector = Field(default=(0.0, 0.0, 0.0), description="constant error of the gyro, body frame [rad/s]")
    seed: int = Field(default=0, ge=0, description="of the encoders' zeros and of the gyro's noise")


class FilteredDerivative:
    """The rate of a sampled angle, by the filter ωn² s / (s² + 2ζωn s + ωn²), exact for an angle held over a period.

    `bandwidth` is ωn [rad/s], and `period` the time between samples [s].
    """

    def __init__(self, bandwidth: float, period: float) -> None:
        decay = DAMPING_RATIO * bandwidth
        ringing = bandwidth * sqrt(1 - DAMPING_RATIO**2)
        envelope, c, s = exp(-decay * period), cos(ringing * period), sin(ringing * period) / ringing
        self._from_lag = envelope * (c + decay * s)
        self._from_rate = envelope * s
        self._rate_from_lag = -envelope * bandwidth**2 * s
        self._rate_from_rate = envelope * (c - decay * s)
        self._angle: float | None = None
        self._rate = 0.0

    def update(self, angle: float) -> float:
        """Filter a sample [rad] and return the rate [rad/s]. The filter starts at the first sample, at rest."""
        held = angle if self._angle is None else self._angle
        self._angle, self._rate = self.after(held, self._rate, angle)
        return self._rate

    def after(self, held: Scalar, rate: Scalar, angle: Scalar) -> tuple[Scalar, Scalar]:
        """Filtered angle [rad] and rate [rad/s] after a sample [rad], from those before it."""
        lag = held - angle
        return (
            angle + self._from_lag * lag + self._from_rate * rate,
            self._rate_from_lag * lag + self._rate_from_rate * rate,
        )


class Sensors:
    """Sensors of one plant, sampled once a `period` [s].

    Attributes:
        zeros: Of pitch and yaw encoders, within a step [1].
        given: Memory of attitude, rate and joint angles, by name: what `sample` samples.
    """

    def __init__(self, settings: SensorSettings, period: float) -> None:
        self._settings = settings
        self._gyro = settings.rate == "gyro"
        self._encoders = settings.attitude == "encoders" or settings.rate == "derivative"
        self._random = np.random.default_rng(settings.seed)
        self.zeros: list[float] = self._random.random(len(settings.counts)).tolist()
        self._errors = self._draw()
        self._compiled = Compiled(sensor_function(settings, period))
        given = self._compiled.inputs
        self.given = {name: given[name] for name in ("attitude", "rate", "angles")}
        self._angles, self._held, self._error = given["angles"], given["held"], given["error"]
        for i in (0, 1):
            given["zeros"][i] = self.zeros[i]
            self._held[2 * i] = nan

    def read(self, attitude: Quaternion, rate: Vector, angles: Sequence[float]) -> Measurement:
        """Sample a true attitude q [1], rate ω [rad/s] and joint angles [rad]. Call it once a period."""
        q, omega = self.given["attitude"], self.given["rate"]
        q[0], q[1], q[2], q[3] = attitude
        omega[0], omega[1], omega[2] = rate
        if self._encoders:
            self._angles[0], self._angles[1] = angles
        return self.sample()

    def sample(self) -> Measurement:
        """Sample the true values that stand in `given`. Call it once a period."""
        if self._encoders and not isfinite(self._angles[0] + self._angles[1]):
            return NO_MEASUREMENT
        if self._gyro:
            self._error[0], self._error[1], self._error[2] = self.error()
        self._compiled.evaluate()
        self._held[:] = self._compiled.outputs["after"]
        w, x, y, z, a, b, c = self._compiled.outputs["seen"].tolist()
        return Measurement((w, x, y, z), (a, b, c))

    @property
    def held(self) -> list[float]:
        """Memory of the filters; see `sensor_function`."""
        return self._held.tolist()  # type: ignore[return-value]  # doubles

    def error(self) -> Vector:
        """Draw a gyro's next error, noise and bias [rad/s]."""
        return next(self._errors)

    def _draw(self) -> Iterator[Vector]:
        noise, bias = self._settings.gyro_noise, self._settings.gyro_bias
        while True:
            drawn = self._random.standard_normal((_BLOCK, 3)) * noise + bias
            yield from map(tuple, drawn[::-1].tolist())  # the last first, as in every log so far


def sensor_function(settings: SensorSettings, period: float) -> ca.Function:
    """A sample as CasADi function.

    Inputs: true attitude q [1], rate ω [rad/s], joint angles [rad]; held (filtered angle [rad] and rate [rad/s] of
    pitch, then of yaw; a NaN angle starts the filter), zeros (of the encoders, within a step [1]), error (of the gyro
    [rad/s]). Outputs: seen (q and ω as measured), after (`held` of the next sample).
    """
    sizes = {"attitude": 4, "rate": 3, "angles": 2, "held": 4, "zeros": 2, "error": 3}
    given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    attitude, rate, angles, held, zeros, error = given.values()
    after = held
    with as_written():
        steps = [2 * pi / counts for counts in settings.counts]
        pitch, yaw = (step * ca.floor(angles[i] / step + zeros[i]) for i, step in enumerate(steps))
        if settings.attitude == "encoders":
            attitude = ca.vertcat(*attitude_of(pitch, yaw, ca))
        if settings.rate == "derivative":
            derivative = FilteredDerivative(settings.bandwidth, period)
            last = [
                ca.if_else(filtered == filtered, filtered, now) for filtered, now in ((held[0], pitch), (held[2], yaw))
            ]
            of_pitch = derivative.after(last[0], held[1], pitch)
            of_yaw = derivative.after(last[1], held[3], yaw)
            rate, after = ca.vertcat(*rate_of(pitch, of_pitch[1], of_yaw[1], ca)), ca.vertcat(*of_pitch, *of_yaw)
        elif settings.rate == "gyro":
            rate = rate + error
        seen = ca.vertcat(attitude, rate)
        return ca.Function("sensors", [*given.values()], [seen, after], [*given], ["seen", "after"])


def attitude_of(pitch: Scalar, yaw: Scalar, use: Any = math) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """q of a body that first yaws, then pitches by these joint angles [rad]; `use` is casadi for expressions."""
    cp, sp, cy, sy = use.cos(pitch / 2), use.sin(pitch / 2), use.cos(yaw / 2), use.sin(yaw / 2)
    return cy * cp, -sy * sp, cy * sp, sy * cp


def rate_of(pitch: Scalar, pitch_rate: Scalar, yaw_rate: Scalar, use: Any = math) -> tuple[Scalar, Scalar, Scalar]:
    """ω in the body frame [rad/s] of joints that turn at these rates [rad/s], at this pitch [rad]; `use` as above."""
    return -use.sin(pitch) * yaw_rate, pitch_rate, use.cos(pitch) * yaw_rate
