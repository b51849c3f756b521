"""An FMU in this process: found, checked, loaded through FMPy, initialized, stepped and freed.

FMI 2 and 3 for co-simulation. What can be wrong is one line each: the file, what it was exported for, its binary, a
variable's name, causality, type or unit, a start value, its own fixed step, and what it fails with, in its own words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import chdir, suppress
from ctypes import c_double, c_uint32
from math import isclose, prod
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any, Final, NamedTuple
from zipfile import ZipFile

from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wording import closest, either

_FMI2: Final = 2
_FATAL: Final = 4
"""FMI's status after which the FMU must not be called again."""


class FmuError(PluginError):
    """The FMU cannot be used, or failed; one line with its file and, where it logged any, its own words."""


class Element(NamedTuple):
    """A number that the FMU holds: a scalar variable, or an element of an array."""

    variable: Any
    offset: int


class Instance:
    """A co-simulation FMU. Call `load` first, then `signals` and `step`.

    Args:
        file: The FMU.
        length: Communication step [s].
        log: Whether it logs all that it can.

    Raises:
        FmuError: FMPy is not installed, or the file is no FMU that runs here. From any method: it fails.
    """

    def __init__(self, file: Path, length: float, log: bool) -> None:
        self._file, self._name, self._length, self._log = file, file.name, length, log
        self._description = _description(file)
        self._variables: Mapping[str, Any] = {each.name: each for each in self._description.modelVariables}
        self._fmu: Any = None
        self._folder: str | None = None
        self._steps = 0
        self._fatal = False
        self._said: tuple[int, str] = (-1, "")
        fixed = float(self._description.coSimulation.fixedInternalStepSize or 0)  # of FMI 3
        if fixed and not (round(length / fixed) and isclose(length / fixed, round(length / fixed))):
            raise FmuError(
                f"{self._name} has steps of {fixed:g} s, of which {length:g} s, the loop's period or its part by "
                "plant.own.substeps, is no multiple: set loop.rate_hz, or export the FMU with another step"
            )

    def element(self, name: str, causalities: Sequence[str], unit: str) -> Element:
        """What a name stands for; `q[2]` may be an element of an array, counted from 1.

        Args:
            name: Of a variable or an element.
            causalities: It must have one of them; the first is the usual one.
            unit: It must not be declared in another unit, if that is one of an angle or its rate.
        """
        array = re.fullmatch(r"(.+)\[(\d+)\]", name)
        index = 0
        if name not in self._variables and array and array[1] in self._variables:
            name, index = array[1], int(array[2]) - 1
        real = "Real" if self._description.fmiMajorVersion == _FMI2 else "Float64"
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
        return Element(variable, index)

    def load(self, start: Mapping[str, object]) -> None:
        """Unpack, load and initialize it with start values and parameters, by name."""
        import fmpy

        for name in start:
            self._known(name, self._variables)
        try:
            self._folder = mkdtemp(prefix="aeroloop-fmu-")
            fmpy.extract(self._file, self._folder)
            with chdir("."):  # FMPy changes the folder to load the library, and does not return where that fails
                self._fmu = fmpy.instantiate_fmu(
                    self._folder, self._description, "CoSimulation", debug_logging=self._log, logger=self._listen
                )
            if self._description.fmiMajorVersion == _FMI2:
                self._fmu.setupExperiment(startTime=0.0)
            left = self._apply(start, fmpy.simulation.settable_in_instantiated)
            self._fmu.enterInitializationMode()
            for name in self._apply(left, fmpy.simulation.settable_in_initialization_mode):
                kind = _kind(self._variables[name])
                raise FmuError(f"{self._name}: plant.own.start.{name} cannot be set: it is {kind}")
            self._fmu.exitInitializationMode()
        except Exception as error:
            raise self._failure("it does not start", error) from None

    def signals(self, elements: Sequence[Element]) -> Signals:
        """Access to some of its numbers, with their present values."""
        return Signals(self._fmu, elements)

    def step(self, inputs: Signals, outputs: Signals, count: int) -> None:
        """Set its inputs, let `count` communication steps pass, and read its outputs."""
        try:
            inputs.write()
            for _ in range(count):
                ended = self._fmu.doStep(self._steps * self._length, self._length)
                self._steps += 1
                if ended is not None and (ended[1] or ended[2]):  # FMI 3: it terminates, or returned early
                    raise FmuError(f"{self._name}: it ended by itself at {ended[3]:g} s{self._own_words()}")
            outputs.read()
        except Exception as error:
            raise self._failure(f"it failed at {self._steps * self._length:g} s", error) from None

    def close(self) -> None:
        """End and free it, and remove its unpacked files. A second call does nothing."""
        fmu, self._fmu = self._fmu, None
        if fmu is not None and not self._fatal:
            with suppress(Exception):  # one that failed may refuse to be ended, and is freed nonetheless
                fmu.terminate()
            fmu.freeInstance()
        if self._folder is not None:
            rmtree(self._folder, ignore_errors=True)

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
            alike = closest(name, fitting)
            hint = f": did you mean {alike}?" if alike else f"; it has {_listed(fitting)}"
            raise FmuError(f"{self._name} has no variable {name}{hint}")
        return self._variables[name]

    def _listen(self, *said: Any) -> None:
        """Keep the gravest of its messages, and of those the last. FMI 2 gives its name too, before these three."""
        status, _, message = said[-3:]
        if status >= self._said[0]:
            self._said = (status, " ".join((message or b"").decode(errors="replace").split()))

    def _own_words(self) -> str:
        return f": {self._said[1]}" if self._said[1] else "; it logged nothing: plant.own.log = true may say more"

    def _failure(self, what: str, error: Exception) -> FmuError:
        if isinstance(error, FmuError):
            return error
        self._fatal |= getattr(error, "status", None) == _FATAL
        text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        preferred = float(getattr(self._description.defaultExperiment, "stepSize", None) or self._length)
        hint = (
            ""
            if isclose(preferred, self._length)
            else f" (steps are of {self._length:g} s, and it prefers {preferred:g} s: see plant.own.substeps)"
        )
        return FmuError(f"{self._name}: {what}: {text}{self._own_words()}{hint}")


class Signals:
    """Some of an FMU's numbers, set or read by one call.

    Attributes:
        values: All elements of the variables that these belong to.
        at: Where in `values` each of them is.
    """

    def __init__(self, fmu: Any, elements: Sequence[Element]) -> None:
        sizes = {variable.valueReference: prod(variable.shape) for variable, _ in elements}
        first = {reference: sum(list(sizes.values())[:i]) for i, reference in enumerate(sizes)}
        self.at = [first[variable.valueReference] + offset for variable, offset in elements]
        total = sum(sizes.values())
        self.values = (c_double * total)()
        references = (c_uint32 * len(sizes))(*sizes)
        three = hasattr(fmu, "fmi3GetFloat64")
        self._get = fmu.fmi3GetFloat64 if three else fmu.fmi2GetReal
        self._set = fmu.fmi3SetFloat64 if three else fmu.fmi2SetReal
        self._arguments = (fmu.component, references, len(sizes), self.values, *([total] if three else []))
        self.read()

    def read(self) -> None:
        """Fill `values` from the FMU."""
        self._get(*self._arguments)

    def write(self) -> None:
        """Set the FMU's variables to `values`."""
        self._set(*self._arguments)


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
    if version not in (_FMI2, 3):
        raise FmuError(f"{file.name} is of FMI {description.fmiVersion}: export it for FMI 2 or 3")
    if description.coSimulation is None:
        raise FmuError(f"{file.name} is for model exchange only: export it for co-simulation")
    platform = fmpy.platform if version == _FMI2 else fmpy.platform_tuple
    library = f"binaries/{platform}/{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    if library not in files:
        others = sorted({name.split("/")[1] for name in files if re.match("binaries/[^/]+/.", name)})
        sources = any(re.match(r"sources/.+\.c$", name) for name in files)
        remedy = f"`fmpy compile {file}` builds one from its sources" if sources else "export it on this platform"
        raise FmuError(f"{file.name} has no binary for {platform}, only for {either(others or ['none'])}: {remedy}")
    return description


def _kind(variable: Any) -> str:
    """Causality and type in words."""
    cause = variable.causality or "local"
    return f"{'an' if cause[0] in 'aeiou' else 'a'} {cause} of type {variable.type}"


def _listed(names: Iterable[str]) -> str:
    some = list(names)
    return ", ".join(some[:8]) + (f" and {len(some) - 8} more" if len(some) > 8 else "") or "none"
