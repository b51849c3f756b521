"""Recomputation of the controller from its own rows, bit for bit.

A row states what the controller received for a tick: a frame; silence, which repeats the levels of the last frame; or a
late frame, whose levels hold from the next tick on. After missing rows, the next batch has the controller's state.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import Received
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Codes, ControllerSnapshot
from aeroloop.service.logs.batch import BatchController, Commands, Computed
from aeroloop.service.logs.codes import codes_in
from aeroloop.service.logs.runs import Block
from aeroloop.service.logs.traces import Array, Integers


class Used(NamedTuple):
    """Ticks k that the controller computed, their rows in the block, shapes (n,), and their codes, shape (n, 6)."""

    rows: Integers
    k: Integers
    codes: Array


class Evaluator:
    """Recomputes one session's controller.

    Args:
        settings: Its configuration.
        own_gains: Keep the configuration's gains and ignore the log's changes of them.
        own_reference: The same for the reference.
        resumes: Continue from the recorded state where rows are missing within the session.
    """

    def __init__(
        self, settings: Settings, *, own_gains: bool = False, own_reference: bool = False, resumes: bool = True
    ) -> None:
        self._settings = settings
        self._controller = self._new_controller()
        self._beside: BatchController | None = None
        self._dropped = {name: None for name, own in (("gains", own_gains), ("reference", own_reference)) if own}
        self._resumes = resumes
        self._holds = settings.wire.transmit.measurement == "on_change"
        self._changes: deque[Change] = deque()
        self._held: Codes | None = None
        self._begun = False

    def used(self, block: Block) -> Used:
        """What the controller used in the next block; pass it to `compute` next."""
        if block.state is not None and (self._resumes or not self._begun):
            state = ControllerSnapshot.model_validate(block.state)
            self._controller.restore(state)
            self._held = state.held
        self._changes += [change.model_copy(update=self._dropped) for change in block.changes]
        rows = block.controller
        if not rows:
            none = np.empty(0, dtype=np.int64)
            return Used(none, none, np.empty((0, 6)))
        self._begun = True
        received_as = rows["received_as"]
        framed = (received_as == Received.FRAME) | (received_as == Received.LATE)
        known = np.cumsum(framed) > 0 if self._held is None else np.ones(len(framed), dtype=np.bool_)
        codes = codes_in(self._settings.wire.measurement, rows["measurement"][framed])
        held, self._held = held_codes(framed, codes, self._held)
        silent = (received_as == Received.SILENT) & known & self._holds
        computed = np.flatnonzero((received_as == Received.FRAME) | silent)
        return Used(computed, rows["tick"][computed], held[computed])

    def compute(self, used: Used) -> Computed:
        """What the controller computed from it."""
        return self._controller.compute_all(used.k, used.codes, self._changes)

    def commands(self, used: Used, computed: Computed) -> Commands:
        """The commands that it sent; call it for every block or for none."""
        return self._controller.commands(used.k, computed.voltages)

    def beside(self, k: Integers, codes: Array) -> Computed:
        """What it would compute from other measurements; its own state stays. The θ̂ is meaningless.

        Ticks k ascend. Shapes (n,) and (n, 6).
        """
        self._beside = self._beside or self._new_controller()
        self._beside.follow(self._controller)
        return self._beside.compute_all(k, codes, deque(self._changes))

    def _new_controller(self) -> BatchController:
        settings = self._settings
        return BatchController(settings.wire, settings.law, settings.reference, settings.loop.period)


def held_codes(framed: npt.NDArray[np.bool_], codes: Array, before: Codes | None) -> tuple[Array, Codes | None]:
    """Codes that hold at each row: its frame's, or those of the last frame before it; NaN before the first frame.

    Args:
        framed: Whether each row has a frame. Shape (n,).
        codes: Codes of these frames. Shape (frames, columns).
        before: Codes that hold before the first row; None if there are none.

    Returns:
        The codes, of shape (n, columns), and those that hold after the last row.
    """
    first = np.full((1, codes.shape[1]), np.nan) if before is None else np.array([before])
    held = np.vstack([first, codes])[np.cumsum(framed)]
    known = before is not None or len(codes) > 0
    return held, tuple(held[-1].tolist()) if known and len(held) else before
