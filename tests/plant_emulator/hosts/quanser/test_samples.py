"""Aero on Quanser's board: what is measured, of samples that are read, lost, late, or not to be had."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi, sin

import pytest

from aeroloop.plant_emulator.plant import Measurement
from aeroloop.plant_emulator.settings import CardType, QuanserSettings
from aeroloop.protocol.wire.attitude import IDENTITY
from tests.support.clock import FakeClock
from tests.support.fake_quanser import FakeQuanser
from tests.support.quanser_board import (
    Calls,
    drive,
    driven_plant,
    emulated_aero,
    is_nothing,
    plant_on_board,
)

PERIOD_NS = 2_000_000


def turn_encoders(board: FakeQuanser, pitch: int, yaw: int) -> None:
    board.set_counts(2, pitch)
    board.set_counts(3, yaw)


@pytest.mark.parametrize(
    ("card", "counts", "voltages", "periods", "yaw"),
    [
        ("quanser_aero2_usb", (2880, 4096), (-18.0, 18.0), 3000, 4096),
        ("quanser_aero_usb", (2048, 4096), (9.0, -12.0), 300, 20),
    ],
)
def test_measurements_are_those_of_an_emulated_aero_with_the_cards_encoders(
    card: CardType, counts: tuple[int, int], voltages: tuple[float, float], periods: int, yaw: int
) -> None:
    """To the last bit: encoders, filter and body are the same pieces, also where yaw has turned more than once."""
    assert QuanserSettings(card_type=card).counts == counts
    plant, board = plant_on_board(card_type=card)
    twin = emulated_aero(counts=counts)
    assert plant.measure() == Measurement(IDENTITY, (0.0, 0.0, 0.0))
    for _ in range(periods):
        for each in (plant, twin):
            drive(each, 1, voltages)
        assert plant.measure() == twin.measure()
    assert abs(board.sample([3], [])[0][0]) > yaw


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_counts_are_an_angle_each_with_its_sign(signs: tuple[int, int]) -> None:
    plant, board = plant_on_board(encoder_signs=signs, pitch_counts=4000, yaw_counts=5000)
    turn_encoders(board, 160, -512)
    plant.advance()
    p, y = signs[0] * 2 * pi * 160 / 4000 / 2, signs[1] * 2 * pi * -512 / 5000 / 2
    half = cos(y) * cos(p), -sin(y) * sin(p), cos(y) * sin(p), sin(y) * cos(p)  # R_z(yaw) R_y(pitch)
    assert plant.measure().attitude == pytest.approx(half, abs=1e-15)


@pytest.mark.parametrize(("axes", "signs", "scale"), [((0, 1, 2), (1, 1, 1), 1.0), ((2, 0, 1), (1, -1, -1), 0.5)])
def test_a_gyros_rates_need_no_filter_and_its_axes_signs_and_scale_can_be_set(
    axes: tuple[int, int, int], signs: tuple[int, int, int], scale: float
) -> None:
    plant, board = driven_plant(rate="gyro", gyro_axes=axes, gyro_signs=signs, gyro_scale=scale)
    true = board.truth().rate
    assert 0.0 not in true
    assert plant.measure().rate == tuple(sign * scale * true[axis] for axis, sign in zip(axes, signs, strict=True))


# Reads that fail

FAILURES = [
    (lambda board: board.fail_next("task_read"), "task_read was made to fail", False),
    (lambda board: board.short_next(), "the board's task gave no sample", False),
    (lambda board: board.fail_next("watchdog_reload"), "watchdog_reload was made to fail", True),
]


@pytest.mark.parametrize(("fail", "words", "reloads"), FAILURES)
@pytest.mark.parametrize("rate", ["derivative", "gyro"])
def test_a_failed_read_is_an_invalid_sample_and_no_old_one_and_reloads_no_watchdog(
    rate: str, fail: Callable[[FakeQuanser], None], words: str, reloads: bool
) -> None:
    plant, board = driven_plant(rate=rate)
    fail(board)
    calls = Calls(board)
    drive(plant, 1)
    assert is_nothing(plant.measure())
    assert ("watchdog_reload" in calls.names()) == reloads
    drive(plant, 1)
    assert not is_nothing(plant.measure())
    assert plant.failures == 1
    assert plant.failure == words
    assert plant.passed == 1


def test_after_a_failed_read_the_attitude_is_the_joints_and_the_filter_starts_anew() -> None:
    plant, board = driven_plant()
    twin = emulated_aero()
    drive(twin, 100)
    board.fail_next("task_read", 3)
    for each in (plant, twin):
        drive(each, 4)
    assert plant.measure().attitude == twin.measure().attitude
    assert twin.measure().rate[2] != 0.0
    assert plant.measure().rate == (0.0, 0.0, 0.0)  # at rest until the filter has seen more


# Samples that are not read in time


def test_of_samples_that_were_not_read_the_newest_is_measured_and_the_others_count_and_measure_nothing() -> None:
    plant, board = driven_plant()
    twin = emulated_aero()
    drive(twin, 100)
    board.let_pass(4)  # the first three are lost to the fourth
    plant.advance()
    for _ in range(4):
        twin.advance()
    assert plant.measure().attitude == twin.measure().attitude
    assert plant.passed == 4
    calls, now = Calls(board), board.time
    for _ in range(3):  # periods that are over are not waited for
        plant.advance()
        assert is_nothing(plant.measure())
    assert (calls.names(), board.time) == ([], now)
    plant.advance()
    assert not is_nothing(plant.measure())
    assert (board.time, plant.passed) == (now + 1, 1)


def test_a_board_that_does_not_count_overflows_is_taken_to_be_in_time() -> None:
    plant, board = plant_on_board(session=False)
    board.counts_overflows = False
    drive(plant, 10)
    board.let_pass(4)
    plant.advance()
    assert not is_nothing(plant.measure())
    assert (plant.passed, plant.failures) == (1, 0)


# A board that samples by the clock


def test_reads_that_fail_by_the_clock_keep_the_loop_in_the_boards_time(clock: FakeClock) -> None:
    """They return at once, and samples go on coming: those are not counted twice."""
    plant, board = plant_on_board(realtime=True)
    began = clock.now_ns
    plant.advance()
    board.fail_next("task_read", 10)
    for k in range(2, 12):
        plant.advance()
        assert (clock.now_ns, plant.passed) == (began + k * PERIOD_NS, 1)
    plant.advance()  # finds the sample of the last failed read, at once: the one period that is counted twice
    assert (clock.now_ns, plant.passed, board.time) == (began + 11 * PERIOD_NS, 1, 11)
    plant.advance()
    assert (clock.now_ns, plant.passed, board.time) == (began + 12 * PERIOD_NS, 1, 12)
    assert plant.failures == 10
