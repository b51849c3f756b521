"""Figures of merit of a review: their names, units and forms, and limits of them.

The limit `z_track=50e-4` holds if the figure is at most that, `theorem=1` if it is at least that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
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
_fourth = "{:.4f}".format


class Figure(NamedTuple):
    """Form of a figure of merit.

    `path` leads to it in the findings, `what` says in a few words what it is, `main` figures are always shown, and
    those that add up over time (`sums_up`) are comparable only between runs of the same duration. A limit of it is in
    `limit_unit`, or in `unit` if that is None.
    """

    path: str
    name: str
    unit: str
    text: Callable[[float], str]
    main: bool = False
    what: str = ""
    less_is_better: bool = True
    sums_up: bool = False
    limit_unit: str | None = None

    @property
    def key(self) -> str:
        """Its name in `--json`."""
        return self.path.partition(".")[0]


FIGURES: Final = (
    Figure("z_track", "tracking error z_track", "×10⁻⁴ s", lambda z: _hundredth(z * 1e4), True,
            "∫ ε̃ᵀε̃ dt, ε̃ the attitude error as measured", sums_up=True, limit_unit="s"),
    Figure("u_total", "control effort u_total", "V²·s", _tenth, True,
            "∫ uᵀu dt, u the voltages as sent", sums_up=True),
    Figure("max_error_deg", "largest attitude error", "°", _hundredth, True,
            "angle from measured to desired attitude"),
    Figure("final_error_deg", "final attitude error", "°", _hundredth, True, "at the last tick"),
    Figure("second_half_error_deg", "largest attitude error in the second half", "°", _hundredth),
    Figure("skipped_ticks", "skipped ticks", "", _whole, True, "ticks without a command", sums_up=True),
    Figure("latency_us.p50", "loop latency p50", "µs", _whole, True, "measurement sent to command received, median"),
    Figure("latency_us.p99", "loop latency p99", "µs", _whole),
    Figure("latency_us.max", "loop latency, longest", "µs", _whole),
    Figure("age_us.p50", "age of measurements at the controller, p50", "µs", _whole),
    Figure("age_us.p99", "age of measurements at the controller, p99", "µs", _whole),
    Figure("measurement.frames_per_s", "measurements", "frames/s", _tenth, less_is_better=False),
    Figure("measurement.bits_per_s", "measurements", "bit/s", _whole, True, "payload from plant to controller", False),
    Figure("command.frames_per_s", "commands", "frames/s", _tenth, less_is_better=False),
    Figure("command.bits_per_s", "commands", "bit/s", _whole, True, "payload from controller to plant", False),
    Figure("gap_count", "gaps", "", _whole, sums_up=True),
    Figure("saturated.attitude", "attitude at the quantizer's limit", "%", percent, limit_unit=""),
    Figure("saturated.rate", "rate at the quantizer's limit", "%", percent, limit_unit=""),
    Figure("saturated.voltage", "voltage at the quantizer's limit", "%", percent, limit_unit=""),
    Figure("invalid", "frames without a valid value", "", _whole, sums_up=True),
    Figure("missing_ticks", "ticks that were not recorded", "", _whole, sums_up=True),
    Figure("lapses", "late, missed, malformed, stale, refused", "", _whole, sums_up=True),
    Figure("losses", "messages the recorder lost", "", _whole, sums_up=True),
    Figure("trips", "trips", "", _whole, sums_up=True),
    Figure("theorem.held", "kept to all that could be judged: 1, or 0", "", _whole, less_is_better=False),
    Figure("theorem.pointwise_share", "true ‖z‖ of its bound at every instant, at most", "%", percent, limit_unit=""),
    Figure("theorem.pointwise_radius", "bound of ‖z‖ at every instant, in the end", "", _fourth, less_is_better=False),
    Figure("theorem.pointwise_deg", "attitude error within that bound", "°", _hundredth, less_is_better=False),
    Figure("theorem.broken", "inequalities of Lemma 1 broken", "", _whole, sums_up=True),
    Figure("duration_s", "duration", "s", seconds, less_is_better=False),
)  # fmt: skip

_TIMING: Final = [
    f"timing.{name}.{percentile}"
    for name in ("latency", "period", "measurement_delay", "command_delay")
    for percentile in ("p50", "p90", "p99", "p999", "max")
]

UNITS: Final = {
    **{
        figure.path: figure.unit if figure.limit_unit is None else figure.limit_unit
        for figure in FIGURES
        if figure.key not in ("measurement", "command")
    },
    **dict.fromkeys(("latency_us.p999", "age_us.max", *_TIMING), "µs"),
    "damages": "",
}
"""Figures that can have a limit, by their names in the findings, and the limit's unit."""

SHORT: Final[dict[str, str]] = {
    "skipped": "skipped_ticks",
    "gaps": "gap_count",
    "theorem": "theorem.held",
    "lemma_broken": "theorem.broken",
    **{path.partition(".")[2]: path for path in UNITS if path.startswith(("timing.", "theorem.pointwise_"))},
    **{path.replace("_us", ""): path for path in UNITS if path.startswith("age_us.")},
}
"""Other names for some of them."""

NAMES: Final = (*(name for name in UNITS if not name.startswith(("timing.", "age_us.", "theorem."))), *SHORT)
"""Names that `--require` lists."""

UNSEEN_SHOWN: Final = 3
"""Of what a figure does not see, so many are listed in its line."""

AT_LEAST: Final = ("theorem.held",)
"""Figures of which more is better."""


class LimitError(AeroloopError):
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

    figure: str
    bound: float

    @classmethod
    def parse(cls, text: str) -> Limit:
        """A limit as the command line gives it. Raises LimitError."""
        name, equals, value = text.partition("=")
        if not equals or not (name in SHORT or name in UNITS):
            raise LimitError(f"--require takes FIGURE=LIMIT, not {text!r}; figures are {', '.join(NAMES)}")
        try:
            return cls(name, float(value))
        except ValueError:
            raise LimitError(f"--require {name} takes a number, not {value!r}") from None

    @property
    def path(self) -> str:
        """The figure's name in the findings."""
        return SHORT.get(self.figure, self.figure)

    def holds(self, figures: Figures) -> bool:
        """Whether the figure is within the limit; an unavailable one is not."""
        value = value_of(figures, self.path)
        return value is not None and (value >= self.bound if self.path in AT_LEAST else value <= self.bound)

    def check(self, findings: Findings, limits: Sequence[Limit] = ()) -> Check:
        """Whether it holds, and what was found.

        A limit that seems to hold does not where ticks or parts of files are unseen, unless `limits`, which are
        required together with it, permit as many `missing_ticks` or `damages`.
        """
        value, unit = value_of(findings, self.path), UNITS[self.path]
        space = "" if unit in ("", "°") else " "
        reasons = (why for key, why in findings.reasons.items() if f"{self.path}.".startswith(f"{key}."))
        found = next(reasons, "not known") if value is None else f"{value:.6g}{space}{unit}"
        permitted = {limit.path for limit in limits if limit.holds(findings)}
        unseen = {figure: lines for figure, lines in findings.unseen.items() if lines and figure not in permitted}
        if self.holds(findings) and unseen:
            lines = [line for of_one in unseen.values() for line in of_one]
            more = f"; and {len(lines) - UNSEEN_SHOWN} more" if len(lines) > UNSEEN_SHOWN else ""
            permits = " ".join(f"--require {figure}={value_of(findings, figure):g}" for figure in unseen)
            found += f", but not seen: {'; '.join(lines[:UNSEEN_SHOWN])}{more} ({permits} permits it)"
        return Check(
            text=f"{self.figure} {'≥' if self.path in AT_LEAST else '≤'} {self.bound:g}{space}{unit}",
            holds=self.holds(findings) and not unseen,
            found=found,
        )


def broken_limits(findings: Findings) -> list[str]:
    """Limits that do not hold, a line each; one that seems to hold of a log that lacks something is one of them."""
    return [f"{check.text} does not hold: {check.found}" for check in findings.checks if not check.holds]
