"""Panels of a session: every quantity over time, in the order of the paper's figures and with their numbers.

Every tick is drawn while there are few enough; of more, the least and the largest value of each bucket.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from typing import Final, NamedTuple

import numpy as np

from aeroloop.service.config import Settings
from aeroloop.service.control.laws.registry import initial_state, law_of
from aeroloop.service.logs.session import Array, Integers, Truths
from aeroloop.service.logs.ticks import Ticks, euler_deg
from aeroloop.service.review.events import error_deg, of_nearer_sign, periods_ns
from aeroloop.service.review.report import Line, Panel
from aeroloop.service.review.theorem import TheoremCheck

MAX_POINTS: Final = 90_000
"""Points of a line. While a session has no more ticks (three minutes at 500 Hz), every tick is drawn."""

DESIRED: Final = ("desired", "bound")  # beginnings of the names of lines that a run should follow, or stay below

CASES: Final = {"continuous": "without quantization", "quantized": "with quantization", "wind": "with wind"}
NUMBERS: Final[dict[str, dict[str, str]]] = {
    "continuous": {"error": "C.4", "rate_error": "C.5", "input": "C.6"},
    "quantized": {"attitude": "C.7", "rate": "C.8", "error": "C.9", "rate_error": "C.10", "input": "C.11"},
    "wind": {"error": "C.12", "rate_error": "C.13", "input": "C.14"},
}  # number of the paper's figure of a quantity, by case

NO_TRUTHS: Final = Truths(np.empty(0, np.int64), np.empty((0, 4)), np.empty((0, 3)), np.empty((0, 2)))
"""Of a log without true states."""

_Quantity = tuple[str, str, Sequence[str], str, dict[str, Array]]  # group, title, label of each column, unit, lines


def case_of(settings: Settings) -> str:
    """The paper's case that a session belongs to."""
    if settings.plant.wind.blowing:
        return "wind"
    wire = settings.wire
    return "quantized" if any(signal.bits for signal in (wire.attitude, wire.rate, wire.voltage)) else "continuous"


def panels_of(
    settings: Settings, ticks: Ticks, theorem: TheoremCheck, points: int = MAX_POINTS, truths: Truths = NO_TRUTHS
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
    panels = list[Panel]()
    case = case_of(settings)
    for group, title, labels, unit, lines in _quantities(settings, ticks, theorem, truths):
        if number := NUMBERS[case].get(group):
            title = f"Figure {number}: {title} {CASES[case]}"
        for i, label in enumerate(labels):
            columns = {name: values.reshape(n, -1)[:, i] for name, values in lines.items()}
            drawn = [
                Line(name, column if starts is None else outline(column, starts), name.startswith(DESIRED))
                for name, column in columns.items()
                if not np.isnan(column).all()
            ]
            if drawn:
                panels.append(Panel(group, title, label, unit, drawn))
    return k * settings.loop.period, panels, 1 if starts is None else int(np.diff(starts, append=n).max())


def outline(values: Array, starts: Integers) -> Array:
    """The least and the largest value of each bucket that begins at `starts`, in the direction in which it goes.

    NaN counts only where a bucket has nothing else. Shapes (n,) and (buckets,); the outline's is (2·buckets,).
    """
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    falls = values[np.append(starts[1:], len(values)) - 1] < values[starts]
    return np.column_stack([np.where(falls, high, low), np.where(falls, low, high)]).ravel()


class StatePanels(NamedTuple):
    """How a part of the law's state is drawn."""

    name: str
    title: str
    labels: list[str]  # of its elements
    unit: str
    columns: slice  # of all of the state's elements, those of this part


def state_panels(settings: Settings) -> Iterator[StatePanels]:
    """The parts of the law's state that are drawn: all but the sign of the equilibrium. Raises LawError."""
    law = law_of(settings.law, settings.loop.period, settings.wire.actuators)
    at = 0
    for name, values in initial_state(law).items():
        columns = slice(at, at + len(values))
        at = columns.stop
        if name != "sign":
            symbol = {"damping_estimate": "θ̂"}.get(name, name)
            labels = [f"{symbol}{'₁₂₃₄₅₆₇₈₉'[i] if i < 9 else i + 1}" for i in range(len(values))]
            title = name.replace("_", " ").capitalize()
            yield StatePanels(name, title, labels, law.units.get(name, "1"), columns)


def _quantities(settings: Settings, ticks: Ticks, theorem: TheoremCheck, truths: Truths) -> Iterator[_Quantity]:
    desired, error, found = ticks.desired, ticks.attitude_error, theorem.findings

    def true(row: int) -> Array:
        """A row of the true states: interpolated between them, for drawing only, and NaN before the first."""
        if not len(theorem.true_k):
            return np.full(len(ticks.k), np.nan)
        return np.asarray(np.interp(ticks.k, theorem.true_k, theorem.true[row], left=np.nan))

    angles = np.unwrap(euler_deg(desired), period=360.0, axis=0)
    measured, actual = (
        angles + (euler_deg(q) - angles + 180.0) % 360.0 - 180.0  # ±360°, nearest to the desired angles
        for q in (ticks.attitude, np.column_stack([true(row) for row in range(2, 6)]))
    )
    lines = {"measured": measured, "desired": angles, "true": actual}
    yield "angles", "Roll, pitch and yaw", ("roll", "pitch", "yaw"), "°", lines
    lines = {"measured": of_nearer_sign(ticks.attitude, desired), "desired": desired}
    yield "attitude", "Attitude", ("η", "ε₁", "ε₂", "ε₃"), "1", lines
    lines = {"measured": ticks.rate, "desired": ticks.desired_rate}
    yield "rate", "Angular velocity", ("ω₁", "ω₂", "ω₃"), "rad/s", lines
    yield "error", "Attitude error", ("ε̃₁", "ε̃₂", "ε̃₃"), "1", {"measured": error}
    lines = {"measured": ticks.rate_error}
    yield "rate_error", "Angular velocity error", ("ω_e1", "ω_e2", "ω_e3"), "rad/s", lines
    inputs = ["u" + "₁₂₃₄₅₆₇₈"[i - 1] for i in settings.wire.motors]
    yield "input", "Input", inputs, "V", {"commanded": ticks.voltages}
    lines = {"measured": error_deg(error), "true": true(1)}
    yield "error_angle", "Attitude error, as an angle", ["angle"], "°", lines
    if not settings.loop.lockstep:
        yield "latency", "Loop latency", ["latency"], "ms", {"latency": ticks.latency_ns * 1e-6}
        yield "period", "Period between measurements", ["period"], "ms", {"period": periods_ns(ticks) * 1e-6}
    for drawn in state_panels(settings):
        lines = {"estimated": ticks.state[:, drawn.columns]}
        yield drawn.name, drawn.title, drawn.labels, drawn.unit, lines
    if found.holds is not None and len(theorem.true_k):
        period, until = settings.loop.period, inf if found.until_s is None else found.until_s
        lines = {"true": true(0)}
        if found.pointwise_radius is not None:
            judged = (ticks.k >= found.since_s / period) & (ticks.k < until / period)
            lines["bound, once within it"] = np.where(judged, found.pointwise_radius, np.nan)
        yield "theorem", "Error of Theorem 1", ["‖z‖"], "1", lines
    for signal, its in truths.signals.items():
        lines = {"true": np.asarray(np.interp(ticks.k, truths.k, its, left=np.nan))}  # for drawing only
        yield "signals", "The plant's own signals", [signal], "1", lines
