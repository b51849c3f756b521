"""Limits that figures are held to: `z_track=50e-4` holds if the figure is at most that."""

from __future__ import annotations

from typing import Final, NamedTuple

from protocol.errors import AeroloopError
from service.figures import Figures

NAMES: Final = (
    "duration_s",
    "z_track",
    "u_total",
    "max_error_deg",
    "final_error_deg",
    "skipped_ticks",
    "latency_us.p50",
    "latency_us.p99",
    "latency_us.max",
    "trips",
)


class LimitError(AeroloopError):
    """Not a limit; one line that says how to write one."""


class Limit(NamedTuple):
    """The most that a figure may be. `trips` counts them."""

    figure: str
    most: float

    @classmethod
    def parse(cls, text: str) -> Limit:
        """A limit as the command line gives it. Raises LimitError."""
        name, equals, value = text.partition("=")
        if not equals or name not in NAMES:
            raise LimitError(f"--require takes FIGURE=LIMIT, not {text!r}; figures are {', '.join(NAMES)}")
        try:
            return cls(name, float(value))
        except ValueError:
            raise LimitError(f"--require {name} takes a number, not {value!r}") from None

    def broken(self, figures: Figures) -> str | None:
        """Why it does not hold, in a line; None if it does. A figure that could not be had does not hold."""
        value: object = figures
        for part in self.figure.split("."):
            value = getattr(value, part, None)
        if isinstance(value, list):
            value = len(value)
        if not isinstance(value, int | float):
            return f"{self.figure} is not known, so it is not at most {self.most:g}"
        return None if value <= self.most else f"{self.figure} is {value:.6g}, more than {self.most:g}"
