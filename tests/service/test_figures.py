"""Figures of merit that no log test states by number."""

from __future__ import annotations

from math import degrees, nan

import numpy as np
import pytest

from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.config import Settings
from aeroloop.service.figures import Score


def test_the_second_half_leaves_out_what_was_before_it_and_changes_count_motors() -> None:
    score = Score(Settings().wire, 0.5)
    sizes = [0.3, 0.1, 0.05, 0.01, 0.02, 0.0, 0.04, 0.03]  # two a second: four seconds
    voltages = [[1, 1], [1, 1], [2, 3], [nan, 3], [nan, nan], [nan, nan], [0.0, -0.0], [-0.0, 0.0]]
    score.errors(np.arange(8), np.array([[0.0, size, 0.0] for size in sizes]))
    score.commands(np.arange(8), np.array(voltages))
    figures = score.figures()
    assert figures.second_half_error_deg == pytest.approx(degrees(angle(0, 0.04, 0)))
    assert figures.command_changes_per_s == (2 + 1 + 1 + 2) / 4.0
