"""Margins: what a loop survives is the last step before the bound, of commands that act late or never."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.service.config import load
from aeroloop.service.lab.margins import WITHIN_DEG, Late, largest_error_deg, survived
from tests.support.failing_laws import FAILING

SLOW = load(overrides=["loop.rate_hz=100", "law.kind=pd"])
S = 4.0


def test_what_a_law_survives_is_the_last_step_before_the_bound() -> None:
    found = survived(SLOW, S)
    ticks, frames = round(found["delay_ms"] / 10), found["lost_frames"]
    assert ticks > 0
    assert frames > 0
    for kept, too_late in (((ticks, 0), (ticks + 1, 0)), ((0, frames), (0, frames + 1))):
        errors = [largest_error_deg(SLOW, S, *late) for late in (kept, too_late)]
        assert errors[0] <= WITHIN_DEG < errors[1]


def test_a_law_that_runs_away_survives_nothing() -> None:
    runaway = load(overrides=["loop.rate_hz=100", f"law.kind={FAILING}:Runaway"])
    assert survived(runaway, S) == {"delay_ms": None, "lost_frames": None}


class Recording(EmulatedPlant):
    """Keeps what is in force in every period."""

    def __init__(self) -> None:
        self.actuators, self.periods = 3, list[float]()
        self.in_force: tuple[float, ...] = (0.0,)

    def actuate(self, voltages: Sequence[float]) -> None:
        self.in_force = tuple(voltages)

    def advance(self) -> None:
        self.periods.append(self.in_force[0])


@pytest.mark.parametrize(
    ("delay", "lost", "in_force"),
    [
        (0, 0, [1, 2, 3, 4, 5, 6, 7]),
        (2, 0, [0, 0, 1, 2, 3, 4, 5]),
        (0, 2, [1, 1, 1, 4, 4, 4, 7]),
        (1, 1, [0, 0, 2, 2, 4, 4, 6]),
    ],
)
def test_a_command_acts_late_or_until_the_next_that_is_not_lost(delay: int, lost: int, in_force: list[float]) -> None:
    body = Recording()
    plant = Late(body, delay, lost)
    for k in range(1, 8):
        plant.actuate([float(k)] * 3)
        plant.advance()
    assert body.periods == in_force
