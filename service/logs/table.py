"""A session as a table: one row a tick, one column a number, with the unit in its name.

The rows are what the controller saw at each tick (see `Tick`). Beside them stand what it told of itself in telemetry,
where it told something of that very tick, and the emulator's truth, the last that was published by then. What the log
does not have is NaN here, and becomes whatever says "nothing" in a file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.wire import WireSpec
from service.logs.spool import Records

Array = npt.NDArray[Any]
Kind = Literal["double", "int64", "int8", "bool", "text"]

AXES: Final = ("x", "y", "z")
EULER: Final = ("roll", "pitch", "yaw")


class Rows(NamedTuple):
    """Some ticks of one session, in order. Every array has shape (n,).

    Attributes:
        ticks: Fields as in `TICK`.
        telemetry: Fields as in `TELEMETRY`; its doubles are NaN where there is none of that tick.
        truth: Fields as in `TRUTH`; its doubles are NaN before the first.
    """

    vehicle: str
    session: str
    ticks: Records
    telemetry: Records
    truth: Records


def tick_fields(actuators: int) -> list[tuple[str, int]]:
    """What is kept of a tick: names, and how many doubles each has (0: an integer)."""
    return [
        ("k", 0),
        ("published_ns", 0),
        ("latency_ns", 0),
        ("attitude", 4),
        ("desired", 4),
        ("rate", 3),
        ("desired_rate", 3),
        ("attitude_error", 3),
        ("rate_error", 3),
        ("voltages", actuators),
    ]


def telemetry_fields(actuators: int) -> list[tuple[str, int]]:
    """The same of telemetry."""
    return [("k", 0), ("damping_estimate", 3), ("voltages", actuators), ("sign", 1)]


def truth_fields(actuators: int) -> list[tuple[str, int]]:
    """The same of the truth."""
    return [("published_ns", 0), ("attitude", 4), ("rate", 3), ("voltages", actuators)]


class Column(NamedTuple):
    """What a column is.

    Attributes:
        name: With its unit at the end, if it has one.
        unit: `1` of a number without one, empty of what is no quantity.
        description: What it is, in a sentence.
        kind: What its values are.
    """

    name: str
    unit: str
    description: str
    kind: Kind = "double"


@dataclass(frozen=True)
class Group:
    """Columns that are computed together.

    Attributes:
        of: Their values in some rows; NaN where there is none, unless they are of integers or text. Shape (n, columns).
    """

    columns: Sequence[Column]
    of: Callable[[Rows], Array]


def groups(wire: WireSpec, period: float) -> list[Group]:
    """Every column of the table, in order.

    Args:
        wire: How the session's frames were quantized.
        period: Time between ticks [s].
    """
    motors = [str(i) for i in range(4 - wire.actuators, 4)]
    outermost = {name: getattr(wire, name).quantizer().outermost for name in ("attitude", "rate", "voltage")}
    return [
        _one(Column("tick", "", "tick k of the law", "int64"), lambda rows: rows.ticks["k"]),
        _one(Column("time_s", "s", "the law's time, k times the period"), lambda rows: rows.ticks["k"] * period),
        _one(
            Column("published_ns", "ns", "when the measurement was published, since 1970, UTC", "int64"),
            lambda rows: rows.ticks["published_ns"],
        ),
        _one(Column("vehicle", "", "name of the vehicle", "text"), lambda rows: _text(rows, rows.vehicle)),
        _one(Column("session", "", "name of the session", "text"), lambda rows: _text(rows, rows.session)),
        *_attitude("", "as measured", lambda rows: rows.ticks["attitude"]),
        *_attitude("desired_", "as desired", lambda rows: rows.ticks["desired"]),
        _vector("rate_{}_rad_s", "rad/s", "ω as measured, body frame, about {}", lambda rows: rows.ticks["rate"]),
        _vector(
            "desired_rate_{}_rad_s", "rad/s", "ω as desired, body frame, about {}",
            lambda rows: rows.ticks["desired_rate"],
        ),
        _vector(
            "attitude_error_{}", "1", "ε̃ of the attitude as measured, {}", lambda rows: rows.ticks["attitude_error"]
        ),
        _vector("rate_error_{}_rad_s", "rad/s", "ω_e, body frame, about {}", lambda rows: rows.ticks["rate_error"]),
        _one(Column("error_angle_deg", "deg", "angle of the attitude error"), _angle_deg),
        _vector("voltage_{}_V", "V", "u{} as commanded; none where no command answered", _commanded, motors),
        _one(
            Column("latency_us", "µs", "from the measurement's publication to its answer's; none where none answered"),
            lambda rows: np.where(rows.ticks["latency_ns"] < 0, np.nan, rows.ticks["latency_ns"] * 1e-3),
        ),
        _vector(
            "saturated_attitude_{}", "", "whether ε has the quantizer's outermost level, {}; unknown where η = 0",
            lambda rows: _outermost(_sent(rows), outermost["attitude"]), kind="bool",
        ),
        _vector(
            "saturated_rate_{}", "", "whether ω has the quantizer's outermost level, {}",
            lambda rows: _outermost(rows.ticks["rate"], outermost["rate"]), kind="bool",
        ),
        _vector(
            "saturated_voltage_{}", "", "whether u{} has the quantizer's outermost level",
            lambda rows: _outermost(_commanded(rows), outermost["voltage"]), motors, "bool",
        ),
        _vector(
            "damping_estimate_{}_Nms_rad", "N·m·s/rad", "θ̂ after this tick, {}; none where telemetry is silent",
            lambda rows: rows.telemetry["damping_estimate"],
        ),
        _vector(
            "unquantized_voltage_{}_V", "V", "u{} before quantization; none where telemetry is silent",
            lambda rows: rows.telemetry["voltages"], motors,
        ),
        _one(
            Column("sign", "1", "the equilibrium approached, z₁₊ or z₁₋; none where telemetry is silent", "int8"),
            lambda rows: rows.telemetry["sign"],
        ),
        *_attitude("truth_", "as the emulator had it", lambda rows: rows.truth["attitude"]),
        _vector(
            "truth_rate_{}_rad_s", "rad/s", "ω as the emulator had it, about {}", lambda rows: rows.truth["rate"]
        ),
        _vector("truth_voltage_{}_V", "V", "at the emulator's motor {}", lambda rows: rows.truth["voltages"], motors),
        _one(Column("truth_age_s", "s", "from the truth's publication to the measurement's"), _truth_age_s),
    ]  # fmt: skip


def euler_deg(q: Array) -> Array:
    """Roll, pitch and yaw in degrees as `protocol.attitude.to_euler` has them. Shape (n, 4) to (n, 3)."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    degrees: Array = np.degrees(np.stack((roll, pitch, yaw), axis=1))
    return degrees


def _one(column: Column, of: Callable[[Rows], Array]) -> Group:
    return Group([column], lambda rows: of(rows).reshape(-1, 1))


def _vector(
    name: str,
    unit: str,
    description: str,
    of: Callable[[Rows], Array],
    axes: Sequence[str] = AXES,
    kind: Kind = "double",
) -> Group:
    """A column an axis, which stands for the braces in name and description."""
    return Group([Column(name.format(axis), unit, description.format(axis), kind) for axis in axes], of)


def _attitude(prefix: str, which: str, of: Callable[[Rows], Array]) -> list[Group]:
    parts = [Column(f"{prefix}q{i}", "1", f"{part} {which}") for i, part in enumerate(("η", "ε₁", "ε₂", "ε₃"))]
    angles = [Column(f"{prefix}{angle}_deg", "deg", f"{angle} {which}, by Z–Y–X") for angle in EULER]
    return [Group(parts, of), Group(angles, lambda rows: euler_deg(of(rows)))]


def _text(rows: Rows, text: str) -> Array:
    return np.full(len(rows.ticks), text, dtype=object)


def _commanded(rows: Rows) -> Array:
    """Of a measurement that was passed over, `Tick` has what the next command said; nothing was commanded then."""
    return np.where((rows.ticks["latency_ns"] >= 0)[:, None], rows.ticks["voltages"], np.nan)


def _sent(rows: Rows) -> Array:
    """ε as it came. Where ‖ε‖ > 1 it was scaled to unit length, with η = 0 (Remark 2), and the levels are gone."""
    q = rows.ticks["attitude"]
    return np.where(q[:, :1] == 0.0, np.nan, q[:, 1:])


def _outermost(values: Array, level: float) -> Array:
    return np.where(np.isnan(values), np.nan, np.abs(values) >= level)


def _angle_deg(rows: Rows) -> Array:
    lengths = np.sqrt(np.sum(np.square(rows.ticks["attitude_error"]), axis=1))
    degrees: Array = np.degrees(2 * np.arcsin(np.minimum(1.0, lengths)))
    return degrees


def _truth_age_s(rows: Rows) -> Array:
    known = ~np.isnan(rows.truth["attitude"][:, 0])
    return np.where(known, (rows.ticks["published_ns"] - rows.truth["published_ns"]) * 1e-9, np.nan)
