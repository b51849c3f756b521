"""Emulated plant: a mechanism with rotors, friction, wind and sensors.

The supply clips the commanded voltages, the rotors lag behind them, friction and wind load the mechanism's axes,
Runge–Kutta steps integrate one period, and the sensors sample the new state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from aeroloop.plant_emulator.model.friction import FrictionSettings, friction_torque
from aeroloop.plant_emulator.model.mechanism import Mechanism
from aeroloop.plant_emulator.model.rotor import RotorSettings, rotor_derivative, thrust_voltage
from aeroloop.plant_emulator.model.sensors import Sensors
from aeroloop.plant_emulator.model.wind import Wind
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.symbolic import Compiled


def rk4(derivative: Callable[[ca.SX], ca.SX], x: ca.SX, period: float, substeps: int) -> ca.SX:
    """The state one `period` [s] later, by the classical fourth-order Runge–Kutta method in equal substeps.

    One unrolled expression: the same steps in the same order every time. `derivative` is ẋ of a state, inputs held.
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
    """One period of the plant under held voltages and wind.

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
        self._evaluate, self._after = self._step.evaluate, self._step.outputs["after"]
        for i, value in enumerate(mechanism.initial):
            self._x[i] = value
        self._measurement = sensors.read(attitude, rate, angles)

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V], clipped to the supply's limits. Shape (actuators,)."""
        limit = self._limit
        for i, voltage in enumerate(voltages):
            self._u[i] = voltage if -limit <= voltage <= limit else max(-limit, min(limit, voltage))

    def advance(self) -> None:
        """Integrate one period and sample the sensors."""
        if not self._wind.calm:
            for i, torque in enumerate(self._wind.sample()):
                self._load[i] = torque
        self._evaluate()
        self._x[:] = self._after
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
