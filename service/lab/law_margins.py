"""Margins of any law: the delay of commands, and the lost frames, with which the attitude error stays within a bound.

Runs of the configured plant, frame by frame and without a watchdog; a bisection looks for the largest of each.
"""

from __future__ import annotations

from math import degrees, inf
from typing import Any, Final

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.config import Settings, with_law_settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.lab.experiment import run_experiment
from aeroloop.service.lab.margins import OLDEST_S, Late, least

PUSHED_S: Final = 10.0
"""Length of a run with delay or lost frames [s]."""


def survives(config: dict[str, Any], lost: bool, within_deg: float) -> int | None:
    """The most ticks of delay, or frames lost in a row, with which the error stays within the bound; None if none is.

    It looks no further than a second.
    """
    settings = with_law_settings(Settings.model_validate(config))

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
