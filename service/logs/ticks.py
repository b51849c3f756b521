"""Ticks of a session in columns, as the controller received and computed them; review, figures and export use them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from aeroloop.service.logs.traces import Array, Integers


class Ticks(NamedTuple):
    """Ticks in order, a row each. What is unknown is NaN, a time −1. Shapes (n,) and (n, columns).

    Attributes:
        k: Tick of the law; its time is k·period.
        wall_ns: When its measurement was sent, on the plant's wall clock; on the controller's where the plant's rows
            are missing [ns since 1970].
        sent_ns: When it was sent, on the plant's monotonic clock; −1 where it was not [ns].
        latency_ns: From then until the command that answers it was received, on the same clock.
        measurement_delay_ns: From the plant's sending to the controller's receiving (see clocks.py).
        command_delay_ns: From the controller's sending to the plant's receiving.
        attitude: q as measured. The other quantities of the law likewise, in its units.
        voltages: What was commanded; NaN where nothing was, or no valid value [V].
        unquantized: u before quantization [V].
        gains: The law's gains, one beside the other.
        state: Its named state that it used, likewise; of the paper's law θ̂ [N·m·s/rad].
        state_next: The same after the tick; of the paper's law the sign of the equilibrium approached. Where the
            controller computed nothing, of the law's own state at the last tick that it did.
    """

    k: Integers
    wall_ns: Integers
    sent_ns: Integers
    latency_ns: Array
    measurement_delay_ns: Array
    command_delay_ns: Array
    attitude: Array
    desired: Array
    rate: Array
    desired_rate: Array
    attitude_error: Array
    rate_error: Array
    voltages: Array
    unquantized: Array
    gains: Array
    state: Array
    state_next: Array

    @classmethod
    def joined(cls, blocks: Sequence[Self]) -> Self:
        """Concatenation of blocks, at least one."""
        return blocks[0] if len(blocks) == 1 else cls(*map(np.concatenate, zip(*blocks, strict=True)))

    def where(self, chosen: npt.NDArray[np.bool_] | Integers | slice) -> Self:
        """The ticks that a mask, index or slice selects."""
        return type(self)(*(column[chosen] for column in self))  # type: ignore[arg-type]  # as they were
