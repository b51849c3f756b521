"""Figures of merit of a review: their names, units and forms, and limits of them.

The limit `z_track=50e-4` holds if the figure is at most that, `theorem.held=1` if it is at least that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from aeroloop.protocol.errors import ConfigError
from aeroloop.service.figures import Figures
from aeroloop.service.review.report import Check, Findings


def seconds(value: float) -> str:
    """A time on the law's clock or a duration, to the millisecond: `12.346`."""
    return f"{round(value, 3) + 0.0:,.3f}".replace("-", "−")  # + 0.0: no minus before a zero


def percent(share: float) -> str:
    """A share 0…1 in percent: two significant digits under 1 %, and `0` only for exactly 0."""
    value = 100 * share
    return "0" if not value else f"{value:.2g}" if value < 1 else f"{value:.1f}"


_whole, _tenth, _hundredth = "{:,.0f}".format, "{:,.1f}".format, "{:,.2f}".format


class Figure(NamedTuple):
    """A figure of merit: its path in the findings, name, unit and form, and in a few words what a main one is."""

    path: str
    name: str
    unit: str
    text: Callable[[float], str] = _whole
    what: str = ""

    @property
    def main(self) -> bool:
        """Whether it is always shown."""
        return bool(self.what)

    @property
    def key(self) -> str:
        """Its name in `--json`."""
        return self.path.partition(".")[0]


FIGURES: Final = (
    Figure("z_track", "tracking error z_track", "×10⁻⁴ s", lambda z: _hundredth(z * 1e4),
           "∫ ε̃ᵀε̃ dt, ε̃ the attitude error as measured"),
    Figure("u_total", "control effort u_total", "V²·s", _tenth, "∫ uᵀu dt, u the voltages as sent"),
    Figure("max_error_deg", "largest attitude error", "°", _hundredth, "angle from measured to desired attitude"),
    Figure("final_error_deg", "final attitude error", "°", _hundredth, "at the last tick"),
    Figure("second_half_error_deg", "largest attitude error in the second half", "°", _hundredth),
    Figure("skipped_ticks", "skipped ticks", "", what="ticks without a command"),
    Figure("latency_us.p50", "loop latency p50", "µs", what="measurement sent to command received, median"),
    Figure("latency_us.p99", "loop latency p99", "µs"),
    Figure("latency_us.max", "loop latency, longest", "µs"),
    Figure("measurement.bits_per_s", "measurements", "bit/s", what="payload from plant to controller"),
    Figure("command.bits_per_s", "commands", "bit/s", what="payload from controller to plant"),
    Figure("gap_count", "gaps", ""),
    Figure("saturated.attitude", "attitude at the quantizer's limit", "%", percent),
    Figure("saturated.rate", "rate at the quantizer's limit", "%", percent),
    Figure("saturated.voltage", "voltage at the quantizer's limit", "%", percent),
    Figure("invalid", "frames without a valid value", ""),
    Figure("missing_ticks", "ticks that were not recorded", ""),
    Figure("lapses", "late, missed, malformed, stale, refused", ""),
    Figure("losses", "messages the recorder lost", ""),
    Figure("trips", "trips", ""),
    Figure("theorem.pointwise_share", "true ‖z‖ of its bound at every instant, at most", "%", percent),
    Figure("duration_s", "duration", "s", seconds),
)  # fmt: skip

_DURATIONS: Final = [
    *(f"latency_us.{percentile}" for percentile in ("p50", "p99", "p999", "max")),
    *(f"timing.{name}.{percentile}"
      for name in ("latency", "period", "measurement_delay", "command_delay")
      for percentile in ("p50", "p90", "p99", "p999", "max")),
]  # fmt: skip

LIMITED: Final = {
    **{figure.path: {"×10⁻⁴ s": "s", "%": ""}.get(figure.unit, figure.unit)
       for figure in FIGURES if figure.unit != "bit/s"},
    **dict.fromkeys(_DURATIONS, "µs"),
    "damages": "", "theorem.held": "", "theorem.pointwise_radius": "", "theorem.pointwise_deg": "°",
}  # fmt: skip
"""Figures that can have a limit, by their paths in `--json`, and the limit's unit."""

AT_LEAST: Final = ("theorem.held",)  # figures of which more is better

UNSEEN_SHOWN: Final = 3  # of what a figure does not see, so many are listed in its line


class LimitError(ConfigError):
    """Not a limit; one line with the correct form."""


def value_of(figures: Figures, path: str) -> float | None:
    """Value of a dotted path; None if unavailable. A list counts by its length, counts by name by their sum."""
    found: object = figures
    for part in path.split("."):
        found = found.get(part) if isinstance(found, dict) else getattr(found, part, None)
    if isinstance(found, list):
        return len(found)
    if isinstance(found, dict):
        return float(sum(found.values()))
    return found if isinstance(found, int | float) else None


class Limit(NamedTuple):
    """Upper limit of a figure, as `value_of` finds it; of those in AT_LEAST a lower limit."""

    path: str
    bound: float

    @classmethod
    def parse(cls, text: str) -> Limit:
        """A limit as the command line gives it. Raises LimitError."""
        path, equals, value = text.partition("=")
        if not equals or path not in LIMITED:
            raise LimitError(f"--require takes FIGURE=LIMIT, not {text!r}; figures are {', '.join(LIMITED)}")
        try:
            return cls(path, float(value))
        except ValueError:
            raise LimitError(f"--require {path} takes a number, not {value!r}") from None

    def holds(self, figures: Figures) -> bool:
        """Whether the figure is within the limit; an unavailable one is not."""
        value = value_of(figures, self.path)
        return value is not None and (value >= self.bound if self.path in AT_LEAST else value <= self.bound)

    def check(self, findings: Findings, limits: Sequence[Limit] = ()) -> Check:
        """Whether it holds, and what was found.

        It does not where ticks or parts of files are unseen, unless `limits` permit so many `missing_ticks`, `damages`.
        """
        value, unit = value_of(findings, self.path), LIMITED[self.path]
        space = "" if unit in ("", "°") else " "
        reasons = (why for key, why in findings.reasons.items() if f"{self.path}.".startswith(f"{key}."))
        found = next(reasons, "not known") if value is None else f"{value:.6g}{space}{unit}"
        if self.path == "theorem.held" and value is not None:
            found = "the run kept to all that is proven" if value else "the run broke what is proven"
        permitted = {limit.path for limit in limits if limit.holds(findings)}
        unseen = {figure: lines for figure, lines in findings.unseen.items() if lines and figure not in permitted}
        if self.holds(findings) and unseen:
            lines = [line for of_one in unseen.values() for line in of_one]
            more = f"; and {len(lines) - UNSEEN_SHOWN} more" if len(lines) > UNSEEN_SHOWN else ""
            permits = " ".join(f"--require {figure}={value_of(findings, figure):g}" for figure in unseen)
            found += f", but not seen: {'; '.join(lines[:UNSEEN_SHOWN])}{more} ({permits} permits it)"
        sign = "≥" if self.path in AT_LEAST else "≤"
        holds = self.holds(findings) and not unseen
        return Check(text=f"{self.path} {sign} {self.bound:g}{space}{unit}", holds=holds, found=found)


def broken_limits(findings: Findings) -> list[str]:
    """Limits that do not hold, a line each; one that seems to hold of a log that lacks something is one of them."""
    return [f"{check.text} does not hold: {check.found}" for check in findings.checks if not check.holds]
