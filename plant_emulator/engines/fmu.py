"""FMU as a plant: a model that Simulink, OpenModelica, Dymola or another tool exported for co-simulation, FMI 2 or 3.

FMPy loads it. Once a period the voltages are set, the FMU advances by the period in equal communication steps, and the
outputs that the settings name are read. What they give is both the true state and what the sensors measure. Whatever is
wrong with a file, a variable or a start value is one line, and a failure of the FMU one line in its own words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import chdir, suppress
from difflib import get_close_matches
from math import cos, isclose, prod, radians, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, ClassVar, Final, Literal
from zipfile import ZipFile

from pydantic import BaseModel, Field, model_validator

from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.attitude import Quaternion, Vector

Name = Annotated[str, Field(min_length=1, max_length=500)]
Names3 = tuple[str, str, str]

_FATAL: Final = 4
"""FMI's status after which the FMU must not be called again."""


class FmuError(PluginError):
    """The FMU cannot be used, or failed; one line with its file and, where it logged any, its own words."""


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
    """A co-simulation FMU as a plant, stepped `period` by `period` [s].

    Raises:
        FmuError: FMPy is not installed, or the FMU cannot be used with these settings; from `advance`: it failed.
    """

    Settings: ClassVar[type[BaseModel]] = FmuSettings
    repeatable: ClassVar[bool] = True  # a simulation; of one that is not, a replay finds the first tick that differs

    def __init__(self, settings: FmuSettings, period: float) -> None:
        self._settings, self._name, self._step = settings, settings.file.name, period / settings.substeps
        self.actuators = len(settings.voltages)
        self._steps = 0
        self._description = description = _description(settings.file)
        self._fmi2 = description.fmiMajorVersion == 2
        self._variables: Mapping[str, Any] = {each.name: each for each in description.modelVariables}
        fixed = float(description.coSimulation.fixedInternalStepSize or 0)  # of FMI 3
        if fixed and not (round(self._step / fixed) and isclose(self._step / fixed, round(self._step / fixed))):
            raise FmuError(
                f"{self._name} has steps of {fixed:g} s, of which {self._step:g} s, the loop's period or its part by "
                "plant.own.substeps, is no multiple: set loop.rate_hz, or export the FMU with another step"
            )
        inputs = [self._element(name, ("input",), "V") for name in settings.voltages]
        self._outputs = {
            name: self._element(name, ("output", "local"), unit) for name, unit in settings.outputs.items()
        }
        self._logged = (-1, "")  # status and text of the gravest message; of those the last
        self._fmu: Any = None
        self._fatal = False
        self._folder = TemporaryDirectory(prefix="aeroloop-fmu-")
        try:
            self._load()
        except BaseException:
            self.close()
            raise
        self._given = {variable.name: self._read(variable) for variable, _ in inputs}
        self._voltages = [(self._given[variable.name], index) for variable, index in inputs]
        self.actuate((0.0,) * self.actuators)
        self._sample()

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V] from the next period on. Shape (actuators,)."""
        for (values, index), voltage in zip(self._voltages, voltages, strict=True):
            values[index] = voltage

    def advance(self) -> None:
        """Advance the FMU by one period."""
        try:
            for name, values in self._given.items():
                write = self._fmu.setReal if self._fmi2 else self._fmu.setFloat64
                write([self._variables[name].valueReference], values)
            for _ in range(self._settings.substeps):
                ended = self._fmu.doStep(self._steps * self._step, self._step)
                self._steps += 1
                if ended is not None and (ended[1] or ended[2]):  # FMI 3: it terminates, or returned early
                    raise FmuError(f"{self._name}: it ended by itself at {ended[3]:g} s{self._own_words()}")
            self._sample()
        except Exception as error:
            raise self._failure(f"it failed at {self._steps * self._step:g} s", error) from None

    def measure(self) -> Measurement:
        """The FMU's outputs at the end of the last period."""
        return self._measurement

    def truth(self) -> State:
        """The same, with the voltages."""
        return State(*self._measurement, tuple(values[index] for values, index in self._voltages))

    def close(self) -> None:
        """End and free the FMU, and remove its unpacked files. A second call does nothing."""
        if self._fmu is not None and not self._fatal:
            with suppress(Exception):  # one that failed may refuse to be ended, and is freed nonetheless
                self._fmu.terminate()
            self._fmu.freeInstance()
        self._fmu = None
        self._folder.cleanup()

    def _read(self, variable: Any) -> list[float]:
        """All elements of a variable."""
        reference = [variable.valueReference]
        values: list[float] = (
            self._fmu.getReal(reference) if self._fmi2 else self._fmu.getFloat64(reference, prod(variable.shape))
        )
        return values

    def _sample(self) -> None:
        settings = self._settings
        of = {name: self._read(variable)[index] for name, (variable, index) in self._outputs.items()} | {"": 0.0}
        angles = _in_radians([of[name] for name in settings.angles or ()], settings.angle_unit)
        a, b, c = _in_radians([of[name] for name in settings.rate or settings.angle_rates or ()], settings.rate_unit)
        if settings.quaternion:
            w, x, y, z = (of[name] for name in settings.quaternion)
            attitude: Quaternion = (w, x, y, z)
        else:
            attitude = quaternion_of(*angles)
        rate = body_rate((angles[0], angles[1]), (a, b, c)) if settings.angle_rates else (a, b, c)
        self._measurement = Measurement(attitude, rate)

    # ── checks and start ──

    def _element(self, name: str, causalities: Sequence[str], unit: str) -> tuple[Any, int]:
        """Variable and index that a name stands for; `q[2]` may be an element of an array, counted from 1.

        It must have one of these causalities, the first being the usual one, and not be declared in another unit, if
        that is one of an angle or its rate.
        """
        array = re.fullmatch(r"(.+)\[(\d+)\]", name)
        index = 0
        if name not in self._variables and array and array[1] in self._variables:
            name, index = array[1], int(array[2]) - 1
        real = "Real" if self._fmi2 else "Float64"
        fitting = [
            each for each, known in self._variables.items() if known.causality == causalities[0] and known.type == real
        ]
        variable = self._known(name, fitting)
        if variable.causality not in causalities or variable.type != real:
            raise FmuError(
                f"{self._name}: {name} is {_kind(variable)}, not an {causalities[0]} of type {real}; "
                f"of those it has {_listed(fitting)}"
            )
        size = prod(variable.shape)
        if not 0 <= index < size:
            raise FmuError(f"{self._name}: {name} has {size} elements, and none is {name}[{index + 1}]")
        declared = variable.unit or getattr(variable.declaredType, "unit", None)
        if declared != unit and {declared, unit} <= {"rad", "deg", "rad/s", "deg/s"}:
            raise FmuError(f"{self._name}: {name} is in {declared}, not in {unit}: set angle_unit or rate_unit")
        return variable, index

    def _load(self) -> None:
        """Unpack, load and initialize it with the start values and parameters."""
        import fmpy

        for name in self._settings.start:
            self._known(name, self._variables)
        try:
            fmpy.extract(self._settings.file, self._folder.name)
            with chdir("."):  # FMPy changes the folder to load the library, and does not return where that fails
                self._fmu = fmpy.instantiate_fmu(self._folder.name, self._description, "CoSimulation", logger=self._log)
            if self._fmi2:
                self._fmu.setupExperiment(startTime=0.0)
            left = self._apply(self._settings.start, fmpy.simulation.settable_in_instantiated)
            self._fmu.enterInitializationMode()
            for name in self._apply(left, fmpy.simulation.settable_in_initialization_mode):
                kind = _kind(self._variables[name])
                raise FmuError(f"{self._name}: plant.own.start.{name} cannot be set: it is {kind}")
            self._fmu.exitInitializationMode()
        except Exception as error:
            raise self._failure("it does not start", error) from None

    def _apply(self, start: Mapping[str, object], when: object) -> dict[str, object]:
        """Set the start values that may be set now; returns the others."""
        from fmpy.simulation import apply_start_values

        left: dict[str, object] = {}
        for name, value in start.items():
            try:
                left |= apply_start_values(self._fmu, self._description, {name: value}, when)
            except (TypeError, ValueError) as error:
                raise FmuError(f"{self._name}: plant.own.start.{name}: {error}") from None
        return left

    def _known(self, name: str, fitting: Iterable[str]) -> Any:
        if name not in self._variables:
            names = {each.lower(): each for each in fitting}
            alike = get_close_matches(name.lower(), names, 1)
            hint = f": did you mean {names[alike[0]]}?" if alike else f"; it has {_listed(fitting)}"
            raise FmuError(f"{self._name} has no variable {name}{hint}")
        return self._variables[name]

    # ── failures ──

    def _log(self, *message: Any) -> None:
        """Keep a message of the FMU. FMI 2 gives the FMU's name, too, before these three."""
        status, _, text = message[-3:]
        if status >= self._logged[0]:
            self._logged = (status, " ".join((text or b"").decode(errors="replace").split()))

    def _own_words(self) -> str:
        return f": {self._logged[1]}" if self._logged[1] else ""

    def _failure(self, what: str, error: Exception) -> FmuError:
        if isinstance(error, FmuError):
            return error
        self._fatal |= getattr(error, "status", None) == _FATAL
        text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        preferred = float(getattr(self._description.defaultExperiment, "stepSize", None) or self._step)
        hint = ""
        if not isclose(preferred, self._step):
            hint = f" (steps are of {self._step:g} s, and it prefers {preferred:g} s: see plant.own.substeps)"
        return FmuError(f"{self._name}: {what}: {text}{self._own_words()}{hint}")


def quaternion_of(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Attitude of these angles [rad]: yaw about z first, then pitch, then roll."""
    (cr, sr), (cp, sp), (cy, sy) = ((cos(angle / 2), sin(angle / 2)) for angle in (roll, pitch, yaw))
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def body_rate(angles: tuple[float, float], derivatives: Vector) -> Vector:
    """ω [rad/s] from roll φ and pitch θ [rad] and the derivatives of roll, pitch and yaw ψ [rad/s].

    ω = [φ̇ − ψ̇ sin θ, θ̇ cos φ + ψ̇ sin φ cos θ, −θ̇ sin φ + ψ̇ cos φ cos θ]
    """
    (roll, pitch), (d_roll, d_pitch, d_yaw) = angles, derivatives
    return (
        d_roll - sin(pitch) * d_yaw,
        cos(roll) * d_pitch + sin(roll) * cos(pitch) * d_yaw,
        -sin(roll) * d_pitch + cos(roll) * cos(pitch) * d_yaw,
    )


def _in_radians(values: list[float], unit: str) -> list[float]:
    return [radians(value) for value in values] if unit.startswith("deg") else values


def _description(file: Path) -> Any:
    """The FMU's model description, if it can be used here."""
    try:
        import fmpy
    except ModuleNotFoundError as missing:
        what = "FMPy" if missing.name == "fmpy" else f"FMPy with {missing.name}"
        raise FmuError(f"an FMU needs {what}, which is not installed: pip install 'aeroloop[fmi]'") from None
    if not file.is_file():
        raise FmuError(f"there is no file {file}: set plant.own.file")
    try:
        with file.open("rb") as opened:  # FMPy would not close it
            description = fmpy.read_model_description(opened, validate=False)
            files = ZipFile(opened).namelist()
        version = description.fmiMajorVersion
    except Exception as error:
        raise FmuError(f"{file} is not an FMU: {' '.join(str(error).split())}") from None
    if version not in (2, 3):
        raise FmuError(f"{file.name} is of FMI {description.fmiVersion}: export it for FMI 2 or 3")
    if description.coSimulation is None:
        raise FmuError(f"{file.name} is for model exchange only: export it for co-simulation")
    platform = fmpy.platform if version == 2 else fmpy.platform_tuple
    library = f"binaries/{platform}/{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    if library not in files:
        remedy = "export it on this platform, or `fmpy compile` it from its sources, if it has any"
        raise FmuError(f"{file.name} has no binary for {platform}: {remedy}")
    return description


def _kind(variable: Any) -> str:
    """Causality and type in words."""
    cause = variable.causality or "local"
    return f"{'an' if cause[0] in 'aeiou' else 'a'} {cause} of type {variable.type}"


def _listed(names: Iterable[str]) -> str:
    some = list(names)
    return ", ".join(some[:8]) + (f" and {len(some) - 8} more" if len(some) > 8 else "") or "none"
