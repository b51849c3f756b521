"""Replay of a plant that is emulated or `repeatable`: its end computed again from its own rows, byte for byte.

`Emulator.tick` uses no clock and no network: settings, seeds, faults, the frames received at each tick and the
operations between ticks determine every measurement. A replay starts at the first row of the plant's process, where the
plant's state is known, and stops at the first missing row.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Final

import numpy as np
from pydantic import BaseModel, Field

from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.hosts.emulator import Emulator
from aeroloop.plant_emulator.plant import PlantError, class_of
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol.messages.models import Refusal
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import NEVER, Batch, Header, PlantChange, Sent
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


class _StoppedError(Exception):
    """The replay ends here, with the reason."""


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
        self._run: int | None = None
        self._rows = self._ticks = self._differ = 0
        self._empty: set[Header] = set()  # of batches without rows
        self._first: PlantDifference | None = None
        self._stopped: str | None = "the log has no trace of the plant"

    def feed(self, batch: Batch) -> None:
        """Replay the next batch of the run. A repeated one, as a restarted recorder receives, is passed over."""
        header = batch.header
        if self._run is None:
            self._run, self._stopped = header.run, None
        repeated = header.first_row < self._rows or header in self._empty
        if self._stopped is not None or (repeated and header.run == self._run):
            return
        try:
            self._check(header)
            self._replay(batch)
        except (_StoppedError, PlantError) as error:
            self._stopped = str(error)
        if header.rows:
            self._rows = header.first_row + header.rows
        else:
            self._empty.add(header)

    def result(self) -> PlantReplayed:
        """Result so far."""
        return PlantReplayed(
            ticks=self._ticks, differ=self._differ, first_difference=self._first, stopped=self._stopped
        )

    def _check(self, header: Header) -> None:
        """Raise _StoppedError if a batch does not follow what was replayed."""
        if header.run != self._run:
            raise _StoppedError("the plant was started again")
        wire = self._wire.measurement.size, self._wire.command.size, self._wire.actuators
        if (header.measurement_bytes, header.command_bytes, header.actuators) != wire:
            raise _StoppedError("the rows are not of the wire that the description describes")
        if header.first_row > self._rows:
            if not self._rows:
                raise _StoppedError("the log lacks the plant's first row, so the plant's state is not known")
            raise _StoppedError(
                f"{header.first_row - self._rows} rows are missing after row {self._rows - 1} of the plant"
            )

    def _replay(self, batch: Batch) -> None:
        rows, changes = batch.columns, deque(batch.tail.operations)
        answered = rows["answered"].astype(np.int64)
        logged = zip(
            *(rows[name].tolist() for name in ("session_tick", "sent_as", "outcome", "trip")),
            np.where(answered == NEVER, -1, answered).tolist(),
            rows["measurement"].tolist(),
            [row.tobytes() for row in rows["voltages"]],
            strict=True,
        )
        received = zip(*(rows[name].tolist() for name in ("tick", "received_as", "command")), strict=True)
        malformed = bytes(self._wire.command.size + 1)
        for (tick, received_as, command), values in zip(received, logged, strict=True):
            while changes and changes[0].tick < tick:
                self._change(changes.popleft())
            if self._emulator.endpoint.session is None:
                raise _StoppedError(f"tick {tick} is in a session whose claim is missing")
            frames = {Sent.FRAME: command, Sent.SILENT: UNCHANGED, Sent.NONE: None}
            self._compare(tick, frames.get(received_as, malformed), (batch.header.session, *values))
        for change in changes:
            self._change(change)

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
            measurement or bytes(self._wire.measurement.size),
            np.array(endpoint.voltages).tobytes(),
        )
        self._ticks += 1
        if computed == logged:
            return
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

    def _change(self, change: PlantChange) -> None:
        """Advance the plant to a change's tick and apply it."""
        emulator, endpoint = self._emulator, self._emulator.endpoint
        if change.cause is TripCause.PLANT:
            return  # it failed within a tick, which has no row, and its process ended
        if change.tick > endpoint.ticked:
            if endpoint.session is not None:
                raise _StoppedError(f"rows are missing before tick {change.tick}, where a session runs")
            emulator.tick(None, change.tick)
        name, reason = change.name or "", change.reason or ""
        match change.kind:
            case "claim":
                assert change.claim is not None
                answer = endpoint.claim(change.claim)
                if isinstance(answer, Refusal):
                    raise _StoppedError(f"the claim after tick {change.tick} is refused: {answer.reason}")
            case "release":
                endpoint.release(name)
            case "arm":
                endpoint.arm()
            case "lost":
                endpoint.lost(name)
            case "stop":
                assert change.cause is not None
                endpoint.stop(change.cause, reason)
            case "expire":
                assert change.cause is not None
                endpoint.expire(change.cause, reason)
            case "inject":
                emulator.inject([Fault.parse(name)] if name else [], clear=not name)
        endpoint.changes.clear()
        endpoint.notices.clear()


def _text(field: str, value: object) -> str:
    if field == "voltages" and isinstance(value, bytes):
        return " ".join(f"{volts!r} V" for volts in np.frombuffer(value).tolist())
    return value.hex() if isinstance(value, bytes) else str(value)
