"""Plant interface: actuate, advance, measure and close; and the check of a user's own class behind it.

The emulated plant, the USB board and a user's own class implement it; `plant.kind = "package.module:Class"` names the
latter. The endpoint calls actuate → advance → measure once a tick; `aeroloop show examples own_plant.py` prints one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from math import hypot, isfinite, isnan
from textwrap import shorten
from typing import Any, ClassVar, Final, NamedTuple, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError, create_model

from aeroloop.protocol import plugins
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import Signals
from aeroloop.protocol.wire.attitude import Quaternion, Vector
from aeroloop.protocol.wire.spec import MAX_ACTUATORS
from aeroloop.protocol.wording import problems

T = TypeVar("T")

EMULATED: Final = ("aero", "rigid_body")  # kinds that are not a class but a body of the emulated plant

BUILT_IN: Final = {
    **dict.fromkeys(EMULATED, "aeroloop.plant_emulator.model.emulated:EmulatedPlant"),
    "mujoco": "aeroloop.plant_emulator.engines.mujoco:MujocoPlant",
    "fmu": "aeroloop.plant_emulator.engines.fmu:FmuPlant",
}

_SIGNALS: Final[TypeAdapter[Signals]] = TypeAdapter(Signals)

_UNIT: Final = 0.01  # a quaternion so much longer or shorter than 1 is none: another order or unit, or a drift


class PlantError(AeroloopError):
    """A plant cannot be used or failed; one line, of a plant of one's own with its class, file and line."""


class Measurement(NamedTuple):
    """Sensor values, unquantized: q, body relative to inertial [1]; ω in the body frame [rad/s].

    A failed sensor yields NaN, never its last value.
    """

    attitude: Quaternion
    rate: Vector


class State(NamedTuple):
    """True state of a plant, free of sensor errors: q [1], ω in the body frame [rad/s], voltages at the motors [V].

    `signals` are up to 16 further quantities by name, such as a battery's or wheel speeds, NaN where not known. A name
    has letters, digits and underscores, and ends in its unit (`wheel_1_rad_s`). No controller receives them.
    """

    attitude: Quaternion
    rate: Vector
    voltages: tuple[float, ...]
    signals: Mapping[str, float] = {}


class NoSettings(BaseModel, extra="forbid"):
    """Settings of a plant that has none."""


class Plant(ABC):
    """A plant that its caller advances period by period.

    Args:
        settings: An instance of the class's `Settings`.
        period: Time of one `advance` [s].

    Attributes:
        Settings: Model of its settings, which the section `[plant.own]` fills; `extra="forbid"` finds wrong keys.
        repeatable: Whether equal settings and voltages give equal measurements and nothing moves: then a log replays.
        actuators: Number of motors, 1 to 8; of the class, or set by its constructor. The wire's must be the same.
        paces: Whether `advance` blocks until the next sample, and so paces the loop.
        passed: Periods that passed in the last `advance`; more than one if the call came late. The caller then raises
            its tick index by `passed`, and `advance` returns at once for the periods already over.
        note: What a status says of it, such as calls of a machine that failed; empty for nothing.
    """

    Settings: ClassVar[type[BaseModel]] = NoSettings
    repeatable: ClassVar[bool] = False
    actuators: int
    paces: bool = False
    passed: int = 1
    note: str = ""

    def __init__(self, settings: Any, period: float) -> None:
        self.settings = settings
        self.period = period

    @abstractmethod
    def actuate(self, voltages: Sequence[float]) -> None:
        """Hold voltages [V] on the motors until the next call. Shape (actuators,).

        They are within `plant.voltage_limit` where the plant is one of a user's; others clip to their own limits.
        """

    def enable(self, on: bool) -> None:  # noqa: B027  # most plants have no power stage
        """Switch the motors' power stage on for a session and off after it. Called at every tick."""

    @abstractmethod
    def advance(self) -> None:
        """Let one period pass. An emulator integrates; hardware waits for its next sample."""

    @abstractmethod
    def measure(self) -> Measurement:
        """Return the sensors' present values. The first call may come before any `advance`."""

    def truth(self) -> State | None:
        """The present true state; None where it is not known."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Set 0 V and release all resources. A second call does nothing."""


def within_supply(voltages: Sequence[float], limit: float) -> tuple[float, ...]:
    """The voltages clipped to ±`limit` [V]; NaN is 0 V. Shape as given."""
    return tuple(0.0 if isnan(volts) else max(-limit, min(limit, volts)) for volts in voltages)


def class_of(kind: str) -> type[Plant]:
    """The class that `plant.kind` names. Raises PluginError."""
    return plugins.find("plant.kind", kind, BUILT_IN, Plant)  # type: ignore[type-abstract]  # made if concrete


def own_plant(kind: str, own: Mapping[str, Any], period: float, voltage_limit: float) -> OwnPlant:
    """Make the plant that `plant.kind` names, with the settings `own`. Raises PluginError, PlantError."""
    found = class_of(kind)
    section = create_model("Section", own=(found.Settings, ...))
    whole = create_model("Configured", plant=(section, ...))  # so that a wrong key is named in full
    try:
        settings: Any = whole.model_validate({"plant": {"own": dict(own)}})
    except ValidationError as error:
        raise PlantError(f"plant.kind = {kind!r}: {'; '.join(problems(error, whole))}") from None
    try:
        return OwnPlant(found(settings.plant.own, period), voltage_limit)
    except AeroloopError as error:
        raise PlantError(str(error)) from None
    except Exception as error:
        raise PlantError(f"{found.__name__} (plant.kind) raised {plugins.exception_line(error, found)}") from None


class OwnPlant(Plant):
    """Watches over a plant of one's own. At most `voltage_limit` [V] reaches it.

    Raises:
        PlantError: From the constructor and every method: the plant failed. From then on only `close` is of use.
    """

    def __init__(self, plant: Plant, voltage_limit: float) -> None:
        self._plant, self._limit = plant, voltage_limit
        self._name = type(plant).__name__
        self._failed = self._closed = False
        self.paces = plant.paces
        count = getattr(plant, "actuators", None)
        if not (isinstance(count, int) and 1 <= count <= MAX_ACTUATORS):
            what = f"has actuators = {count!r}, which must be a whole number from 1 to {MAX_ACTUATORS}"
            raise self._failure(what, type(plant))
        self.actuators = count

    def actuate(self, voltages: Sequence[float]) -> None:
        self._call(self._plant.actuate, within_supply(voltages, self._limit))

    def enable(self, on: bool) -> None:
        self._call(self._plant.enable, on)

    def advance(self) -> None:
        self._call(self._plant.advance)
        self.passed, self.note = self._plant.passed, self._plant.note

    def measure(self) -> Measurement:
        measured = self._call(self._plant.measure)
        try:
            (w, x, y, z), (a, b, c) = (map(float, part) for part in measured)
        except (TypeError, ValueError):
            form = "measure() must return Measurement((w, x, y, z), (x, y, z))"
            raise self._failure(f"measured {_shown(measured)}: {form}", self._plant.measure) from None
        length = hypot(w, x, y, z)
        if isfinite(length) and abs(length - 1) > _UNIT:
            what = f"measured an attitude of length {length:.3g}, not a unit quaternion (w, x, y, z)"
            raise self._failure(what, self._plant.measure)
        return Measurement((w, x, y, z), (a, b, c))

    def truth(self) -> State | None:
        true = self._call(self._plant.truth)
        if true is None:
            return None
        try:
            (w, x, y, z), (a, b, c), (*voltages,) = (map(float, part) for part in true[:3])
            signals = {name: float(value) for name, value in dict(*true[3:]).items()}
            _SIGNALS.validate_python(dict.fromkeys(signals))
        except (TypeError, ValueError):
            form = "truth() must return State((w, x, y, z), (x, y, z), voltages, {'a_name': value, …}) or None"
            raise self._failure(f"gave {_shown(true)}: {form}", self._plant.truth) from None
        if len(voltages) != self.actuators:
            what = f"gave a true state of {len(voltages)} voltages, and has {self.actuators} actuators"
            raise self._failure(what, self._plant.truth)
        known = isfinite(sum((w, x, y, z, a, b, c, *voltages)))
        return State((w, x, y, z), (a, b, c), tuple(voltages), signals) if known else None

    def close(self) -> None:
        if self._closed:
            return
        self._closed, failed = True, self._failed
        try:
            self._call(self._plant.close)
        except PlantError:
            if not failed:  # otherwise the first failure is the one to show
                raise

    def _call(self, method: Callable[..., T], *values: object) -> T:
        try:
            return method(*values)
        except Exception as error:
            words = str(error) if isinstance(error, AeroloopError) else plugins.exception_line(error, method)
            raise self._failure(f"failed in {method.__name__}(): {words}") from None

    def _failure(self, what: str, called: object = None) -> PlantError:
        self._failed = True
        return PlantError(f"{self._name} {what}{plugins.place_of(called)}")


def _shown(value: object) -> str:
    return shorten(repr(value), 80, placeholder="…")
