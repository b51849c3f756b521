"""One-way delays: how long a frame took each way, from the four times of a tick on two unrelated clocks.

    forward  = received by the controller − sent by the plant      = delay of the measurement + offset
    backward = received by the plant − sent by the controller      = delay of the command     − offset

The offset (controller's monotonic clock minus the plant's) is half their difference if both ways are equally fast. It
is fitted by a straight line over windows of 512 ticks, through the half with the shortest round trips. Why: queues and
hitches only lengthen a delay. A difference of the medians stays in both delays, with opposite signs.
"""

from __future__ import annotations

from itertools import pairwise
from math import nan
from typing import Final

import numpy as np

from aeroloop.service.logs.traces import Array

WINDOW: Final = 512
"""Ticks per fit; two crystals drift apart by less than 1 µs per second."""
_LEAST: Final = 16


class ClockOffset:
    """Estimates the offset between both ends' clocks, block by block; keeps that of the first and the last tick."""

    def __init__(self) -> None:
        self.first_ns = self.last_ns = nan

    def at(self, forward: Array, backward: Array) -> Array:
        """The offset at ticks in order [ns]; NaN before the first estimate. Shapes (n,).

        `forward` and `backward` are as above, NaN where a time is unknown [ns].
        """
        found = np.empty(len(forward))
        edges = [*range(0, max(1, len(forward) - WINDOW // 2), WINDOW), len(forward)]
        for begin, end in pairwise(edges):
            found[begin:end] = self.last_ns
            there, back = forward[begin:end], backward[begin:end]
            known = np.flatnonzero(~np.isnan(there + back))
            if len(known) >= _LEAST:
                # Differences to a base are small; products of times since boot would exceed a double's digits.
                base = there[known[0]]
                trip = (there - base) + (back + base)
                quick = known[trip[known] <= np.median(trip[known])]
                offset = ((there - base) - (back + base))[quick] / 2
                apart, middle = quick - quick.mean(), offset.mean()
                spread = float(apart @ apart) if quick[-1] - quick[0] >= WINDOW // 4 else 0.0
                slope = float(apart @ (offset - middle)) / spread if spread else 0.0
                found[begin:end] = base + middle + slope * (np.arange(end - begin) - quick.mean())
                self.last_ns = float(found[end - 1])
        known_ns = found[~np.isnan(found)]
        if self.first_ns != self.first_ns and len(known_ns):
            self.first_ns = float(known_ns[0])
        return found
