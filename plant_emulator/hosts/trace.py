"""Trace of the plant end: its rows written while it runs, and computed again from a log, byte for byte.

`Endpoint.tick` uses no clock and no network: settings, seeds, faults, the frames received at each tick and the changes
between ticks determine every measurement of a plant that is emulated or `repeatable`. A replay starts at the first row
of the plant's process, where the plant's state is known, and stops at the first missing row.
"""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, Field

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint, VehicleClaim
from aeroloop.plant_emulator.faults.language import Fault
from aeroloop.plant_emulator.plant import class_of
from aeroloop.plant_emulator.settings import PlantSettings
from aeroloop.protocol import plugins
from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.models import Refusal
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import NEVER, Batch, Header, PlantChange, PlantRow, Sent, Tail, TraceWriter
from aeroloop.protocol.runtime.timing import Clock
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.spec import LoopSettings, WireSpec
from aeroloop.protocol.wire.transmit import UNCHANGED

# ── writing ──


def plant_row(end: VehicleClaim, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> PlantRow:
    """Trace row of the last tick; arguments as of `PlantNetwork.after_tick`, `measurement` None if it tripped."""
    command, received_ns = arrival or (b"", 0)
    received_as = Sent.NONE if arrival is None else Sent.FRAME if command else Sent.SILENT
    if command and len(command) != end.wire.command.size:
        received_as, command = Sent.MALFORMED, b""
    return PlantRow(
        end.ticked,
        end.session_tick,
        Sent.NONE if measurement is None else Sent.FRAME if measurement else Sent.SILENT,
        received_as,
        end.outcome,
        0 if end.session or end.trip is None else end.trip.number,
        end.answered,
        sent_ns,
        received_ns,
        measurement or b"",
        command,
        end.voltages,
    )


class PlantTrace:
    """Trace of the plant end: a row for every tick of a session, and the changes between ticks.

    The owner adds a row after each measurement was sent, and calls `follow` whenever a session may have begun or ended.
    All waiting rows are published when a session ends; changes outside of sessions at once, without rows. `publish` is
    called with every batch; `run` is the random number that identifies this process, drawn if None.
    """

    def __init__(
        self, wire: WireSpec, publish: Callable[[bytes], None], run: int | None = None, clock: Clock = time
    ) -> None:
        self._publish, self._clock = publish, clock
        self._writer = TraceWriter("plant", wire, secrets.randbits(64) if run is None else run)

    def row(self, end: VehicleClaim, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """Add the row of the last tick, and publish a batch that is due. Nothing without a session."""
        if self._writer.session:
            self._writer.row(plant_row(end, measurement, arrival, sent_ns))
            if self._writer.due(sent_ns):
                self._publish_batch(final=False)

    def follow(self, end: VehicleClaim) -> None:
        """Move the end's changes into the trace; publish everything waiting if its session ended or none runs."""
        writer = self._writer
        writer.operations += end.changes
        end.changes.clear()
        session = end.session or ""
        if session != writer.session or not session:
            self.finish()
        if session != writer.session:
            writer.session, writer.record = session, b""

    def record(self, changes: bytes) -> None:
        """Take over the running session's gains and reference, as `record_json` has them, for later batches."""
        self._writer.record = changes

    def finish(self) -> None:
        """Publish everything waiting; the last batch of a session is marked final, with or without rows."""
        if self._writer.session or not self._writer.empty:
            self._publish_batch(final=bool(self._writer.session))

    def _publish_batch(self, *, final: bool) -> None:
        self._publish(self._writer.take(self._clock.monotonic_ns(), self._clock.time_ns(), final=final))


# ── computing again ──

_COMPARED: Final = ("session_tick", "sent_as", "outcome", "trip", "answered", "measurement", "voltages")


class PlantDifference(BaseModel, frozen=True):
    """The first row that differs."""

    tick: int = Field(description="of the plant, since its process started")
    session: str
    session_tick: int
    field: str = Field(description="column of the row")
    logged: str
    computed: str
    signals: list[str] = Field(default=[], description="of a measurement: both values, and how many steps apart")


class PlantReplayed(BaseModel, frozen=True):
    """Result of the replay of one process of the plant."""

    ticks: int = Field(description="rows compared")
    differ: int = Field(description="rows that differ from the logged ones")
    first_difference: PlantDifference | None
    stopped: str | None = Field(description="why it ends before the log does; null if it does not")


def cut(batch: Batch, rows: int) -> Batch:
    """A batch with its first rows only, at least one, and with the changes before the last of them."""
    columns = {name: column[:rows] for name, column in batch.columns.items()}
    changes = [change for change in batch.tail.operations if change.tick < int(columns["tick"][-1])]
    return Batch(batch.header._replace(rows=rows), columns, Tail(operations=changes))


def why_not(plant: PlantSettings) -> str | None:
    """Why no log of a plant can be replayed; None if it can. Of a plant that is no body of ours this imports the class.

    Raises PluginError if there is no such class here, or its code is not trusted.
    """
    if plant.via != "emulator":
        return f"plant.via is {plant.via!r}: only an emulated plant is computed again"
    if plant.emulated:
        return None
    if plant.kind == "fmu":
        plugins.check_named("plant.own.file", str(plant.own.get("file")))
    found = class_of(plant.kind)
    return None if found.repeatable else f"{found.__name__} (plant.kind) does not state that it is `repeatable`"


class PlantReplay:
    """Replays one process of an emulated plant: `endpoint` is as it was after the last row, `last` that row computed.

    `on_tick` is called after each tick, before its row is compared. Raises ValueError with the reason of `why_not`,
    PluginError, or PlantError.
    """

    def __init__(
        self,
        loop: LoopSettings,
        wire: WireSpec,
        plant: PlantSettings,
        on_tick: Callable[[Endpoint], None] = lambda _: None,
    ) -> None:
        if reason := why_not(plant):
            raise ValueError(reason)
        self.endpoint = plant.endpoint(plant.make(loop.period), loop, wire)
        self.last: PlantRow | None = None
        self._wire, self._on_tick = wire, on_tick
        self._run: int | None = None
        self._rows = self._ticks = self._differ = 0
        self._empty: set[Header] = set()  # of batches without rows
        self._first: PlantDifference | None = None
        self._stopped: str | None = "the log has no trace of the plant"

    def feed(self, batch: Batch) -> None:
        """Replay the next batch of the run; a repeated one, as a restarted recorder receives, is passed over."""
        header = batch.header
        if self._run is None:
            self._run, self._stopped = header.run, None
        repeated = header.first_row < self._rows or header in self._empty
        if self._stopped is not None or (repeated and header.run == self._run):
            return
        try:
            self._check(header)
            self._replay(batch)
        except AeroloopError as error:
            self._stopped = str(error)
        if header.rows:
            self._rows = header.first_row + header.rows
        else:
            self._empty.add(header)

    def result(self) -> PlantReplayed:
        """Result so far."""
        result = {"ticks": self._ticks, "differ": self._differ}
        return PlantReplayed(**result, first_difference=self._first, stopped=self._stopped)

    def _check(self, header: Header) -> None:
        """Raise AeroloopError if a batch does not follow what was replayed."""
        if header.run != self._run:
            raise AeroloopError("the plant was started again")
        wire = self._wire.measurement.size, self._wire.command.size, self._wire.actuators
        if (header.measurement_bytes, header.command_bytes, header.actuators) != wire:
            raise AeroloopError("the rows are not of the wire that the description describes")
        missing = header.first_row - self._rows
        if missing > 0 and not self._rows:
            raise AeroloopError("the log lacks the plant's first row, so the plant's state is not known")
        if missing > 0:
            raise AeroloopError(f"{missing} rows are missing after row {self._rows - 1} of the plant")

    def _replay(self, batch: Batch) -> None:
        header, changes = batch.header, deque(batch.tail.operations)
        rows = np.empty(header.rows, header.row_dtype)
        for name, column in batch.columns.items():
            rows[name] = column
        for row in rows:
            tick = int(row["tick"])
            while changes and changes[0].tick < tick:
                self.apply(changes.popleft())
            if self.endpoint.session != header.session:
                raise AeroloopError(f"tick {tick} is in a session whose claim is missing")
            self._compare(header.session, row)
        for change in changes:
            self.apply(change)

    def _compare(self, session: str, logged: Any) -> None:
        """Compute a tick again, and compare its row."""
        frames = {Sent.FRAME: logged["command"].tobytes(), Sent.SILENT: UNCHANGED, Sent.NONE: None}
        frame = frames.get(logged["received_as"], bytes(self._wire.command.size + 1))
        measurement = self.endpoint.tick(frame, int(logged["tick"]))
        self._on_tick(self.endpoint)
        arrival = None if frame is None else Arrival(frame, 0)
        self.last = row = plant_row(self.endpoint, measurement, arrival, 0)
        computed = np.array([row._replace(answered=row.answered & NEVER)], logged.dtype)[0]
        self._ticks += 1
        differ = [name for name in _COMPARED if logged[name].tobytes() != computed[name].tobytes()]
        self._differ += bool(differ)
        if differ and self._first is None:
            name = differ[0]
            self._first = PlantDifference(
                tick=int(logged["tick"]), session=session, session_tick=int(logged["session_tick"]), field=name,
                logged=_text(logged[name]), computed=_text(computed[name]),
            )  # fmt: skip

    def apply(self, change: PlantChange) -> None:
        """Advance the plant to a change's tick and apply it. Raises AeroloopError where that cannot be."""
        endpoint = self.endpoint
        if change.cause is TripCause.PLANT:
            return  # it failed within a tick, which has no row, and its process ended
        if change.tick > endpoint.ticked:
            if endpoint.session is not None:
                raise AeroloopError(f"rows are missing before tick {change.tick}, where a session runs")
            endpoint.tick(None, change.tick)
        name, reason, cause = change.name or "", change.reason or "", change.cause or TripCause.OPERATOR
        match change.kind:
            case "claim":
                if change.claim is None:
                    raise AeroloopError(f"the claim after tick {change.tick} does not say what it claims")
                if isinstance(answer := endpoint.claim(change.claim), Refusal):
                    raise AeroloopError(f"the claim after tick {change.tick} is refused: {answer.reason}")
            case "release":
                endpoint.release(name)
            case "arm":
                endpoint.arm()
            case "lost":
                endpoint.lost(name)
            case "stop":
                endpoint.stop(cause, reason)
            case "expire":
                endpoint.expire(cause, reason)
            case "inject":
                endpoint.inject([Fault.parse(name)] if name else [], clear=not name)
        endpoint.changes.clear()
        endpoint.notices.clear()


def _text(value: Any) -> str:
    """A value of a row: voltages, a frame in hexadecimal, or a number."""
    if isinstance(value, np.ndarray):
        return " ".join(f"{volts!r} V" for volts in value.tolist())
    if isinstance(value, np.void):
        return value.tobytes().hex()
    return "none" if value == NEVER else str(value)
