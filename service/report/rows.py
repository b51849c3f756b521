"""Rows of figures of merit: a name, a unit, and each run's value in significant digits.

The page and the terminal show the same rows, so that a figure reads the same in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from aeroloop.service.review.report import Findings
from aeroloop.service.review.requirements import value_of


class Value(NamedTuple):
    """A figure of one run: its digits, or the reason why there are none; and the number."""

    text: str
    why: str | None = None
    number: float | None = None


class Delta(NamedTuple):
    """How a figure of one run differs from the same figure of the first run."""

    text: str
    word: str | None
    """`better`, `worse` or `same`; None where neither can be said."""


class Row(NamedTuple):
    """A figure of several runs.

    Attributes:
        key: Its name in `--json`.
        name: Its name for display.
        unit: Empty if it has none.
        values: One per run.
        figure: Its form.
        comparable: Whether less is better, run by run: sums are not comparable if runs last differently long.
    """

    key: str
    name: str
    unit: str
    values: list[Value]
    figure: _Figure
    comparable: list[bool]

    def delta(self, run: int) -> Delta | None:
        """Difference of a run to the first; None where either is unknown."""
        first, value = self.values[0].number, self.values[run].number
        if first is None or value is None:
            return None
        if self.values[0].text == self.values[run].text:
            return Delta("0", "same")
        apart = value - first
        sign = "+" if apart > 0 else "−"
        share = f" ({sign}{percent(abs(apart / first))} %)" if first else ""
        word = "better" if apart < 0 else "worse"
        return Delta(f"{sign}{self.figure.text(abs(apart))}{share}", word if self.comparable[run] else None)


class _Figure(NamedTuple):
    path: str
    """In the findings."""
    name: str
    unit: str
    text: Callable[[float], str]
    main: bool = False
    what: str = ""
    """What it is, in a few words."""
    less_is_better: bool = True
    sums_up: bool = False
    """Whether it grows with the run's duration."""


def micros(value: float) -> str:
    """A duration with its unit: `622 µs`, `1.42 ms`, `2.1 s`."""
    for scale, unit in ((1e6, "s"), (1e3, "ms")):
        if abs(value) >= scale:
            return f"{value / scale:.3g} {unit}" if abs(value) < 1e3 * scale else f"{value / scale:,.0f} {unit}"
    return f"{value:.3g} µs" if value < 100 else f"{value:.0f} µs"


def seconds(value: float) -> str:
    """A time on the law's clock or a duration, to the millisecond: `12.346`."""
    return f"{round(value, 3) + 0.0:,.3f}".replace("-", "−")  # + 0.0: no minus before a zero


def percent(share: float) -> str:
    """A share 0…1 in percent: two significant digits under 1 %, and `0` only for exactly 0."""
    value = 100 * share
    return "0" if not value else f"{value:.2g}" if value < 1 else f"{value:.1f}"


_whole, _tenth, _hundredth = "{:,.0f}".format, "{:,.1f}".format, "{:,.2f}".format
_fourth = "{:.4f}".format

THEOREM: Final = "theorem."
"""Prefix of the theorem's keys."""

FIGURES: Final = (
    _Figure("z_track", "tracking error z_track", "×10⁻⁴ s", lambda z: _hundredth(z * 1e4), True,
            "∫ ε̃ᵀε̃ dt, ε̃ the attitude error as measured", sums_up=True),
    _Figure("u_total", "control effort u_total", "V²·s", _tenth, True,
            "∫ uᵀu dt, u the voltages as sent", sums_up=True),
    _Figure("max_error_deg", "largest attitude error", "°", _hundredth, True,
            "angle from measured to desired attitude"),
    _Figure("final_error_deg", "final attitude error", "°", _hundredth, True, "at the last tick"),
    _Figure("skipped_ticks", "skipped ticks", "", _whole, True, "ticks without a command", sums_up=True),
    _Figure("latency_us.p50", "loop latency p50", "µs", _whole, True, "measurement sent to command received, median"),
    _Figure("latency_us.p99", "loop latency p99", "µs", _whole),
    _Figure("latency_us.max", "loop latency, longest", "µs", _whole),
    _Figure("age_us.p50", "age of measurements at the controller, p50", "µs", _whole),
    _Figure("age_us.p99", "age of measurements at the controller, p99", "µs", _whole),
    _Figure("measurement.frames_per_s", "measurements", "frames/s", _tenth, less_is_better=False),
    _Figure("measurement.bits_per_s", "measurements", "bit/s", _whole, True, "payload from plant to controller", False),
    _Figure("command.frames_per_s", "commands", "frames/s", _tenth, less_is_better=False),
    _Figure("command.bits_per_s", "commands", "bit/s", _whole, True, "payload from controller to plant", False),
    _Figure("gap_count", "gaps", "", _whole, sums_up=True),
    _Figure("saturated.attitude", "attitude at the quantizer's limit", "%", percent),
    _Figure("saturated.rate", "rate at the quantizer's limit", "%", percent),
    _Figure("saturated.voltage", "voltage at the quantizer's limit", "%", percent),
    _Figure("invalid", "frames without a valid value", "", _whole, sums_up=True),
    _Figure("missing_ticks", "ticks that were not recorded", "", _whole, sums_up=True),
    _Figure("lapses", "late, missed, malformed, stale, refused", "", _whole, sums_up=True),
    _Figure("losses", "messages the recorder lost", "", _whole, sums_up=True),
    _Figure("trips", "trips", "", _whole, sums_up=True),
    _Figure("theorem.held", "kept to all that could be judged: 1, or 0", "", _whole, less_is_better=False),
    _Figure("theorem.mean_square_share", "∫k‖z‖² of its bound V(t₀) + ∫δ_Q, at most", "%", percent),
    _Figure("theorem.pointwise_share", "true ‖z‖ of its bound at every instant, at most", "%", percent),
    _Figure("theorem.radius", "bound of ‖z‖ in the long run, root mean square", "", _fourth, less_is_better=False),
    _Figure("theorem.pointwise_radius", "bound of ‖z‖ at every instant, in the end", "", _fourth, less_is_better=False),
    _Figure("theorem.pointwise_deg", "attitude error within that bound", "°", _hundredth, less_is_better=False),
    _Figure("theorem.z_norm", "largest ‖z‖ after the transient", "", _fourth),
    _Figure("theorem.true_z_norm", "… of the true state", "", _fourth),
    _Figure("theorem.error_deg", "largest attitude error after the transient", "°", _hundredth),
    _Figure("theorem.true_error_deg", "… of the true state", "°", _hundredth),
    _Figure("theorem.broken", "inequalities of Lemma 1 broken", "", _whole, sums_up=True),
    _Figure("duration_s", "duration", "s", seconds, less_is_better=False),
)  # fmt: skip


def figure_rows(runs: Sequence[Findings]) -> list[Row]:
    """Main figures, and every other that at least one run has or has a reason for lacking."""
    rows = []
    apart = [abs(run.duration_s - runs[0].duration_s) > 0.01 * runs[0].duration_s for run in runs]
    for figure in FIGURES:
        path = figure.path
        key = path if path.startswith(THEOREM) else path.partition(".")[0]
        found = [(run, value_of(run, path)) for run in runs]
        values = [Value("–", run.reasons.get(key)) if v is None else Value(figure.text(v), None, v) for run, v in found]
        if figure.main or any(value.text != "–" or value.why for value in values):
            comparable = [figure.less_is_better and not (figure.sums_up and differ) for differ in apart]
            rows.append(Row(key, figure.name, figure.unit, values, figure, comparable))
    return rows
