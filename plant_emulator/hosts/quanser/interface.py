"""Types of the used part of Quanser's HIL interface.

The interface is part of Quanser's SDK and is imported when a plant is made. It passes arrays to C as bare memory, so
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

Inputs: TypeAlias = tuple[Channels | None, int, Channels | None, int, Channels | None, int, Channels | None, int]
"""Channels to read and how many, of analog, encoder, digital and other inputs."""
Buffers: TypeAlias = tuple[Doubles | None, Counts | None, Lines | None, Doubles | None]
"""Arrays to read these inputs into."""


class QuanserError(AeroloopError):
    """Quanser's board cannot be used; the message is one line with the reason."""


class Board(Protocol):
    """Used part of `quanser.hardware.HIL`. Every call raises HILError if the board refuses it."""

    def open(self, card_type: str, card_identifier: str, /) -> None:
        """Open a board."""

    def close(self) -> None:
        """Close it."""

    def write_analog(self, channels: Channels, n: int, volts: Doubles, /) -> None:
        """Set analog outputs [V]."""

    def write_digital(self, channels: Channels, n: int, lines: Lines, /) -> None:
        """Set digital outputs."""

    def write_other(self, channels: Channels, n: int, values: Doubles, /) -> None:
        """Set other outputs."""

    def set_encoder_counts(self, channels: Channels, n: int, counts: Counts, /) -> None:
        """Set the encoders' present counts."""

    def read(self, *inputs_and_buffers: *tuple[*Inputs, *Buffers]) -> None:
        """Read inputs at once."""

    def task_create_reader(self, samples_in_buffer: int, /, *inputs: *Inputs) -> object:
        """Create a task that samples inputs by a clock of the board."""

    def task_set_buffer_overflow_mode(self, task: Any, mode: int, /) -> None:
        """Set what happens to samples that are not read in time."""

    def task_get_buffer_overflows(self, task: Any, /) -> int:
        """Return the number of samples lost since the task was started."""

    def task_start(self, task: Any, clock: int, frequency: float, samples: int, /) -> None:
        """Start sampling at a frequency [Hz]."""

    def task_read(self, task: Any, samples: int, /, *buffers: *Buffers) -> int:
        """Wait for samples and read them. Returns how many were read; only these are in the buffers."""

    def task_stop(self, task: Any, /) -> None:
        """Stop sampling."""

    def task_delete(self, task: Any, /) -> None:
        """Delete the task."""

    def watchdog_set_analog_expiration_state(self, channels: Channels, n: int, volts: Doubles, /) -> None:
        """Set the analog outputs at expiry of the watchdog [V]."""

    def watchdog_set_digital_expiration_state(self, channels: Channels, n: int, states: Counts, /) -> None:
        """Set the digital outputs at expiry: an enumeration of 4 bytes each, 0 for low."""

    def watchdog_set_other_expiration_state(self, channels: Channels, n: int, values: Doubles, /) -> None:
        """Set the other outputs at expiry."""

    def watchdog_start(self, timeout: float, /) -> None:
        """Start the watchdog with a timeout [s]."""

    def watchdog_reload(self) -> bool:
        """Restart the timeout. False if the watchdog has expired."""

    def watchdog_is_expired(self) -> bool:
        """Whether it has expired: outputs are at their expiration states, and writes are refused."""

    def watchdog_clear(self) -> None:
        """Allow writes again, and perhaps restore the outputs of before the expiry."""

    def watchdog_stop(self) -> None:
        """Stop the watchdog. An expired one stays expired."""


class Hardware(Protocol):
    """Used part of the module `quanser.hardware`."""

    HIL: Callable[[], Board]
    HILError: type[Exception]
    Clock: Any
    BufferOverflowMode: Any


def quanser() -> Hardware:
    """Import `quanser.hardware`. Raises QuanserError if it is missing."""
    try:
        hardware: Any = import_module("quanser.hardware")
        enumerations: Any = import_module("quanser.hardware.enumerations")
    except (ImportError, OSError) as error:  # OSError: the package is installed, the libraries that it loads are not
        raise QuanserError(
            f"Quanser's Python interface is missing ({error}): install the Quanser SDK, then in this environment "
            "`pip install --find-links <SDK's folder>/python quanser_api`"
        ) from error
    names = SimpleNamespace(
        HIL=hardware.HIL,
        HILError=hardware.HILError,
        Clock=hardware.Clock,
        BufferOverflowMode=enumerations.BufferOverflowMode,  # not every version exports it one level up
    )
    return cast(Hardware, names)
