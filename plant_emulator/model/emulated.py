"""Emulated plant: a mechanism with rotors, friction, wind and sensors.

The supply clips the commanded voltages, the rotors lag behind them, friction and wind load the mechanism's axes,
Runge–Kutta steps integrate one period, and the sensors sample the new state.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from math import cos, exp, hypot, isfinite, nan, pi, sin, sqrt
from typing import Final, Literal, TypeVar

import casadi as ca
import numpy as np
from pydantic import BaseModel, Field, model_validator

from aeroloop.plant_emulator.model.bodies import Mechanism
from aeroloop.plant_emulator.plant import Measurement, Plant, State, within_supply
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.expressions import as_written
from aeroloop.protocol.wire.symbolic import Compiled

Scalar = TypeVar("Scalar", float, "ca.SX")

_BLOCK: Final = 4096  # periods whose random numbers are drawn at once: one draw costs more than a plant's step

# ── rotors and friction ──


class RotorSettings(BaseModel, extra="forbid"):
    """Lag and dead zone of the rotors. Lags of 0 leave the rotors out."""

    lag_up_s: float = Field(default=0.154, ge=0, le=10, description="time constant while |thrust| rises [s]; measured")
    lag_down_s: float = Field(default=0.176, ge=0, le=10, description="time constant while it falls [s]; measured")
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


class FrictionSettings(BaseModel, extra="forbid"):
    """Friction about the axes: pitch and yaw of the Aero, x, y, z of a free body (missing ones are 0)."""

    viscous: tuple[float, ...] = Field(default=(0.0071, 0.0220), max_length=3, description="[N·m·s/rad]; lab material")
    coulomb: tuple[float, ...] = Field(
        default=(0.0009, 0.003040),
        max_length=3,
        description="Coulomb friction about the axes [N·m]; pitch measured (spin-down), yaw fitted to the paper",
    )
    width: float = Field(default=0.01, gt=0, le=1, description="rate within which Coulomb torque changes sign [rad/s]")


def friction_torque(settings: FrictionSettings, rates: ca.SX) -> ca.SX:
    """Torque about each axis [N·m] from the rates about them [rad/s]. Shape (axes,).

    The Coulomb torque changes sign smoothly: with a jump the result would depend on where the integration steps fall.
    """
    axes = rates.numel()
    viscous, coulomb = (ca.SX((*values, 0.0, 0.0, 0.0)[:axes]) for values in (settings.viscous, settings.coulomb))
    return -viscous * rates - coulomb * ca.tanh(rates / settings.width)


# ── wind ──


class WindSettings(BaseModel, extra="forbid"):
    """Wind on the plant: calm by default; the torques are the fitted ones of the paper's fan."""

    blowing: bool = Field(default=False, description="whether the fan is on")
    torque: tuple[float, ...] = Field(
        default=(-0.000220, 0.009858),
        max_length=3,
        description="steady torque about the axes [N·m], missing ones 0; fitted to the paper",
    )
    gust: float = Field(
        default=0.2,
        ge=0,
        le=10,
        description="standard deviation of gusts, all axes together, as a part of the steady torque [1]; assumed",
    )
    gust_time_s: float = Field(default=1.0, gt=0, le=1000, description="time constant of a gust [s]")
    seed: int = Field(default=0, ge=0, description="of the gusts' random numbers")


def wind_torques(settings: WindSettings, axes: int, period: float) -> Iterator[list[float]] | None:
    """Torque about each axis [N·m], shape (axes,), `period` by `period` [s]; None if it is always 0.

    A gust is an Ornstein–Uhlenbeck process (the same filter as Dryden's longitudinal gust) with time constant
    `gust_time_s` and a standard deviation of `gust` times the steady torque; seeded, so that a run repeats, and stepped
    exactly, so that its statistics do not depend on the period.
    """
    steady = [torque * settings.blowing for torque in (*settings.torque, 0.0, 0.0, 0.0)[:axes]]
    deviation = settings.gust * hypot(*steady) / sqrt(axes)
    keep = exp(-period / settings.gust_time_s)

    def blow() -> Iterator[list[float]]:
        random = np.random.default_rng(settings.seed)
        gust = (deviation * random.standard_normal(axes)).tolist()
        kick = deviation * sqrt(1 - keep**2)
        while True:
            for kicks in (random.standard_normal((_BLOCK, axes)) * kick).tolist():
                gust = [keep * old + new for old, new in zip(gust, kicks, strict=True)]
                yield [torque + part for torque, part in zip(steady, gust, strict=True)]

    return blow() if any(steady) else None


# ── sensors: a sample is one CasADi function ──

NO_MEASUREMENT = Measurement((nan, nan, nan, nan), (nan, nan, nan))
"""Measurement without a valid value, such as of a state that is not finite."""

DAMPING_RATIO: Final = 0.8  # ζ of the derivative's filter [1]; as in Quanser's own examples


class SensorSettings(BaseModel, extra="forbid"):
    """Sensors of attitude and angular velocity."""

    attitude: Literal["encoders", "perfect"] = Field(default="encoders", description="encoders need joints: the Aero")
    counts: tuple[int, int] = Field(default=(2048, 4096), description="a turn, pitch and yaw; Aero 2 has 2880 in pitch")
    rate: Literal["derivative", "gyro", "perfect"] = Field(
        default="derivative", description="derivative: of the encoders' angles, filtered"
    )
    bandwidth: float = Field(default=50.0, gt=0, description="ωn of the derivative's filter [rad/s]")
    gyro_noise: float = Field(default=0.0, ge=0, description="standard deviation of a gyro sample [rad/s]")
    gyro_bias: Vector = Field(default=(0.0, 0.0, 0.0), description="constant error of the gyro, body frame [rad/s]")
    seed: int = Field(default=0, ge=0, description="of the encoders' zeros and of the gyro's noise")

    @property
    def of_joints(self) -> bool:
        """Whether joints must carry encoders."""
        return self.attitude == "encoders" or self.rate == "derivative"


def filtered_derivative(bandwidth: float, period: float) -> Callable[[Scalar, Scalar, Scalar], tuple[Scalar, Scalar]]:
    """The rate of a sampled angle, by the filter ωn² s / (s² + 2ζωn s + ωn²), exact for an angle held over a period.

    `bandwidth` is ωn [rad/s], and `period` the time between samples [s]. Returns a function of the filtered angle [rad]
    and rate [rad/s] and a sample [rad], which gives angle and rate after it.
    """
    decay, ringing = DAMPING_RATIO * bandwidth, bandwidth * sqrt(1 - DAMPING_RATIO**2)
    envelope, c, s = exp(-decay * period), cos(ringing * period), sin(ringing * period) / ringing
    from_lag, from_rate = envelope * (c + decay * s), envelope * s
    rate_from_lag, rate_from_rate = -envelope * bandwidth**2 * s, envelope * (c - decay * s)

    def after(held: Scalar, rate: Scalar, angle: Scalar) -> tuple[Scalar, Scalar]:
        lag = held - angle
        return angle + from_lag * lag + from_rate * rate, rate_from_lag * lag + rate_from_rate * rate

    return after


class Sensors:
    """Sensors of one plant, sampled once a `period` [s].

    `zeros` are those of pitch and yaw encoders, within a step [1], random unless given; `errors` draws a gyro's next
    error, noise and bias [rad/s].
    """

    def __init__(self, settings: SensorSettings, period: float, zeros: list[float] | None = None) -> None:
        self._settings = settings
        self._random = np.random.default_rng(settings.seed)
        self.zeros: list[float] = zeros or self._random.random(len(settings.counts)).tolist()
        self.errors = self._draw()
        self._compiled = Compiled(sensor_function(settings, period))
        given = self._compiled.inputs
        self._held, self._error = given["held"], given["error"]
        given["zeros"][:] = array("d", self.zeros)
        self.restart()

    def restart(self) -> None:
        """Start the derivatives' filters anew, at rest at the next sample."""
        self._held[0] = self._held[2] = nan
        self._held[1] = self._held[3] = 0.0

    def read(self, attitude: Quaternion, rate: Vector, angles: Sequence[float]) -> Measurement:
        """Sample a true attitude q [1], rate ω [rad/s] and joint angles [rad]. Call it once a period."""
        if self._settings.of_joints and not isfinite(sum(angles)):
            return NO_MEASUREMENT
        given = self._compiled.inputs
        given["attitude"][:], given["rate"][:] = array("d", attitude), array("d", rate)
        if self._settings.of_joints:
            given["angles"][:] = array("d", angles)
        if self._settings.rate == "gyro":
            self._error[:] = array("d", next(self.errors))
        self._compiled.evaluate()
        self._held[:] = self._compiled.outputs["after"]
        w, x, y, z, a, b, c = self._compiled.outputs["seen"].tolist()
        return Measurement((w, x, y, z), (a, b, c))

    @property
    def held(self) -> list[float]:
        """Memory of the filters; see `sensor_function`."""
        return self._held.tolist()  # type: ignore[return-value]  # doubles

    def follow(self, others: Sensors) -> None:
        """Continue from the filters' memory of other sensors."""
        self._held[:] = others._held

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
            cp, sp, cy, sy = ca.cos(pitch / 2), ca.sin(pitch / 2), ca.cos(yaw / 2), ca.sin(yaw / 2)
            attitude = ca.vertcat(cy * cp, -sy * sp, cy * sp, sy * cp)  # yaws, then pitches
        if settings.rate == "derivative":
            derivative = filtered_derivative(settings.bandwidth, period)
            last = [
                ca.if_else(filtered == filtered, filtered, now) for filtered, now in ((held[0], pitch), (held[2], yaw))
            ]
            of_pitch = derivative(last[0], held[1], pitch)
            of_yaw = derivative(last[1], held[3], yaw)
            rate, after = ca.vertcat(*rate_of(pitch, of_pitch[1], of_yaw[1])), ca.vertcat(*of_pitch, *of_yaw)
        elif settings.rate == "gyro":
            rate = rate + error
        seen = ca.vertcat(attitude, rate)
        return ca.Function("sensors", [*given.values()], [seen, after], [*given], ["seen", "after"])


def rate_of(pitch: Scalar, pitch_rate: Scalar, yaw_rate: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """ω in the body frame [rad/s] of joints that turn at these rates [rad/s], at this pitch [rad]."""
    return -ca.sin(pitch) * yaw_rate, pitch_rate, ca.cos(pitch) * yaw_rate


# ── one period ──

SUBSTEPS: Final = 2  # Runge–Kutta steps a period: off by 4e-9 rad/s at most, where Coulomb friction changes sign


def rk4(derivative: Callable[[ca.SX], ca.SX], x: ca.SX, period: float, substeps: int) -> ca.SX:
    """The state one `period` [s] later, by the classical fourth-order Runge–Kutta method; `derivative` is ẋ."""
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
        voltages, zone = rotors if rotor.present else u, rotor.dead_zone_v
        if zone:
            voltages = ca.sign(voltages) * ca.fmax(ca.fabs(voltages) - zone, 0)
        *_, axis_rates, _ = mechanism.outputs(body)
        body_dot = mechanism.derivative(body, voltages, friction_torque(friction, axis_rates) + wind)
        return ca.vertcat(body_dot, rotor_derivative(rotor, rotors, u)) if rotor.present else body_dot

    stepped = rk4(derivative, x, period, substeps)
    after = ca.vertcat(mechanism.settle(stepped[0:n]), stepped[n:])
    attitude, rate, _, angles = mechanism.outputs(after[0:n])
    outputs = {"after": after, "attitude": attitude, "rate": rate, "angles": angles}
    names = ["x", "u", "wind"], list(outputs)
    return ca.Function("step", [x, u, wind], list(outputs.values()), *names, {"cse": True})


def initially(mechanism: Mechanism) -> tuple[Quaternion, Vector, list[float]]:
    """q [1], ω [rad/s] and joint angles [rad] of a mechanism's initial state."""
    attitude, rate, _, angles = (ca.evalf(part).elements() for part in mechanism.outputs(ca.SX(mechanism.initial)))
    return tuple(attitude), tuple(rate), angles  # type: ignore[return-value]  # four and three elements


class EmulatedPlant(Plant):
    """A computed plant with an accessible true state; `voltage_limit` is the supply's [V]."""

    def __init__(
        self,
        mechanism: Mechanism,
        rotor: RotorSettings,
        friction: FrictionSettings,
        wind: Iterator[list[float]] | None,
        sensors: Sensors,
        period: float,
        voltage_limit: float,
    ) -> None:
        self.actuators = mechanism.actuators
        self._wind, self._sensors, self._limit = wind, sensors, voltage_limit
        attitude, rate, angles = initially(mechanism)
        self._step = Compiled(step_function(mechanism, rotor, friction, period))
        self._x, self._u, self._load = (self._step.inputs[name] for name in ("x", "u", "wind"))
        self._x[: len(mechanism.initial)] = array("d", mechanism.initial)
        self._true = attitude, rate
        self._measurement = sensors.read(attitude, rate, angles)

    def take_over(self, other: EmulatedPlant, *, wind: bool, sensors: bool) -> None:
        """Continue from another plant's state; with `wind` and `sensors` also with its gusts and sensors.

        Raises ValueError if the other has another number of states.
        """
        if len(self._x) != len(other._x):
            raise ValueError("another body, or rotors where there were none: a plant cannot continue with that")
        self._x[:], self._u[:], self._true, self._measurement = other._x, other._u, other._true, other._measurement
        if wind:
            self._wind, self._load[:] = other._wind, other._load
        if sensors:
            self._sensors = other._sensors
        else:
            self._sensors.follow(other._sensors)

    def actuate(self, voltages: Sequence[float]) -> None:
        self._u[:] = array("d", within_supply(voltages, self._limit))

    def advance(self) -> None:
        if self._wind is not None:
            self._load[:] = array("d", next(self._wind))
        self._step.evaluate()
        after, attitude, rate, angles = self._step.outputs.values()
        self._x[:] = after
        (w, x, y, z), (a, b, c) = attitude, rate
        self._true = (w, x, y, z), (a, b, c)
        self._measurement = self._sensors.read(*self._true, angles)

    def measure(self) -> Measurement:
        return self._measurement

    def truth(self) -> State:
        return State(*self._true, tuple(self._u))

    def close(self) -> None:
        self.actuate((0.0,) * len(self._u))
