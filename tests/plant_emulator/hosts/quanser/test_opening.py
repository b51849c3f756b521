"""Aero on Quanser's board: settings, finding the interface, opening, starting and closing; each call in its order."""

from __future__ import annotations

from types import ModuleType

import pytest

from aeroloop.plant_emulator.hosts import quanser_board
from aeroloop.plant_emulator.hosts.quanser_board import QuanserError, QuanserPlant
from aeroloop.plant_emulator.plant import Measurement
from aeroloop.plant_emulator.settings import QuanserSettings
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import IDENTITY
from tests.support.fake_quanser import BufferOverflowMode, FakeQuanser
from tests.support.quanser_board import (
    AERO,
    OFF,
    PERIOD,
    VOLTS,
    WATCHDOG,
    Calls,
    driven_plant,
    plant_of,
    plant_on_board,
)

CLOSING = ["write_analog", "write_digital", "write_other", "watchdog_stop", "task_stop", "task_delete", "close"]
DARK = [0.0, 0.0, 0.0]


@pytest.mark.parametrize("error", [ModuleNotFoundError("No module named 'quanser'"), OSError("libhil.so not found")])
def test_where_quansers_package_cannot_be_imported_the_error_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(_: str) -> ModuleType:
        raise error

    monkeypatch.setattr(quanser_board, "import_module", fail)
    with pytest.raises(QuanserError) as refused:
        QuanserPlant(QuanserSettings(), PERIOD)
    text = str(refused.value)
    assert all(part in text for part in (str(error), "Quanser SDK", "quanser_api"))
    assert "\n" not in text


def test_a_board_is_made_safe_before_anything_else_and_sampled_only_when_time_begins() -> None:
    plant, board = plant_on_board(session=False)
    assert list(board.calls) == [
        "open",
        "watchdog_stop",
        "watchdog_clear",
        "write_analog",
        "write_digital",
        "watchdog_set_analog_expiration_state",
        "watchdog_set_digital_expiration_state",
        "watchdog_set_other_expiration_state",
        "set_encoder_counts",
        "read",
        "task_create_reader",
        "task_set_buffer_overflow_mode",
    ]
    assert (board.analog, board.enabled) == ([0.0, 0.0], [False, False])
    assert board.at_expiry == {"analog": [0.0, 0.0], "digital": [False, False], "other": [1.0, 0.0, 0.0]}
    assert board.task is not None
    assert board.task.mode == BufferOverflowMode.OVERWRITE_ON_OVERFLOW
    assert board.task.samples.maxlen == 1
    period = ["task_read", "task_get_buffer_overflows", "watchdog_reload"]
    for expected in (["watchdog_start", "task_start", *period], period):
        calls = Calls(board)
        plant.advance()
        assert calls.names() == expected


def test_the_watchdog_runs_before_the_first_command_is_written_and_the_amplifier_is_on_before_its_voltage() -> None:
    plant, board = plant_on_board(session=False, board_watchdog_s=0.3)
    calls = Calls(board)
    plant.follow(PlantState.GRANTED)
    assert calls.names() == ["watchdog_start", "task_start", "write_digital", "write_analog", "write_other"]
    assert board.watchdog == 150  # samples, as set


def test_a_board_that_was_left_under_an_expired_watchdog_is_had_again_at_0_v() -> None:
    _, board = driven_plant()
    board.let_pass(WATCHDOG + 1)
    assert board.expired
    board.holder = board.task = None  # its process died
    plant_of(board)
    assert not board.expired
    assert board.motor_voltages == OFF
    assert board.analog == [0.0, 0.0]  # not only behind a switch


def test_a_board_that_is_not_there_or_not_free_is_reported_in_one_line() -> None:
    _, board = plant_on_board()
    for settings, words in [
        (QuanserSettings(card_type="quanser_aero_usb"), "quanser_aero_usb '0': there is no quanser_aero_usb '0'; .*?"),
        (QuanserSettings(card_identifier="1"), "quanser_aero2_usb '1': there is no quanser_aero2_usb '1'"),
        (QuanserSettings(), "quanser_aero2_usb '0': the board is in use"),
    ]:
        with pytest.raises(QuanserError, match=f"cannot open {words}"):
            plant_of(board, settings)


@pytest.mark.parametrize(
    "call",
    [
        "write_analog",
        "write_digital",
        "watchdog_set_analog_expiration_state",
        "watchdog_set_digital_expiration_state",
        "set_encoder_counts",
        "read",
        "task_create_reader",
        "task_set_buffer_overflow_mode",
    ],
)
def test_a_board_that_cannot_be_made_ready_is_closed(call: str) -> None:
    board = FakeQuanser(AERO, PERIOD)
    board.fail_next(call)
    with pytest.raises(QuanserError, match=f"cannot make quanser_aero2_usb '0' ready: {call} was made to fail"):
        plant_of(board)
    assert board.holder is None
    plant_of(board)  # so another try can have it


@pytest.mark.parametrize("call", ["watchdog_start", "task_start"])
def test_a_board_that_cannot_be_started_is_reported_in_one_line(call: str) -> None:
    plant, board = plant_on_board(session=False)
    board.fail_next(call)
    with pytest.raises(QuanserError, match=f"cannot start quanser_aero2_usb: {call} was made to fail"):
        plant.advance()
    plant.close()
    assert board.holder is None


@pytest.mark.parametrize("call", ["watchdog_stop", "watchdog_set_other_expiration_state"])
def test_what_a_board_may_lack_does_not_keep_it_from_being_used(call: str) -> None:
    board = FakeQuanser(AERO, PERIOD)
    board.fail_next(call)
    plant = plant_of(board)
    plant.advance()
    assert plant.measure() == Measurement(IDENTITY, (0.0, 0.0, 0.0))


def test_a_virtual_board_waits_for_its_reader() -> None:
    plant, board = plant_on_board(card_identifier="0@tcpip://localhost:18950")
    plant.advance()
    board.let_pass(5)
    plant.advance()
    assert board.time == 2  # one sample waited in the buffer, and time with it
    assert plant.passed == 1


def test_a_closed_plant_is_at_rest_and_dark_and_its_board_free() -> None:
    plant, board = driven_plant()
    assert board.leds != DARK
    calls = Calls(board)
    plant.close()
    plant.close()
    assert calls.names() == CLOSING  # once
    assert (board.analog, board.enabled, board.leds) == ([0.0, 0.0], [False, False], DARK)
    assert (board.holder, board.task, board.watchdog) == (None, None, None)


@pytest.mark.parametrize("failing", [*CLOSING, "all"])
def test_closing_goes_on_when_a_step_fails(failing: str) -> None:
    plant, board = driven_plant()
    if failing == "all":
        board.unplug()
    else:
        board.fail_next(failing)
    calls = Calls(board)
    plant.close()
    assert calls.names() == [call for call in CLOSING if failing != "all" or call != "watchdog_stop"]
    assert board.motor_voltages == (VOLTS if failing == "all" else OFF)
    assert board.holder is None


def test_the_watchdog_is_left_to_do_what_closing_could_not() -> None:
    plant, board = driven_plant()
    for call in ("write_analog", "write_digital"):
        board.fail_next(call)
    calls = Calls(board)
    plant.close()
    assert "watchdog_stop" not in calls.names()
    assert board.watchdog is not None
