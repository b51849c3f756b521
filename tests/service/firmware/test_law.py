"""The law in C: what it does without numbers, with ticks that are none, and beside the node in one program."""

from __future__ import annotations

import ctypes
import subprocess
from math import inf, nan
from pathlib import Path
from typing import Final

import pytest

from aeroloop.protocol.messages.states import PlantState
from aeroloop.protocol.transport.can_format import COMMAND_ID, MEASUREMENT_ID
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import Settings, load
from aeroloop.service.firmware.export import export
from tests.support.board import NODE_SOURCES, Board, Sent, board_library
from tests.support.firmware import COMPILERS, NO_COMPILER, SOURCE, library

pytestmark = pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)

WIRE = WireSpec()
NO_VALUE = (WIRE.voltage.quantizer().invalid,) * 2
LAW: Final = r"""
#include <math.h>
#include <string.h>
#include "aero_law.h"
static aero_law law;
void start(void) { aero_law_start(&law); }
int tick(const uint8_t *frame, size_t size, int64_t k, uint8_t *command)
{
    return aero_law_tick(&law, frame, size, k, command);
}
int fault(void) { return law.fault; }
uint32_t refused(void) { return law.refused; }
"""
NAMES: Final = r"""
typedef struct { double estimate[2]; } aero_state;
typedef struct { double none[1]; } aero_gains;
#define AERO_STATE_BYTES 16U
#define AERO_INITIAL_STATE {{0.0, 0.0}}
#define AERO_GAINS_BYTES 0U
#define AERO_CONFIGURED_GAINS {{0.0}}
#define AERO_PERIOD_S 0.002
#define AERO_PIECE(start) {start, {{0.0}}, {0.0}, {0.0}}
#define AERO_REFERENCE {AERO_PIECE(0.0), AERO_PIECE(0.01), AERO_PIECE(0.02)}
int aero_equations(const double **arguments, double **results, long long int *indices, double *scratch, int);
extern const uint64_t aero_equations_config;
#define AERO_SCRATCH_ARGUMENTS 10
#define AERO_SCRATCH_RESULTS 6
#define AERO_SCRATCH_INDICES 1
#define AERO_SCRATCH 1
"""
"""Of a law that the tests make give what they want."""
EQUATIONS: Final = r"""
#include <string.h>
#include "aero_law.h"
const uint64_t aero_equations_config = AERO_CONFIG;
double volts[2], after[2], asked[2];
int status, evaluated;
int aero_equations(const double **arguments, double **results, long long int *indices, double *scratch, int memory)
{
    static const double zeros[4];
    (void)indices; (void)scratch; (void)memory;
    evaluated++;
    asked[0] = *arguments[0];
    asked[1] = *arguments[1];
    if (status != 0) { return status; }
    memcpy(results[0], zeros, sizeof zeros);
    memcpy(results[1], after, sizeof after);
    memcpy(results[2], zeros, sizeof zeros);
    memcpy(results[3], zeros, 3 * sizeof *zeros);
    memcpy(results[4], zeros, 3 * sizeof *zeros);
    memcpy(results[5], volts, sizeof volts);
    return 0;
}
"""


class Law:
    """The law around equations that give what a test sets."""

    def __init__(self, c: ctypes.CDLL) -> None:
        self.c = c
        self.volts = (ctypes.c_double * 2).in_dll(c, "volts")
        self.after = (ctypes.c_double * 2).in_dll(c, "after")
        self.asked = (ctypes.c_double * 2).in_dll(c, "asked")  # time, start of the reference's piece
        self.status = ctypes.c_int.in_dll(c, "status")
        self.evaluated = ctypes.c_int.in_dll(c, "evaluated")
        self.give()
        self.start()

    def give(self, *, volts: tuple[float, float] = (3.0, -3.0), state: float = 0.5, status: int = 0) -> None:
        """What the equations give from now on."""
        self.volts[:] = [*volts]
        self.after[:] = [0.25, state]
        self.status.value = status

    def start(self) -> None:
        """Begin a session."""
        self.c.start()

    def tick(self, k: int, frame: bytes | None = None) -> tuple[float, ...] | None:
        """Answer a measurement of tick k: the codes of the command; None if it was refused."""
        measurement = WIRE.measurement.pack(k % WIRE.measurement.counters, [1, 2, 3, 4, 5, 6])
        given = measurement if frame is None else frame
        command = (ctypes.c_uint8 * WIRE.command.size)()
        length = self.c.tick(given, ctypes.c_size_t(len(given)), ctypes.c_int64(k), command)
        if length < 0:
            return None
        counter, codes = WIRE.command.unpack(bytes(command[:length])) or (None, None)
        assert counter == k % WIRE.measurement.counters
        return codes


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("law")
    texts = {"aero_names.h": NAMES, "law_under_test.c": LAW, "aero_equations.c": EQUATIONS}
    for name, text in texts.items():
        (folder / name).write_text(text)
    sources = [*(SOURCE / f"aero_{part}.c" for part in ("wire", "law")), *folder.glob("*.c")]
    return library(Settings(), folder, *sources)


@pytest.fixture
def law(compiled: ctypes.CDLL) -> Law:
    return Law(compiled)


def test_it_commands_what_its_equations_give(law: Law) -> None:
    encode = WIRE.voltage.quantizer().encode
    assert law.tick(0) == (encode(3.0), encode(-3.0))
    law.give(volts=(inf, -5.0), state=inf)
    top = WIRE.voltage.quantizer().top  # type: ignore[attr-defined]
    assert law.tick(1) == (top, encode(-5.0)), "what is beyond the range saturates, and is no fault"
    assert law.c.fault() == 0


def test_a_piece_of_the_reference_holds_from_its_start_on(law: Law) -> None:
    for k, start in ((0, 0.0), (4, 0.0), (5, 0.01), (9, 0.01), (10, 0.02), (1_000_000, 0.02)):
        law.tick(k)
        assert law.asked[:] == [k * 0.002, start]


@pytest.mark.parametrize(
    "given",
    [{"state": nan}, {"volts": (nan, 1.0)}, {"volts": (1.0, nan)}, {"volts": (inf, -inf)}, {"status": 1}],
    ids=["a state", "a voltage", "another voltage", "voltages without a sum", "equations that failed"],
)
def test_without_a_number_every_command_has_no_valid_value_until_the_session_begins_anew(
    law: Law, given: dict[str, float]
) -> None:
    assert law.tick(0) != NO_VALUE
    law.give(**given)  # type: ignore[arg-type]
    assert law.tick(1) == NO_VALUE
    assert law.c.fault() == 1
    law.give()
    evaluated = law.evaluated.value
    assert [law.tick(k) for k in (2, 3, 4)] == [NO_VALUE] * 3
    assert law.evaluated.value == evaluated
    law.start()
    assert law.c.fault() == 0
    assert law.tick(0) not in (None, NO_VALUE)


def test_a_negative_tick_and_a_frame_of_another_length_are_refused_and_counted(law: Law) -> None:
    assert law.tick(-1) is None
    assert law.tick(0, bytes(WIRE.measurement.size + 1)) is None
    assert law.tick(0, b"") is None
    assert law.c.refused() == 3
    law.give(status=1)
    assert law.tick(-(2**63)) is None
    assert law.c.fault() == 0, "the equations were not asked"


# ── law and node in one program ──


BOTH: Final = r"""
#include "aero_law.h"
#include "aero_node.h"
static aero_law law;
void start_law(void) { aero_law_start(&law); }
int answer(const uint8_t *frame, size_t size, int64_t k, uint8_t *command)
{
    return aero_law_tick(&law, frame, size, k, command);
}
int fault(void) { return law.fault; }
"""


def both(settings: Settings, folder: Path) -> tuple[Board, ctypes.CDLL]:
    (folder / "both.c").write_text(BOTH)
    sources = [*NODE_SOURCES, SOURCE / "aero_law.c", folder / "aero_equations.c", folder / "both.c"]
    c = board_library(settings, folder, sources, may_warn=True)
    c.start_law()
    return Board(settings, c), c


@pytest.fixture
def settings() -> Settings:
    return load(overrides=["plant.via=can"])


def test_law_and_node_of_one_export_close_the_loop(settings: Settings, tmp_path: Path) -> None:
    export(settings, tmp_path)
    board, c = both(settings, tmp_path)
    board.turn()
    board.begin()
    command = (ctypes.c_uint8 * settings.wire.command.size)()
    for k in range(50):
        measured = [call for call in board.calls if isinstance(call, Sent) and call.identifier == MEASUREMENT_ID + 1]
        frame = measured[-1].data
        assert c.answer(frame, ctypes.c_size_t(len(frame)), ctypes.c_int64(k), command) == len(command)
        board.turn((COMMAND_ID + 1, bytes(command)))
    assert board.state is PlantState.DRIVEN
    assert board.volts != board.off
    assert c.fault() == 0


def test_a_law_of_another_export_commands_no_valid_value(settings: Settings, tmp_path: Path) -> None:
    """Its equations are of other gains, whose files look alike."""
    export(settings, tmp_path)
    other = load(overrides=["plant.via=can", "law.C1=[0.4,0.3,0.3]"])
    export(other, tmp_path / "other")
    (tmp_path / "aero_equations.c").write_text((tmp_path / "other" / "aero_equations.c").read_text())
    _, c = both(settings, tmp_path)
    assert c.fault() == 1
    command = (ctypes.c_uint8 * settings.wire.command.size)()
    measurement = settings.wire.measurement.pack(0, [0] * 6)
    assert c.answer(measurement, ctypes.c_size_t(len(measurement)), ctypes.c_int64(0), command) == len(command)
    assert settings.wire.command.unpack(bytes(command)) == (0, NO_VALUE)


def test_headers_of_two_exports_do_not_compile(settings: Settings, tmp_path: Path) -> None:
    export(settings, tmp_path)
    export(load(overrides=["law.C1=[0.4,0.3,0.3]"]), tmp_path / "other")
    (tmp_path / "aero_names.h").write_text((tmp_path / "other" / "aero_names.h").read_text())
    words = [COMPILERS[0], "-c", "-o", "/dev/null", "aero_law.c"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode != 0
    assert "aero_config.h is of another export" in done.stderr
