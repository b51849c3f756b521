"""FMU as a plant: a model that Simulink, OpenModelica, Dymola or another tool exported for co-simulation, FMI 2 or 3.

FMPy loads it. Once a period the voltages are set, the FMU advances by the period in equal communication steps, and the
outputs that the settings name are read. What they give is both the true state and what the sensors measure.

From roll φ, pitch θ and yaw ψ, yaw about z first, then pitch, then roll, the body rates are

    ω = [φ̇ − ψ̇ sin θ, θ̇ cos φ + ψ̇ sin φ cos θ, −θ̇ sin φ + ψ̇ cos φ cos θ]
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal
from weakref import finalize

from pydantic import BaseModel, Field, model_validator

from aeroloop.plant_emulator.engines.fmu_instance import Instance
from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.lazy import casadi as ca
from aeroloop.protocol.wire.attitude import from_euler
from aeroloop.protocol.wire.symbolic import Compiled

Name = Annotated[str, Field(min_length=1, max_length=500)]
Names3 = tuple[str, str, str]

_DEGREE: Final = 0.017453292519943295
"""One degree [rad]."""


class FmuSettings(BaseModel, extra="forbid", frozen=True):
    """Which FMU, and its variables by name; `q[2]` is an element of an array too, counted from 1."""

    file: Path = Field(description="the FMU, of FMI 2 or 3, exported for co-simulation")
    voltages: list[Name] = Field(
        min_length=1, max_length=8, description="inputs that take the motors' voltages, in the wire's order [V]"
    )
    quaternion: tuple[Name, Name, Name, Name] | None = Field(
        default=None, description="outputs with q, body relative to inertial, scalar part first [1]; or set angles"
    )
    angles: Names3 | None = Field(
        default=None,
        description="outputs with roll, pitch and yaw [angle_unit]: yaw about z, then pitch, then roll; '' is 0 always",
    )
    rate: tuple[Name, Name, Name] | None = Field(
        default=None, description="outputs with the angular velocity in the body frame [rate_unit]; or set angle_rates"
    )
    angle_rates: Names3 | None = Field(
        default=None, description="outputs with the derivatives of roll, pitch and yaw [rate_unit]; '' is 0 always"
    )
    angle_unit: Literal["rad", "deg"] = Field(default="rad", description="unit of angles")
    rate_unit: Literal["rad/s", "deg/s"] = Field(default="rad/s", description="unit of rate and angle_rates")
    substeps: int = Field(default=1, ge=1, le=100, description="communication steps of the FMU a period")
    start: dict[str, bool | int | float | str | list[float]] = Field(
        default={}, description="start values and parameters, by the FMU's names, in the FMU's units"
    )
    log: bool = Field(
        default=False, description="let the FMU log all that it can: its last message is shown where it fails; slower"
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> FmuSettings:
        if (self.quaternion is None) == (self.angles is None):
            raise ValueError("set either quaternion or angles: the FMU's outputs with the attitude")
        if (self.rate is None) == (self.angle_rates is None):
            raise ValueError("set either rate or angle_rates: the FMU's outputs with the angular velocity")
        if self.angle_rates is not None and self.angles is None:
            raise ValueError("angle_rates needs angles: with a quaternion, set rate")
        if len(set(self.voltages)) < len(self.voltages):
            raise ValueError("voltages must name each input once")
        return self

    @property
    def outputs(self) -> dict[str, str]:
        """Names of the variables that are read, each with the unit that it must have."""
        attitude = dict.fromkeys(self.quaternion or self.angles or (), self.angle_unit if self.angles else "1")
        return {name: unit for name, unit in attitude.items() if name} | {
            name: self.rate_unit for name in self.rate or self.angle_rates or () if name
        }


class FmuPlant(Plant):
    """A co-simulation FMU as a plant.

    Args:
        settings: Which FMU, and its variables.
        period: The loop's period [s].

    Raises:
        FmuError: FMPy is not installed, or the FMU cannot be used with these settings; from `advance`: it failed.
    """

    Settings: ClassVar[type[BaseModel]] = FmuSettings
    repeatable: ClassVar[bool] = True  # a simulation; of one that is not, a replay finds the first tick that differs

    def __init__(self, settings: FmuSettings, period: float) -> None:
        self.actuators = len(settings.voltages)
        self._fmu = fmu = Instance(settings.file, period / settings.substeps, settings.log)
        self._substeps = settings.substeps
        inputs = [fmu.element(name, ("input",), "V") for name in settings.voltages]
        outputs = [fmu.element(name, ("output", "local"), unit) for name, unit in settings.outputs.items()]
        self._release = finalize(self, fmu.close)
        try:
            fmu.load(settings.start)
            self._inputs, self._outputs = fmu.signals(inputs), fmu.signals(outputs)
        except Exception:
            self.close()
            raise
        self._read = Compiled(_reading(settings))
        self.actuate((0.0,) * self.actuators)
        self._sample()

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V] from the next period on. Shape (actuators,)."""
        values = self._inputs.values
        for at, voltage in zip(self._inputs.at, voltages, strict=True):
            values[at] = voltage

    def advance(self) -> None:
        """Advance the FMU by one period."""
        self._fmu.step(self._inputs, self._outputs, self._substeps)
        self._sample()

    def measure(self) -> Measurement:
        """The FMU's outputs at the end of the last period."""
        return self._measurement

    def truth(self) -> State:
        """The same, with the voltages."""
        return State(*self._measurement, tuple(self._inputs.values[at] for at in self._inputs.at))

    def close(self) -> None:
        """End and free the FMU."""
        self._release()

    def _sample(self) -> None:
        values, into = self._outputs.values, self._read.inputs["values"]
        for i, at in enumerate(self._outputs.at):
            into[i] = values[at]
        self._read()
        w, x, y, z = self._read.outputs["attitude"]
        a, b, c = self._read.outputs["rate"]
        self._measurement = Measurement((w, x, y, z), (a, b, c))


def _reading(settings: FmuSettings) -> ca.Function:
    """q [1] and ω [rad/s] of the values of `settings.outputs`."""
    values = ca.SX.sym("values", len(settings.outputs))
    of = dict(zip(settings.outputs, ca.vertsplit(values), strict=True)) | {"": ca.SX(0)}
    degrees = {"rad": 1.0, "rad/s": 1.0}

    def column(names: Sequence[str], unit: str) -> ca.SX:
        return degrees.get(unit, _DEGREE) * ca.vertcat(*(of[name] for name in names))

    angles = column(settings.angles or (), settings.angle_unit)
    q = column(settings.quaternion, "rad") if settings.quaternion else from_euler(angles)
    rate = column(settings.rate or settings.angle_rates or (), settings.rate_unit)
    if settings.angle_rates:
        (sr, sp, _), (cr, cp, _) = ca.vertsplit(ca.sin(angles)), ca.vertsplit(ca.cos(angles))
        roll, pitch, yaw = ca.vertsplit(rate)
        rate = ca.vertcat(roll - sp * yaw, cr * pitch + sr * cp * yaw, -sr * pitch + cr * cp * yaw)
    return ca.Function("reading", [values], [q, rate], ["values"], ["attitude", "rate"])
