"""Aero on Quanser's board: calls to the board and their times, and the loop when the board fails.

A fake of Quanser's interface stands in for the board, with an emulated Aero behind it. It refuses every call that a
board would refuse, so every test also checks types, channels and order. Its time is a count of samples of 2 ms: the
board's watchdog of 0.1 s expires after 50 of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from math import cos, inf, isnan, nan, pi, sin
from types import ModuleType
from typing import Any, cast

import numpy as np
import pytest
from pydantic import ValidationError

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.plant_emulator.hosts.quanser import fake as quanser_fake
from aeroloop.plant_emulator.hosts.quanser import interface as quanser_interface
from aeroloop.plant_emulator.hosts.quanser import usb as quanser_usb
from aeroloop.plant_emulator.hosts.quanser.fake import BufferOverflowMode, FakeQuanser, HILError, MisuseError
from aeroloop.plant_emulator.hosts.quanser.interface import Hardware, QuanserError
from aeroloop.plant_emulator.hosts.quanser.usb import COLOURS, QuanserPlant
from aeroloop.plant_emulator.model.emulated import EmulatedPlant
from aeroloop.plant_emulator.model.sensors import FilteredDerivative, SensorSettings
from aeroloop.plant_emulator.model.wind import WindSettings
from aeroloop.plant_emulator.plant import Measurement, Plant
from aeroloop.plant_emulator.quanser_settings import QuanserSettings
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Claim, Grant
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.service.config import Settings, with_bits
from aeroloop.service.control.controller import Controller
from aeroloop.service.figures import Score
from aeroloop.service.lab.experiment import run_experiment

PERIOD = 0.002
PERIOD_NS = 2_000_000
WATCHDOG = 50
"""Samples in 0.1 s."""
REST = 250
"""Samples in 0.5 s."""
AERO = PlantSettings(voltage_limit=18.0)
ENCODERS = SensorSettings(counts=(2880, 4096))
"""Of an Aero 2."""
OFF = (0.0, 0.0)
VOLTS = (9.0, -12.0)
DARK = [0.0, 0.0, 0.0]


def _board(settings: PlantSettings = AERO, **options: Any) -> FakeQuanser:
    return FakeQuanser(settings, PERIOD, **options)


def _made(settings: PlantSettings = AERO, **changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    board = _board(settings)
    return QuanserPlant(QuanserSettings(**changed), PERIOD, hardware=board), board


def _driven(**changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    """A plant that has been driven for long enough to be in motion."""
    plant, board = _made(**changed)
    _drive(plant, 200)
    return plant, board


def _drive(plant: Plant, periods: int, voltages: tuple[float, float] = VOLTS) -> None:
    for _ in range(periods):
        plant.actuate(voltages)
        plant.advance()


def _emulated(settings: PlantSettings = AERO, sensors: SensorSettings = ENCODERS) -> EmulatedPlant:
    return settings.model_copy(update={"sensors": sensors}).build(PERIOD)


def _is_nothing(seen: Measurement) -> bool:
    return all(isnan(value) for value in (*seen.attitude, *seen.rate))


def _since(board: FakeQuanser, n: int) -> list[str]:
    """The calls after the first n."""
    return list(board.calls)[n:]


# Opening and the order of calls


def test_a_board_is_made_safe_before_anything_else_and_sampled_only_when_time_begins() -> None:
    plant, board = _made()
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
    plant.advance()
    start = ["watchdog_start", "task_start", "task_get_buffer_overflows"]
    assert _since(board, 12) == [*start, "task_read", "task_get_buffer_overflows", "watchdog_reload"]
    assert board.watchdog == WATCHDOG
    plant.advance()
    assert _since(board, 18) == ["task_read", "task_get_buffer_overflows", "watchdog_reload"]


def test_the_watchdog_runs_before_the_first_command_is_written() -> None:
    plant, board = _made()
    plant.actuate(VOLTS)
    assert _since(board, 12) == [
        "watchdog_start",
        "task_start",
        "task_get_buffer_overflows",
        "write_digital",
        "write_analog",
    ]


@pytest.mark.parametrize("seconds", [0.01, 0.3])
def test_the_boards_watchdog_can_be_set(seconds: float) -> None:
    plant, board = _made(board_watchdog_s=seconds)
    plant.advance()
    assert board.watchdog == round(seconds / PERIOD)


def test_a_board_that_was_left_under_an_expired_watchdog_is_had_again_at_0_v() -> None:
    _, board = _driven()
    board.let_pass(WATCHDOG + 1)
    assert board.expired
    board.holder = board.task = None  # its process died
    QuanserPlant(QuanserSettings(), PERIOD, hardware=board)
    assert not board.expired
    assert board.motor_voltages == OFF
    assert board.analog == [0.0, 0.0]  # not only behind a switch


def test_a_board_that_is_not_there_is_reported_in_one_line() -> None:
    with pytest.raises(QuanserError, match=r"cannot open quanser_aero_usb '0': there is no quanser_aero_usb '0'; .*\?"):
        QuanserPlant(QuanserSettings(card_type="quanser_aero_usb"), PERIOD, hardware=_board())
    with pytest.raises(QuanserError, match="there is no quanser_aero2_usb '1'"):
        QuanserPlant(QuanserSettings(card_identifier="1"), PERIOD, hardware=_board())


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
def test_a_board_that_cannot_be_made_ready_is_given_back(call: str) -> None:
    board = _board()
    board.fail_next(call)
    with pytest.raises(QuanserError, match=f"cannot make quanser_aero2_usb '0' ready: {call} was told to fail"):
        QuanserPlant(QuanserSettings(), PERIOD, hardware=board)
    assert board.holder is None
    QuanserPlant(QuanserSettings(), PERIOD, hardware=board)  # so another try can have it


@pytest.mark.parametrize("call", ["watchdog_start", "task_start"])
def test_a_board_that_cannot_be_started_is_reported_in_one_line(call: str) -> None:
    plant, board = _made()
    board.fail_next(call)
    with pytest.raises(QuanserError, match=f"cannot start quanser_aero2_usb: {call} was told to fail"):
        plant.advance()
    plant.close()
    assert board.holder is None


@pytest.mark.parametrize("call", ["watchdog_stop", "watchdog_set_other_expiration_state"])
def test_what_a_board_may_lack_does_not_keep_it_from_being_used(call: str) -> None:
    board = _board()
    board.fail_next(call)
    plant = QuanserPlant(QuanserSettings(), PERIOD, hardware=board)
    plant.advance()
    assert plant.measure() == Measurement(IDENTITY, (0.0, 0.0, 0.0))


def test_a_virtual_board_waits_for_its_reader() -> None:
    plant, board = _made(card_identifier="0@tcpip://localhost:18950")
    assert board.task is not None
    assert board.task.mode == BufferOverflowMode.WAIT_ON_OVERFLOW
    plant.advance()
    board.let_pass(5)
    plant.advance()
    assert board.time == 2  # one sample waited in the buffer, and time with it
    assert (plant.passed, plant.overrun) == (1, 0)


# The interface itself


def test_without_quansers_package_the_error_names_what_to_install() -> None:
    with pytest.raises(QuanserError) as refused:
        QuanserPlant(QuanserSettings(), PERIOD)
    text = str(refused.value)
    assert "No module named 'quanser'" in text
    assert "Quanser SDK" in text
    assert "quanser_api" in text
    assert "\n" not in text


def test_a_package_whose_libraries_are_missing_is_reported_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> ModuleType:
        raise OSError(f"libhil.so not found for {name}")

    monkeypatch.setattr(quanser_interface, "import_module", fail)
    with pytest.raises(QuanserError, match=r"libhil\.so not found"):
        QuanserPlant(QuanserSettings(), PERIOD)


def test_quansers_package_is_used_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    board = _board()
    hardware = {"HIL": board.HIL, "HILError": HILError, "Clock": quanser_fake.Clock}
    enumerations = {"BufferOverflowMode": BufferOverflowMode}
    for name, names in (("", {}), (".hardware", hardware), (".hardware.enumerations", enumerations)):
        module = ModuleType(f"quanser{name}")
        module.__dict__.update(names)
        monkeypatch.setitem(sys.modules, f"quanser{name}", module)
    plant = QuanserPlant(QuanserSettings(), PERIOD)
    _drive(plant, 3)
    assert board.time == 3


# Samples


@pytest.mark.parametrize(("voltages", "periods"), [((-18.0, 18.0), 4000), (VOLTS, 500), ((18.0, -3.0), 500)])
def test_measurements_are_those_of_an_emulated_aero_with_the_same_encoders(
    voltages: tuple[float, float], periods: int
) -> None:
    """To the last bit: encoders, filter and body are the same pieces, also where yaw has turned more than once."""
    plant, board = _made()
    twin = _emulated()
    assert plant.measure() == twin.measure() == Measurement(IDENTITY, (0.0, 0.0, 0.0))
    for _ in range(periods):
        for each in (plant, twin):
            _drive(each, 1, voltages)
        assert plant.measure() == twin.measure()
    assert abs(board.sample([3], [])[0][0]) > (4096 if periods == 4000 else 100)


def test_an_aero_has_fewer_counts_a_turn_than_an_aero_2() -> None:
    assert QuanserSettings().counts == (2880, 4096)
    assert QuanserSettings(card_type="quanser_aero_usb").counts == (2048, 4096)
    assert QuanserSettings(pitch_counts=4000, yaw_counts=5000).counts == (4000, 5000)
    board = _board(card_type="quanser_aero_usb")
    plant = QuanserPlant(QuanserSettings(card_type="quanser_aero_usb"), PERIOD, hardware=board)
    twin = _emulated(sensors=SensorSettings(counts=(2048, 4096)))
    for _ in range(300):
        for each in (plant, twin):
            each.actuate(VOLTS)
            each.advance()
        assert plant.measure() == twin.measure()


def _at(board: FakeQuanser, pitch: int, yaw: int) -> None:
    """Turn the joints' encoders by hand."""
    board.set_counts(2, pitch)
    board.set_counts(3, yaw)


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_counts_are_an_angle_each_with_its_sign(signs: tuple[int, int]) -> None:
    plant, board = _made(encoder_signs=signs)
    _at(board, 160, -512)
    plant.advance()
    p, y = signs[0] * 2 * pi * 160 / 2880 / 2, signs[1] * 2 * pi * -512 / 4096 / 2
    half = cos(y) * cos(p), -sin(y) * sin(p), cos(y) * sin(p), sin(y) * cos(p)  # R_z(yaw) R_y(pitch)
    assert plant.measure().attitude == pytest.approx(half, abs=1e-15)


def test_rates_are_the_filtered_derivative_in_the_body_frame() -> None:
    plant, board = _made(bandwidth=30.0, damping_ratio=0.7)
    of_pitch, of_yaw = (FilteredDerivative(30.0, 0.7, PERIOD) for _ in range(2))
    of_pitch.update(0.0)
    of_yaw.update(0.0)
    for k in range(1, 200):
        _at(board, 3 * k, -5 * k)
        plant.advance()
        p = 2 * pi / 2880 * 3 * k
        dp, dy = of_pitch.update(p), of_yaw.update(-2 * pi / 4096 * 5 * k)
        assert plant.measure().rate == pytest.approx((-sin(p) * dy, dp, cos(p) * dy), abs=1e-12)
    assert dp > 3.0  # 3 counts a sample are 3.27 rad/s


def test_a_gyros_rates_are_the_bodys_and_need_no_filter() -> None:
    plant, board = _made(rate="gyro")
    for _ in range(100):
        _drive(plant, 1)
        assert plant.measure().rate == board.truth().rate
    assert max(map(abs, board.truth().rate)) > 0.05


def test_a_gyros_axes_signs_and_scale_can_be_set() -> None:
    plant, board = _made(rate="gyro", gyro_axes=(2, 0, 1), gyro_signs=(1, -1, -1), gyro_scale=0.5)
    _drive(plant, 100)
    x, y, z = board.truth().rate
    assert 0.0 not in (x, y, z)
    assert plant.measure().rate == (0.5 * z, -0.5 * x, -0.5 * y)


def test_a_gyros_bias_is_that_of_the_emulated_aero() -> None:
    settings = AERO.model_copy(update={"sensors": SensorSettings(gyro_bias=(0.1, 0.2, 0.3))})
    plant, _ = _made(settings, rate="gyro")
    plant.advance()
    assert plant.measure().rate == pytest.approx((0.1, 0.2, 0.3), abs=1e-4)  # it has begun to sink by less


# Reads that fail


def _fails(board: FakeQuanser) -> None:
    board.fail_next("task_read")


def _falls_short(board: FakeQuanser) -> None:
    board.short_next()


def _cannot_reload(board: FakeQuanser) -> None:
    board.fail_next("watchdog_reload")


@pytest.mark.parametrize("failure", [_fails, _falls_short, _cannot_reload])
@pytest.mark.parametrize("rate", ["derivative", "gyro"])
def test_a_failed_read_is_an_invalid_sample_and_no_old_one(rate: str, failure: Callable[[FakeQuanser], None]) -> None:
    plant, board = _driven(rate=rate)
    failure(board)
    _drive(plant, 1)
    assert _is_nothing(plant.measure())
    assert plant.failures == 1
    _drive(plant, 1)
    assert not _is_nothing(plant.measure())
    assert plant.failures == 1
    assert (plant.passed, plant.overrun, plant.expiries) == (1, 0, 0)


def test_a_failure_is_kept_in_words() -> None:
    plant, board = _made()
    assert plant.failure is None
    board.fail_next("task_read")
    plant.advance()
    assert plant.failure == "task_read was told to fail"
    board.short_next()
    plant.advance()
    assert plant.failure == "the board's task gave no sample"


def test_after_a_failed_read_the_attitude_is_the_joints_and_the_filter_starts_anew() -> None:
    plant, board = _made()
    twin = _emulated()
    for each in (plant, twin):
        _drive(each, 200)
    board.fail_next("task_read", 3)
    for each in (plant, twin):
        _drive(each, 4)
    assert plant.measure().attitude == twin.measure().attitude
    assert twin.measure().rate[2] != 0.0
    assert plant.measure().rate == (0.0, 0.0, 0.0)  # at rest until the filter has seen more


@pytest.mark.parametrize("failure", [_fails, _falls_short])
def test_a_failed_read_does_not_reload_the_watchdog(failure: Callable[[FakeQuanser], None]) -> None:
    plant, board = _driven()
    failure(board)
    n = len(board.calls)
    plant.advance()
    assert "watchdog_reload" not in _since(board, n)


def test_where_reads_fail_for_long_the_board_goes_to_0_v_by_itself() -> None:
    plant, board = _driven()
    board.fail_next("task_read", 1000)
    for k in range(WATCHDOG + 5):
        before = board.truth().voltages
        assert (before == OFF) == (k > WATCHDOG)  # of the period that is over
        _drive(plant, 1)  # the loop that drives it goes on
    assert plant.expiries == 1


def test_reads_that_fail_take_their_time(clock: HandClock) -> None:
    """With nothing to wait for, a loop would spin."""
    plant, board = _made()
    plant.advance()
    plant.advance()
    assert clock.slept == []  # a good one has waited for its sample
    board.fail_next("task_read", 3)
    plant.advance()
    clock.ns += 500_000  # the owner works for half a millisecond
    plant.advance()
    clock.ns += 5_000_000  # and for longer than a period
    plant.advance()
    assert clock.slept == pytest.approx([PERIOD, PERIOD - 0.0005], abs=1e-9)


# Samples that were not read in time


def test_of_samples_that_were_not_read_the_newest_is_measured_and_the_others_are_counted() -> None:
    plant, board = _made()
    twin = _emulated()
    for each in (plant, twin):
        _drive(each, 100)
    board.let_pass(4)  # the first three are lost to the fourth
    plant.advance()
    assert (plant.passed, plant.overrun) == (4, 3)
    for _ in range(4):
        twin.advance()
    assert plant.measure().attitude == twin.measure().attitude


def test_for_the_filter_the_newest_sample_lasts_as_long_as_those_that_were_lost() -> None:
    plant, board = _made()
    filtered = FilteredDerivative(50.0, 0.8, PERIOD)
    filtered.update(0.0)
    plant.advance()
    filtered.update(0.0)
    _at(board, 0, 40)
    board.let_pass(4)
    plant.advance()
    for _ in range(4):
        rate = filtered.update(2 * pi / 4096 * 40)
    assert plant.measure().rate == (0.0, 0.0, rate)
    assert rate > 0.5


def test_periods_that_are_over_are_not_waited_for_and_measure_nothing() -> None:
    plant, board = _driven()
    board.let_pass(4)
    plant.advance()
    assert not _is_nothing(plant.measure())
    n, now = len(board.calls), board.time
    for _ in range(3):
        plant.advance()
        assert _is_nothing(plant.measure())
    assert (_since(board, n), board.time) == ([], now)
    plant.advance()
    assert not _is_nothing(plant.measure())
    assert board.time == now + 1
    assert (plant.passed, plant.overrun) == (1, 3)


def test_an_owner_that_ticks_by_what_has_passed_stays_in_the_boards_time() -> None:
    plant, board = _made()
    endpoint, _ = _claimed(plant)
    assert plant.paces
    k, wire = 0, Settings().wire
    for stall in (0, 0, 3, 0, 1, 7, 0, 0):
        board.let_pass(stall)
        k += plant.passed
        frame = endpoint.tick(None, k)
        assert frame is not None
        read = wire.measurement.unpack(frame)
        assert read is not None
        assert not isnan(wire.attitude.quantizer().decode(read[1][0]))
        assert board.time == k + plant.passed - 1
    assert plant.overrun == (3 - 1) + (1 - 1) + (7 - 1)


def test_a_failed_read_counts_as_a_period_once() -> None:
    plant, board = _driven()
    for _ in range(5):
        board.fail_next("task_read")
        plant.advance()
        assert plant.passed == 1
    plant.advance()
    assert (plant.passed, plant.overrun) == (1, 0)
    board.let_pass(3)
    plant.advance()
    assert (plant.passed, plant.overrun) == (3, 2)


def test_a_board_that_does_not_count_overflows_is_taken_to_be_in_time() -> None:
    board = _board()
    board.counts_overflows = False
    plant = QuanserPlant(QuanserSettings(), PERIOD, hardware=board)
    _drive(plant, 10)
    board.let_pass(4)
    plant.advance()
    assert not _is_nothing(plant.measure())
    assert (plant.passed, plant.overrun, plant.failures) == (1, 0, 0)


# The board's watchdog


def test_a_loop_that_stands_still_leaves_the_motors_at_0_v_when_the_watchdogs_time_is_over() -> None:
    plant, board = _driven()
    board.let_pass(WATCHDOG)
    assert board.truth().voltages == VOLTS  # in the last period before it
    board.let_pass(1)
    assert board.truth().voltages == board.motor_voltages == OFF
    assert (board.analog, board.enabled, board.leds) == ([0.0, 0.0], [False, False], list(COLOURS[PlantState.TRIPPED]))
    plant.advance()
    assert _is_nothing(plant.measure())
    assert plant.expiries == 1
    assert plant.passed == WATCHDOG + 1


def test_a_loop_that_is_just_in_time_goes_on() -> None:
    plant, board = _driven()
    board.let_pass(WATCHDOG - 1)
    plant.advance()
    assert not _is_nothing(plant.measure())
    assert (plant.expiries, board.expired) == (0, False)


def _expired(**changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    """A plant whose board went to 0 V while it was driven, and that has noticed; no periods are owed."""
    plant, board = _driven(**changed)
    board.let_pass(WATCHDOG + 1)
    for _ in range(WATCHDOG + 1):
        plant.advance()
    assert (plant.expiries, board.expired) == (1, True)
    return plant, board


@pytest.mark.parametrize("reads_go_on", [True, False])
def test_an_expired_watchdog_is_cleared_by_0_v_and_by_nothing_else(reads_go_on: bool) -> None:
    plant, board = _expired()
    board.reads_while_expired = reads_go_on
    n = len(board.calls)
    for _ in range(5):
        _drive(plant, 1)
        assert _is_nothing(plant.measure())
        assert board.truth().voltages == OFF
    assert not {"watchdog_clear", "write_analog", "write_digital"} & set(_since(board, n))
    n = len(board.calls)
    _drive(plant, 1, OFF)
    assert _since(board, n)[:5] == [
        "watchdog_stop",
        "watchdog_clear",
        "watchdog_start",
        "write_analog",
        "write_digital",
    ]
    assert not _is_nothing(plant.measure())
    assert board.truth().voltages == OFF  # though clearing gave the outputs back as they were
    assert not board.expired
    _drive(plant, 1)
    assert board.truth().voltages == VOLTS
    assert plant.expiries == 1


def test_a_board_whose_reads_stop_with_the_watchdog_is_found_out_too() -> None:
    plant, board = _driven()
    board.reads_while_expired = False
    board.let_pass(WATCHDOG + 1)
    _drive(plant, 1)
    assert (plant.expiries, _is_nothing(plant.measure())) == (1, True)


def test_nothing_is_written_while_the_watchdog_has_the_outputs() -> None:
    plant, board = _driven()
    plant.actuate(OFF)
    board.let_pass(WATCHDOG + 1)
    n = len(board.calls)
    for _ in range(WATCHDOG + REST + 2):  # long enough to switch the amplifier off, were it on
        plant.advance()
    assert not any(call.startswith("write") for call in _since(board, n))
    assert (plant.failures, plant.expiries) == (0, 1)


def test_a_cleared_watchdog_is_armed() -> None:
    plant, board = _expired()
    _drive(plant, 1, OFF)
    _drive(plant, 1)
    board.let_pass(WATCHDOG + 1)
    assert board.motor_voltages == OFF
    plant.advance()
    assert plant.expiries == 2


@pytest.mark.parametrize("call", ["watchdog_start", "write_analog", "write_digital"])
def test_outputs_that_cannot_be_had_back_stay_at_0_v_until_they_can(call: str) -> None:
    plant, board = _expired()
    board.fail_next(call)
    _drive(plant, 1, OFF)
    assert _is_nothing(plant.measure())
    assert plant.failures == 1
    board.let_pass(WATCHDOG)  # if the outputs came back alone, the watchdog takes them again
    assert board.motor_voltages == OFF
    _drive(plant, WATCHDOG + 2, OFF)
    assert not _is_nothing(plant.measure())
    _drive(plant, 1)
    assert board.truth().voltages == VOLTS


def test_a_command_that_could_not_be_written_does_not_reload_the_watchdog() -> None:
    plant, board = _driven()
    board.fail_next("write_analog")
    n = len(board.calls)
    _drive(plant, 1)
    assert "watchdog_reload" not in _since(board, n)
    assert not _is_nothing(plant.measure())  # what it sees is true all the same
    assert plant.failures == 1
    n = len(board.calls)
    _drive(plant, 1)
    assert "watchdog_reload" in _since(board, n)


@pytest.mark.parametrize("call", ["write_analog", "write_digital"])
def test_a_plant_that_ignores_its_calls_has_0_v_before_long(call: str) -> None:
    plant, board = _driven()
    board.fail_next(call, 1000)
    if call == "write_digital":
        plant.enable(False)
        assert board.enabled == [True, True]
    for _ in range(WATCHDOG + 1):
        plant.actuate((1.0, 1.0))
        if call == "write_digital":
            plant.enable(False)
        plant.advance()
    assert board.motor_voltages == OFF
    assert _is_nothing(plant.measure())
    assert plant.expiries == 1


# Voltages and amplifier


def test_voltages_are_clipped_to_the_limit() -> None:
    plant, board = _made()
    plant.actuate((19.0, -24.0))
    assert board.analog == [18.0, -18.0]
    plant.actuate((inf, -inf))
    assert board.analog == [18.0, -18.0]
    plant, board = _made(voltage_limit=5.0)
    plant.actuate((4.0, -6.0))
    assert board.analog == [4.0, -5.0]


def test_no_number_is_0_v() -> None:
    plant, board = _made()
    plant.actuate((nan, 3.0))
    assert board.analog == [0.0, 3.0]


def test_motors_can_be_crossed_and_turned() -> None:
    plant, board = _made(motor_channels=(1, 0), motor_signs=(1, -1))
    plant.actuate((4.0, 6.0))
    assert board.analog == [-6.0, 4.0]


def test_another_number_of_voltages_is_refused() -> None:
    plant, _ = _made()
    with pytest.raises(ValueError, match="argument"):
        plant.actuate((1.0, 2.0, 3.0))


def test_the_amplifier_is_on_from_the_first_voltage_until_half_a_second_of_none() -> None:
    plant, board = _made()
    _drive(plant, 10, OFF)
    assert board.enabled == [False, False]
    _drive(plant, 1, (0.0, 0.1))
    assert board.enabled == [True, True]
    _drive(plant, REST, OFF)
    assert board.enabled == [True, True]
    _drive(plant, 1, OFF)
    assert board.enabled == [False, False]
    _drive(plant, 1)
    assert board.enabled == [True, True]
    assert board.truth().voltages == VOLTS


def test_a_voltage_in_between_keeps_the_amplifier_on() -> None:
    plant, board = _made()
    for _ in range(3):
        _drive(plant, 1)
        _drive(plant, REST, OFF)
    assert board.enabled == [True, True]


def test_the_amplifier_has_no_voltage_yet_when_it_is_switched_on() -> None:
    plant, board = _made()
    plant.actuate(VOLTS)
    written = [call for call in board.calls if call in ("write_digital", "write_analog")]
    assert written[-2:] == ["write_digital", "write_analog"]


def test_with_explicit_enable_only_its_caller_switches_the_amplifier() -> None:
    plant, board = _made()
    plant.enable(False)
    _drive(plant, 3)
    assert (board.enabled, board.analog) == ([False, False], [0.0, 0.0])
    plant.enable(True)
    assert (board.enabled, board.analog) == ([True, True], list(VOLTS))
    _drive(plant, 2 * REST, OFF)
    assert board.enabled == [True, True]
    _drive(plant, 1)
    plant.enable(False)
    assert (board.enabled, board.analog) == ([False, False], [0.0, 0.0])


def test_a_board_that_is_expired_is_enabled_only_when_it_is_cleared() -> None:
    plant, board = _expired()
    plant.enable(True)
    assert board.expired
    assert plant.failures == 0  # nothing was tried
    _drive(plant, 1, OFF)
    assert board.enabled == [True, True]


# Lights


def test_lights_show_the_state() -> None:
    plant, board = _made()
    assert board.leds == DARK
    shown = []
    for state in PlantState:
        plant.show(state)
        shown.append(tuple(board.leds))
    assert shown == [COLOURS[state] for state in PlantState]
    assert len(set(shown)) == 4
    names = {state: max(zip(colour, "rgb", strict=True))[1] for state, colour in COLOURS.items()}
    assert names[PlantState.IDLE] == "b"
    assert names[PlantState.DRIVEN] == "g"
    assert names[PlantState.TRIPPED] == "r"


def test_lights_are_written_when_the_state_changes() -> None:
    plant, board = _made()
    for state in (PlantState.IDLE, PlantState.IDLE, PlantState.DRIVEN, PlantState.DRIVEN):
        plant.show(state)
    assert list(board.calls).count("write_other") == 2


def test_a_light_that_fails_is_tried_again_and_costs_no_sample() -> None:
    plant, board = _driven()
    board.fail_next("write_other")
    plant.show(PlantState.DRIVEN)
    n = len(board.calls)
    plant.advance()
    assert "watchdog_reload" in _since(board, n)
    assert not _is_nothing(plant.measure())
    plant.show(PlantState.DRIVEN)
    assert board.leds == list(COLOURS[PlantState.DRIVEN])


def test_lights_come_back_with_the_outputs() -> None:
    plant, board = _driven()
    plant.show(PlantState.DRIVEN)
    board.let_pass(WATCHDOG + 1)
    plant.advance()
    plant.show(PlantState.DRIVEN)
    assert board.leds == list(COLOURS[PlantState.TRIPPED])  # the board's own
    assert plant.failures == 0
    n = len(board.calls)
    plant.actuate(OFF)
    assert board.leds == list(COLOURS[PlantState.DRIVEN])
    assert "write_other" in _since(board, n)  # not every board may give them back by itself


# Closing

CLOSING = [
    "write_analog",
    "write_digital",
    "write_other",
    "watchdog_stop",
    "task_stop",
    "task_delete",
    "close",
]


def test_a_closed_plant_is_at_rest_dark_and_given_back() -> None:
    plant, board = _driven()
    plant.show(PlantState.DRIVEN)
    n = len(board.calls)
    plant.close()
    assert _since(board, n) == CLOSING
    assert (board.analog, board.enabled, board.leds) == ([0.0, 0.0], [False, False], DARK)
    assert (board.holder, board.task, board.watchdog) == (None, None, None)
    plant.close()
    assert len(board.calls) == n + len(CLOSING)


def test_a_plant_that_was_never_started_can_be_closed() -> None:
    plant, board = _made()
    n = len(board.calls)
    plant.close()
    assert _since(board, n) == [call for call in CLOSING if call != "task_stop"]
    assert plant.failures == 0


@pytest.mark.parametrize("failing", CLOSING)
def test_closing_goes_on_when_a_step_fails(failing: str) -> None:
    plant, board = _driven()
    board.fail_next(failing)
    n = len(board.calls)
    plant.close()
    assert _since(board, n) == CLOSING
    assert board.motor_voltages == OFF
    assert board.holder is None
    plant.close()


def test_the_watchdog_is_left_to_do_what_closing_could_not() -> None:
    plant, board = _driven()
    board.fail_next("write_analog")
    board.fail_next("write_digital")
    n = len(board.calls)
    plant.close()
    assert "watchdog_stop" not in _since(board, n)
    assert board.watchdog is not None


def test_a_board_that_was_unplugged_can_be_closed() -> None:
    plant, board = _driven()
    board.unplug()
    plant.close()
    plant.close()
    assert board.holder is None


# Behind an endpoint


def _claimed(plant: Plant, settings: Settings | None = None) -> tuple[Endpoint, bytes]:
    """An endpoint at tick 0, in lockstep and granted, and its first measurement."""
    settings = settings or Settings()
    wire, period_ns = settings.wire, settings.loop.period_ns
    guard = settings.plant.guard(period_ns, wire.voltage.quantizer().outermost)
    endpoint = Endpoint(plant, wire, period_ns, lockstep=True, guard=guard)
    claim = Claim(controller="test", session="test", period_ns=period_ns, lockstep=True, auto_arm=True, wire=wire)
    assert isinstance(endpoint.claim(claim), Grant)
    measurement = endpoint.tick(None, 0)
    assert measurement is not None
    return endpoint, measurement


def _score(plant: Plant, settings: Settings, duration_s: float) -> tuple[float, float]:
    """z_track and u_total of the closed loop, as `run_experiment` has them."""
    wire, period = settings.wire, settings.loop.period
    controller = Controller(wire, settings.law, settings.reference, period)
    score = Score(wire, period)
    level = wire.voltage.quantizer().level
    endpoint, measurement = _claimed(plant, settings)
    for k in range(settings.loop.ticks(duration_s)):
        command = controller.tick(measurement, k)
        assert command is not None
        read = wire.command.unpack(command)
        assert read is not None
        score.error(k, controller.attitude_error)
        score.command(k, [level(code) for code in read[1]])
        answered = endpoint.tick(command, k + 1)
        assert answered is not None
        measurement = answered
    figures = score.figures(reasons={})
    assert figures.z_track is not None
    assert figures.u_total is not None
    return figures.z_track, figures.u_total


@pytest.mark.parametrize("bits", [("8", "6"), ("cont", "cont")])
def test_the_loop_on_the_board_is_the_loop_on_the_emulator_to_the_last_bit(bits: tuple[str, str]) -> None:
    settings = with_bits(Settings(plant=AERO.model_copy(update={"sensors": ENCODERS})), *bits)
    plant, board = _made(settings.plant)
    z_track, u_total = _score(plant, settings, 5.0)
    figures = run_experiment(settings, 5.0)
    assert (z_track, u_total) == (figures.z_track, figures.u_total)
    assert u_total > 0
    assert (plant.failures, plant.overrun, plant.expiries) == (0, 0, 0)
    assert board.time == 2500


def test_wind_blows_at_the_aero_on_the_board_too() -> None:
    windy = AERO.model_copy(update={"sensors": ENCODERS, "wind": WindSettings(blowing=True)})
    settings = Settings(plant=windy)
    plant, _ = _made(windy)
    figures = run_experiment(settings, 1.0)
    assert _score(plant, settings, 1.0) == (figures.z_track, figures.u_total)
    assert _score(_made()[0], Settings(plant=AERO), 1.0) != (figures.z_track, figures.u_total)


def _controlled(plant: Plant) -> tuple[Endpoint, Controller, Callable[[], None]]:
    """The closed loop, and what takes it a tick further."""
    settings = Settings()
    endpoint, measurement = _claimed(plant, settings)
    controller = Controller(settings.wire, settings.law, settings.reference, PERIOD)
    at: dict[str, Any] = {"k": 0, "measurement": measurement}

    def tick() -> None:
        command = controller.tick(at["measurement"], at["k"])
        at["k"] += 1
        at["measurement"] = endpoint.tick(command, at["k"])

    return endpoint, controller, tick


def test_a_board_that_is_unplugged_trips_the_endpoint_in_the_time_of_its_guard() -> None:
    plant, board = _made()
    endpoint, _, tick = _controlled(plant)
    for _ in range(500):
        tick()
    assert endpoint.state is PlantState.DRIVEN
    board.unplug()
    ticks = 0
    while endpoint.session is not None and ticks < 1000:
        tick()
        ticks += 1
    assert ticks == 51  # limits.max_invalid_s = 0.1 s of samples without a value, and the one that makes it more
    assert "no valid value" in endpoint.notices[-1].text
    assert board.analog == [0.0, 0.0]  # no write reaches it any more: the board's watchdog did
    assert board.expired


def test_one_lost_sample_does_not_end_the_session() -> None:
    plant, board = _made()
    endpoint, controller, tick = _controlled(plant)
    for k in range(300):
        if k == 200:
            board.fail_next("task_read")
        tick()
    assert endpoint.state is PlantState.DRIVEN
    assert controller.invalid == 1
    assert plant.failures == 1


# The stand-in: what it does not let pass

CH = np.array([0, 1], dtype=np.uint32)
JOINTS = np.array([2, 3], dtype=np.uint32)
ZERO = np.zeros(2)
LINES = np.ones(2, dtype=np.int8)


def _handle(board: FakeQuanser) -> quanser_fake.FakeHIL:
    return cast(quanser_fake.FakeHIL, board.HIL())


SHARED = _board()
"""To be misused: its Aero is never moved, and building one takes a tenth of a second."""


def _opened() -> quanser_fake.FakeHIL:
    SHARED.holder = SHARED.task = SHARED.watchdog = None
    handle = _handle(SHARED)
    handle.open("quanser_aero2_usb", "0")
    return handle


def _armed() -> quanser_fake.FakeHIL:
    handle = _opened()
    handle.watchdog_set_analog_expiration_state(CH, 2, ZERO)
    handle.watchdog_set_digital_expiration_state(CH, 2, np.zeros(2, dtype=np.int32))
    handle.watchdog_start(0.1)
    return handle


def _reader(handle: quanser_fake.FakeHIL) -> object:
    return handle.task_create_reader(1, None, 0, JOINTS, 2, None, 0, None, 0)


def _started() -> tuple[quanser_fake.FakeHIL, object]:
    handle = _opened()
    task = _reader(handle)
    handle.task_start(task, 0, 500.0, 2**32 - 1)
    return handle, task


@pytest.mark.parametrize(
    "use",
    [
        lambda h: h.write_analog(CH.astype(np.int32), 2, ZERO),
        lambda h: h.write_analog(CH, 3, ZERO),
        lambda h: h.write_analog(CH, 2, np.zeros(3)),
        lambda h: h.write_analog(CH, 2, np.zeros(2, dtype=np.float32)),
        lambda h: h.write_analog(CH, 2, np.zeros(4)[::2]),
        lambda h: h.write_analog(CH, 2, [0.0, 0.0]),
        lambda h: h.write_analog(np.array([0, 2], dtype=np.uint32), 2, ZERO),
        lambda h: h.write_analog(np.array([1, 1], dtype=np.uint32), 2, ZERO),
        lambda h: h.write_analog(CH, 2, np.array([24.1, 0.0])),
        lambda h: h.write_analog(CH, 2, np.array([nan, 0.0])),
        lambda h: h.write_digital(CH, 2, np.zeros(2, dtype=np.int32)),
        lambda h: h.write_digital(CH, 2, np.full(2, 2, dtype=np.int8)),
        lambda h: h.write_digital(CH, 2, LINES),
        lambda h: h.write_other(CH, 2, ZERO),
        lambda h: h.write_other(np.array([11000], dtype=np.uint32), 1, np.array([1.5])),
        lambda h: h.set_encoder_counts(JOINTS, 2, ZERO),
        lambda h: h.set_encoder_counts(np.array([4], dtype=np.uint32), 1, np.zeros(1, dtype=np.int32)),
        lambda h: h.read(None, 0, JOINTS, 2, None, 0, None, 0, None, np.zeros(1, dtype=np.int32), None, None),
        lambda h: h.read(None, 0, JOINTS, 2, None, 0, None, 0, None, np.zeros(2, dtype=np.int64), None, None),
        lambda h: h.read(CH, 2, JOINTS, 2, None, 0, None, 0, ZERO, np.zeros(2, dtype=np.int32), None, None),
        lambda h: h.open("quanser_aero2_usb", "0"),
        lambda h: h.task_create_reader(0, None, 0, JOINTS, 2, None, 0, None, 0),
        lambda h: h.task_create_reader(1, None, 0, JOINTS, 2, None, 0, np.array([3003], dtype=np.uint32), 1),
        lambda h: h.task_read(_reader(h), 1, None, np.zeros(2, dtype=np.int32), None, None),
        lambda h: h.task_stop(_reader(h)),
        lambda h: h.task_start(_reader(h), 0, 499.0, 2**32 - 1),
        lambda h: h.task_start(_reader(h), -1, 500.0, 2**32 - 1),
        lambda h: h.task_start(_reader(h), 0, 500.0, 5000),
        lambda h: h.task_start(None, 0, 500.0, 2**32 - 1),
        lambda h: h.watchdog_start(0.1),
        lambda h: h.watchdog_reload(),
        lambda h: h.watchdog_set_analog_expiration_state(CH[:1], 1, np.zeros(1)),
        lambda h: h.watchdog_set_digital_expiration_state(CH, 2, np.zeros(2, dtype=np.int8)),
    ],
)
def test_the_stand_in_refuses_what_c_would_misread_or_a_board_would_not_bear(
    use: Callable[[quanser_fake.FakeHIL], None],
) -> None:
    with pytest.raises(MisuseError):
        use(_opened())


@pytest.mark.parametrize(
    "use",
    [
        lambda h: h.watchdog_start(0.1),
        lambda h: h.watchdog_set_analog_expiration_state(CH, 2, ZERO),
    ],
)
def test_the_stand_ins_watchdog_is_set_before_it_runs_and_started_once(
    use: Callable[[quanser_fake.FakeHIL], None],
) -> None:
    with pytest.raises(MisuseError):
        use(_armed())


@pytest.mark.parametrize(
    "use",
    [
        lambda h: h.write_analog(CH, 2, ZERO),
        lambda h: h.watchdog_clear(),
        lambda h: h.watchdog_is_expired(),
        lambda h: _reader(h),
    ],
)
def test_nothing_is_asked_of_the_stand_in_before_it_is_open_or_after(
    use: Callable[[quanser_fake.FakeHIL], None],
) -> None:
    with pytest.raises(MisuseError, match="not open"):
        use(_handle(SHARED))
    handle = _opened()
    assert handle.is_valid()
    handle.close()
    assert not handle.is_valid()
    with pytest.raises(MisuseError, match="not open"):
        use(handle)
    handle.close()


def test_the_stand_ins_task_is_read_one_sample_at_a_time_into_buffers_that_fit() -> None:
    handle, task = _started()
    counts = np.zeros(2, dtype=np.int32)
    with pytest.raises(MisuseError):
        handle.task_read(task, 2, None, counts, None, None)
    with pytest.raises(MisuseError):
        handle.task_read(task, 1, None, counts, None, np.zeros(3))
    counts.flags.writeable = False
    with pytest.raises(MisuseError):
        handle.task_read(task, 1, None, counts, None, None)
    with pytest.raises(MisuseError):
        handle.task_start(task, 0, 500.0, 2**32 - 1)
    with pytest.raises(MisuseError):
        handle.task_set_buffer_overflow_mode(task, BufferOverflowMode.OVERWRITE_ON_OVERFLOW)


def test_the_stand_in_handles_overflows_as_the_mode_states() -> None:
    counts = np.zeros(2, dtype=np.int32)
    for mode, expected in [
        (BufferOverflowMode.OVERWRITE_ON_OVERFLOW, [3, 4, 5, 6]),
        (BufferOverflowMode.DISCARD_ON_OVERFLOW, [1, 2, 5, 6]),
        (BufferOverflowMode.ERROR_ON_OVERFLOW, []),
    ]:
        board = _board()
        handle = _handle(board)
        handle.open("quanser_aero2_usb", "0")
        task = handle.task_create_reader(2, None, 0, JOINTS, 2, None, 0, None, 0)
        handle.task_set_buffer_overflow_mode(task, mode)
        handle.task_start(task, 0, 500.0, 2**32 - 1)
        for k in range(1, 5):
            board.set_counts(2, k)
            board.let_pass(1)
        assert handle.task_get_buffer_overflows(task) == 2
        if not expected:
            with pytest.raises(HILError, match="overflowed"):
                handle.task_read(task, 1, None, counts, None, None)
            continue
        for k, count in enumerate(expected, start=3):
            if not board.task or not board.task.samples:
                board.set_counts(2, k)
            assert handle.task_read(task, 1, None, counts, None, None) == 1
            assert counts[0] == count


def test_the_stand_in_leaves_buffers_as_they_were_when_a_read_fails() -> None:
    """So code that takes them for new has old data, as with the usual class for this board."""
    handle, task = _started()
    board, began = SHARED, SHARED.time
    counts = np.array([123, 456], dtype=np.int32)
    board.fail_next("task_read")
    with pytest.raises(HILError):
        handle.task_read(task, 1, None, counts, None, None)
    board.short_next()
    assert handle.task_read(task, 1, None, counts, None, None) == 0
    assert counts.tolist() == [123, 456]
    assert board.time == began + 2  # both samples are lost


def test_the_stand_in_gives_outputs_back_as_they_were() -> None:
    """The worst that can be read into the documentation: after a watchdog is cleared, 0 V must be written at once."""
    board = _board()
    plant = QuanserPlant(QuanserSettings(), PERIOD, hardware=board)
    _drive(plant, 1)
    board.let_pass(WATCHDOG + 1)
    assert board.motor_voltages == OFF
    handle = cast(quanser_fake.FakeHIL, board.holder)
    with pytest.raises(HILError, match="expired"):
        handle.write_analog(CH, 2, ZERO)
    handle.watchdog_clear()
    assert board.motor_voltages == VOLTS


def test_the_stand_in_can_be_had_by_one() -> None:
    board = _board()
    QuanserPlant(QuanserSettings(), PERIOD, hardware=board)
    with pytest.raises(QuanserError, match="in use"):
        QuanserPlant(QuanserSettings(), PERIOD, hardware=board)


def test_only_a_virtual_stand_in_waits_for_its_reader() -> None:
    handle = _opened()
    with pytest.raises(HILError, match="virtual"):
        handle.task_set_buffer_overflow_mode(_reader(handle), BufferOverflowMode.WAIT_ON_OVERFLOW)


def test_a_failure_can_be_asked_for_by_the_name_of_a_call() -> None:
    with pytest.raises(ValueError, match="no call 'read_minds'"):
        _board().fail_next("read_minds")


def test_there_is_an_aero_on_the_stand_in() -> None:
    rigid = PlantSettings(kind="rigid_body", sensors=SensorSettings(attitude="perfect", rate="perfect"))
    with pytest.raises(ValueError, match=r"plant\.kind"):
        FakeQuanser(rigid, PERIOD)


def test_the_ideal_aero_on_the_stand_in_has_encoders_all_the_same() -> None:
    plant, board = _made(PlantSettings(ideal=True, voltage_limit=18.0))
    for _ in range(300):
        _drive(plant, 1)
        seen, true = plant.measure().attitude, board.truth().attitude
        assert seen == pytest.approx(true, abs=2 * pi / 2880)  # half a count in pitch and in yaw, halved again
    assert seen != true


# By the clock


class HandClock:
    """Takes the place of the module `time`; sleeping takes no time but its own."""

    def __init__(self) -> None:
        self.ns = 10**9
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        return self.ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.ns += round(seconds * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> HandClock:
    hand = HandClock()
    monkeypatch.setattr(quanser_usb, "time", hand)
    monkeypatch.setattr(quanser_fake, "time", hand)
    return hand


def _timed(**changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    board = _board(realtime=True)
    return QuanserPlant(QuanserSettings(**changed), PERIOD, hardware=board), board


def test_the_clocks_board_paces_its_reader_on_an_absolute_grid(clock: HandClock) -> None:
    plant, board = _timed()
    began = clock.ns
    for k in range(1, 20):
        plant.actuate(OFF)
        plant.advance()
        assert clock.ns == began + k * PERIOD_NS
        assert (plant.passed, board.time) == (1, k)
        clock.ns += 100_000 * (k % 7)  # the owner's work, of less than a period
    assert plant.overrun == 0


def test_the_clocks_board_goes_on_while_its_reader_is_late(clock: HandClock) -> None:
    plant, board = _timed()
    plant.advance()
    slept = len(clock.slept)
    clock.ns += 25 * PERIOD_NS + PERIOD_NS // 2
    plant.advance()
    assert (plant.passed, plant.overrun, board.time) == (25, 24, 26)
    assert not _is_nothing(plant.measure())
    assert len(clock.slept) == slept  # the newest sample was there
    for _ in range(25):
        plant.advance()
    assert clock.slept[-1] == PERIOD / 2  # and the next is due where it always was
    assert (plant.passed, plant.overrun) == (1, 24)


def test_the_clocks_board_goes_to_0_v_when_its_reader_stalls(clock: HandClock) -> None:
    plant, board = _timed()
    _drive(plant, 5)
    clock.ns += (WATCHDOG + 1) * PERIOD_NS
    plant.actuate(VOLTS)  # too late, and refused
    assert board.motor_voltages == OFF
    plant.advance()
    assert (plant.expiries, plant.passed) == (1, WATCHDOG + 1)
    assert _is_nothing(plant.measure())


def test_reads_that_fail_by_the_clock_keep_the_loop_in_the_boards_time(clock: HandClock) -> None:
    """They return at once, and samples go on coming: those are not counted twice."""
    plant, board = _timed()
    began = clock.ns
    plant.advance()
    board.fail_next("task_read", 10)
    for k in range(2, 12):
        plant.advance()
        assert (clock.ns, plant.passed) == (began + k * PERIOD_NS, 1)
    plant.advance()  # finds the sample of the last failed read, at once: the one period that is counted twice
    assert (clock.ns, plant.passed, board.time) == (began + 11 * PERIOD_NS, 1, 11)
    plant.advance()
    assert (clock.ns, plant.passed, board.time) == (began + 12 * PERIOD_NS, 1, 12)
    assert (plant.failures, plant.overrun) == (10, 0)


# Settings


@pytest.mark.parametrize(
    "changed",
    [
        {"card_type": "q2_usb"},
        {"voltage_limit": 24.5},
        {"voltage_limit": 0.0},
        {"board_watchdog_s": 0.0},
        {"gyro_axes": (0, 1, 1)},
        {"motor_channels": (0, 0)},
        {"motor_channels": (1, 2)},
        {"motor_signs": (1, 0)},
        {"encoder_signs": (1, 2)},
        {"damping_ratio": 1.0},
        {"pitch_counts": 0},
        {"colour": "red"},
    ],
)
def test_settings_that_no_board_has_are_refused(changed: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        QuanserSettings.model_validate(changed)


def test_the_stand_in_has_what_is_used_of_the_module() -> None:
    hardware: Hardware = _board()  # for the type checker, too
    assert hardware.Clock.HARDWARE_CLOCK_0 == 0
    assert issubclass(hardware.HILError, Exception)
