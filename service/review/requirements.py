"""Limits of figures: `z_track=50e-4` holds if the figure is at most that, `theorem=1` if it is at least that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.figures import Figures
from aeroloop.service.review.report import Check, Findings

_SPREADS: Final = ("latency", "period", "measurement_delay", "command_delay")
_THEOREM: Final = ("z_norm", "true_z_norm", "radius", "pointwise_radius", "mean_square_share", "pointwise_share")
_PERCENTILES: Final = ("p50", "p90", "p99", "p999", "max")

UNITS: Final[dict[str, str]] = {
    "duration_s": "s",
    "z_track": "s",
    "u_total": "V²·s",
    "max_error_deg": "°",
    "final_error_deg": "°",
    **dict.fromkeys(["skipped_ticks", "trips", "gap_count", "losses", "lapses", "missing_ticks"], ""),
    **dict.fromkeys(["invalid", "damages"], ""),
    **{f"latency_us.{name}": "µs" for name in ("p50", "p99", "p999", "max")},
    **{f"timing.{spread}.{name}": "µs" for spread in _SPREADS for name in _PERCENTILES},
    **{f"age_us.{name}": "µs" for name in ("p50", "p99", "max")},
    **{f"saturated.{name}": "" for name in ("attitude", "rate", "voltage")},
    **{f"theorem.{name}": "" for name in (*_THEOREM, "held", "broken")},
    **{f"theorem.{name}": "°" for name in ("error_deg", "true_error_deg", "pointwise_deg")},
}
"""Figures that can have a limit, by their names in the findings, and their units."""

SHORT: Final[dict[str, str]] = {
    "skipped": "skipped_ticks",
    "gaps": "gap_count",
    **{f"{name}.{p}": f"timing.{name}.{p}" for name in _SPREADS for p in _PERCENTILES},
    "theorem": "theorem.held",
    **{name: f"theorem.{name}" for name in (*_THEOREM, "pointwise_deg")},
    "settled_error_deg": "theorem.error_deg",
    "true_settled_error_deg": "theorem.true_error_deg",
    "lemma_broken": "theorem.broken",
    **{f"age.{name}": f"age_us.{name}" for name in ("p50", "p99", "max")},
}
"""Other names for some of them."""

UNSEEN_SHOWN: Final = 3
"""Of what a figure does not see, so many are listed in its line."""

AT_LEAST: Final = ("theorem.held",)
"""Figures of which more is better."""

NAMES: Final = (*(name for name in UNITS if not name.startswith(("timing.", "age_us.", "theorem."))), *SHORT)


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

    def value(self, figures: Figures) -> float | None:
        """The figure's value; None if it is unavailable."""
        return value_of(figures, self.path)

    def holds(self, figures: Figures) -> bool:
        """Whether the figure is within the limit; an unavailable one is not."""
        value = self.value(figures)
        return value is not None and (value >= self.bound if self.path in AT_LEAST else value <= self.bound)

    def unseen(self, findings: Findings, limits: Sequence[Limit]) -> str:
        """What the figure does not see, in words, if it seems to hold; empty where all was seen, or is permitted.

        A limit of `missing_ticks` or `damages` among `limits` permits as many.
        """
        permitted = {limit.path for limit in limits if limit.holds(findings)}
        found = {figure: lines for figure, lines in findings.unseen.items() if lines and figure not in permitted}
        if not self.holds(findings) or not found:
            return ""
        lines = [line for of_one in found.values() for line in of_one]
        more = f"; and {len(lines) - UNSEEN_SHOWN} more" if len(lines) > UNSEEN_SHOWN else ""
        permits = " ".join(f"--require {figure}={value_of(findings, figure):g}" for figure in found)
        return f", but not seen: {'; '.join(lines[:UNSEEN_SHOWN])}{more} ({permits} permits it)"

    def check(self, findings: Findings, limits: Sequence[Limit] = ()) -> Check:
        """Whether it holds, and what was found, required together with `limits`."""
        value, unseen, unit = self.value(findings), self.unseen(findings, limits), UNITS[self.path]
        space = "" if unit in ("", "°") else " "
        reasons = (why for key, why in findings.reasons.items() if f"{self.path}.".startswith(f"{key}."))
        found = next(reasons, "not known") if value is None else f"{value:.6g}{space}{unit}"
        return Check(
            text=f"{self.figure} {'≥' if self.path in AT_LEAST else '≤'} {self.bound:g}{space}{unit}",
            holds=self.holds(findings) and not unseen,
            found=found + unseen,
        )


def broken_limits(findings: Findings) -> list[str]:
    """Limits that do not hold, a line each; one that seems to hold of a log that lacks something is one of them."""
    return [f"{check.text} does not hold: {check.found}" for check in findings.checks if not check.holds]
