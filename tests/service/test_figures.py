"""Figures of merit: sums over ticks, against a plain loop over the same ticks."""

from __future__ import annotations

from math import degrees, isnan, nan

import numpy as np
import pytest

from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.config import Settings
from aeroloop.service.figures import figures

WIRE = Settings().wire
NONE = np.empty(0, dtype=np.int64)


@pytest.mark.parametrize("seed", range(5))
def test_errors_hold_until_the_next_and_commands_for_at_most_the_watchdog_to_the_last_bit(seed: int) -> None:
    """With gaps longer than the watchdog holds a command, ticks without a command, and commands without a value."""
    rng = np.random.default_rng(seed)
    k = np.sort(rng.choice(3000, 1000, replace=False))
    k[500:] += 400
    errors, volts = rng.normal(scale=0.1, size=(1000, 3)), rng.normal(size=(1000, 2)).round(1)
    errors[700] = errors[300] = errors[np.abs(errors).sum(axis=1).argmax()] * 2
    volts[rng.random(1000) < 0.1, 0] = nan
    answered = np.flatnonzero(rng.random(1000) < 0.9)
    found = figures(WIRE, 0.002, (k, errors), (k[answered], volts[answered]), watchdog_s=0.1, unsent=(3, 5))

    z_track = u_total = 0.0
    for i, (x, y, z) in enumerate(errors.tolist()):
        ticks = int(k[i + 1] - k[i]) if i < 999 else 1
        z_track += (x * x + y * y + z * z) * (ticks * 0.002)
    changes, rows = 0, list(zip(k[answered].tolist(), volts[answered].tolist(), strict=True))
    for i, (tick, (a, b)) in enumerate(rows):
        ticks = rows[i + 1][0] - tick if i < len(rows) - 1 else 1
        u_total += (0.0 if isnan(a) else a * a + b * b) * (min(ticks, 50) * 0.002)
        before = rows[i - 1][1] if i else (a, b)
        changes += sum(new != old and not (isnan(new) and isnan(old)) for new, old in zip((a, b), before, strict=True))
    duration = (int(k[-1] - k[0]) + 1) * 0.002
    assert (found.z_track, found.u_total, found.duration_s) == (z_track, u_total, round(duration, 9))
    assert found.command_changes_per_s == changes / duration
    assert found.max_error_deg == degrees(angle(*errors[300].tolist()))
    assert found.final_error_deg == degrees(angle(*errors[-1].tolist()))
    assert found.skipped_ticks == k[-1] - k[0] + 1 - len(answered)
    assert found.measurement.frames_per_s == (1000 - 3) / duration
    assert found.command.bits_per_s == (len(answered) - 5) * WIRE.command.size * 8 / duration


def test_the_second_half_leaves_out_what_was_before_it() -> None:
    sizes = [0.3, 0.1, 0.05, 0.01, 0.02, 0.0, 0.04, 0.03]  # two a second: four seconds
    found = figures(WIRE, 0.5, (np.arange(8), np.array([[0.0, size, 0.0] for size in sizes])), (NONE, np.empty((0, 2))))
    assert found.second_half_error_deg == pytest.approx(degrees(angle(0, 0.04, 0)))


def test_ticks_whose_measurement_was_invalid_are_not_skipped_if_a_command_answered_them() -> None:
    """As when the sensors fail at last, and the controller goes on to command no valid value."""
    commands = np.array([0, 1, 3, 4, 5, 6]), np.zeros((6, 2))
    assert figures(WIRE, 0.5, (np.arange(4), np.zeros((4, 3))), commands).skipped_ticks == 1


def test_what_is_not_available_is_null_with_its_reason() -> None:
    found = figures(WIRE, 0.5, (NONE, np.empty((0, 3))), (NONE, np.empty((0, 2))))
    names = ("z_track", "max_error_deg", "final_error_deg", "second_half_error_deg", "skipped_ticks")
    assert all(found.reasons[name] == "no measurement was answered" and getattr(found, name) is None for name in names)
    assert (found.u_total, found.reasons["u_total"]) == (None, "no command was sent")
    assert (found.duration_s, found.measurement.frames_per_s) == (0.0, None)
