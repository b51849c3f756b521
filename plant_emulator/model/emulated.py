"""Emulated plant: a mechanism with rotors, friction, wind and sensors.

The supply clips the commanded voltages, the rotors lag behind them, friction and wind load the mechanism's axes,
Runge–Kutta steps integrate one period, and the sensors sample the new state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import hypot, inf
from typing import Annotated

import casadi as ca
from pydantic import AfterValidator, BaseModel, Field, model_validator

from aeroloop.plant_emulator.model.sensors import Sensors
from aeroloop.plant_emulator.model.wind import Wind
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.wire.attitude import Quaternion, R, S, Vector
from aeroloop.protocol.wire.symbolic import Compiled

# ── mechanism ──


class Mechanism(ABC):
    """Equations of motion of a body in CasADi, without rotors, friction, wind and sensors.

    It moves freely about its axes: two joints for the Aero, three body axes for a free body. A load, such as friction
    and wind, is a torque about each axis. States are in rad, rad/s and, for a quaternion, 1.

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


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _with_a_direction(attitude: Quaternion) -> Quaternion:
    if not 0 < hypot(*attitude) < inf:
        raise ValueError("a quaternion of any finite length but zero")
    return attitude


Direction = Annotated[Quaternion, AfterValidator(_with_a_direction)]
"""An attitude q to be scaled to unit length [1]."""


class BodySettings(BaseModel, extra="forbid"):
    """A body about a fixed point. Defaults: the inertia and mass of Table C.1."""

    inertia: tuple[Positive, Positive, Positive] = Field(
        default=(0.0218, 0.0217, 0.0218), description="J, diagonal [kg·m²]"
    )
    mass: float = Field(default=1.075, gt=0, description="m [kg]")
    gravity: float = Field(default=9.81, ge=0, description="g [m/s²]")
    centre_of_mass: Vector = Field(default=(0.0, 0.0, 0.0), description="r_g, origin to centre of mass, body frame [m]")


def torque_of_motion(body: BodySettings, damping: Vector, q: ca.SX, omega: ca.SX) -> ca.SX:
    """Ψ(q, ω) + Φ(ω) θ of (C.2): gyroscopic torque, weight and damping θ, in the body frame [N·m]. Shape (3,)."""
    J, weight = ca.diag(ca.SX(body.inertia)), ca.vertcat(0, 0, -body.mass * body.gravity)
    g = -S(ca.SX(body.centre_of_mass)) @ R(q).T @ weight  # (C.6)
    Psi = -S(omega) @ (J @ omega) - g  # (C.4)
    Phi = ca.diag(-omega)  # (C.5)
    return Psi + Phi @ ca.SX(damping)


# ── rotors and friction ──


class RotorSettings(BaseModel, extra="forbid"):
    """Lag and dead zone of the rotors. Lags of 0 leave the rotors out."""

    lag_up_s: float = Field(
        default=0.154, ge=0, le=10, description="time constant while |thrust| rises [s]; measured on an Aero"
    )
    lag_down_s: float = Field(
        default=0.176, ge=0, le=10, description="time constant while |thrust| falls [s]; measured on an Aero"
    )
    dead_zone_v: float = Field(
        default=0.0,
        ge=0,
        le=24,
        description="no thrust below this [V]; 2–3 V measured on an Aero, but off: with 2.5 V, height and friction "
        "fitted again are -2.94 mm and 1.94 mN·m (published: -3.8, 3.7), and the tables are predicted no better",
    )

    @model_validator(mode="after")
    def _both_lags_or_none(self) -> RotorSettings:
        if (self.lag_up_s > 0) != (self.lag_down_s > 0):
            raise ValueError("lag_up_s and lag_down_s are both positive, or both 0 to leave the rotors out")
        return self

    @property
    def present(self) -> bool:
        """Whether there is any lag."""
        return self.lag_up_s > 0


def rotor_derivative(settings: RotorSettings, state: ca.SX, command: ca.SX) -> ca.SX:
    """V̇ of the voltages that make thrust [V/s], from those and the commanded ones [V]. Shape as given.

    A first-order lag, a little faster up than down: drag brakes a rotor less than the motor drives it.
    """
    rising = (command - state) * state >= 0  # away from zero; a rotor that reverses falls first, then rises
    return (command - state) / ca.if_else(rising, settings.lag_up_s, settings.lag_down_s)


def thrust_voltage(settings: RotorSettings, state: ca.SX) -> ca.SX:
    """Voltage beyond the dead zone [V]. Shape as given."""
    if not settings.dead_zone_v:
        return state
    return ca.sign(state) * ca.fmax(ca.fabs(state) - settings.dead_zone_v, 0)


class FrictionSettings(BaseModel, extra="forbid"):
    """Friction about the axes: pitch and yaw of the Aero, x, y, z of a free body (missing ones are 0)."""

    viscous: tuple[float, ...] = Field(
        default=(0.0071, 0.0220), max_length=3, description="viscous friction about the axes [N·m·s/rad]; lab material"
    )
    coulomb: tuple[float, ...] = Field(
        default=(0.0009, 0.003040),
        max_length=3,
        description="Coulomb friction about the axes [N·m]; pitch measured (spin-down), yaw fitted by `lab calibrate`",
    )
    width: float = Field(default=0.01, gt=0, le=1, description="rate within which Coulomb torque changes sign [rad/s]")


def friction_torque(settings: FrictionSettings, rates: ca.SX) -> ca.SX:
    """Torque about each axis [N·m] from the rates about them [rad/s]. Shape (axes,).

    The Coulomb torque changes sign smoothly, within a rate that the plant's sensors cannot resolve. Why: with a jump
    the result would depend on where the integration steps fall.
    """
    axes = rates.numel()
    viscous, coulomb = (ca.SX((*values, 0.0, 0.0, 0.0)[:axes]) for values in (settings.viscous, settings.coulomb))
    return -viscous * rates - coulomb * ca.tanh(rates / settings.width)


# ── one period ──


def rk4(derivative: Callable[[ca.SX], ca.SX], x: ca.SX, period: float, substeps: int) -> ca.SX:
    """The state one `period` [s] later, by the classical fourth-order Runge–Kutta method in equal substeps.

    `derivative` is ẋ of a state, inputs held.
    """
    h = period / substeps
    for _ in range(substeps):
        k1 = derivative(x)
        k2 = derivative(x + h / 2 * k1)
        k3 = derivative(x + h / 2 * k2)
        k4 = derivative(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def step_function(
    mechanism: Mechanism, rotor: RotorSettings, friction: FrictionSettings, period: float, substeps: int
) -> ca.Function:
    """One period of the plant under held voltages and wind, as one unrolled expression.

    Inputs: x (the mechanism's state, then the rotors' voltages if they lag), u [V], wind [N·m]. Outputs: the state
    after, and its q, ω and joint angles.
    """
    n, m = len(mechanism.initial), mechanism.actuators
    x = ca.SX.sym("x", n + (m if rotor.present else 0))
    u, wind = ca.SX.sym("u", m), ca.SX.sym("wind", mechanism.axes)

    def derivative(state: ca.SX) -> ca.SX:
        body, rotors = state[0:n], state[n:]
        voltages = thrust_voltage(rotor, rotors if rotor.present else u)
        load = friction_torque(friction, mechanism.axis_rates(body)) + wind
        body_dot = mechanism.derivative(body, voltages, load)
        return ca.vertcat(body_dot, rotor_derivative(rotor, rotors, u)) if rotor.present else body_dot

    stepped = rk4(derivative, x, period, substeps)
    after = ca.vertcat(mechanism.settle(stepped[0:n]), stepped[n:])
    body = after[0:n]
    return ca.Function(
        "step",
        [x, u, wind],
        [after, mechanism.attitude(body), mechanism.rate(body), mechanism.axis_angles(body)],
        ["x", "u", "wind"],
        ["after", "attitude", "rate", "angles"],
        {"cse": True},
    )


def initially(mechanism: Mechanism) -> tuple[Quaternion, Vector, list[float]]:
    """q [1], ω [rad/s] and joint angles [rad] of a mechanism's initial state."""
    start = ca.SX(mechanism.initial)
    parts = mechanism.attitude(start), mechanism.rate(start), mechanism.axis_angles(start)
    attitude, rate, angles = (ca.evalf(part).elements() for part in parts)
    return tuple(attitude), tuple(rate), angles  # type: ignore[return-value]  # four and three elements


class EmulatedPlant(Plant):
    """A computed plant with an accessible true state.

    `period` is the time of one `advance` [s], in `substeps` Runge–Kutta steps; `voltage_limit` is the supply's [V].
    """

    def __init__(
        self,
        mechanism: Mechanism,
        rotor: RotorSettings,
        friction: FrictionSettings,
        wind: Wind,
        sensors: Sensors,
        *,
        period: float,
        voltage_limit: float,
        substeps: int,
    ) -> None:
        self.actuators = mechanism.actuators
        self._wind, self._sensors, self._limit = wind, sensors, voltage_limit
        attitude, rate, angles = initially(mechanism)
        true = sensors.given if angles else {name: sensors.given[name] for name in ("attitude", "rate")}
        self._step = Compiled(step_function(mechanism, rotor, friction, period, substeps), true)
        self._x, self._u, self._load = (self._step.inputs[name] for name in ("x", "u", "wind"))
        for i, value in enumerate(mechanism.initial):
            self._x[i] = value
        self._measurement = sensors.read(attitude, rate, angles)

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V], clipped to the supply's limits. Shape (actuators,)."""
        limit = self._limit
        for i, voltage in enumerate(voltages):
            self._u[i] = max(-limit, min(limit, voltage))

    def advance(self) -> None:
        """Integrate one period and sample the sensors."""
        if not self._wind.calm:
            for i, torque in enumerate(self._wind.sample()):
                self._load[i] = torque
        self._step.evaluate()
        self._x[:] = self._step.outputs["after"]
        self._measurement = self._sensors.sample()

    def measure(self) -> Measurement:
        """Sensor values at the end of the last period."""
        return self._measurement

    def truth(self) -> State:
        """The present true state."""
        w, x, y, z = self._sensors.given["attitude"]
        a, b, c = self._sensors.given["rate"]
        return State((w, x, y, z), (a, b, c), tuple(self._u))

    def close(self) -> None:
        """0 V."""
        self.actuate((0.0,) * len(self._u))
