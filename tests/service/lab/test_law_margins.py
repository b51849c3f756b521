"""Margins of a law: commands act late, or not at all, and the search finds where that fails."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.service.lab.law_margins import Late, least


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


@pytest.mark.parametrize("first", [0, 1, 2, 9, 10, 11, 37, 80, 81, 1000])
def test_the_search_finds_the_first_number_that_fails(first: int) -> None:
    assert least(lambda ticks: ticks >= first, guess=10, most=100) == (first if first <= 80 else None)
