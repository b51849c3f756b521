"""Replay of a plant that is emulated or `repeatable`: its end computed again from its own rows, byte for byte.

`Emulator.tick` uses no clock and no network: settings, seeds, faults, the frames received at each tick and the
operations between ticks determine every measurement. A replay starts at the first row of the plant's process, where the
plant's state is known, and stops at the first missing row.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.emulator import Emulator
from aeroloop.plant_emulator.plant import PlantError, class_of
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Refusal
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import NEVER, Batch, PlantChange, Sent
from aeroloop.protocol.plugins import PluginError
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED

_FIELDS: Final = ("session", "session_tick", "sent_as", "outcome", "trip", "answered", "measurement", "voltages")
"""Compared columns of a row; the first that differs is reported."""


class PlantDifference(BaseModel, frozen=True):
    """The first row with computed values that differ from the logged ones."""

    tick: int = Field(description="of the plant, since its process started")
    session: str
    session_tick: int
    field: str = Field(description="column of the row")
    logged: str
    computed: str


class PlantReplayed(BaseModel, frozen=True):
    """Result of the replay of one process of the plant."""

    ticks: int = Field(description="rows compared")
    differ: int = Field(description="rows that differ from the logged ones")
    first_difference: PlantDifference | None
    stopped: str | None = Field(description="why it ends before the log does; null if it does not")


def why_not(plant: PlantSettings) -> str | None:
    """Why a plant cannot be replayed; None if it can. Of a plant that is no body of ours this imports the class."""
    if plant.via != "emulator":
        return f"plant.via is {plant.via!r}: only an emulated plant is computed again"
    if plant.emulated:
        return None
    try:
        found = class_of(plant.kind)
    except PluginError as error:
        return str(error)
    return None if found.repeatable else f"{found.__name__} (plant.kind) does not state that it is `repeatable`"


class PlantReplay:
    """Replays one process of an emulated plant, from its settings and its trace.

    Raises:
        ValueError: The plant cannot be replayed, with the reason of `why_not`.
        PlantError: It cannot be made.
    """

    def __init__(self, loop: LoopSettings, wire: WireSpec, plant: PlantSettings) -> None:
        if reason := why_not(plant):
            raise ValueError(reason)
        self._emulator = Emulator(loop, wire, plant, threading.Event())
        self._wire = wire
        self._none = bytes(wire.measurement.size)
        self._malformed = bytes(wire.command.size + 1)
        self._run: int | None = None
        self._rows = self._ticks = self._differ = 0
        self._first: PlantDifference | None = None
        self._stopped: str | None = None
        self._empty_at: set[int] = set()  # bases of batches without rows since the last row

    def feed(self, batch: Batch) -> bool:
        """Replay the next batch of the run; a repeated batch is ignored.

        Returns:
            Whether the replay goes on; it stops at a gap.
        """
        if self._run is None:
            self._run = batch.header.run
        if self._stopped is None and not self._repeated(batch):
            self._stopped = self._cannot_follow(batch)
            if self._stopped is None:
                try:
                    self._replay(batch)
                except PlantError as error:
                    self._stopped = str(error)
        return self._stopped is None

    def result(self) -> PlantReplayed:
        """Result so far."""
        stopped = self._stopped
        if self._run is None and stopped is None:
            stopped = "the log has no trace of the plant"
        return PlantReplayed(ticks=self._ticks, differ=self._differ, first_difference=self._first, stopped=stopped)

    def _repeated(self, batch: Batch) -> bool:
        """Whether a batch was fed before: a restarted recorder receives the last minute again."""
        header = batch.header
        if header.run != self._run:
            return False
        if header.rows == 0:
            repeated = header.first_row < self._rows or header.monotonic_ns in self._empty_at
            self._empty_at.add(header.monotonic_ns)
            return repeated
        return header.first_row < self._rows

    def _cannot_follow(self, batch: Batch) -> str | None:
        header = batch.header
        if header.run != self._run:
            return "the plant was started again"
        wire = self._wire.measurement.size, self._wire.command.size, self._wire.actuators
        if (header.measurement_bytes, header.command_bytes, header.actuators) != wire:
            return "the rows are not of the wire that the description describes"
        if header.first_row > self._rows:
            if not self._rows:
                return "the log lacks the plant's first row, so the plant's state is not known"
            return f"{header.first_row - self._rows} rows are missing after row {self._rows - 1} of the plant"
        return None

    # ── a batch ──

    def _replay(self, batch: Batch) -> None:
        operations = iter(batch.tail.operations)
        operation = next(operations, None)
        for tick, frame, logged in self._inputs(batch):
            while operation is not None and operation.tick < tick:
                if not self._operate(operation):
                    return
                operation = next(operations, None)
            if self._emulator.endpoint.session is None:
                self._stopped = f"tick {tick} is in a session whose claim is missing"
                return
            self._compare(tick, frame, logged)
        while operation is not None and self._operate(operation):
            operation = next(operations, None)
        if batch.header.rows:
            self._rows = batch.header.first_row + batch.header.rows
            self._empty_at.clear()

    def _inputs(self, batch: Batch) -> Iterator[tuple[int, bytes | None, tuple[object, ...]]]:
        """Tick, command and compared columns of each row."""
        rows = batch.columns
        session = batch.header.session
        answered = rows["answered"].astype(np.int64)
        columns = [
            *(rows[name].tolist() for name in ("session_tick", "sent_as", "outcome", "trip")),
            np.where(answered == NEVER, -1, answered).tolist(),
            _frames(rows["measurement"]),
            [row.tobytes() for row in rows["voltages"]],
        ]
        received = zip(
            rows["tick"].tolist(), rows["received_as"].tolist(), _frames(rows["command"]), *columns, strict=True
        )
        for tick, received_as, command, *logged in received:
            if received_as == Sent.FRAME:
                frame: bytes | None = command
            elif received_as == Sent.SILENT:
                frame = UNCHANGED
            else:
                frame = None if received_as == Sent.NONE else self._malformed
            yield tick, frame, (session, *logged)

    def _compare(self, tick: int, frame: bytes | None, logged: tuple[object, ...]) -> None:
        endpoint = self._emulator.endpoint
        session = endpoint.session
        measurement = self._emulator.tick(frame, tick)
        computed = (
            session,
            endpoint.session_tick,
            Sent.FRAME if measurement else Sent.NONE if measurement is None else Sent.SILENT,
            endpoint.outcome,
            0 if endpoint.session or endpoint.trip is None else endpoint.trip.number,
            endpoint.answered,
            measurement or self._none,
            np.array(endpoint.voltages).tobytes(),
        )
        self._ticks += 1
        if computed != logged:
            self._differ += 1
            if self._first is None:
                columns = zip(_FIELDS, logged, computed, strict=True)
                field, was, now = next((field, a, b) for field, a, b in columns if a != b)
                self._first = PlantDifference(
                    tick=tick,
                    session=str(logged[0]),
                    session_tick=int(str(logged[1])),
                    field=field,
                    logged=_text(field, was),
                    computed=_text(field, now),
                )

    # ── between ticks ──

    def _operate(self, operation: PlantChange) -> bool:
        """Advance the plant to an operation's tick and apply it. Returns whether that was possible."""
        emulator, endpoint = self._emulator, self._emulator.endpoint
        if operation.cause is TripCause.PLANT:
            return True  # it failed within a tick, which has no row, and its process ended
        if operation.tick > endpoint.ticked:
            if endpoint.session is not None:
                self._stopped = f"rows are missing before tick {operation.tick}, where a session runs"
                return False
            emulator.tick(None, operation.tick)
        match operation.kind:
            case "claim":
                assert operation.claim is not None
                answer = endpoint.claim(operation.claim)
                if isinstance(answer, Refusal):
                    self._stopped = f"the claim after tick {operation.tick} is refused: {answer.reason}"
            case "release":
                endpoint.release(operation.name or "")
            case "arm":
                endpoint.arm()
            case "stop":
                assert operation.cause is not None
                endpoint.stop(operation.cause, operation.reason or "")
            case "lost":
                endpoint.lost(operation.name or "")
            case "expire":
                assert operation.cause is not None
                endpoint.expire(operation.cause, operation.reason or "")
            case "inject":
                fault = operation.name
                emulator.inject([] if fault is None else [Fault.parse(fault)], clear=fault is None)
        endpoint.changes.clear()
        endpoint.notices.clear()
        return self._stopped is None


def _frames(column: npt.NDArray[np.void]) -> list[bytes]:
    """A column of frames as bytes."""
    whole, size = column.tobytes(), column.dtype.itemsize
    return [whole[at : at + size] for at in range(0, len(whole), size)]


def _text(field: str, value: object) -> str:
    if field == "voltages" and isinstance(value, bytes):
        return " ".join(f"{volts!r} V" for volts in np.frombuffer(value).tolist())
    return value.hex() if isinstance(value, bytes) else str(value)
