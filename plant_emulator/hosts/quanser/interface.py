"""Quanser's HIL interface, as far as it is used: what a board can be asked, and the types that each call takes.

The interface comes with Quanser's SDK and is imported when a plant is made. Its arrays cross to C as bare memory, so
their types are part of the call: channels uint32, analog and other float64, encoder counts int32, digital lines int8.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import SimpleNamespace
from typing import Any, Protocol, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from aeroloop.protocol.errors import AeroloopError

Channels: TypeAlias = NDArray[np.uint32]
Doubles: TypeAlias = NDArray[np.float64]
Counts: TypeAlias = NDArray[np.int32]
Lines: TypeAlias = NDArray[np.int8]


class QuanserError(AeroloopError):
    """Quanser's board cannot be used; one line that says why."""


class Board(Protocol):
    """What is used of `quanser.hardware.HIL`. Every call raises HILError where the board refuses."""

    def open(self, card_type: str, card_identifier: str, /) -> None:
        """Take hold of a board."""

    def close(self) -> None:
        """Let go of it."""

    def write_analog(self, channels: Channels, n: int, volts: Doubles, /) -> None:
        """Set analog outputs [V]."""

    def write_digital(self, channels: Channels, n: int, lines: Lines, /) -> None:
        """Set digital outputs."""

    def write_other(self, channels: Channels, n: int, values: Doubles, /) -> None:
        """Set other outputs."""

    def set_encoder_counts(self, channels: Channels, n: int, counts: Counts, /) -> None:
        """Say what the encoders count now."""

    def read(
        self,
        analog: Channels | None,
        n_analog: int,
        encoders: Channels | None,
        n_encoders: int,
        digital: Channels | None,
        n_digital: int,
        other: Channels | None,
        n_other: int,
        analog_buffer: Doubles | None,
        encoder_buffer: Counts | None,
        digital_buffer: Lines | None,
        other_buffer: Doubles | None,
        /,
    ) -> None:
        """Read inputs at once."""

    def task_create_reader(
        self,
        samples_in_buffer: int,
        analog: Channels | None,
        n_analog: int,
        encoders: Channels | None,
        n_encoders: int,
        digital: Channels | None,
        n_digital: int,
        other: Channels | None,
        n_other: int,
        /,
    ) -> object:
        """A task that will sample inputs by a clock of the board."""

    def task_set_buffer_overflow_mode(self, task: Any, mode: int, /) -> None:
        """What happens to samples that nobody reads in time."""

    def task_get_buffer_overflows(self, task: Any, /) -> int:
        """How many samples have been lost to others since the task was started."""

    def task_start(self, task: Any, clock: int, frequency: float, samples: int, /) -> None:
        """Begin to sample at a frequency [Hz]."""

    def task_read(
        self,
        task: Any,
        samples: int,
        analog_buffer: Doubles | None,
        encoder_buffer: Counts | None,
        digital_buffer: Lines | None,
        other_buffer: Doubles | None,
        /,
    ) -> int:
        """Wait for samples and read them. Returns how many were read; buffers hold no more than that."""

    def task_stop(self, task: Any, /) -> None:
        """Sample no more."""

    def task_delete(self, task: Any, /) -> None:
        """Give the task back."""

    def watchdog_set_analog_expiration_state(self, channels: Channels, n: int, volts: Doubles, /) -> None:
        """What analog outputs go to when the watchdog expires [V]."""

    def watchdog_set_digital_expiration_state(self, channels: Channels, n: int, states: Counts, /) -> None:
        """What digital outputs go to then: an enumeration of 4 bytes each, 0 for low."""

    def watchdog_set_other_expiration_state(self, channels: Channels, n: int, values: Doubles, /) -> None:
        """What other outputs go to then."""

    def watchdog_start(self, timeout: float, /) -> None:
        """Begin to count [s]."""

    def watchdog_reload(self) -> bool:
        """Count from 0 again. False if it has expired."""

    def watchdog_is_expired(self) -> bool:
        """Whether it has expired: outputs are at their expiration states, and the board lets nobody at them."""

    def watchdog_clear(self) -> None:
        """Let outputs be written again, and perhaps put them back to what they were."""

    def watchdog_stop(self) -> None:
        """Count no more. An expired one stays so."""


class Hardware(Protocol):
    """What is used of the module `quanser.hardware`."""

    HIL: Callable[[], Board]
    HILError: type[Exception]
    Clock: Any
    BufferOverflowMode: Any


def quanser() -> Hardware:
    """The module `quanser.hardware`. Raises QuanserError where it is missing."""
    try:
        hardware: Any = import_module("quanser.hardware")
        enumerations: Any = import_module("quanser.hardware.enumerations")
    except (ImportError, OSError) as error:  # OSError: the package is there, the libraries that it loads are not
        raise QuanserError(
            f"Quanser's Python interface is missing ({error}): install the Quanser SDK, then in this environment "
            "`pip install --find-links <SDK's folder>/python quanser_api`"
        ) from error
    names = SimpleNamespace(
        HIL=hardware.HIL,
        HILError=hardware.HILError,
        Clock=hardware.Clock,
        BufferOverflowMode=enumerations.BufferOverflowMode,  # not every version offers it one level up
    )
    return cast(Hardware, names)
