"""FMU as a plant: a model that Simulink, OpenModelica, Dymola or another tool exported for co-simulation, FMI 2 or 3.

FMPy loads it. Once a period the voltages are set, the FMU advances by one communication step, the loop's period, and
the outputs that the settings name are read. What they give is both the true state and what the sensors measure.

From roll φ, pitch θ and yaw ψ, yaw about z first, then pitch, then roll, the body rates are

    ω = [φ̇ − ψ̇ sin θ, θ̇ cos φ + ψ̇ sin φ cos θ, −θ̇ sin φ + ψ̇ cos φ cos θ]
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import chdir, suppress
from ctypes import c_double, c_uint32
from math import isclose, prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, ClassVar, Final, Literal
from zipfile import ZipFile

from pydantic import BaseModel, Field, model_validator

from aeroloop.plant_emulator.plant import Measurement, Plant, State
from aeroloop.protocol.lazy import casadi as ca
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.attitude import from_euler
from aeroloop.protocol.wire.symbolic import Compiled
from aeroloop.protocol.wording import closest, either

Name = Annotated[str, Field(min_length=1, max_length=500)]
Names3 = tuple[str, str, str]

_DEGREE: Final = 0.017453292519943295
_FMI2: Final = 2
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
        period: The loop's period, and the FMU's communication step [s].

    Raises:
        FmuError: FMPy is not installed, or the FMU cannot be used with these settings.
    """

    Settings: ClassVar[type[BaseModel]] = FmuSettings
    repeatable: ClassVar[bool] = True  # a simulation; where one is not, a replay finds the first tick that differs

    def __init__(self, settings: FmuSettings, period: float) -> None:
        try:
            import fmpy
        except ModuleNotFoundError as missing:
            what = "FMPy" if missing.name == "fmpy" else f"FMPy with {missing.name}"
            raise FmuError(f"an FMU needs {what}, which is not installed: pip install 'aeroloop[fmi]'") from None
        self.actuators = len(settings.voltages)
        self._name, self._period, self._steps = settings.file.name, period, 0
        self._said: tuple[int, str] = (-1, "")
        self._fmu: Any = None
        self._fatal = False
        self._description = _description(settings.file)
        variables = {variable.name: variable for variable in self._description.modelVariables}
        inputs = [self._variable(variables, name, ("input",), "V") for name in settings.voltages]
        outputs = [
            self._variable(variables, name, ("output", "local"), unit) for name, unit in settings.outputs.items()
        ]
        if step := self._step_that_does_not_divide(fixed=True):
            raise FmuError(
                f"{self._name} has steps of {step:g} s, and the loop's period, {period:g} s, is no multiple of them: "
                "set loop.rate_hz, or export the FMU with another step"
            )
        self._folder = TemporaryDirectory(prefix="aeroloop-fmu-")
        try:
            with chdir("."):  # FMPy changes the folder to load the library, and does not return where that fails
                fmpy.extract(settings.file, self._folder.name)
                self._fmu = fmpy.instantiate_fmu(
                    self._folder.name,
                    self._description,
                    "CoSimulation",
                    debug_logging=settings.log,
                    logger=self._log,
                )
            self._initialize(settings, variables)
            self._inputs = _Signals(self._fmu, inputs)
            self._outputs = _Signals(self._fmu, outputs)
            self._inputs.read()  # those elements of arrays that are no voltages stay as they are
            self._outputs.read()
        except Exception as error:
            failure = self._failure("it does not start", error)
            self.close()
            raise failure from None
        self._read = Compiled(_reading(settings))
        self._sample()

    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V] from the next period on. Shape (actuators,)."""
        values = self._inputs.values
        for at, voltage in zip(self._inputs.at, voltages, strict=True):
            values[at] = voltage

    def advance(self) -> None:
        """Advance the FMU by one period. Raises FmuError if it fails or ends."""
        time = self._steps * self._period
        try:
            self._inputs.write()
            ended = self._fmu.doStep(time, self._period)
            self._outputs.read()
        except Exception as error:
            raise self._failure(f"it failed at {time:g} s", error) from None
        if ended is not None and (ended[1] or ended[2]):  # FMI 3: it terminates, or returned early
            raise FmuError(f"{self._name} ended by itself at {ended[3]:g} s{self._own_words()}")
        self._steps += 1
        self._sample()

    def measure(self) -> Measurement:
        """The FMU's outputs at the end of the last period."""
        return self._measurement

    def truth(self) -> State:
        """The same, with the voltages."""
        return State(*self._measurement, tuple(self._inputs.values[at] for at in self._inputs.at))

    def close(self) -> None:
        """End and free the FMU, and remove its unpacked files."""
        fmu, self._fmu = self._fmu, None
        if fmu is not None and not self._fatal:
            with suppress(Exception):  # one that failed may refuse to be ended, and is freed nonetheless
                fmu.terminate()
            fmu.freeInstance()
        self._folder.cleanup()

    def _initialize(self, settings: FmuSettings, variables: Mapping[str, Any]) -> None:
        from fmpy import simulation

        def apply(when: Callable[[Any], bool]) -> None:
            for name in list(left):
                try:
                    applied = simulation.apply_start_values(self._fmu, self._description, {name: left[name]}, when)
                except (TypeError, ValueError) as error:
                    raise FmuError(f"{self._name}: plant.own.start.{name}: {error}") from None
                if not applied:
                    del left[name]

        left = dict(settings.start)
        for name in left:
            self._known(variables, name, variables)
        if self._description.fmiMajorVersion == 2:  # FMI's major version
            self._fmu.setupExperiment(startTime=0.0)
        apply(simulation.settable_in_instantiated)
        self._fmu.enterInitializationMode()
        apply(simulation.settable_in_initialization_mode)
        for name in left:
            raise FmuError(f"{self._name}: plant.own.start.{name} cannot be set: it is {_kind(variables[name])}")
        self._fmu.exitInitializationMode()

    def _variable(self, variables: Mapping[str, Any], name: str, causes: Sequence[str], unit: str) -> tuple[Any, int]:
        """The variable that a name stands for, and the index of its element."""
        element = re.fullmatch(r"(.+)\[(\d+)\]", name)
        index = 0
        if name not in variables and element and element[1] in variables:
            name, index = element[1], int(element[2]) - 1
        real = "Real" if self._description.fmiMajorVersion == _FMI2 else "Float64"
        fitting = [
            each for each, known in variables.items() if known.causality == causes[0] and known.type == real
        ]
        self._known(variables, name, fitting)
        variable = variables[name]
        if variable.causality not in causes or variable.type != real:
            raise FmuError(
                f"{self._name}: {name} is {_kind(variable)}, not an {causes[0]} of type {real}; "
                f"of those it has {_listed(fitting)}"
            )
        if not 0 <= index < prod(variable.shape):
            raise FmuError(f"{self._name}: {name} has {prod(variable.shape)} elements, and {index + 1} is none of them")
        declared = variable.unit or getattr(variable.declaredType, "unit", None)
        if declared != unit and {declared, unit} <= {"rad", "deg", "rad/s", "deg/s"}:
            raise FmuError(f"{self._name}: {name} is in {declared}, not in {unit}: set angle_unit or rate_unit")
        return variable, index

    def _known(self, variables: Mapping[str, Any], name: str, fitting: Iterable[str]) -> None:
        if name not in variables:
            alike = closest(name, fitting) or closest(name, variables)
            hint = f": did you mean {alike}?" if alike else f"; it has {_listed(fitting)}"
            raise FmuError(f"{self._name} has no variable {name}{hint}")

    def _step_that_does_not_divide(self, fixed: bool) -> float | None:
        """The FMU's own step [s] if the period is no multiple of it: a fixed one of FMI 3, or the preferred one."""
        preferred = getattr(self._description.defaultExperiment, "stepSize", None)
        step = float(self._description.coSimulation.fixedInternalStepSize or (0 if fixed else preferred) or 0)
        whole = step > 0 and round(self._period / step) >= 1
        return None if not step or (whole and isclose(self._period / step, round(self._period / step))) else step

    def _log(self, *said: Any) -> None:
        """Keep the gravest of the FMU's messages, and of those the last. FMI 3 gives no instance's name."""
        status, _, message = said[-3:]
        if status >= self._said[0]:
            self._said = (status, " ".join((message or b"").decode(errors="replace").split()))

    def _own_words(self) -> str:
        return f": {self._said[1]}" if self._said[1] else "; it logged nothing: plant.own.log = true may say more"

    def _failure(self, what: str, error: Exception) -> FmuError:
        if isinstance(error, FmuError):
            return error
        self._fatal |= getattr(error, "status", None) == _FATAL
        step = self._step_that_does_not_divide(fixed=False)
        hint = f" (it prefers steps of {step:g} s, and the loop's period is {self._period:g} s)" if step else ""
        return FmuError(f"{self._name}: {what}: {_text(error)}{self._own_words()}{hint}")

    def _sample(self) -> None:
        values, into = self._outputs.values, self._read.inputs["values"]
        for i, at in enumerate(self._outputs.at):
            into[i] = values[at]
        self._read()
        w, x, y, z = self._read.outputs["attitude"]
        a, b, c = self._read.outputs["rate"]
        self._measurement = Measurement((w, x, y, z), (a, b, c))


class _Signals:
    """Some of an FMU's variables, set or read by one call.

    Attributes:
        values: All elements of all variables.
        at: Where in `values` the element of each name is.
    """

    def __init__(self, fmu: Any, elements: Sequence[tuple[Any, int]]) -> None:
        sizes = {variable.valueReference: prod(variable.shape) for variable, _ in elements}
        first = {reference: sum(list(sizes.values())[:i]) for i, reference in enumerate(sizes)}
        self.at = [first[variable.valueReference] + index for variable, index in elements]
        total = sum(sizes.values())
        self.values = (c_double * total)()
        references = (c_uint32 * len(sizes))(*sizes)
        three = hasattr(fmu, "fmi3GetFloat64")
        self._get = fmu.fmi3GetFloat64 if three else fmu.fmi2GetReal
        self._set = fmu.fmi3SetFloat64 if three else fmu.fmi2SetReal
        self._arguments = (fmu.component, references, len(sizes), self.values, *([total] if three else []))

    def read(self) -> None:
        self._get(*self._arguments)

    def write(self) -> None:
        self._set(*self._arguments)


def _description(file: Path) -> Any:
    """The FMU's model description, if it can be used here."""
    import fmpy

    if not file.is_file():
        raise FmuError(f"there is no file {file}: set plant.own.file")
    try:
        description = fmpy.read_model_description(file, validate=False)
        with ZipFile(file) as archive:
            files = archive.namelist()
        version = description.fmiMajorVersion
    except Exception as error:
        raise FmuError(f"{file} is not an FMU: {_text(error)}") from None
    if version not in (_FMI2, 3):
        raise FmuError(f"{file.name} is of FMI {description.fmiVersion}: export it for FMI 2 or 3")
    if description.coSimulation is None:
        raise FmuError(f"{file.name} is for model exchange only: export it for co-simulation")
    platform = fmpy.platform if version == 2 else fmpy.platform_tuple  # FMI's major version
    library = f"binaries/{platform}/{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    if library not in files:
        others = sorted({name.split("/")[1] for name in files if re.match("binaries/[^/]+/.", name)})
        sources = any(re.match(r"sources/.+\.c$", name) for name in files)
        remedy = f"`fmpy compile {file}` builds one from its sources" if sources else "export it on this platform"
        raise FmuError(f"{file.name} has no binary for {platform}, only for {either(others or ['none'])}: {remedy}")
    return description


def _text(error: Exception) -> str:
    """An exception's text in one line."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _kind(variable: Any) -> str:
    """Causality and type in words: `a local Real`."""
    cause = variable.causality or "local"
    return f"{'an' if cause[0] in 'aeiou' else 'a'} {cause} of type {variable.type}"


def _listed(names: Iterable[str]) -> str:
    (*first,) = names
    return ", ".join(first[:8]) + (f" and {len(first) - 8} others" if len(first) > 8 else "") or "none"


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
