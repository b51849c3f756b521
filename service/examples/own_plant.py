"""A plant of your own: a satellite with four reaction wheels in a pyramid; own-plant.toml configures and runs it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, Field

import aeroloop

AXES = np.array([[1, 0, -1, 0], [0, 1, 0, -1], [1, 1, 1, 1]]) / 2**0.5  # of the wheels, body frame, a column each


class SatelliteSettings(BaseModel, extra="forbid"):
    """Keys of [plant.own], with units and bounds: what is wrong is refused before anything moves."""

    inertia: tuple[float, float, float] = Field(default=(0.02, 0.02, 0.03), description="with wheels locked [kg·m²]")
    torque: float = Field(default=0.002, gt=0, description="of a motor on its wheel [N·m/V]")
    drag: float = Field(default=0.02, ge=0, description="of the bearings, of a wheel's momentum [1/s]")
    gyro_noise: float = Field(default=0.001, ge=0, description="standard deviation of the gyro [rad/s]")


class Satellite(aeroloop.Plant):
    """Wheels accelerate, the body turns the other way, and what the wheels hold turns with it."""

    Settings = SatelliteSettings
    actuators = 4
    repeatable = True  # equal voltages give equal measurements: then a log replays byte for byte

    def __init__(self, settings: SatelliteSettings, period: float) -> None:
        self.settings, self.period = settings, period
        self.q, self.rate = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        self.wheels, self.volts = np.zeros(4), np.zeros(4)  # momentum [N·m·s], voltage [V]
        self.noise = np.random.default_rng(0)  # seeded, and no clock anywhere

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages, which are within `plant.voltage_limit`, until the next call."""
        self.volts = np.array(voltages)

    def advance(self) -> None:
        """Integrate one period: J ω̇ = −A ḣ − ω × (J ω + A h), q̇ = q ∘ (0, ω)/2."""
        inertia, turned = np.array(self.settings.inertia), self.rate * self.period / 2
        speeding = self.settings.torque * self.volts - self.settings.drag * self.wheels
        momentum = inertia * self.rate + AXES @ self.wheels
        self.q = self.q + np.array([-self.q[1:] @ turned, *(self.q[0] * turned + np.cross(self.q[1:], turned))])
        self.q /= np.linalg.norm(self.q)
        self.rate = self.rate + self.period * (-AXES @ speeding - np.cross(self.rate, momentum)) / inertia
        self.wheels = self.wheels + self.period * speeding

    def measure(self) -> aeroloop.Measurement:
        """What the sensors show now; NaN for one that has failed, never its last value."""
        return aeroloop.Measurement(tuple(self.q), tuple(self.rate + self.noise.normal(0, self.settings.gyro_noise, 3)))

    def close(self) -> None:
        """Set 0 V and release what must be released."""
        self.volts = np.zeros(4)
