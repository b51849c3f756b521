"""Item of the bench: a figure of ours beside its floor, measured in turns, with the aim of their ratio and a margin.

A floor is what the machine gives to the least program that does the same: a bare call, a bare ping-pong, cyclictest.
Both are measured in one run, in turns, so that a slow machine slows both; only their ratio is judged, never a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from aeroloop.protocol.errors import AeroloopError


class NotMeasuredError(AeroloopError):
    """This machine, or this length of run, cannot measure an item; one line with the reason."""


class Figure(NamedTuple):
    """A figure of ours and its floor, in the item's unit; a note stands below the table."""

    ours: float
    floor: float
    note: str = ""


class Margin(NamedTuple):
    """How much worse a ratio may be than an earlier one: `factor` times that, plus `slack`.

    Attributes:
        factor: On the earlier ratio [1].
        why: What makes the ratio vary by so much.
        slack: For ratios near 0 [1].
    """

    factor: float
    why: str
    slack: float = 0.0

    def limit(self, before: float) -> float:
        """The largest ratio that is not worse than `before`."""
        return before * self.factor + self.slack


class Item(NamedTuple):
    """A line of the table.

    Attributes:
        name: Its key in JSON. Items that share a first word are a group, which `--only` takes, too.
        unit: Of ours and floor.
        aim: The largest ratio that is wanted; None where there is none.
        margin: See `Margin`.
        measure: Measures it; its argument is whether the run is a quick one. Raises NotMeasuredError.
        what: Ours; the floor.
        quick: Whether a quick run measures it.
    """

    name: str
    unit: str
    aim: float | None
    margin: Margin
    measure: Callable[[bool], Figure]
    what: str
    quick: bool = True


def in_turns(
    ours: Callable[[], float],
    floor: Callable[[], float],
    rounds: int,
    of: Callable[[Iterable[float]], float] = min,
) -> Figure:
    """Both, `rounds` times one after the other.

    The least of each is the round that other work disturbed least: right for processor time. For waiting, take the
    median.
    """
    pairs = [(ours(), floor()) for _ in range(rounds)]
    each_ours, each_floor = zip(*pairs, strict=True)
    return Figure(of(each_ours), of(each_floor))
