"""FMU as a plant: a model that Simulink, OpenModelica, Dymola or another tool exported for co-simulation, FMI 2 or 3.

FMPy loads it. Once a period the voltages are set, the FMU advances by the period, and the outputs that the settings
name are read. What they give is both the true state and what the sensors measure. Whatever is wrong with a file or a
variable is one line, and a failure of the FMU one line in its own words.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import chdir, suppress
from math import cos, radians, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import shorten
from typing import Annotated, Any, ClassVar, Final

from pydantic import BaseModel, Field, model_validator

from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.attitude import Quaternion

Name = Annotated[str, Field(min_length=1, max_length=500)]

_FATAL: Final = 4  # FMI's status after which the FMU must not be called again


class FmuSettings(BaseModel, extra="forbid", frozen=True):
    """Which FMU, and its variables by name. Angles and rates that it declares in degrees are converted."""

    file: Path = Field(description="the FMU, of FMI 2 or 3, exported for co-simulation")
    voltages: list[Name] = Field(
        min_length=1, max_length=8, description="inputs that take the motors' voltages, in the wire's order [V]"
    )
    quaternion: tuple[Name, Name, Name, Name] | None = Field(
        default=None, description="outputs with q, body relative to inertial, scalar part first [1]; or set angles"
    )
    angles: tuple[str, str, str] | None = Field(
        default=None,
        description="outputs with roll, pitch and yaw [rad]: yaw about z, then pitch, then roll; '' is 0 always",
    )
    rate: tuple[Name, Name, Name] = Field(description="outputs with the angular velocity in the body frame [rad/s]")
    start: dict[str, bool | int | float | str | list[float]] = Field(
        default={}, description="start values and parameters, by the FMU's names, in the FMU's units"
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> FmuSettings:
        if (self.quaternion is None) == (self.angles is None):
            raise ValueError("set either quaternion or angles: the FMU's outputs with the attitude")
        if len(set(self.voltages)) < len(self.voltages):
            raise ValueError("voltages must name each input once")
        return self


class FmuPlant(Plant):
    """A co-simulation FMU as a plant. Raises PluginError: FMPy is missing, it cannot be used, or failed."""

    Settings: ClassVar[type[BaseModel]] = FmuSettings
    repeatable: ClassVar[bool] = True  # a simulation; of one that is not, a replay finds the first tick that differs

    def __init__(self, settings: FmuSettings, period: float) -> None:
        self._settings, self._name, self._period = settings, settings.file.name, period
        self._description = _description(settings.file)
        self._real = "Real" if self._description.fmiMajorVersion == 2 else "Float64"
        self._inputs = [self._reference(name, "input")[0] for name in settings.voltages]
        outputs = [*(settings.quaternion or settings.angles or ()), *settings.rate]
        self._outputs = {name: self._reference(name, "output", "local") for name in outputs if name}
        self.actuators = len(self._inputs)
        self._voltages = [0.0] * self.actuators
        self._periods = 0
        self._words = ""  # of its last message that is more than a remark
        self._fmu: Any = None
        self._fatal = False
        self._folder = TemporaryDirectory(prefix="aeroloop-fmu-")
        try:
            self._start()
            self._sample()
        except BaseException:
            self.close()
            raise

    def actuate(self, voltages: Sequence[float]) -> None:
        self._voltages = [float(voltage) for voltage in voltages]

    def advance(self) -> None:
        time = self._periods * self._period
        try:
            self._set(self._inputs, self._voltages)
            ended = self._fmu.doStep(time, self._period)
            if ended is not None and (ended[1] or ended[2]):  # FMI 3: it terminates, or returned early
                raise PluginError(f"{self._name}: it ended by itself at {ended[3]:g} s{self._words}")
            self._periods += 1
            self._sample()
        except Exception as error:
            raise self._failure(f"it failed at {time:g} s", error) from None

    def measure(self) -> Measurement:
        return self._measurement

    def truth(self) -> State:
        return State(*self._measurement, tuple(self._voltages))

    def close(self) -> None:
        if self._fmu is not None and not self._fatal:
            with suppress(Exception):  # one that failed may refuse to be ended, and is freed nonetheless
                self._fmu.terminate()
            self._fmu.freeInstance()
        self._fmu = None
        self._folder.cleanup()

    def _reference(self, name: str, *causalities: str) -> tuple[int, float]:
        """Value reference of a real scalar of one of these causalities, and its unit in rad, rad/s or its own."""
        fitting = {
            each.name: each
            for each in self._description.modelVariables
            if each.causality in causalities and each.type == self._real and not each.shape
        }
        if name not in fitting:
            listed = shorten(", ".join(fitting), 200, placeholder=" …")
            wanted = f"{causalities[0]} {name} of type {self._real}"
            raise PluginError(f"{self._name} has no {wanted}; it has {listed or 'none'}")
        variable = fitting[name]
        unit = variable.unit or getattr(variable.declaredType, "unit", None) or ""
        return variable.valueReference, radians(1) if unit.startswith("deg") else 1.0

    def _start(self) -> None:
        import fmpy
        from fmpy.simulation import apply_start_values, settable_in_initialization_mode, settable_in_instantiated

        try:
            fmpy.extract(self._settings.file, self._folder.name)
            with chdir("."):  # FMPy changes the folder to load the library, and does not return where that fails
                fmu = fmpy.instantiate_fmu(self._folder.name, self._description, "CoSimulation", logger=self._log)
            self._fmu = fmu
            self._set, self._get = getattr(fmu, f"set{self._real}"), getattr(fmu, f"get{self._real}")
            if self._real == "Real":
                fmu.setupExperiment(startTime=0.0)
            unset = apply_start_values(fmu, self._description, self._settings.start, settable_in_instantiated)
            fmu.enterInitializationMode()
            unset = apply_start_values(fmu, self._description, unset, settable_in_initialization_mode)
            if unset:
                names = ", ".join(unset)
                raise PluginError(f"{self._name} has no parameter or start value {names}: see plant.own.start")
            fmu.exitInitializationMode()
        except Exception as error:
            raise self._failure("it does not start", error) from None

    def _sample(self) -> None:
        values = self._get([reference for reference, _ in self._outputs.values()])
        of = {name: value * scale for (name, (_, scale)), value in zip(self._outputs.items(), values, strict=True)}
        of[""] = 0.0
        if self._settings.quaternion:
            w, x, y, z = (of[name] for name in self._settings.quaternion)
        else:
            w, x, y, z = quaternion_of(*(of[name] for name in self._settings.angles or ()))
        a, b, c = (of[name] for name in self._settings.rate)
        self._measurement = Measurement((w, x, y, z), (a, b, c))

    def _log(self, *message: Any) -> None:
        """Keep a message of the FMU. FMI 2 gives the FMU's name, too, before these three."""
        status, _, text = message[-3:]
        if status and text:
            self._words = ": " + " ".join(text.decode(errors="replace").split())

    def _failure(self, what: str, error: Exception) -> PluginError:
        if isinstance(error, PluginError):
            return error
        self._fatal |= getattr(error, "status", None) == _FATAL
        text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        return PluginError(f"{self._name}: {what}: {text}{self._words}")


def quaternion_of(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Attitude of these angles [rad]: yaw about z first, then pitch, then roll."""
    (cr, sr), (cp, sp), (cy, sy) = ((cos(angle / 2), sin(angle / 2)) for angle in (roll, pitch, yaw))
    w, x = cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr
    return w, x, cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr


def _description(file: Path) -> Any:
    try:
        import fmpy
    except ModuleNotFoundError as missing:
        what = "FMPy" if missing.name == "fmpy" else f"FMPy with {missing.name}"
        raise PluginError(f"an FMU needs {what}, which is not installed: pip install 'aeroloop[fmi]'") from None
    if not file.is_file():
        raise PluginError(f"there is no file {file}: set plant.own.file")
    try:
        with file.open("rb") as opened:  # FMPy would not close it
            description = fmpy.read_model_description(opened, validate=False)
        version = description.fmiMajorVersion
    except Exception as error:
        raise PluginError(f"{file} is not an FMU: {' '.join(str(error).split())}") from None
    if version not in (2, 3) or description.coSimulation is None:
        raise PluginError(f"{file.name} is of FMI {description.fmiVersion}: export it for co-simulation by FMI 2 or 3")
    return description
