"""Margins of any law: the delay of commands, and the lost frames, with which the attitude error stays within a bound.

Runs of the configured plant, frame by frame and without a watchdog; a bisection looks for the largest of each.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import degrees, inf
from typing import Final

from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.config import Settings, with_law_settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.lab.experiment import run_experiment

OLDEST_S: Final = 1.0
"""No search goes beyond this age of a command [s]."""
PUSHED_S: Final = 10.0
"""Length of a run with delay or lost frames [s]."""


def survived(settings: Settings, within_deg: float) -> dict[str, float | int | None]:
    """The longest delay [ms], and the most frames lost in a row, with which the error stays within the bound.

    None if none is. It looks no further than a second.
    """
    settings = with_law_settings(settings)
    delay, lost = _most(settings, within_deg, lost=False), _most(settings, within_deg, lost=True)
    delay_ms = None if delay is None else round(delay * settings.loop.period * 1e3, 6)
    return {"delay_ms": delay_ms, "lost_frames": lost}


def _most(settings: Settings, within_deg: float, *, lost: bool) -> int | None:
    def fails(ticks: int) -> bool:
        late = {"lost": ticks, "delay": 0} if lost else {"lost": 0, "delay": ticks}
        return largest_error_deg(settings, **late) > within_deg

    most = settings.loop.ticks(OLDEST_S)
    first = least(fails, settings.loop.ticks(0.1), most)
    return most if first is None else first - 1 if first else None


def largest_error_deg(settings: Settings, delay: int, lost: int) -> float:
    """The largest attitude error in the second half of a run [deg]; infinite if the plant trips or the law fails."""
    loop = settings.loop
    controller = Controller(settings.wire, settings.law, settings.reference, loop.period)
    plant = Late(settings.plant.make(loop.period), delay, lost)
    errors = [0.0]

    def watch(k: int, _measurement: bytes, _command: bytes) -> None:
        if 2 * k >= loop.ticks(PUSHED_S):
            errors.append(angle(*controller.attitude_error))

    try:
        run_experiment(settings, PUSHED_S, watch=watch, plant=plant, controller=controller)
    except (AeroloopError, ValueError):
        return inf
    return degrees(max(errors))


def least(fails: Callable[[int], bool], guess: int, most: int) -> int | None:
    """The least number that fails, if all larger ones do, by bisection from a guess; None if none up to `most` does."""
    low, high = 0, max(1, guess)
    while not fails(high):
        low, high = high, 2 * high
        if high > most:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fails(middle) else (middle, high)
    return 0 if high == 1 and fails(0) else high


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
