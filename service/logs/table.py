"""Table of a session: a row per tick, a column per number, with the unit in the column's name.

A row has what the controller received and computed at a tick (see `Ticks`), and the emulator's latest truth. A value
that the log lacks is NaN here, and the file format's own null in a file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.models import Truth
from aeroloop.protocol.messages.trace import NEVER
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.control.laws.evaluation import initial_state
from aeroloop.service.control.laws.interface import Law
from aeroloop.service.logs.ticks import Ticks

Array = npt.NDArray[Any]
Kind = Literal["double", "int64", "int8", "bool", "string"]
"""Type of a column's values, by Arrow's name."""

AXES: Final = ("x", "y", "z")
EULER: Final = ("roll", "pitch", "yaw")


class TruthColumns(NamedTuple):
    """True states at measurements, a row each, in order. Shapes (n,), (n, 4), (n, 3), (n, actuators)."""

    k: Array
    attitude: Array
    rate: Array
    voltages: Array


def is_of_tick(truth: Truth, actuators: int) -> bool:
    """Whether a true state can be that of a session's tick; a stranger's may have any tick, and any plant's motors."""
    return 0 <= (truth.session_tick or 0) < NEVER and len(truth.voltages) == actuators


class Rows(NamedTuple):
    """Some ticks of one session, in order, with the latest truth at each; NaN before the first."""

    vehicle: str
    session: str
    ticks: Ticks
    truth: TruthColumns


class Column(NamedTuple):
    """A column. Its name ends in its unit; the unit is `1` for a number without, empty for what is no quantity."""

    name: str
    unit: str
    description: str
    kind: Kind = "double"


class Group(NamedTuple):
    """Columns that are computed together by `of`; NaN where there is no value of a double. Shape (n, columns)."""

    columns: Sequence[Column]
    of: Callable[[Rows], Array]


def groups(wire: WireSpec, period: float, law: Law[Any]) -> list[Group]:
    """Every column of the table, in order, by how frames were quantized, the time between ticks [s], and the law."""
    motors = list(map(str, wire.motors))
    outermost = {name: getattr(wire, name).quantizer().outermost for name in ("attitude", "rate", "voltage")}
    return [
        _group("tick", "", "tick k of the law", lambda rows: rows.ticks.k, kind="int64"),
        _group("time_s", "s", "the law's time, k times the period", lambda rows: rows.ticks.k * period),
        _group("published_ns", "ns", "when the measurement was sent, on the plant's clock since 1970",
               lambda rows: rows.ticks.wall_ns, kind="int64"),
        _group("vehicle", "", "name of the vehicle", lambda rows: _text(rows, rows.vehicle), kind="string"),
        _group("session", "", "name of the session", lambda rows: _text(rows, rows.session), kind="string"),
        *_attitude("", "as measured", lambda rows: rows.ticks.attitude),
        *_attitude("desired_", "as desired", lambda rows: rows.ticks.desired),
        _group("rate_{}_rad_s", "rad/s", "ω as measured, body frame, about {}", lambda rows: rows.ticks.rate, AXES),
        _group("desired_rate_{}_rad_s", "rad/s", "ω as desired, body frame, about {}",
               lambda rows: rows.ticks.desired_rate, AXES),
        _group("attitude_error_{}", "1", "ε̃ of the attitude as measured, {}",
               lambda rows: rows.ticks.attitude_error, AXES),
        _group("rate_error_{}_rad_s", "rad/s", "ω_e, body frame, about {}", lambda rows: rows.ticks.rate_error, AXES),
        _group("error_angle_deg", "deg", "angle of the attitude error", _angle_deg),
        _group("voltage_{}_V", "V", "u{} as commanded; none where no command answered",
               lambda rows: rows.ticks.voltages, motors),
        _group("latency_us", "µs", "from the measurement to the command that answers it, on the plant's clock",
               lambda rows: rows.ticks.latency_ns * 1e-3),
        _group("measurement_delay_us", "µs", "from the plant to the controller, if both ways are equally fast",
               lambda rows: rows.ticks.measurement_delay_ns * 1e-3),
        _group("command_delay_us", "µs", "from the controller to the plant, likewise",
               lambda rows: rows.ticks.command_delay_ns * 1e-3),
        _group("saturated_attitude_{}", "", "whether ε has the quantizer's outermost level, {}; unknown where η = 0",
               lambda rows: _outermost(_sent(rows), outermost["attitude"]), AXES, "bool"),
        _group("saturated_rate_{}", "", "whether ω has the quantizer's outermost level, {}",
               lambda rows: _outermost(rows.ticks.rate, outermost["rate"]), AXES, "bool"),
        _group("saturated_voltage_{}", "", "whether u{} has the quantizer's outermost level",
               lambda rows: _outermost(rows.ticks.voltages, outermost["voltage"]), motors, "bool"),
        *_state(law),
        _group("unquantized_voltage_{}_V", "V", "u{} before quantization", lambda rows: rows.ticks.unquantized, motors),
        *_attitude("truth_", "as the emulator had it", lambda rows: rows.truth.attitude),
        _group("truth_rate_{}_rad_s", "rad/s", "ω as the emulator had it, about {}",
               lambda rows: rows.truth.rate, AXES),
        _group("truth_voltage_{}_V", "V", "at the emulator's motor {}", lambda rows: rows.truth.voltages, motors),
        _group("truth_age_s", "s", "from the tick of the truth to this one",
               lambda rows: (rows.ticks.k - rows.truth.k) * period),
    ]  # fmt: skip


def euler_deg(q: Array) -> Array:
    """Roll, pitch and yaw in degrees as `aeroloop.protocol.wire.attitude.to_euler` has them. Shape (n, 4) to (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.asarray(np.degrees(np.column_stack((roll, pitch, yaw))))


def _group(
    name: str, unit: str, what: str, of: Callable[[Rows], Array], axes: Sequence[str] = ("",), kind: Kind = "double"
) -> Group:
    """A column, or one per axis, which replaces the braces in its name and description."""
    columns = [Column(name.format(axis), unit, what.format(axis), kind) for axis in axes]
    return Group(columns, lambda rows: of(rows).reshape(-1, len(axes)))


def _state(law: Law[Any]) -> list[Group]:
    """The law's named state as it used it, a column for each number: by axis if it is three, else counted."""
    found, since = list[Group](), 0
    for name, values in initial_state(law).items():
        n, unit = len(values), law.units.get(name, "1")
        axes = {1: [""], 3: [f"_{axis}" for axis in AXES]}.get(n, [f"_{i + 1}" for i in range(n)])
        suffix = "" if unit == "1" else "_" + unit.translate(_PLAIN)
        of: Callable[[Rows], Array] = partial(_part, since=since, until=since + n)
        found.append(_group(f"{name}{{}}{suffix}", unit, f"{name} as the law used it, {{}}", of, axes))
        since += n
    return found


_PLAIN: Final = str.maketrans({"·": "", "/": "_", "²": "2", "°": "deg", " ": ""})
"""Characters of a unit in a column's name."""


def _part(rows: Rows, since: int, until: int) -> Array:
    return rows.ticks.state[:, since:until]


def _attitude(prefix: str, which: str, of: Callable[[Rows], Array]) -> list[Group]:
    parts = [Column(f"{prefix}q{i}", "1", f"{part} {which}") for i, part in enumerate(("η", "ε₁", "ε₂", "ε₃"))]
    angles = [Column(f"{prefix}{angle}_deg", "deg", f"{angle} {which}, by Z–Y–X") for angle in EULER]
    return [Group(parts, of), Group(angles, lambda rows: euler_deg(of(rows)))]


def _text(rows: Rows, text: str) -> Array:
    return np.full(len(rows.ticks.k), text, dtype=object)


def _sent(rows: Rows) -> Array:
    """ε as received; NaN where ‖ε‖ > 1: it was scaled to unit length, with η = 0 (Remark 2), so its levels are lost."""
    q = rows.ticks.attitude
    return np.where(q[:, :1] == 0.0, np.nan, q[:, 1:])


def _outermost(values: Array, level: float) -> Array:
    return np.where(np.isnan(values), np.nan, np.abs(values) >= level)


def _angle_deg(rows: Rows) -> Array:
    lengths = np.sqrt(np.sum(np.square(rows.ticks.attitude_error), axis=1))
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(1.0, lengths))))
