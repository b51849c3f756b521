"""The fake of Quanser's board: misuse that it refuses, and what it does where the documentation is silent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.support.fake_quanser import BufferOverflowMode, FakeHIL, FakeQuanser, MisuseError
from tests.support.quanser_board import AERO, PERIOD

CH = np.array([0, 1], dtype=np.uint32)
JOINTS = np.array([2, 3], dtype=np.uint32)
ZERO = np.zeros(2)
COUNTS = np.zeros(2, dtype=np.int32)
LINES = np.ones(2, dtype=np.int8)
UNLIMITED = 2**32 - 1
BOARD = FakeQuanser(AERO, PERIOD)
"""To be misused: its Aero is never moved, and building one takes a tenth of a second."""


def opened(board: FakeQuanser = BOARD) -> FakeHIL:
    board.holder = board.task = board.watchdog = None
    handle = board.HIL()
    handle.open("quanser_aero2_usb", "0")
    return handle


def armed() -> FakeHIL:
    handle = opened()
    handle.watchdog_set_analog_expiration_state(CH, 2, ZERO)
    handle.watchdog_set_digital_expiration_state(CH, 2, COUNTS)
    handle.watchdog_start(0.1)
    return handle


def reader(handle: FakeHIL) -> object:
    return handle.task_create_reader(1, None, 0, JOINTS, 2, None, 0, None, 0)


def started() -> FakeHIL:
    handle = opened()
    handle.task_start(reader(handle), 0, 500.0, UNLIMITED)
    return handle


def read_only() -> np.ndarray[tuple[int], np.dtype[np.int32]]:
    counts = np.zeros(2, dtype=np.int32)
    counts.flags.writeable = False
    return counts


@pytest.mark.parametrize(
    ("ready", "use"),
    [
        (opened, lambda h: h.write_analog(CH.astype(np.int32), 2, ZERO)),
        (opened, lambda h: h.write_analog(CH, 2, np.zeros(3))),
        (opened, lambda h: h.write_analog(np.array([0, 2], dtype=np.uint32), 2, ZERO)),
        (opened, lambda h: h.write_analog(CH, 2, np.array([24.1, 0.0]))),
        (opened, lambda h: h.write_digital(CH, 2, LINES)),
        (opened, lambda h: h.write_other(np.array([11000], dtype=np.uint32), 1, np.array([1.5]))),
        (opened, lambda h: h.set_encoder_counts(JOINTS, 2, ZERO)),
        (opened, lambda h: h.read(None, 0, JOINTS, 2, None, 0, None, 0, None, COUNTS[:1], None, None)),
        (opened, lambda h: h.open("quanser_aero2_usb", "0")),
        (opened, lambda h: h.task_read(reader(h), 1, None, COUNTS, None, None)),
        (opened, lambda h: h.task_start(reader(h), 0, 499.0, UNLIMITED)),
        (opened, lambda h: h.watchdog_start(0.1)),
        (opened, lambda h: h.watchdog_reload()),
        (armed, lambda h: h.watchdog_start(0.1)),
        (started, lambda h: h.task_read(BOARD.task, 2, None, COUNTS, None, None)),
        (started, lambda h: h.task_read(BOARD.task, 1, None, read_only(), None, None)),
        (started, lambda h: h.task_start(BOARD.task, 0, 500.0, UNLIMITED)),
        (started, lambda h: h.task_set_buffer_overflow_mode(BOARD.task, BufferOverflowMode.OVERWRITE_ON_OVERFLOW)),
    ],
)
def test_it_refuses_what_c_would_misread_or_a_board_would_not_bear(
    ready: Callable[[], FakeHIL], use: Callable[[FakeHIL], None]
) -> None:
    handle = ready()
    with pytest.raises(MisuseError):
        use(handle)
