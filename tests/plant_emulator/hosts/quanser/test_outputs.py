"""Aero on Quanser's board: voltages, amplifier and lights, and the watchdog that takes them over."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import pytest

from aeroloop.plant_emulator.hosts.quanser_board import COLOURS
from aeroloop.protocol.messages.states import PlantState
from tests.support.quanser_board import (
    OFF,
    VOLTS,
    WATCHDOG,
    Calls,
    drive,
    driven_plant,
    expired_plant,
    is_nothing,
    plant_on_board,
)


@pytest.mark.parametrize(
    ("changed", "commanded", "written"),
    [
        ({}, (19.0, -24.0), [18.0, -18.0]),
        ({}, (inf, -inf), [18.0, -18.0]),
        ({"voltage_limit": 5.0}, (4.0, -6.0), [4.0, -5.0]),
        ({}, (nan, 3.0), [0.0, 3.0]),
        ({"motor_channels": (1, 0), "motor_signs": (1, -1)}, (4.0, 6.0), [-6.0, 4.0]),
    ],
)
def test_voltages_are_clipped_no_number_is_0_v_and_motors_can_be_crossed_and_turned(
    changed: dict[str, Any], commanded: tuple[float, float], written: list[float]
) -> None:
    plant, board = plant_on_board(**changed)
    plant.actuate(commanded)
    assert board.analog == written


def test_the_amplifier_is_on_during_a_session_only() -> None:
    plant, board = plant_on_board(session=False)
    for state in (PlantState.IDLE, PlantState.GRANTED, PlantState.DRIVEN, PlantState.TRIPPED, PlantState.IDLE):
        plant.follow(state)
        on = state in (PlantState.GRANTED, PlantState.DRIVEN)
        volts = VOLTS if on else OFF
        assert board.enabled == [on, on]  # at once
        drive(plant, 3)
        assert (board.enabled, board.truth().voltages) == ([on, on], volts)
        assert board.analog == list(volts)  # not only behind a switch
    plant.follow(PlantState.DRIVEN)
    drive(plant, 500, OFF)
    assert board.enabled == [True, True]


def test_an_amplifier_that_could_not_be_switched_is_switched_at_the_next_tick() -> None:
    plant, board = driven_plant()
    board.fail_next("write_digital")
    plant.follow(PlantState.TRIPPED)
    assert (board.enabled, board.analog) == ([True, True], [0.0, 0.0])
    plant.actuate(OFF)
    assert board.enabled == [False, False]


def test_lights_show_the_state_and_are_written_when_it_changes() -> None:
    plant, board = plant_on_board(session=False)
    assert board.leds == [0.0, 0.0, 0.0]
    shown = []
    for state in PlantState:
        plant.follow(state)
        plant.follow(state)
        shown.append(tuple(board.leds))
    assert shown == [COLOURS[state] for state in PlantState]
    assert len(set(shown)) == list(board.calls).count("write_other") == 4
    strongest = {state: max(zip(colour, "rgb", strict=True))[1] for state, colour in COLOURS.items()}
    assert [strongest[s] for s in (PlantState.IDLE, PlantState.DRIVEN, PlantState.TRIPPED)] == ["b", "g", "r"]


# The watchdog


def test_a_loop_that_stands_still_leaves_the_motors_at_0_v_when_the_watchdogs_time_is_over() -> None:
    plant, board = driven_plant()
    board.let_pass(WATCHDOG - 1)
    plant.advance()
    assert not is_nothing(plant.measure())  # just in time
    assert (plant.failures, board.expired) == (0, False)
    board.let_pass(WATCHDOG)
    assert board.truth().voltages == VOLTS  # in the last period before it
    board.let_pass(1)
    assert board.truth().voltages == board.motor_voltages == OFF
    assert (board.analog, board.enabled, board.leds) == ([0.0, 0.0], [False, False], list(COLOURS[PlantState.TRIPPED]))


@pytest.mark.parametrize("reads_go_on", [True, False])
def test_a_watchdog_that_expired_is_noticed_and_nothing_written_while_it_has_the_outputs(reads_go_on: bool) -> None:
    plant, board = driven_plant()
    plant.actuate(OFF)
    board.reads_while_expired = reads_go_on
    board.let_pass(WATCHDOG + 1)
    calls = Calls(board)
    plant.advance()
    assert is_nothing(plant.measure())
    assert plant.failure == "the board's watchdog expired"
    assert not reads_go_on or (plant.passed, plant.failures) == (WATCHDOG + 1, 1)
    for _ in range(WATCHDOG):
        plant.advance()
    plant.follow(PlantState.TRIPPED)
    assert not any(call.startswith("write") for call in calls.names())


@pytest.mark.parametrize("reads_go_on", [True, False])
def test_an_expired_watchdog_is_cleared_by_0_v_and_by_nothing_else_and_then_armed(reads_go_on: bool) -> None:
    plant, board = expired_plant()
    board.reads_while_expired = reads_go_on
    calls = Calls(board)
    for _ in range(5):
        drive(plant, 1)
        assert is_nothing(plant.measure())
        assert board.truth().voltages == OFF
    assert not {"watchdog_clear", "write_analog", "write_digital"} & set(calls.names())
    calls = Calls(board)
    drive(plant, 1, OFF)
    clearing = ["watchdog_stop", "watchdog_clear", "watchdog_start", "write_analog", "write_digital"]
    assert calls.names()[:5] == clearing
    assert not is_nothing(plant.measure())
    assert board.truth().voltages == OFF  # though clearing restored the outputs of before
    drive(plant, 1)
    assert board.truth().voltages == VOLTS
    board.let_pass(WATCHDOG + 1)
    assert board.motor_voltages == OFF
    plant.advance()
    assert is_nothing(plant.measure())


@pytest.mark.parametrize("call", ["watchdog_start", "write_analog", "write_digital"])
def test_outputs_that_cannot_be_had_back_stay_at_0_v_until_they_can(call: str) -> None:
    plant, board = expired_plant()
    board.fail_next(call)
    drive(plant, 1, OFF)
    assert is_nothing(plant.measure())
    assert plant.failures == 2  # the expiry, and this
    board.let_pass(WATCHDOG)  # if the outputs came back alone, the watchdog takes them again
    assert board.motor_voltages == OFF
    drive(plant, WATCHDOG + 2, OFF)
    assert not is_nothing(plant.measure())
    drive(plant, 1)
    assert board.truth().voltages == VOLTS


def test_a_command_that_could_not_be_written_does_not_reload_the_watchdog() -> None:
    plant, board = driven_plant()
    board.fail_next("write_analog")
    for reloads in (False, True):
        calls = Calls(board)
        drive(plant, 1)
        assert ("watchdog_reload" in calls.names()) == reloads
        assert not is_nothing(plant.measure())  # what it sees is true all the same
    assert plant.failures == 1


@pytest.mark.parametrize("call", ["task_read", "write_analog", "write_digital"])
def test_where_reads_or_writes_fail_for_long_the_board_goes_to_0_v_by_itself(call: str) -> None:
    plant, board = driven_plant()
    board.fail_next(call, 1000)
    for k in range(WATCHDOG + 5):
        assert (board.truth().voltages == OFF) == (k > WATCHDOG)  # of the period that is over
        plant.actuate(VOLTS)  # the loop that drives it goes on
        if call == "write_digital":
            plant.follow(PlantState.TRIPPED)
            board.analog[:] = VOLTS  # were only the amplifier left to switch the motors off
        plant.advance()
    assert is_nothing(plant.measure())
    assert board.expired
