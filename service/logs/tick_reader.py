"""Tick reader: turns joined rows into ticks with what was computed and commanded, and the delay of each way.

A tick counts once a command has answered it or a later one; ticks after the last answer are not judged. The error at a
tick that the controller did not compute is that of the plant's own measurement.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from aeroloop.protocol.messages.trace import Received, Sent
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Codes
from aeroloop.service.logs.clocks import ClockOffset
from aeroloop.service.logs.codes import codes_in, levels
from aeroloop.service.logs.evaluate import Evaluator, Used, held_codes
from aeroloop.service.logs.runs import Block, Rows
from aeroloop.service.logs.ticks import Ticks
from aeroloop.service.logs.traces import Array, Integers

Flags = npt.NDArray[np.bool_]


class Judged(NamedTuple):
    """What a block adds to a session.

    Attributes:
        judged: Ticks with a valid measurement, up to the last that was answered; the rest comes with a later block.
        answered: Ticks that a command answered, be it one without a valid value. Shape (m,).
        voltages: What was commanded at them [V]. Shape (m, actuators).
        missed: Judged ticks that the plant measured and the controller did not compute. Shape (n,).
        unsent: How many of the judged measurements, and of the answers, were silent.
        measurements: Codes of all measurement frames of the block. Shape (n, 6).
        commands: Codes of all command frames. Shape (n, actuators).
    """

    judged: Ticks
    answered: Integers
    voltages: Array
    missed: Integers
    unsent: tuple[int, int]
    measurements: Array
    commands: Array


class TickReader:
    """Reads one session's ticks, by the configuration of its controller; `offset` is between both ends' clocks."""

    def __init__(self, settings: Settings) -> None:
        self.offset = ClockOffset()
        self._wire = settings.wire
        self._evaluator = Evaluator(settings)
        self._measured: Codes | None = None  # of the last measurement that the plant sent
        self._commanded: Codes | None = None  # of the last command that the controller sent
        self._later: list[tuple[Ticks, Flags, Flags]] = []  # ticks after the last answer, as in `_ticks`

    def take(self, block: Block) -> Judged:
        """Read the next block."""
        measurements, plants_codes = self._measurements(block)
        commands, commanded = self._commands(block)
        seen, over, sent = self._ticks(block, plants_codes, commanded)
        rows, at = block.controller, block.at_controller
        answered = _is(rows, at, "sent_as", Sent.FRAME, Sent.SILENT) | (block.acted >= 0)
        silent = answered & _is(rows, at, "sent_as", Sent.SILENT)
        after = int(np.flatnonzero(answered)[-1]) + 1 if answered.any() else 0
        judged, over_so_far, sent_so_far = seen.where(slice(0)), over[:0], sent[:0]
        if after:
            until = seen.where(slice(after)), over[:after], sent[:after]
            ticks, overs, sents = zip(*self._later, until, strict=True)
            judged, over_so_far, sent_so_far = Ticks.joined(ticks), np.concatenate(overs), np.concatenate(sents)
            self._later.clear()
        if after < len(seen.k):
            self._later.append((seen.where(slice(after, None)), over[after:], sent[after:]))
        valid = ~np.isnan(judged.attitude[:, 0])
        return Judged(
            judged if valid.all() else judged.where(valid),
            seen.k[answered],
            seen.voltages[answered],
            judged.k[over_so_far],
            (int((valid & ~sent_so_far).sum()), int(silent.sum())),
            measurements,
            commands,
        )

    def _measurements(self, block: Block) -> tuple[Array, Array]:
        """Codes of the measurement frames; and the codes that hold at every row of the plant in the block."""
        rows, plant = block.controller, block.plant
        if not plant:
            frames = rows["measurement"][rows["received_as"] == Received.FRAME]
            return codes_in(self._wire.measurement, frames), np.empty((0, 6))
        its = block.at_plant[block.at_plant >= 0]
        framed = plant["sent_as"][its] == Sent.FRAME
        codes = codes_in(self._wire.measurement, plant["measurement"][its][framed])
        held, self._measured = held_codes(framed, codes, self._measured)
        return codes, held

    def _commands(self, block: Block) -> tuple[Array, Array]:
        """Codes of the command frames; and the voltages of every row of the controller, NaN before the first [V]."""
        rows, wire = block.controller, self._wire
        if not rows:
            return np.empty((0, wire.actuators)), np.empty((0, wire.actuators))
        if block.state is not None and (sent := block.state.get("sent_codes")) is not None:
            self._commanded = tuple(sent)  # a silent command repeats one of before the log's first row
        framed = rows["sent_as"] == Sent.FRAME
        codes = codes_in(wire.command, rows["command"][framed])
        held, self._commanded = held_codes(framed, codes, self._commanded)
        unknown = np.isnan(held)
        volts = levels(wire.voltage, np.where(unknown, 0.0, held))
        volts[unknown] = np.nan
        return codes, volts

    def _ticks(self, block: Block, plants_codes: Array, commanded: Array) -> tuple[Ticks, Flags, Flags]:
        """The block's ticks; which the plant measured and the controller did not compute; and which had a frame."""
        rows, plant, n = block.controller, block.plant, len(block.k)
        used = self._evaluator.used(block)
        places = np.searchsorted(block.k, used.k)
        over = (block.at_plant >= 0) & ~_is(plant, block.at_plant, "sent_as", Sent.NONE)
        over[places] = False
        beside = self._beside(block, used, places, over, plants_codes) if over.any() else None
        columns = list(self._evaluator.compute(used))
        if len(used.k) < n:
            for i, column in enumerate(columns):
                columns[i] = np.full((n, column.shape[1]), np.nan)
                columns[i][places] = column
                if beside is not None:
                    columns[i][over] = beside[i]
        attitude, desired, rate, attitude_error, rate_error, unquantized, gains, state, after = columns
        unquantized[over] = state[over] = np.nan
        ticks = Ticks(
            block.k, *self._times(block), attitude, desired, rate, attitude_error, rate_error,
            self._voltages(block, commanded), unquantized, gains, state, after,
        )  # fmt: skip
        sent = _is(plant, block.at_plant, "sent_as", Sent.FRAME)
        sent |= (block.at_plant < 0) & _is(rows, block.at_controller, "received_as", Received.FRAME)
        return ticks, over, sent

    def _beside(self, block: Block, used: Used, places: Integers, over: Flags, plants_codes: Array) -> list[Array]:
        """What the controller would have computed at the ticks that it did not, from what the plant measured then."""
        codes = np.full((len(block.k), 6), np.nan)
        codes[block.at_plant >= 0] = plants_codes
        codes[places] = used.codes
        union = over.copy()
        union[places] = True
        return [column[over[union]] for column in self._evaluator.beside(block.k[union], codes[union])]

    def _voltages(self, block: Block, commanded: Array) -> Array:
        """What was commanded at each tick, NaN where nothing was [V]. Shape (n, actuators)."""
        at, plant, wire = block.at_controller, block.plant, self._wire
        voltages = np.full((len(block.k), wire.actuators), np.nan)
        its = _is(block.controller, at, "sent_as", Sent.FRAME, Sent.SILENT)
        voltages[its] = commanded[at[its]]
        others = (at < 0) & _is(plant, block.acted, "received_as", Sent.FRAME)
        if others.any():  # the plant acted on commands of which the controller's rows are missing
            voltages[others] = levels(wire.voltage, codes_in(wire.command, plant["command"][block.acted[others]]))
        return voltages

    def _times(self, block: Block) -> tuple[Integers, Integers, Array, Array, Array]:
        """Wall time, time of sending, latency and both delays of each tick [ns]. Shapes (n,)."""
        rows, plant = block.controller, block.plant
        at, at_plant, acted = block.at_controller, block.at_plant, block.acted
        sent = np.where(_is(plant, at_plant, "sent_as", Sent.FRAME), _column(plant, at_plant, "sent"), -1)
        acted_on = np.where(_is(plant, acted, "received_as", Sent.FRAME), _column(plant, acted, "received"), -1)
        received = np.where(_is(rows, at, "received_as", Received.FRAME), _column(rows, at, "received"), -1)
        forward, backward = _since(sent, received), _since(_column(rows, at, "sent"), acted_on)
        offset = self.offset.at(forward, backward)
        wall = np.where(
            at_plant >= 0,
            _column(plant, at_plant, "sent") + _column(plant, at_plant, "wall"),
            _column(rows, at, "received") + _column(rows, at, "wall"),
        )
        return wall, sent, _since(sent, acted_on), forward - offset, backward + offset


def _column(rows: Rows, at: Integers, name: str) -> Integers:
    """A column's values at places of rows; −1 where the place is −1. Shape (n,)."""
    if not rows or not len(rows[name]):  # no batch of the end at all, or none of this block
        return np.full(len(at), -1)
    return np.where(at >= 0, rows[name][at].astype(np.int64), -1)


def _is(rows: Rows, at: Integers, name: str, *kinds: int) -> Flags:
    """Whether a column's value at places of rows is one of these; false where the place is −1. Shape (n,)."""
    values = _column(rows, at, name)
    found = np.zeros(len(at), dtype=np.bool_)
    for kind in kinds:
        found |= values == kind
    return found


def _since(begin: Integers, end: Integers) -> Array:
    """How long after one time another was [ns]; NaN where one is unknown. Shape (n,)."""
    return np.where((begin >= 0) & (end >= 0), (end - begin).astype(np.float64), np.nan)
