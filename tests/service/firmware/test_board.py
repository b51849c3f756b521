"""The node in C on a board: what it calls of the port, in which order, and what it bounds and refuses.

That it decides as the node in Python does is test_node.py's.
"""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from math import nan
from pathlib import Path
from typing import Any

import pytest

from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import CanSettings
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.protocol.wire.transmit import Transmit
from aeroloop.service.config import Settings
from aeroloop.service.firmware.configuration import config_header
from tests.support.board import NODE_SOURCES, Actuated, Board, Enabled, Sent, board_library
from tests.support.firmware import COMPILERS, NO_COMPILER, SOURCE

pytestmark = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)

WATCHDOG_TICKS = 8
SATURATED_TICKS = 30
INVALID_TICKS = 10
FULL = 23.0  # the node clips it to its supply, and the motor counts as saturated [V]
SUPPLY = 18.0
AT_REST = Measurement((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
BLIND = Measurement((1.0, 0.0, 0.0, 0.0), (0.0, nan, 0.0))
TURNED_OVER = Measurement((0.6, 0.8, 0.0, 0.0), (0.0, 0.0, 0.0))


def settings_of(**changed: Any) -> Settings:
    limits = {"max_saturated_s": 0.002 * SATURATED_TICKS + 0.001, "max_invalid_s": 0.002 * INVALID_TICKS + 0.001}
    plant = {"via": "can", "watchdog_s": 0.002 * WATCHDOG_TICKS, "voltage_limit": SUPPLY, "limits": limits}
    return Settings.model_validate({"plant": plant, "controller": {"stale_s": 0.016}} | changed)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return board_library(settings_of(), tmp_path_factory.mktemp("node"))


@pytest.fixture
def board(compiled: ctypes.CDLL) -> Board:
    """In no session yet."""
    return Board(settings_of(), compiled)


@pytest.fixture
def driven(board: Board) -> Board:
    """In a session, with different voltages at both motors."""
    board.turn()
    board.begin()
    board.drive(9.0, -9.0)
    assert board.state is PlantState.DRIVEN
    assert board.volts != board.off
    assert board.is_powered
    return board


def test_it_starts_at_0_v_with_the_power_stage_off_and_stays_so_without_a_session(board: Board) -> None:
    assert board.calls == [Actuated(-1, board.off), Enabled(on=False)]
    for _ in range(3):
        board.turn(board.command(9.0, 9.0, echo=0))
    assert board.volts == board.off
    assert not board.is_powered
    assert [call.tick for call in board.calls if isinstance(call, Actuated)] == [-1, 0, 0, 1]


def test_the_power_stage_is_on_from_the_begin_of_a_session_but_the_voltage_only_with_the_first_command(
    board: Board,
) -> None:
    board.turn()
    board.begin()
    board.turn()
    assert board.is_powered
    assert board.volts == board.off
    board.drive(9.0, -9.0)
    assert board.volts != board.off


# ── 0 V first, at every end ──


def goes_silent(board: Board) -> None:
    board.now_ns += 501_000_000
    board.turn()


def is_left_waiting(board: Board) -> None:
    for _ in range(WATCHDOG_TICKS + 1):
        board.turn()


def is_saturated(board: Board, volts: float = FULL) -> None:
    board.drive(volts, 0.0, ticks=SATURATED_TICKS + 1)


def fails(board: Board) -> None:
    board.trip(TripCause.PLANT)
    board.poll()


def measures(reading: Measurement, ticks: int = 1) -> Callable[[Board], None]:
    def end(board: Board) -> None:
        board.reading = reading
        board.drive(9.0, -9.0, ticks=ticks)

    return end


ENDS: dict[str, tuple[Callable[[Board], None], PlantState, TripCause | None]] = {
    "released": (lambda board: board.turn(board.beat(state=PlantState.IDLE)), PlantState.IDLE, None),
    "left": (Board.leave, PlantState.IDLE, None),
    "silent": (goes_silent, PlantState.TRIPPED, TripCause.HOLDER_GONE),
    "watchdog": (is_left_waiting, PlantState.TRIPPED, TripCause.COMMAND_TIMEOUT),
    "watchdog, in one jump": (
        lambda board: board.turn(k=board.tick + 50),
        PlantState.TRIPPED,
        TripCause.COMMAND_TIMEOUT,
    ),
    "no valid value": (lambda board: board.drive(nan, nan), PlantState.TRIPPED, TripCause.INVALID_COMMAND),
    "turned over": (measures(TURNED_OVER), PlantState.TRIPPED, TripCause.ENVELOPE),
    "too fast": (
        measures(Measurement(AT_REST.attitude, (0.0, 0.0, 20.1))),
        PlantState.TRIPPED,
        TripCause.ENVELOPE,
    ),
    "saturated": (is_saturated, PlantState.TRIPPED, TripCause.SATURATION),
    "saturated, negative": (lambda board: is_saturated(board, -FULL), PlantState.TRIPPED, TripCause.SATURATION),
    "blind": (measures(BLIND, INVALID_TICKS + 1), PlantState.TRIPPED, TripCause.SENSORS),
    "the board's own": (fails, PlantState.TRIPPED, TripCause.PLANT),
    "a tick again": (lambda board: board.turn(k=board.tick), PlantState.TRIPPED, TripCause.NODE),
    "a tick below 0": (lambda board: board.turn(k=-1), PlantState.TRIPPED, TripCause.NODE),
}


@pytest.mark.parametrize("name", ENDS)
def test_at_every_end_0_v_comes_first_then_the_power_stage_then_the_bus(driven: Board, name: str) -> None:
    end, state, cause = ENDS[name]
    driven.calls.clear()
    end(driven)
    off = driven.calls.index(Enabled(on=False))
    last = driven.calls[off - 1]
    assert isinstance(last, Actuated)
    assert last.volts == driven.off
    assert [call for call in driven.calls[off:] if isinstance(call, Sent)], "its heartbeat says it at once"
    assert driven.heartbeat.state is state
    assert driven.heartbeat.cause is cause
    assert driven.cause is cause

    driven.tick = max(driven.tick, 100)
    if cause is not TripCause.HOLDER_GONE:  # a frame of its peer is the end of its silence
        driven.turn(driven.command(9.0, -9.0))
    driven.turn()
    assert {call.volts for call in driven.calls[off - 1 :] if isinstance(call, Actuated)} == {driven.off}
    assert not driven.is_powered
    assert driven.state is state


def test_another_session_begins_at_0_v(driven: Board) -> None:
    driven.calls.clear()
    driven.turn(driven.beat(number=2), driven.command(9.0, -9.0))
    assert [call for call in driven.calls if isinstance(call, Enabled)] == [Enabled(on=False), Enabled(on=True)]
    assert {call.volts for call in driven.calls if isinstance(call, Actuated)} == {driven.off}
    assert driven.state is PlantState.GRANTED


def test_a_node_that_leaves_after_a_trip_keeps_its_cause_at_0_v(driven: Board) -> None:
    driven.trip(TripCause.PLANT)
    driven.calls.clear()
    driven.leave()
    assert driven.calls[:2] == [Actuated(driven.tick, driven.off), Enabled(on=False)]
    assert driven.state is PlantState.TRIPPED
    assert driven.heartbeat.cause is TripCause.PLANT


# ── nothing of the session before ──


def test_a_measurement_without_a_value_in_an_earlier_session_forgives_no_command(board: Board) -> None:
    board.turn()
    board.reading = BLIND
    board.begin()
    board.drive(nan, nan)
    assert board.state is PlantState.DRIVEN, "it answers a measurement without a valid value, so it means 0 V"
    assert board.volts == board.off
    board.reading = AT_REST
    board.begin(number=2)
    board.drive(nan, nan)
    assert board.cause is TripCause.INVALID_COMMAND


def test_nor_does_one_whose_counter_the_session_has_not_reached_yet(tmp_path: Path) -> None:
    """On change a command may lack a value up to a heartbeat after a measurement did: here counter 15 is before 0."""
    wire = WireSpec(counter_bits=4, transmit=Transmit(measurement="on_change", heartbeat_s=0.008))
    settings = settings_of(wire=wire)
    board = Board(settings, board_library(settings, tmp_path))
    board.turn()
    board.begin()
    for counter in range(14):
        board.turn(board.command(9.0, 9.0, echo=counter))
    board.reading = BLIND
    board.turn(board.command(9.0, 9.0, echo=14))
    board.turn(board.command(nan, nan, echo=15))
    assert board.state is PlantState.DRIVEN
    board.reading = AT_REST
    board.begin(number=2)
    board.turn(board.command(nan, nan, echo=0))
    assert board.cause is TripCause.INVALID_COMMAND


@pytest.mark.parametrize("volts", [FULL, -FULL])
def test_time_at_full_voltage_counts_within_a_session_alone(board: Board, volts: float) -> None:
    board.turn()
    for number in (1, 2):
        board.begin(number)
        board.drive(0.0, volts, ticks=SATURATED_TICKS)
        assert board.state is PlantState.DRIVEN
    board.drive(0.0, 17.0)
    board.drive(0.0, volts, ticks=SATURATED_TICKS)
    assert board.state is PlantState.DRIVEN, "a tick below full voltage has begun the time anew"
    board.drive(0.0, volts)
    assert board.cause is TripCause.SATURATION


def test_time_without_valid_values_counts_within_a_session_alone(board: Board) -> None:
    board.turn()
    board.reading = BLIND
    for number in (1, 2):
        board.begin(number)
        board.drive(0.0, 0.0, ticks=INVALID_TICKS - 1)
        assert board.state is PlantState.DRIVEN
    board.drive(0.0, 0.0)
    assert board.cause is TripCause.SENSORS


def test_a_command_that_came_before_a_session_is_dropped(board: Board) -> None:
    board.turn()
    board.received.append(board.command(9.0, 9.0, echo=0))
    board.poll()
    board.begin()
    board.turn()
    assert board.state is PlantState.GRANTED
    assert board.volts == board.off


# ── bounds ──


def test_a_babbling_bus_holds_neither_the_tick_nor_the_watchdog(driven: Board) -> None:
    driven.babbles = (0x7FF, b"")
    before = driven.receives
    driven.turn()
    assert driven.receives - before < 200, "in a period of 2 ms no bus carries more"
    driven.turn(*[(0x7FF, b"")] * 100, driven.command(9.0, -9.0))
    assert driven.refused == 0
    for _ in range(WATCHDOG_TICKS - 1):
        driven.turn()
    assert driven.cause is None, "the command behind 100 other frames was taken in time"
    driven.turn()
    assert driven.cause is TripCause.COMMAND_TIMEOUT


@pytest.mark.parametrize("jump", [WATCHDOG_TICKS, WATCHDOG_TICKS + 1, 1_000_000, 2**63 - 1])
def test_a_jump_of_k_takes_one_step_and_counts_for_the_watchdog(driven: Board, jump: int) -> None:
    """The last command was put in force one tick ago."""
    volts = driven.volts
    put_in_force = driven.tick - 1
    driven.calls.clear()
    driven.turn(k=min(put_in_force + jump, 2**63 - 1))
    acts = [call for call in driven.calls if isinstance(call, Actuated)]
    if jump > WATCHDOG_TICKS:
        assert acts == [Actuated(put_in_force + 1, volts), Actuated(put_in_force + WATCHDOG_TICKS, driven.off)]
        assert driven.cause is TripCause.COMMAND_TIMEOUT
    else:
        assert acts == [Actuated(put_in_force + 1, volts)]
        assert driven.state is PlantState.DRIVEN


def test_a_k_below_0_before_the_first_tick_is_no_tick(board: Board) -> None:
    board.turn(k=-5)
    board.turn(k=0)
    board.begin()
    board.drive(9.0, -9.0)
    assert board.state is PlantState.DRIVEN


FUZZ = r"""
#include <string.h>
#include "aero_node.h"
#include "aero_port.h"
static uint64_t seed = 1;
static int64_t now = 1;
static uint32_t draw(uint32_t below) { seed = seed * 6364136223846793005U + 1; return (uint32_t)(seed >> 33) % below; }
int64_t aero_port_now(void) { return now += draw(4000000); }
void aero_port_actuate(int64_t k, const double volts[AERO_ACTUATORS]) { (void)k; (void)volts; }
void aero_port_enable(int on) { (void)on; }
void aero_port_measure(int64_t k, double q[4], double w[3])
{
    (void)k;
    for (int i = 0; i < 4; i++) { q[i] = i ? 0.1 * draw(3) : 1; }
    for (int i = 0; i < 3; i++) { w[i] = draw(3); }
}
void aero_port_send(uint32_t id, const uint8_t *data, size_t size) { (void)id; (void)data; (void)size; }
int aero_port_receive(uint32_t *id, uint8_t data[64], size_t *size)
{
    static const uint8_t mark[] = AERO_FINGERPRINT;
    memset(data, 0, 64);
    for (int i = 0; i < 4; i++) { data[i] = (uint8_t)draw(256); }
    *id = (draw(2) ? 0x200 : 0x380) + AERO_CAN_NODE;
    *size = draw(3) ? AERO_COMMAND_BYTES : draw(300);
    if (*id > 0x380) {
        data[0] = (uint8_t)(0x10 | AERO_GRANTED);
        memcpy(data + 1, mark, sizeof mark);
        *size = draw(5) ? 8 : draw(300);
    }
    return draw(4) != 0;
}
int main(void)
{
    static aero_node node;
    int64_t k = 0;
    aero_start(&node);
    for (int i = 0; i < 20000; i++) {
        k += draw(50) ? 1 : (int64_t)draw(1000) - 200;
        aero_poll(&node);
        (void)aero_answered(&node);
        aero_tick(&node, k);
    }
    return node.refused > 100 && node.ticked > 1000 ? 0 : 3;
}
"""


def test_frames_of_any_length_and_ticks_of_any_order_touch_nothing_but_the_node(tmp_path: Path) -> None:
    """By the sanitizers for addresses and undefined behaviour, with frames of up to 300 bytes as they say."""
    wire = WireSpec(attitude=SignalSpec(bits=None, limit=1.0), voltage=SignalSpec(bits=None, limit=24.0), actuators=3)
    settings = settings_of(wire=wire, can=CanSettings(fd=True))
    (tmp_path / "aero_config.h").write_text(config_header(settings))
    (tmp_path / "main.c").write_text(FUZZ)
    sanitized = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]
    words = [*sanitized, "-std=c99", f"-I{tmp_path}", f"-I{SOURCE}", "-o", str(tmp_path / "main"), "main.c"]
    sources = map(str, NODE_SOURCES)
    built = subprocess.run([COMPILERS[0], *words, *sources, "-lm"], cwd=tmp_path, capture_output=True, text=True)
    if "cannot find" in built.stderr:
        pytest.skip("the compiler has no sanitizers here")
    assert built.returncode == 0, built.stderr
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


# ── of one export ──


def test_object_files_of_two_exports_make_a_node_that_stays_tripped(tmp_path: Path) -> None:
    others = tmp_path / "other"
    others.mkdir()
    other = settings_of(wire=WireSpec(rate=SignalSpec(bits=8, limit=2.0)))
    (others / "aero_config.h").write_text(config_header(other))
    wire = others / "aero_wire.o"
    words = [COMPILERS[0], "-std=c99", "-fPIC", f"-I{others}", "-c", "-o", str(wire), str(SOURCE / "aero_wire.c")]
    subprocess.run(words, check=True)
    board = Board(settings_of(), board_library(settings_of(), tmp_path, [wire, SOURCE / "aero_node.c"]))
    board.turn()
    board.turn(board.beat())
    board.turn(board.command(9.0, 9.0, echo=0))
    assert board.state is PlantState.TRIPPED
    assert board.heartbeat.cause is TripCause.NODE
    assert board.volts == board.off
    assert not board.is_powered
