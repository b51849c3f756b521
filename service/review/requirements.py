"""Limits of figures: `z_track=50e-4` holds if the figure is at most that, `theorem=1` if it is at least that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.figures import Figures
from aeroloop.service.review.report import Check, Findings

_DURATIONS: Final = [
    f"{name}.{percentile}"
    for name in ("latency", "period", "measurement_delay", "command_delay")
    for percentile in ("p50", "p90", "p99", "p999", "max")
]
_AGES: Final = [f"age_us.{percentile}" for percentile in ("p50", "p99", "max")]
_THEOREM: Final = ("pointwise_radius", "pointwise_share", "pointwise_deg")
_BY_UNIT: Final[dict[str, Sequence[str]]] = {
    "s": ["duration_s", "z_track"],
    "V²·s": ["u_total"],
    "°": ["max_error_deg", "final_error_deg", "second_half_error_deg", "theorem.pointwise_deg"],
    "": [
        *("skipped_ticks", "trips", "gap_count", "losses", "lapses", "missing_ticks", "invalid", "damages"),
        *(f"saturated.{name}" for name in ("attitude", "rate", "voltage")),
        *(f"theorem.{name}" for name in ("pointwise_radius", "pointwise_share", "held", "broken")),
    ],
    "µs": [
        *(f"latency_us.{name}" for name in ("p50", "p99", "p999", "max")),
        *(f"timing.{name}" for name in _DURATIONS),
        *_AGES,
    ],
}

UNITS: Final = {name: unit for unit, names in _BY_UNIT.items() for name in names}
"""Figures that can have a limit, by their names in the findings, and their units."""

SHORT: Final[dict[str, str]] = {
    "skipped": "skipped_ticks",
    "gaps": "gap_count",
    **{name: f"timing.{name}" for name in _DURATIONS},
    "theorem": "theorem.held",
    **{name: f"theorem.{name}" for name in _THEOREM},
    "lemma_broken": "theorem.broken",
    **{path.replace("_us", ""): path for path in _AGES},
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
