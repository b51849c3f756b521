"""Table of a session: a row per tick, a column per number, with the unit in the column's name.

A row has what the controller received and computed at a tick (see `Ticks`), and the emulator's latest truth. A value
that the log lacks is NaN here, and the file format's own null in a file.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping, Sequence
from math import nan
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.models import MAX_SIGNALS, Truth
from aeroloop.protocol.messages.trace import NEVER
from aeroloop.service.config import Settings
from aeroloop.service.control.laws.evaluation import initial_state
from aeroloop.service.control.laws.registry import law_of
from aeroloop.service.logs.session import Array, SessionKey
from aeroloop.service.logs.ticks import Ticks

Kind = Literal["double", "int64", "int8", "bool", "string"]
"""Type of a column's values, by Arrow's name."""

AXES: Final = ("x", "y", "z")
EULER: Final = ("roll", "pitch", "yaw")

_PLAIN: Final = str.maketrans({"·": "", "/": "_", "²": "2", "°": "deg", " ": ""})
"""Characters of a unit in a column's name."""


class TrueStates:
    """Collects the true states of some sessions of a vehicle, by name with the number of motors."""

    def __init__(self, actuators: Mapping[str, int]) -> None:
        self._actuators = actuators
        self._states = {session: array("d") for session in actuators}
        self._signals: dict[str, dict[str, array[float]]] = {session: {} for session in actuators}  # tick, value, …

    def add(self, data: bytes) -> None:
        """Add a message, unless it is of another session.

        Raises:
            ValueError: It is malformed: anyone on the network may publish one, of any tick and any plant's motors.
        """
        truth = Truth.model_validate_json(data)
        if truth.session is None or truth.session not in self._actuators or truth.session_tick is None:
            return
        signals = self._signals[truth.session]
        if not 0 <= truth.session_tick < NEVER or len(truth.voltages) != self._actuators[truth.session]:
            raise ValueError("a true state of no tick of its session")
        if len({*signals, *truth.signals}) > MAX_SIGNALS:
            raise ValueError("more signals than a plant has")
        self._states[truth.session].extend((truth.session_tick, *truth.attitude, *truth.rate, *truth.voltages))
        for name, value in truth.signals.items():
            signals.setdefault(name, array("d")).extend((truth.session_tick, nan if value is None else value))

    def rows(self, session: str) -> Array:
        """Tick, q, ω and the motors' voltages, ascending; of a tick, the first. Shape (n, 8 + actuators)."""
        rows = np.frombuffer(self._states[session]).reshape(-1, 8 + self._actuators[session])
        return np.asarray(rows[np.unique(rows[:, 0], return_index=True)[1]])

    def signals(self, session: str) -> dict[str, Array]:
        """The plant's further signals by name, a value for each of `rows`; NaN where it is not known. Shapes (n,)."""
        ticks, signals = self.rows(session)[:, 0], dict[str, Array]()
        for name, pairs in sorted(self._signals[session].items()):
            of_tick, first = np.unique(np.frombuffer(pairs)[::2], return_index=True)
            signals[name] = np.full(len(ticks), np.nan)
            signals[name][np.searchsorted(ticks, of_tick)] = np.frombuffer(pairs)[1::2][first]
        return signals


class Column(NamedTuple):
    """A column and its values, NaN where a double is missing. Shape (n,).

    Its name ends in its unit; the unit is `1` for a number without, empty for what is no quantity.
    """

    name: str
    unit: str
    description: str
    values: npt.NDArray[Any]
    kind: Kind = "double"


def columns_of(
    which: SessionKey, ticks: Ticks, truth: Array, settings: Settings, signals: Sequence[str] = ()
) -> list[Column]:
    """Every column of the table of some ticks of a session, with the latest true state at each; NaN before the first.

    A row of `truth` is a tick, q, ω, the motors' voltages and the plant's `signals`: (n, 8 + actuators + signals).
    """
    wire, period = settings.wire, settings.loop.period
    n = len(ticks.k)
    motors = list(map(str, wire.motors))
    outermost = {name: getattr(wire, name).quantizer().outermost for name in ("attitude", "rate", "voltage")}
    # ε as received is not known where ‖ε‖ > 1: it was scaled to unit length, with η = 0 (Remark 2)
    received = np.where(ticks.attitude[:, :1] == 0.0, np.nan, ticks.attitude[:, 1:])
    lengths = np.sqrt(np.sum(np.square(ticks.attitude_error), axis=1))
    found = [
        Column("tick", "", "tick k of the law", ticks.k, "int64"),
        Column("time_s", "s", "the law's time, k times the period", ticks.k * period),
        Column("published_ns", "ns", "when the measurement was sent, on the plant's clock since 1970", ticks.wall_ns,
               "int64"),
        Column("vehicle", "", "name of the vehicle", np.full(n, which[0], dtype=object), "string"),
        Column("session", "", "name of the session", np.full(n, which[1], dtype=object), "string"),
        *_attitude("", "as measured", ticks.attitude),
        *_attitude("desired_", "as desired", ticks.desired),
        *_by("rate_{}_rad_s", "rad/s", "ω as measured, body frame, about {}", ticks.rate, AXES),
        *_by("desired_rate_{}_rad_s", "rad/s", "ω as desired, body frame, about {}", ticks.desired_rate, AXES),
        *_by("attitude_error_{}", "1", "ε̃ of the attitude as measured, {}", ticks.attitude_error, AXES),
        *_by("rate_error_{}_rad_s", "rad/s", "ω_e, body frame, about {}", ticks.rate_error, AXES),
        Column("error_angle_deg", "deg", "angle of the attitude error",
               np.degrees(2 * np.arcsin(np.minimum(1.0, lengths)))),
        *_by("voltage_{}_V", "V", "u{} as commanded; none where no command answered", ticks.voltages, motors),
        Column("latency_us", "µs", "from the measurement to the command that answers it, on the plant's clock",
               ticks.latency_ns * 1e-3),
        Column("measurement_delay_us", "µs", "from the plant to the controller, if both ways are equally fast",
               ticks.measurement_delay_ns * 1e-3),
        Column("command_delay_us", "µs", "from the controller to the plant, likewise", ticks.command_delay_ns * 1e-3),
        *_by("saturated_attitude_{}", "", "whether ε has the quantizer's outermost level, {}; unknown where η = 0",
             _reaches(received, outermost["attitude"]), AXES, "bool"),
        *_by("saturated_rate_{}", "", "whether ω has the quantizer's outermost level, {}",
             _reaches(ticks.rate, outermost["rate"]), AXES, "bool"),
        *_by("saturated_voltage_{}", "", "whether u{} has the quantizer's outermost level",
             _reaches(ticks.voltages, outermost["voltage"]), motors, "bool"),
    ]  # fmt: skip
    law, since = law_of(settings.law, period, wire.actuators), 0
    for name, initial in initial_state(law).items():
        until, unit = since + len(initial), law.units.get(name, "1")
        # by axis if it is three numbers, else counted
        axes = {1: [""], 3: [f"_{axis}" for axis in AXES]}.get(len(initial), [f"_{i + 1}" for i in range(len(initial))])
        suffix = "" if unit == "1" else "_" + unit.translate(_PLAIN)
        state = ticks.state[:, since:until]
        found += _by(f"{name}{{}}{suffix}", unit, f"{name} as the law used it, {{}}", state, axes)
        since = until
    return [
        *found,
        *_by("unquantized_voltage_{}_V", "V", "u{} before quantization", ticks.unquantized, motors),
        *_attitude("truth_", "as the emulator had it", truth[:, 1:5]),
        *_by("truth_rate_{}_rad_s", "rad/s", "ω as the emulator had it, about {}", truth[:, 5:8], AXES),
        *_by("truth_voltage_{}_V", "V", "at the emulator's motor {}", truth[:, 8 : 8 + len(motors)], motors),
        *_by("plant_{}", "", "{}, the plant's own signal", truth[:, 8 + len(motors) :], signals),
        Column("truth_age_s", "s", "from the tick of the truth to this one", (ticks.k - truth[:, 0]) * period),
    ]


def euler_deg(q: Array) -> Array:
    """Roll, pitch and yaw in degrees as `aeroloop.protocol.wire.attitude.to_euler` has them. Shape (n, 4) to (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.asarray(np.degrees(np.column_stack((roll, pitch, yaw))))


def _by(name: str, unit: str, what: str, values: Array, axes: Sequence[str], kind: Kind = "double") -> Iterator[Column]:
    """A column per axis, which replaces the braces in its name and description."""
    for axis, column in zip(axes, values.T, strict=True):
        yield Column(name.format(axis), unit, what.format(axis), column, kind)


def _attitude(prefix: str, which: str, q: Array) -> Iterator[Column]:
    for i, part in enumerate(("η", "ε₁", "ε₂", "ε₃")):
        yield Column(f"{prefix}q{i}", "1", f"{part} {which}", q[:, i])
    yield from _by(f"{prefix}{{}}_deg", "deg", f"{{}} {which}, by Z–Y–X", euler_deg(q), EULER)


def _reaches(values: Array, level: float) -> Array:
    return np.where(np.isnan(values), np.nan, np.abs(values) >= level)
