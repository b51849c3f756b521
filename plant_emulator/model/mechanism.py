"""Mechanism interface: the equations of motion of an emulated body, without rotors, friction, wind and sensors.

A mechanism moves freely about its axes: two joints for the Aero, three body axes for a free body. A load is a torque
about each axis. Friction and wind are loads, so they depend on the axes only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated

import casadi as ca
from pydantic import AfterValidator

from aeroloop.protocol.wire.attitude import Vector


def _positive(values: Vector) -> Vector:
    if not all(0 < value < float("inf") for value in values):
        raise ValueError("every moment of inertia must be positive and finite")
    return values


Inertia = Annotated[Vector, AfterValidator(_positive)]
"""The diagonal of J [kg·m²]."""


class Mechanism(ABC):
    """Equations of motion in CasADi. States are in rad, rad/s and, for a quaternion, 1.

    Attributes:
        initial: Initial state; its length is the number of states.
        actuators: Number of motors.
        axes: Number of axes that a load acts about.
    """

    initial: tuple[float, ...]
    actuators: int
    axes: int

    @abstractmethod
    def derivative(self, x: ca.SX, voltages: ca.SX, load: ca.SX) -> ca.SX:
        """ẋ under voltages that make thrust [V], shape (actuators,), and a load on each axis [N·m], shape (axes,)."""

    @abstractmethod
    def attitude(self, x: ca.SX) -> ca.SX:
        """q, body relative to inertial. Shape (4,)."""

    @abstractmethod
    def rate(self, x: ca.SX) -> ca.SX:
        """ω in the body frame [rad/s]. Shape (3,)."""

    @abstractmethod
    def axis_rates(self, x: ca.SX) -> ca.SX:
        """Rates about the axes [rad/s], shape (axes,): what friction opposes."""

    @abstractmethod
    def axis_angles(self, x: ca.SX) -> ca.SX:
        """Angles of the joints [rad], for encoders. Shape (axes,), or (0,) where there are no joints."""

    def settle(self, x: ca.SX) -> ca.SX:
        """Correct the drift of a state after an integration step."""
        return x
