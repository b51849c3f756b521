"""Rows of figures of merit: a name, a unit, and each run's value in significant digits.

The page and the terminal show the same rows, so that a figure reads the same in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from aeroloop.service.review.report import Findings


class Value(NamedTuple):
    """A figure of one run: its digits, or the reason why there are none."""

    text: str
    why: str | None = None


class Row(NamedTuple):
    """A figure of several runs.

    Attributes:
        key: Its name in `--json`.
        name: Its name for display.
        unit: Empty if it has none.
        values: One per run.
        main: Whether it is a main figure.
    """

    key: str
    name: str
    unit: str
    values: list[Value]
    main: bool = False


class _Figure(NamedTuple):
    key: str
    name: str
    unit: str
    text: Callable[[Findings], str | None]
    main: bool = False


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


def _digits(form: str, scale: float = 1.0) -> Callable[[float | None], str | None]:
    return lambda value: None if value is None else format(value * scale, form)


def _latency(name: str) -> Callable[[Findings], str | None]:
    return lambda f: None if f.latency_us is None else f"{getattr(f.latency_us, name):,.0f}"


def _age(name: str) -> Callable[[Findings], str | None]:
    return lambda f: None if f.age_us is None or name not in f.age_us else f"{f.age_us[name]:,.0f}"


def _saturated(name: str) -> Callable[[Findings], str | None]:
    return lambda f: percent(f.saturated[name]) if name in f.saturated else None


def _theorem(name: str, form: str) -> Callable[[Findings], str | None]:
    return lambda f: None if f.theorem is None else _digits(form)(getattr(f.theorem, name))


_whole, _tenth, _hundredth = _digits(",.0f"), _digits(",.1f"), _digits(",.2f")
_z_track = _digits(",.2f", 1e4)

THEOREM: Final = "theorem."
"""Prefix of the theorem's keys."""

FIGURES: Final = (
    _Figure("z_track", "z_track", "10⁻⁴ s", lambda f: _z_track(f.z_track), main=True),
    _Figure("u_total", "u_total", "V²·s", lambda f: _tenth(f.u_total), main=True),
    _Figure("max_error_deg", "largest attitude error", "°", lambda f: _hundredth(f.max_error_deg), main=True),
    _Figure("final_error_deg", "final attitude error", "°", lambda f: _hundredth(f.final_error_deg), main=True),
    _Figure("skipped_ticks", "skipped ticks", "", lambda f: _whole(f.skipped_ticks), main=True),
    _Figure("latency_us", "loop latency, p50", "µs", _latency("p50"), main=True),
    _Figure("latency_us", "loop latency, p99", "µs", _latency("p99"), main=True),
    _Figure("latency_us", "loop latency, longest", "µs", _latency("max")),
    _Figure("age_us", "age when used, p50", "µs", _age("p50")),
    _Figure("age_us", "age when used, p99", "µs", _age("p99")),
    _Figure("measurement", "measurements", "frames/s", lambda f: _tenth(f.measurement.frames_per_s)),
    _Figure("measurement", "measurements", "bit/s", lambda f: _whole(f.measurement.bits_per_s), main=True),
    _Figure("command", "commands", "frames/s", lambda f: _tenth(f.command.frames_per_s)),
    _Figure("command", "commands", "bit/s", lambda f: _whole(f.command.bits_per_s), main=True),
    _Figure("gap_count", "gaps", "", lambda f: _whole(f.gap_count)),
    _Figure("saturated", "attitude at its outermost level", "%", _saturated("attitude")),
    _Figure("saturated", "rate at its outermost level", "%", _saturated("rate")),
    _Figure("saturated", "voltage at its outermost level", "%", _saturated("voltage")),
    _Figure("invalid", "frames without a valid value", "", lambda f: _whole(sum(f.invalid.values()))),
    _Figure("missing_ticks", "ticks that were not recorded", "", lambda f: _whole(sum(f.missing_ticks.values()))),
    _Figure("lapses", "late, missed, malformed, stale, refused", "", lambda f: _whole(sum(f.lapses.values()))),
    _Figure("losses", "messages the recorder lost", "", lambda f: _whole(sum(f.losses.values()))),
    _Figure("trips", "trips", "", lambda f: _whole(len(f.trips))),
    _Figure("theorem.radius", "‖z‖ that the theorem guarantees in the end", "", _theorem("radius", ".4f")),
    _Figure("theorem.z_norm", "largest ‖z‖ after the transient", "", _theorem("z_norm", ".4f")),
    _Figure("theorem.true_z_norm", "… of the true state", "", _theorem("true_z_norm", ".4f")),
    _Figure("theorem.radius_deg", "attitude error that is guaranteed", "°", _theorem("radius_deg", ",.2f")),
    _Figure("theorem.error_deg", "largest attitude error after the transient", "°", _theorem("error_deg", ",.2f")),
    _Figure("theorem.true_error_deg", "… of the true state", "°", _theorem("true_error_deg", ",.2f")),
    _Figure("theorem.broken", "inequalities of Lemma 1 broken", "", _theorem("broken", ",.0f")),
    _Figure("duration_s", "duration", "s", lambda f: seconds(f.duration_s)),
)


def figure_rows(runs: Sequence[Findings]) -> list[Row]:
    """Main figures, and every other that at least one run has or has a reason for lacking."""
    rows = []
    for key, name, unit, text, main in FIGURES:
        values = [_value(run, key, text(run)) for run in runs]
        if main or any(value.text != "–" or value.why for value in values):
            rows.append(Row(key, name, unit, values, main))
    return rows


def _value(run: Findings, key: str, text: str | None) -> Value:
    return Value("–", run.reasons.get(key)) if text is None else Value(text)
