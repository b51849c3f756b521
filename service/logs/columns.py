"""Columns of a log's table: what the controller received and computed at each tick, and the plant's latest true state.

A column has one name in every form of the table, ending in its unit; Parquet has unit and description beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.service.config import Settings
from aeroloop.service.control.laws.registry import initial_state, law_of
from aeroloop.service.logs.frames import AXES
from aeroloop.service.logs.session import Array, SessionKey, Truths
from aeroloop.service.logs.ticks import Ticks, euler_deg

EULER: Final = ("roll", "pitch", "yaw")
_PLAIN: Final = str.maketrans({"·": "", "/": "_", "²": "2", "°": "deg", " ": ""})  # of a unit in a column's name


class Column(NamedTuple):
    """A column and its values, NaN where a double is missing. Shape (n,).

    Its name ends in its unit; the unit is `1` for a number without, empty for what is no quantity.
    """

    name: str
    unit: str
    description: str
    values: npt.NDArray[Any]
    boolean: bool = False  # 1.0 and 0.0


def columns_of(which: SessionKey, ticks: Ticks, truths: Truths, settings: Settings) -> list[Column]:
    """Every column of the table of some ticks of a session, with the latest true state by then; NaN before any."""
    wire, period = settings.wire, settings.loop.period
    n = len(ticks.k)
    motors = list(map(str, wire.motors))
    outermost = {name: getattr(wire, name).quantizer().outermost for name in ("attitude", "rate", "voltage")}
    # ε as received is not known where ‖ε‖ > 1: it was scaled to unit length, with η = 0 (Remark 2)
    received = np.where(ticks.attitude[:, :1] == 0.0, np.nan, ticks.attitude[:, 1:])
    lengths = np.sqrt(np.sum(np.square(ticks.attitude_error), axis=1))
    found = [
        Column("tick", "", "tick k of the law", ticks.k),
        Column("time_s", "s", "the law's time, k times the period", ticks.k * period),
        Column("published_ns", "ns", "when the measurement was sent, on the plant's clock since 1970", ticks.wall_ns),
        Column("vehicle", "", "name of the vehicle", np.full(n, which[0], dtype=object)),
        Column("session", "", "name of the session", np.full(n, which[1], dtype=object)),
        *_attitude("", "as measured", ticks.attitude),
        *_attitude("desired_", "as desired", ticks.desired),
        *_by("rate_{}_rad_s", "rad/s", "ω as measured, body frame, about {}", ticks.rate, AXES),
        *_by("desired_rate_{}_rad_s", "rad/s", "ω as desired, body frame, about {}", ticks.desired_rate, AXES),
        *_by("attitude_error_{}", "1", "ε̃ of the attitude as measured, {}", ticks.attitude_error, AXES),
        *_by("rate_error_{}_rad_s", "rad/s", "ω_e, body frame, about {}", ticks.rate_error, AXES),
        Column("attitude_error_deg", "deg", "angle of the attitude error",
               np.degrees(2 * np.arcsin(np.minimum(1.0, lengths)))),
        *_by("voltage_{}_V", "V", "u{} as commanded; none where no command answered", ticks.voltages, motors),
        Column("latency_us", "µs", "from the measurement to the command that answers it, on the plant's clock",
               ticks.latency_ns * 1e-3),
        Column("measurement_delay_us", "µs", "from the plant to the controller, if both ways are equally fast",
               ticks.measurement_delay_ns * 1e-3),
        Column("command_delay_us", "µs", "from the controller to the plant, likewise", ticks.command_delay_ns * 1e-3),
        *_by("saturated_attitude_{}", "", "whether ε has the quantizer's outermost level, {}; unknown where η = 0",
             _reaches(received, outermost["attitude"]), AXES, True),
        *_by("saturated_rate_{}", "", "whether ω has the quantizer's outermost level, {}",
             _reaches(ticks.rate, outermost["rate"]), AXES, True),
        *_by("saturated_voltage_{}", "", "whether u{} has the quantizer's outermost level",
             _reaches(ticks.voltages, outermost["voltage"]), motors, True),
    ]  # fmt: skip
    parts = (truths.k, truths.attitude, truths.rate, truths.voltages, *truths.signals.values())
    states = np.insert(np.column_stack(parts).astype(np.float64), 0, np.nan, axis=0)
    truth = states[np.searchsorted(truths.k, ticks.k, side="right")]  # 0: before the first
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
        *_by("plant_{}", "", "{}, the plant's own signal", truth[:, 8 + len(motors) :], list(truths.signals)),
        Column("truth_age_s", "s", "from the tick of the truth to this one", (ticks.k - truth[:, 0]) * period),
    ]


def _by(name: str, unit: str, what: str, values: Array, axes: Sequence[str], boolean: bool = False) -> Iterator[Column]:
    """A column per axis, which replaces the braces in its name and description."""
    for axis, column in zip(axes, values.T, strict=True):
        yield Column(name.format(axis), unit, what.format(axis), column, boolean)


def _attitude(prefix: str, which: str, q: Array) -> Iterator[Column]:
    for i, part in enumerate(("η", "ε₁", "ε₂", "ε₃")):
        yield Column(f"{prefix}q{i}", "1", f"{part} {which}", q[:, i])
    yield from _by(f"{prefix}{{}}_deg", "deg", f"{{}} {which}, by Z–Y–X", euler_deg(q), EULER)


def _reaches(values: Array, level: float) -> Array:
    return np.where(np.isnan(values), np.nan, np.abs(values) >= level)
