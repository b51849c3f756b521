"""Trace of the plant end: a row for every tick of a session, and the operations between ticks.

The owner adds a row after each measurement was sent, and calls `follow` whenever a session may have begun or ended. All
waiting rows are published when a session ends; operations outside of sessions are published at once, without rows.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable

from aeroloop.plant_emulator.endpoint.tenancy import Tenancy
from aeroloop.protocol.messages.trace import Sent, TraceWriter
from aeroloop.protocol.transport.link import Arrival
from aeroloop.protocol.wire.loop import LoopSettings
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import SILENCE


class PlantTrace:
    """Writer of one plant end's trace; `publish` is called with every batch.

    `run` is the random number that identifies this process; drawn if None.
    """

    def __init__(
        self, loop: LoopSettings, wire: WireSpec, publish: Callable[[bytes], None], run: int | None = None
    ) -> None:
        self._publish = publish
        self._command_bytes = wire.command.size
        run = secrets.randbits(64) if run is None else run
        self._writer = TraceWriter("plant", wire, run, round(loop.trace_s * 1e9))

    def row(self, end: Tenancy, measurement: bytes | None, arrival: Arrival | None, sent_ns: int) -> None:
        """Add the row of the last tick, and publish a batch that is due. Nothing without a session.

        The arguments are those of `Front.after_tick`; `measurement` is None if the tick tripped.
        """
        writer = self._writer
        if not writer.session:
            return
        if arrival is None:
            command, received_ns, received_as = b"", 0, 0
        else:
            command, received_ns = arrival
            if len(command) == self._command_bytes:
                received_as = 1
            else:
                received_as, command = (Sent.SILENT if command == SILENCE else Sent.MALFORMED), b""
        writer.plant_row(
            end.ticked,
            end.session_tick,
            1 if measurement else 0 if measurement is None else 2,
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
        if writer.due(sent_ns):
            self._publish_batch(final=False)

    def follow(self, end: Tenancy) -> None:
        """Move the end's operations into the trace; publish everything waiting if its session ended or none runs."""
        writer = self._writer
        if end.operations:
            writer.operations += end.operations
            end.operations.clear()
        session = end.session or ""
        if session != writer.session:
            if writer.session or not writer.empty:  # the last batch is marked final, with or without rows
                self._publish_batch(final=bool(writer.session))
            writer.session = session
        elif not session and not writer.empty:
            self._publish_batch(final=False)

    def finish(self) -> None:
        """Publish everything waiting, before the process ends."""
        if self._writer.session or not self._writer.empty:
            self._publish_batch(final=bool(self._writer.session))

    def _publish_batch(self, *, final: bool) -> None:
        self._publish(self._writer.take(time.monotonic_ns(), time.time_ns(), final=final))
