"""Both ends in one process, sans-I/O, through real frames: as a network without any delay connects them.

The order of a tick is that of `aeroloop demo --lockstep`: the controller answers what the plant has sent, and the plant
acts on the answer from its next period on. Injected faults of frames act; where they hold frames back, a tick has no
answer. `LockstepLog` writes what happened as the recorder does, so every reader of logs reads it.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Sequence
from json import dumps
from pathlib import Path
from typing import Any, NamedTuple

from aeroloop.plant_emulator.endpoint.endpoint import Endpoint
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, EventKind
from aeroloop.protocol.messages.operator import Change
from aeroloop.protocol.messages.trace import (
    ENDS,
    ControllerRow,
    End,
    PlantRow,
    Received,
    Sent,
    TraceWriter,
    record_json,
)
from aeroloop.protocol.transport.history import Delivery
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.frames import FrameFormat, TickCounter
from aeroloop.protocol.wire.transmit import UNCHANGED
from aeroloop.service.config import Settings
from aeroloop.service.control.controller import Controller
from aeroloop.service.logs.session import SessionKey
from aeroloop.service.recording.rolling import LogFile


def tick_of(ticks: TickCounter, layout: FrameFormat, frame: bytes) -> int | None:
    """The tick of a measurement that is received in lockstep; None of a repeated or older one."""
    counter = layout.counter(frame)
    return ticks.advance_one() if counter is None else ticks.advance(counter, 0)


class Answered(NamedTuple):
    """A measurement that the controller received, of tick k, and its command; None where it sends none."""

    k: int
    received_as: Received
    measurement: bytes
    command: bytes | None


class LockstepLoop:
    """A controller and a plant end that has taken a measurement which the controller has not received.

    `k` is the tick of the last measurement that it has received; `measurement` is the plant's last one, as
    `Endpoint.tick` returned it. `before` is called before the controller's tick k, to change gains or reference.
    """

    def __init__(
        self, endpoint: Endpoint, controller: Controller, measurement: bytes | None, k: int = -1,
        before: Callable[[int], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.endpoint, self.controller, self.measurement = endpoint, controller, measurement
        counters = endpoint.wire.measurement.counters
        self._ticks = TickCounter(endpoint.period_ns, counters, lockstep=True, tick=k)
        self._before = before

    def answer(self) -> Iterator[Answered]:
        """The controller's answers to what the plant has sent: one, or what faults of frames leave, in order.

        Each is computed when it is asked for: between two of them the controller is as it was after the first.
        """
        layout = self.endpoint.wire.measurement
        for frame in self.endpoint.outgoing:
            k = tick_of(self._ticks, layout, frame)
            if k is None:
                continue
            received_as = Received.FRAME
            if frame == UNCHANGED:
                received_as = Received.SILENT
            elif layout.counter(frame) is None:
                received_as = Received.MALFORMED
            self._before(k)
            yield Answered(k, received_as, frame, self.controller.tick(frame, k))

    def advance(self, command: bytes | None) -> Arrival | None:
        """The plant acts on a command, if any, for a period, and measures. Returns what it received."""
        if command == UNCHANGED and not self.endpoint.lockstep:
            command = None  # silence is no frame
        self.measurement = self.endpoint.tick(command, self.endpoint.ticked + 1)
        return None if command is None else Arrival(command, 0)


class LockstepLog:
    """A new log of one session from a tick on: rows of both ends, events, true states.

    Tick `first` is at `begin_ns` on the one clock that everything has [ns since 1970]. Raises OSError if the file
    exists, or cannot be written.
    """

    def __init__(self, path: Path, settings: Settings, which: SessionKey, first: int, begin_ns: int) -> None:
        self._settings, self._first, self._begin_ns = settings, first, max(begin_ns, 1)
        self._vehicle, self._session = which
        self._file = LogFile(path)
        self._writers = {end: TraceWriter(end, settings.wire, secrets.randbits(64)) for end in ENDS}
        rate_hz = settings.plant.truth_rate_hz
        self._truth_every = max(1, round(settings.loop.rate_hz / rate_hz)) if rate_hz else 0

    def describe(self, role: Description) -> None:
        """Add a role's description, with the log's own settings in lockstep."""
        loop = self._settings.loop.model_copy(update={"lockstep": True})
        config = self._settings.model_copy(update={"loop": loop}).description()
        key = topics.key("description", self._vehicle, role=role.role)
        self._file.add_description(key, role.model_copy(update={"config": config}).encode())

    def add_metadata(self, name: str, **entries: Any) -> None:
        """Add a metadata record, of entries that are JSON."""
        self._file.add_metadata(name, json=dumps(entries))

    def begin(self, controller: Controller, in_force: Sequence[Change]) -> None:
        """Begin with the controller's state, and with the gains and the reference in force."""
        for writer in self._writers.values():
            writer.session, writer.record = self._session, record_json(in_force)
        self._controller = controller
        self._writers["controller"].state = controller.state.model_dump(mode="json")

    def controller(self, one: Answered, changes: Sequence[Change]) -> None:
        """Add the tick that the controller has just computed, and the changes before it."""
        self._writers["controller"].changes += changes
        sent_as = Sent.NONE if one.command is None else Sent.FRAME if one.command else Sent.SILENT
        at_ns, command = self._at_ns(one.k), one.command or b""
        row = ControllerRow(one.k, one.received_as, sent_as, at_ns, at_ns, one.measurement, command)
        self._row("controller", one.k, row)

    def plant(self, row: PlantRow, endpoint: Endpoint) -> None:
        """Add a tick of the plant, its events and its true state."""
        k, at_ns = row.session_tick, self._at_ns(row.session_tick)
        if endpoint.session is not None:
            self._row("plant", k, row._replace(sent_ns=at_ns, received_ns=at_ns))
        for notice in endpoint.notices:
            self.event("plant", notice.kind, notice.text, k)
        endpoint.notices.clear()
        endpoint.changes.clear()
        if self._truth_every and k % self._truth_every == 0 and (truth := endpoint.truth()) is not None:
            self._add("truth", "plant", truth.encode(), k)

    def event(self, role: str, kind: EventKind, text: str, k: int) -> None:
        """Add an event of a role at tick k."""
        event = Event(role=role, kind=kind, text=text, session=self._session, tick=k)
        self._add("event", role, event.encode(), k)

    def finish(self, k: int) -> None:
        """Write what is left, up to tick k, and the index."""
        for end in ENDS:
            self._publish(end, k, final=True)
        self._file.commit()
        self._file.end()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _at_ns(self, k: int) -> int:
        return self._begin_ns + (k - self._first) * self._settings.loop.period_ns

    def _row(self, end: End, k: int, row: ControllerRow | PlantRow) -> None:
        self._writers[end].row(row)
        if self._writers[end].due(self._at_ns(k)):
            self._publish(end, k)

    def _publish(self, end: End, k: int, *, final: bool = False) -> None:
        self._add("trace", end, self._writers[end].take(self._at_ns(k), self._at_ns(k), final=final), k)
        if end == "controller":
            self._writers[end].state = self._controller.state.model_dump(mode="json")  # before the next batch's rows

    def _add(self, topic: str, role: str, payload: bytes, k: int) -> None:
        at_ns = self._at_ns(k)
        if self._file.add(Delivery(topics.key(topic, self._vehicle, role=role), payload, 0, at_ns, None), at_ns):
            self._file.commit()
