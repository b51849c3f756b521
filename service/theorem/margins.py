"""Margin: how much later a command may act until a certificate no longer holds.

A command is as old as its measurement until the next command replaces it: hold + delay + frames lost in a row · period.
So one bisection over the age gives both, the largest delay and the most frames lost.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

MOST_S: Final = 1.0
"""The search goes no further [s]."""
RESOLUTION_S: Final = 1e-5


def largest_delay(fails_after: Callable[[float], bool]) -> float:
    """The largest delay with which a certificate holds that does without any, within `RESOLUTION_S` below [s]."""
    low, high = 0.0, MOST_S
    if not fails_after(high):
        return high
    while high - low > RESOLUTION_S:
        middle = (low + high) / 2
        low, high = (low, middle) if fails_after(middle) else (middle, high)
    return low
