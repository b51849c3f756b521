"""Panels of a session: every quantity over time, in the order of the paper's figures and with their numbers.

A log is one run, and a run is one of the paper's three cases: without quantization (C.4–C.6), with it (C.7–C.11), with
it and wind (C.12–C.14). Every quantity is drawn in every case; a title has the paper's number where the paper has
that figure. Roll, pitch and yaw come before them; timing, estimates, and the theorem's norms follow. Every tick is
drawn while there are few enough; of more, the least and the largest value of each bucket, so that no extreme is lost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from typing import Final, Literal

import numpy as np

from aeroloop.service.config import Settings
from aeroloop.service.control.laws.evaluation import initial_state
from aeroloop.service.control.laws.registry import law_of
from aeroloop.service.logs.session import Array, Integers
from aeroloop.service.logs.table import euler_deg
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.review.observations import error_deg, of_nearer_sign, periods_ns
from aeroloop.service.review.report import Line, Panel
from aeroloop.service.review.theorem import TheoremCheck

MAX_POINTS: Final = 180_000
"""Points of a line. While a session has no more ticks (six minutes at 500 Hz), every tick is drawn."""

Case = Literal["continuous", "quantized", "wind"]

CASES: Final[dict[Case, str]] = {
    "continuous": "without quantization",
    "quantized": "with quantization",
    "wind": "with wind",
}

NUMBERS: Final[dict[tuple[str, Case], str]] = {
    ("error", "continuous"): "C.4",
    ("rate_error", "continuous"): "C.5",
    ("input", "continuous"): "C.6",
    ("attitude", "quantized"): "C.7",
    ("rate", "quantized"): "C.8",
    ("error", "quantized"): "C.9",
    ("rate_error", "quantized"): "C.10",
    ("input", "quantized"): "C.11",
    ("error", "wind"): "C.12",
    ("rate_error", "wind"): "C.13",
    ("input", "wind"): "C.14",
}
"""Number of the paper's figure of a quantity in a case."""

_Quantity = tuple[str, str, Sequence[str], str, dict[str, Array]]
"""Group, title, a label and an axis for each column, unit, and the lines by name. Shapes (n,) or (n, columns)."""


def case_of(settings: Settings) -> Case:
    """The paper's case that a session belongs to."""
    if settings.plant.wind.blowing and not settings.plant.ideal:
        return "wind"
    bits = (settings.wire.attitude.bits, settings.wire.rate.bits, settings.wire.voltage.bits)
    return "continuous" if bits == (None, None, None) else "quantized"


def panels_of(
    settings: Settings, ticks: Ticks, theorem: TheoremCheck, points: int = MAX_POINTS
) -> tuple[Array, list[Panel], int]:
    """Times on the law's clock [s], panels, and how many ticks two points of a line stand for; 1 for every tick.

    A panel has one column of a quantity; a line without any value is left out.
    """
    k, n = ticks.k.astype(np.float64), len(ticks.k)
    if not n:
        return k, [], 1
    starts = None if n <= points else np.linspace(0, n, points // 2, endpoint=False).astype(np.int64)
    if starts is not None:
        first, last = k[starts], k[np.append(starts[1:], n) - 1]
        quarter = np.maximum(0.0, ((last - first + 1) / 2 - 1) / 2)
        k = np.column_stack([first + quarter, last - quarter]).ravel()
    time, panels = k * settings.loop.period, list[Panel]()
    for group, title, labels, unit, lines in _quantities(settings, ticks, theorem):
        for i, label in enumerate(labels):
            columns = {name: values.reshape(n, -1)[:, i] for name, values in lines.items()}
            drawn = [
                Line(name, column if starts is None else outline(column, starts), name == "desired")
                for name, column in columns.items()
                if not np.isnan(column).all()
            ]
            if group == "z_norm" and drawn:
                drawn += _level(theorem, time)
            if drawn:
                panels.append(Panel(group, title, label, unit, drawn))
    return time, panels, 1 if starts is None else int(np.diff(starts, append=n).max())


def outline(values: Array, starts: Integers) -> Array:
    """The least and the largest value of each bucket that begins at `starts`, in the direction in which it goes.

    NaN counts only where a bucket has nothing else. Shapes (n,) and (buckets,); the outline's is (2·buckets,).
    """
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    falls = values[np.append(starts[1:], len(values)) - 1] < values[starts]
    return np.column_stack([np.where(falls, high, low), np.where(falls, low, high)]).ravel()


def _quantities(settings: Settings, ticks: Ticks, theorem: TheoremCheck) -> Iterator[_Quantity]:
    case, desired, error = case_of(settings), ticks.desired, ticks.attitude_error

    def title(name: str, quantity: str) -> str:
        number = NUMBERS.get((name, case))
        return f"{f'Figure {number}: ' if number else ''}{quantity} {CASES[case]}"

    def true_line(row: int) -> Array:
        """A row of the true states: interpolated between them, for drawing only, and NaN before the first."""
        if not len(theorem.true_k):
            return np.full(len(ticks.k), np.nan)
        return np.asarray(np.interp(ticks.k, theorem.true_k, theorem.true[row], left=np.nan))

    angles = np.unwrap(euler_deg(desired), period=360.0, axis=0)
    measured, actual = (
        _near(euler_deg(q), angles) for q in (ticks.attitude, np.column_stack([true_line(row) for row in range(3, 7)]))
    )
    lines = {"measured": measured, "desired": angles, "true": actual}
    yield "angles", "Roll, pitch and yaw", ("roll", "pitch", "yaw"), "°", lines
    lines = {"measured": of_nearer_sign(ticks.attitude, desired), "desired": desired}
    yield "attitude", title("attitude", "Attitude"), ("η", "ε₁", "ε₂", "ε₃"), "1", lines
    lines = {"measured": ticks.rate, "desired": ticks.desired_rate}
    yield "rate", title("rate", "Angular velocity"), ("ω₁", "ω₂", "ω₃"), "rad/s", lines
    yield "attitude_error", title("error", "Attitude error"), ("ε̃₁", "ε̃₂", "ε̃₃"), "1", {"measured": error}
    lines = {"measured": ticks.rate_error}
    yield "rate_error", title("rate_error", "Angular velocity error"), ("ω_e1", "ω_e2", "ω_e3"), "rad/s", lines
    inputs = ["u" + "₁₂₃₄₅₆₇₈"[i - 1] for i in settings.wire.motors]
    yield "input", title("input", "Input"), inputs, "V", {"commanded": ticks.voltages}
    lines = {"measured": error_deg(error), "true": true_line(2)}
    yield "error_angle", "Attitude error, as an angle", ["angle"], "°", lines
    if not settings.loop.lockstep:
        yield "latency", "Loop latency", ["latency"], "µs", {"latency": ticks.latency_ns * 1e-3}
        yield "period", "Period between measurements", ["period"], "µs", {"period": periods_ns(ticks) * 1e-3}
    yield from _law_state(settings, ticks)
    yield "z_norm", "Error of Theorem 1", ["‖z‖"], "1", {"measured": theorem.norm, "true": true_line(0)}
    name = "true, with θ̃" if theorem.findings.damping_known else "true, without θ̃"
    yield "lyapunov", "Lyapunov function", ["V"], "N·m", {"measured, without θ̃": theorem.V, name: true_line(1)}


def _law_state(settings: Settings, ticks: Ticks) -> Iterator[_Quantity]:
    """Each part of the law's named state, in its order, but for the sign of the equilibrium."""
    law, at = law_of(settings.law, settings.loop.period, settings.wire.actuators), 0
    for name, values in initial_state(law).items():
        if name != "sign":
            symbol = {"damping_estimate": "θ̂"}.get(name, name)
            labels = [f"{symbol}{'₁₂₃₄₅₆₇₈₉'[i] if i < 9 else i + 1}" for i in range(len(values))]
            state, title = ticks.state[:, at : at + len(values)], name.replace("_", " ").capitalize()
            yield name, title, labels, law.units.get(name, "1"), {"estimated": state}
        at += len(values)


def _level(theorem: TheoremCheck, time: Array) -> list[Line]:
    """The bound of ‖z‖ where it is judged after the transient; none where there is no bound or no such time."""
    found, name = theorem.findings, "bound, once within it"
    if (bound := found.pointwise_radius) is None:
        bound, name = found.radius, "bound of the root mean square"
    judged = (time >= found.since_s + found.transient_s) & (time < (inf if found.until_s is None else found.until_s))
    if bound is None or not judged.any():
        return []
    return [Line(name, np.where(judged, bound, np.nan), desired=True)]


def _near(angles: Array, others: Array) -> Array:
    """Angles ±360°, nearest to others [deg]. Shapes (n, 3)."""
    return np.asarray(others + (angles - others + 180.0) % 360.0 - 180.0)
