"""Emulated plant: a mechanism with rotors, friction, wind and sensors.

The supply clips the commanded voltages, the rotors lag behind them, friction and wind load the mechanism's axes,
Runge–Kutta steps integrate one period, and the sensors sample the new state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import casadi as ca
from pydantic import BaseModel, Field, model_validator

from aeroloop.plant_emulator.model.bodies import Mechanism
from aeroloop.plant_emulator.model.sensors import Sensors
from aeroloop.plant_emulator.model.wind import Wind
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.symbolic import Compiled

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
        description="Coulomb friction about the axes [N·m]; pitch measured (spin-down), yaw fitted to the paper",
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

SUBSTEPS: Final = 2
"""Runge–Kutta steps a period. Two are off by 4e-9 rad/s at most in 2 ms, where Coulomb friction changes sign."""


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
    mechanism: Mechanism, rotor: RotorSettings, friction: FrictionSettings, period: float, substeps: int = SUBSTEPS
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
        *_, axis_rates, _ = mechanism.outputs(body)
        body_dot = mechanism.derivative(body, voltages, friction_torque(friction, axis_rates) + wind)
        return ca.vertcat(body_dot, rotor_derivative(rotor, rotors, u)) if rotor.present else body_dot

    stepped = rk4(derivative, x, period, substeps)
    after = ca.vertcat(mechanism.settle(stepped[0:n]), stepped[n:])
    attitude, rate, _, angles = mechanism.outputs(after[0:n])
    return ca.Function(
        "step",
        [x, u, wind],
        [after, attitude, rate, angles],
        ["x", "u", "wind"],
        ["after", "attitude", "rate", "angles"],
        {"cse": True},
    )


def initially(mechanism: Mechanism) -> tuple[Quaternion, Vector, list[float]]:
    """q [1], ω [rad/s] and joint angles [rad] of a mechanism's initial state."""
    attitude, rate, _, angles = (ca.evalf(part).elements() for part in mechanism.outputs(ca.SX(mechanism.initial)))
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
        substeps: int = SUBSTEPS,
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
