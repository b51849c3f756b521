"""Aero on Quanser's board: each call in its order, voltages, watchdog, samples that are lost or late, and its loop.

The fake refuses every call that a board would refuse, so every test also checks types, channels and order. Its time is
a count of samples of 2 ms: the board's watchdog of 0.1 s expires after 50 of them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from math import cos, inf, isnan, nan, pi, sin
from typing import Any

import pytest

from aeroloop.plant_emulator.hosts import quanser_board
from aeroloop.plant_emulator.hosts.quanser_board import QuanserPlant
from aeroloop.plant_emulator.model.emulated import EmulatedPlant, SensorSettings
from aeroloop.plant_emulator.plant import Measurement, Plant, PlantError
from aeroloop.plant_emulator.settings import PlantSettings, QuanserSettings
from aeroloop.protocol.messages.models import Grant
from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.wire.attitude import IDENTITY
from aeroloop.protocol.wire.spec import LoopSettings
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from tests.support import fake_quanser
from tests.support.clock import FakeClock
from tests.support.fake_quanser import BufferOverflowMode, FakeQuanser
from tests.support.plant_end import claim_of

PERIOD = 0.002
PERIOD_NS = 2_000_000
WATCHDOG = 50
"""Samples in 0.1 s."""
AERO = PlantSettings(voltage_limit=18.0)
OFF = (0.0, 0.0)
VOLTS = (9.0, -12.0)


def plant_on_board(*, realtime: bool = False, session: bool = True, **changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    """A plant that was just opened, and its board; `changed` are fields of QuanserSettings."""
    quanser = QuanserSettings(**changed)
    board = FakeQuanser(AERO, PERIOD, card_type=quanser.card_type, realtime=realtime)
    plant = plant_of(board, quanser)
    if session:
        plant.enable(True)
    return plant, board


def plant_of(board: FakeQuanser, settings: QuanserSettings = AERO.quanser) -> QuanserPlant:
    """A plant on this board, which is what `import quanser.hardware` finds."""
    sys.modules.update(fake_quanser.modules(board))
    return QuanserPlant(settings, PERIOD, AERO.watchdog_s)


def drive(plant: Plant, periods: int, voltages: tuple[float, float] = VOLTS) -> None:
    for _ in range(periods):
        plant.actuate(voltages)
        plant.advance()


def driven_plant(**changed: Any) -> tuple[QuanserPlant, FakeQuanser]:
    plant, board = plant_on_board(**changed)
    drive(plant, 100)
    return plant, board


def expired_plant() -> tuple[QuanserPlant, FakeQuanser]:
    """A plant whose board's watchdog expired while it was driven, and that has noticed; no periods are owed."""
    plant, board = driven_plant()
    board.let_pass(WATCHDOG + 1)
    for _ in range(WATCHDOG + 1):
        plant.advance()
    assert board.expired
    assert is_nothing(plant.measure())
    return plant, board


def emulated_aero(counts: tuple[int, int] = (2880, 4096)) -> EmulatedPlant:
    return AERO.model_copy(update={"sensors": SensorSettings(counts=counts)}).build(PERIOD)


def is_nothing(seen: Measurement) -> bool:
    return all(isnan(value) for value in (*seen.attitude, *seen.rate))


@pytest.fixture(autouse=True)
def no_package() -> Iterator[None]:
    """Remove the fake package that a test has put in the place of Quanser's."""
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "quanser"]:
        del sys.modules[name]


CLOSING = ["write_analog", "write_digital", "watchdog_stop", "task_stop", "task_delete", "close"]


def test_where_quansers_package_cannot_be_imported_the_error_names_what_to_install() -> None:
    with pytest.raises(PlantError, match=r"No module named 'quanser'.*Quanser SDK.*quanser_api") as refused:
        QuanserPlant(QuanserSettings(), PERIOD, 0.1)
    assert "\n" not in str(refused.value)


def test_a_board_is_made_safe_before_anything_else_and_sampled_only_when_time_begins() -> None:
    plant, board = plant_on_board(session=False)
    assert " ".join(board.calls) == (
        "open watchdog_stop watchdog_clear write_analog write_digital watchdog_set_analog_expiration_state "
        "watchdog_set_digital_expiration_state set_encoder_counts read task_create_reader task_set_buffer_overflow_mode"
    )
    assert (board.analog, board.enabled) == ([0.0, 0.0], [False, False])
    assert board.at_expiry == {"analog": [0.0, 0.0], "digital": [False, False]}
    assert board.task is not None
    assert board.task.mode == BufferOverflowMode.OVERWRITE_ON_OVERFLOW
    assert board.task.samples.maxlen == 1
    period = ["task_read", "task_get_buffer_overflows", "watchdog_reload"]
    for expected in (["watchdog_start", "task_start", *period], period):
        board.calls.clear()
        plant.advance()
        assert list(board.calls) == expected


def test_a_board_that_was_left_under_an_expired_watchdog_is_had_again_at_0_v() -> None:
    _, board = driven_plant()
    board.let_pass(WATCHDOG + 1)
    assert board.expired
    board.holder = board.task = None  # its process died
    plant_of(board)
    assert not board.expired
    assert board.motor_voltages == OFF
    assert board.analog == [0.0, 0.0]  # not only behind a switch


def test_a_board_that_cannot_be_had_or_started_is_one_line_and_is_closed() -> None:
    _, board = plant_on_board()
    for settings, words in [
        (QuanserSettings(card_type="quanser_aero_usb"), "quanser_aero_usb '0': there is no quanser_aero_usb '0'; .*?"),
        (QuanserSettings(card_identifier="1"), "quanser_aero2_usb '1': there is no quanser_aero2_usb '1'"),
        (QuanserSettings(), "quanser_aero2_usb '0': the board is in use"),
    ]:
        with pytest.raises(PlantError, match=f"cannot open {words}"):
            plant_of(board, settings)
    board = FakeQuanser(AERO, PERIOD)
    board.fail_next("task_create_reader")
    with pytest.raises(PlantError, match="cannot make quanser_aero2_usb '0' ready: task_create_reader was made"):
        plant_of(board)
    assert board.holder is None
    plant = plant_of(board)  # so another try can have it
    board.fail_next("watchdog_start")
    with pytest.raises(PlantError, match="cannot start quanser_aero2_usb: watchdog_start was made to fail"):
        plant.advance()
    plant.close()
    assert board.holder is None


@pytest.mark.parametrize("failing", ["write_analog", "task_stop", "both writes", "none", "all"])
def test_closing_goes_on_when_a_step_fails_and_leaves_to_the_watchdog_what_it_could_not_do(failing: str) -> None:
    plant, board = driven_plant()
    if failing == "all":
        board.unplug()
    for call in {"none": (), "all": (), "both writes": ("write_analog", "write_digital")}.get(failing, (failing,)):
        board.fail_next(call)
    board.calls.clear()
    plant.close()
    plant.close()
    left = failing in ("all", "both writes")
    assert list(board.calls) == [call for call in CLOSING if not left or call != "watchdog_stop"]  # once
    assert board.motor_voltages == (VOLTS if left else OFF)
    assert (board.holder, board.watchdog is not None) == (None, left)


@pytest.mark.parametrize(
    ("changed", "commanded", "written"),
    [
        ({}, (inf, -inf), [18.0, -18.0]),
        ({"voltage_limit": 5.0}, (4.0, -6.0), [4.0, -5.0]),
        ({}, (nan, 3.0), [0.0, 3.0]),
        ({"motor_signs": (1, -1)}, (4.0, 6.0), [4.0, -6.0]),
    ],
)
def test_voltages_are_clipped_no_number_is_0_v_and_motors_can_be_turned(
    changed: dict[str, Any], commanded: tuple[float, float], written: list[float]
) -> None:
    plant, board = plant_on_board(**changed)
    plant.actuate(commanded)
    assert board.analog == written


def test_the_amplifier_is_on_during_a_session_only() -> None:
    plant, board = plant_on_board(session=False)
    for on in (False, True, False):
        plant.enable(on)
        volts = VOLTS if on else OFF
        assert board.enabled == [on, on]  # at once
        drive(plant, 3)
        assert (board.enabled, board.truth().voltages) == ([on, on], volts)
        assert board.analog == list(volts)  # not only behind a switch
    plant.enable(True)
    drive(plant, 500, OFF)
    assert board.enabled == [True, True]


def test_an_amplifier_that_could_not_be_switched_is_switched_at_the_next_tick() -> None:
    plant, board = driven_plant()
    board.fail_next("write_digital")
    plant.enable(False)
    assert (board.enabled, board.analog) == ([True, True], [0.0, 0.0])
    plant.actuate(OFF)
    assert board.enabled == [False, False]


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
    assert (board.analog, board.enabled) == ([0.0, 0.0], [False, False])


def test_a_watchdog_that_expired_is_noticed_and_nothing_written_while_it_has_the_outputs() -> None:
    plant, board = driven_plant()
    plant.actuate(OFF)
    board.let_pass(WATCHDOG + 1)
    board.calls.clear()
    plant.advance()
    assert is_nothing(plant.measure())
    assert plant.note.endswith("the last: the board's watchdog expired")
    assert (plant.passed, plant.failures) == (WATCHDOG + 1, 1)
    for _ in range(WATCHDOG):
        plant.advance()
    plant.enable(False)
    assert not any(call.startswith("write") for call in board.calls)


def test_an_expired_watchdog_is_cleared_by_0_v_and_by_nothing_else_and_then_armed() -> None:
    plant, board = expired_plant()
    board.calls.clear()
    for _ in range(5):
        drive(plant, 1)
        assert is_nothing(plant.measure())
        assert board.truth().voltages == OFF
    assert not {"watchdog_clear", "write_analog", "write_digital"} & set(board.calls)
    board.calls.clear()
    drive(plant, 1, OFF)
    clearing = ["watchdog_stop", "watchdog_clear", "watchdog_start", "write_analog", "write_digital"]
    assert list(board.calls)[:5] == clearing
    assert not is_nothing(plant.measure())
    assert board.truth().voltages == OFF  # though clearing restored the outputs of before
    drive(plant, 1)
    assert board.truth().voltages == VOLTS
    board.let_pass(WATCHDOG + 1)
    assert board.motor_voltages == OFF
    plant.advance()
    assert is_nothing(plant.measure())


@pytest.mark.parametrize("call", ["watchdog_start", "write_analog"])
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


@pytest.mark.parametrize("call", ["task_read", "write_analog"])
def test_a_failed_call_reloads_no_watchdog_and_after_a_failed_read_no_old_sample_is_measured(call: str) -> None:
    plant, board = driven_plant()
    board.fail_next(call)
    for reloads in (False, True):
        board.calls.clear()
        drive(plant, 1)
        assert ("watchdog_reload" in board.calls) == reloads
        assert is_nothing(plant.measure()) == (call == "task_read" and not reloads)
        assert plant.passed == 1
    assert plant.note == f"the board: 1 failed calls, the last: {call} was made to fail"


@pytest.mark.parametrize("call", ["task_read", "write_analog", "write_digital"])
def test_where_reads_or_writes_fail_for_long_the_board_goes_to_0_v_by_itself(call: str) -> None:
    plant, board = driven_plant()
    board.fail_next(call, 1000)
    for k in range(WATCHDOG + 5):
        assert (board.truth().voltages == OFF) == (k > WATCHDOG)  # of the period that is over
        plant.actuate(VOLTS)  # the loop that drives it goes on
        if call == "write_digital":
            plant.enable(False)
            board.analog[:] = VOLTS  # were only the amplifier left to switch the motors off
        plant.advance()
    assert is_nothing(plant.measure())
    assert board.expired


@pytest.mark.parametrize(
    ("card", "counts", "voltages", "periods", "yaw"),
    [
        ("quanser_aero2_usb", (2880, 4096), (-18.0, 18.0), 3000, 4096),
        ("quanser_aero_usb", (2048, 4096), (9.0, -12.0), 300, 20),
    ],
)
def test_measurements_are_those_of_an_emulated_aero_with_the_cards_encoders(
    card: str, counts: tuple[int, int], voltages: tuple[float, float], periods: int, yaw: int
) -> None:
    """To the last bit: encoders, filter and body are the same pieces, also where yaw has turned more than once."""
    plant, board = plant_on_board(card_type=card)
    twin = emulated_aero(counts)
    assert plant.measure() == Measurement(IDENTITY, (0.0, 0.0, 0.0))
    for _ in range(periods):
        for each in (plant, twin):
            drive(each, 1, voltages)
        assert plant.measure() == twin.measure()
    assert abs(board.sample([3], [])[0][0]) > yaw


def test_counts_are_an_angle_each_with_its_sign() -> None:
    plant, board = plant_on_board(encoder_signs=(-1, 1))
    board.set_counts(2, 160)
    board.set_counts(3, -512)
    plant.advance()
    p, y = -2 * pi * 160 / 2880 / 2, 2 * pi * -512 / 4096 / 2
    half = cos(y) * cos(p), -sin(y) * sin(p), cos(y) * sin(p), sin(y) * cos(p)  # R_z(yaw) R_y(pitch)
    assert plant.measure().attitude == pytest.approx(half, abs=1e-15)


def test_a_gyros_rates_need_no_filter_and_its_axes_can_be_set() -> None:
    plant, board = driven_plant(rate="gyro", gyro_channels=(3, -1, -2))
    x, y, z = board.truth().rate
    assert 0.0 not in (x, y, z)
    assert plant.measure().rate == (z, -x, -y)


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
    board.calls.clear()
    now = board.time
    for _ in range(3):  # periods that are over are not waited for
        plant.advance()
        assert is_nothing(plant.measure())
    assert (list(board.calls), board.time) == ([], now)
    plant.advance()
    assert not is_nothing(plant.measure())
    assert (board.time, plant.passed) == (now + 1, 1)


def test_reads_that_fail_by_the_clock_keep_the_loop_in_the_boards_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """They return at once, and samples go on coming: those are not counted twice."""
    clock = FakeClock()
    for module in (quanser_board, fake_quanser):
        monkeypatch.setattr(module, "time", clock)
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


def test_one_lost_sample_does_not_end_a_session_and_an_unplugged_board_trips_in_the_time_of_its_limit() -> None:
    plant, board = plant_on_board(session=False)
    settings = Settings()
    wire, loop = settings.wire, LoopSettings(lockstep=True)
    endpoint = settings.plant.endpoint(plant, loop, wire)
    assert isinstance(endpoint.claim(claim_of(wire=wire, period_ns=loop.period_ns, lockstep=True)), Grant)
    controller = Controller(wire, settings.law, settings.reference, PERIOD)
    measurement = endpoint.tick(None, 0)
    for k in range(1000):
        if k == 100:
            board.fail_next("task_read")
        if k == 200:
            assert (endpoint.state, board.enabled) == (PlantState.DRIVEN, [True, True])  # by the endpoint
            assert (controller.invalid, plant.failures) == (1, 1)
            board.unplug()
        if measurement is None:
            break
        measurement = endpoint.tick(controller.tick(measurement, k), k + 1)
    # limits.max_invalid_s = 0.1 s of samples without a value are 50 ticks, and the one that makes it more
    assert (k, endpoint.session) == (251, None)
    assert "no valid value" in endpoint.notices[-1].text
    assert board.analog == [0.0, 0.0]  # no write reaches it any more: the board's watchdog did
    assert board.expired
