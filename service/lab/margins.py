"""Margins of any law on any plant: the delay of commands and the loss of frames that a loop survives.

Runs go frame by frame, without a watchdog: commands act later, or of some in a row none acts, again and again, until
the attitude error in the second half of a run leaves a bound or the plant trips.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from math import inf
from typing import Final

from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.errors import AeroloopError
from aeroloop.service.config import Settings, with_law_settings
from aeroloop.service.lab.engine import Row
from aeroloop.service.lab.experiment import run_experiment

WITHIN_DEG: Final = 10.0
"""An attitude error up to this counts as survived: twice what the laws of this project reach in wind [deg]."""
LONGEST_S: Final = 10.0
"""Length of a run with delay or lost frames, at most [s]."""
_OLDEST_S: Final = 1.0
"""No search goes beyond this age of a command [s]."""


def survived(settings: Settings, duration_s: float = LONGEST_S) -> Row:
    """The longest delay [ms], and the most frames lost in a row, with which the error stays within the bound.

    None if none is. It looks no further than a second, in runs of `duration_s`, but no longer than `LONGEST_S`.
    """
    settings = with_law_settings(settings)
    length = min(duration_s, LONGEST_S)
    most, guess = settings.loop.ticks(_OLDEST_S), settings.loop.ticks(0.1)
    delay = last_good(lambda ticks: largest_error_deg(settings, length, delay=ticks) <= WITHIN_DEG, guess, most)
    lost = last_good(lambda ticks: largest_error_deg(settings, length, lost=ticks) <= WITHIN_DEG, guess, most)
    delay_ms = None if delay is None else round(delay * settings.loop.period * 1e3, 6)
    return {"delay_ms": delay_ms, "lost_frames": lost}


def last_good(good: Callable[[int], bool], guess: int, most: int) -> int | None:
    """The last number that is good, if all larger ones are not, by bisection from a guess.

    None if 0 is not good, `most` if none is found to be bad by doubling the guess up to it.
    """
    low, high = 0, max(1, guess)
    while good(high):
        low, high = high, 2 * high
        if high > most:
            return most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if good(middle) else (low, middle)
    return low if low or good(0) else None


def largest_error_deg(settings: Settings, duration_s: float, delay: int = 0, lost: int = 0) -> float:
    """The largest attitude error in the second half of a run [deg]; infinite if the plant trips or the law fails."""
    try:
        with closing(Late(settings.plant.make(settings.loop.period), delay, lost)) as plant:
            found = run_experiment(settings, duration_s, plant=plant).second_half_error_deg
    except (AeroloopError, ValueError):
        return inf
    return inf if found is None else found


class Late(Plant):
    """A plant whose commands act `delay` ticks later, and of which `lost` in a row never do."""

    def __init__(self, plant: Plant, delay: int, lost: int) -> None:
        self.actuators = plant.actuators
        self._plant, self._every = plant, lost + 1
        self._due = deque([(0.0,) * plant.actuators] * delay)
        self._ticks = 0

    def actuate(self, voltages: Sequence[float]) -> None:
        """Take the command of a tick; the one that is due replaces the one in force."""
        self._due.append(tuple(voltages))
        due = self._due.popleft()
        if self._ticks % self._every == 0:
            self._plant.actuate(due)
        self._ticks += 1

    def advance(self) -> None:
        """Integrate one period."""
        self._plant.advance()

    def measure(self) -> Measurement:
        """Sensor values at the end of the last period."""
        return self._plant.measure()

    def close(self) -> None:
        """0 V."""
        self._plant.close()
