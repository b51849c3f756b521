"""CAN link: one end's frames and heartbeats on a CAN bus, by python-can. Any interface, classic or FD.

A frame's bytes are the CAN payload; `can_format` has identifiers and heartbeats.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Final, Literal

import can

from aeroloop.protocol.transport.can_format import (
    CLASSIC_BYTES,
    COMMAND_ID,
    CONTROLLER_HEARTBEAT_ID,
    HEARTBEAT_S,
    LOCKSTEP_SILENT_S,
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    SILENT_S,
    CanError,
    CanSettings,
    Heartbeat,
    carried_bytes,
    check_widths,
)
from aeroloop.protocol.transport.link import Link
from aeroloop.protocol.wire.spec import WireSpec

_BUS_OFF: Final = 0x40  # of a SocketCAN error frame's id
_RECEIVE_S: Final = 0.1
_SEND_S: Final = 0.002
_REOPEN_S: Final = 0.5
_UNSENT: Final = 20  # failed sends in a row after which the bus counts as lost


class CanLink(Link):
    """One end's frames and heartbeats on a bus. A thread of its own receives. In lockstep an empty frame is silence.

    `peer` is the other end's last heartbeat, or None; `fault` says why the bus cannot be used, as after repeated
    failures to send, until `reopen` clears it. `errors` counts error frames, failed sends and receives, `refused`
    malformed frames and heartbeats. Raises CanError if the bus cannot be opened, or a frame does not fit it.
    """

    def __init__(
        self,
        settings: CanSettings,
        wire: WireSpec,
        end: Literal["plant", "controller"],
        changed: threading.Condition | None = None,
        *,
        lockstep: bool = False,
    ) -> None:
        check_widths(settings, wire)
        super().__init__(changed)
        plant, controller = (MEASUREMENT_ID, PLANT_HEARTBEAT_ID), (COMMAND_ID, CONTROLLER_HEARTBEAT_ID)
        sent, taken = (plant, controller) if end == "plant" else (controller, plant)
        received: Literal["measurement", "command"] = "command" if end == "plant" else "measurement"
        self._send_id, self._beat_id = (each + settings.node for each in sent)
        self._receive_id, self._peer_beat_id = (each + settings.node for each in taken)
        self._settings = settings
        self._size = getattr(wire, received).size
        self._accepts = wire.acceptance(received, lockstep=lockstep)
        self._patience_s = LOCKSTEP_SILENT_S if lockstep else SILENT_S
        self._reopen_due = self._beat_due = 0.0
        self._sent: Heartbeat | None = None  # the last heartbeat sent
        self._open = False
        self.peer: Heartbeat | None = None
        self.peer_ns = 0  # last reception from the other end
        self.fault: str | None = None
        self.errors = self.refused = 0
        self._connect()

    def send(self, frame: bytes) -> None:
        self._put(self._send_id, frame)

    def beat(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat."""
        self._sent = heartbeat
        self._beat_due = time.monotonic() + HEARTBEAT_S
        self._put(self._beat_id, heartbeat.pack())

    def beat_when_due(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat ten times a second, and at once if it says something new."""
        if heartbeat != self._sent or time.monotonic() >= self._beat_due:
            self.beat(heartbeat)

    def silent_s(self) -> float:
        """Time since the last reception from the other end [s]; infinite if there was none."""
        return (time.monotonic_ns() - self.peer_ns) * 1e-9 if self.peer_ns else float("inf")

    @property
    def silent(self) -> bool:
        """Whether the other end has been silent for longer than `SILENT_S`, in lockstep than `LOCKSTEP_SILENT_S`."""
        return self.silent_s() > self._patience_s

    def reopen(self) -> bool:
        """Reopen the bus after a fault, twice a second at the most; whether that succeeded."""
        if time.monotonic() < self._reopen_due:
            return False
        self._reopen_due = time.monotonic() + _REOPEN_S
        self.close()
        with suppress(CanError):
            self._connect()
            return True
        return False

    def close(self) -> None:
        if self._open:
            self._open = False
            self._receiver.join(5 * _RECEIVE_S)
            with suppress(can.CanError, OSError):
                self._bus.shutdown()

    # ── the bus ──

    def _connect(self) -> None:
        bus = self._settings
        try:
            self._bus = can.Bus(channel=bus.channel, interface=bus.interface, fd=bus.fd, **bus.options)
        except (can.CanError, OSError, ValueError, TypeError) as error:
            where = f"{bus.interface}:{bus.channel}"
            raise CanError(f"cannot open the CAN bus {where}: {str(error).splitlines()[0]}") from None
        self._open, self.fault, self._unsent = True, None, 0
        self._receiver = threading.Thread(target=self._receive, args=(self._bus,), name="can", daemon=True)
        self._receiver.start()

    def _fail(self, reason: str) -> None:
        self.errors += 1
        if self.fault is None:
            self.fault = reason

    def _put(self, identifier: int, payload: bytes) -> None:
        if not self._open or self.fault is not None:
            return
        fd = len(payload) > CLASSIC_BYTES
        data = payload.ljust(carried_bytes(len(payload)), b"\0")
        message = can.Message(arbitration_id=identifier, is_extended_id=False, is_fd=fd, bitrate_switch=fd, data=data)
        try:
            self._bus.send(message, timeout=_SEND_S)
            self._unsent = 0
        except (can.CanError, OSError) as error:
            self.errors += 1
            self._unsent += 1
            if self._unsent >= _UNSENT:
                self._fail(f"the bus takes no frames: {str(error).splitlines()[0]}")

    def _receive(self, bus: can.BusABC) -> None:
        while self._open and bus is self._bus:
            try:
                message = bus.recv(_RECEIVE_S)
            except (can.CanError, OSError, ValueError, TypeError) as error:  # an adapter that was unplugged
                if self._open:
                    self._fail(f"the bus is lost: {str(error).splitlines()[0]}")
                return
            if message is None:
                continue
            if message.is_error_frame:
                self.errors += 1
                if message.arbitration_id & _BUS_OFF:
                    self._fail("the controller is bus-off")
                    return
            elif not message.is_extended_id and not message.is_remote_frame:
                self._accept(message.arbitration_id, bytes(message.data))

    def _accept(self, identifier: int, data: bytes) -> None:
        now, size = time.monotonic_ns(), self._size
        if identifier == self._receive_id:
            is_filled_up = len(data) > size > CLASSIC_BYTES and not any(data[size:])  # to a length that CAN FD has
            frame = data[:size] if is_filled_up else data
            if self._accepts(frame):
                self.peer_ns = now
                self.put(frame)
            else:
                self.refused += 1
        elif identifier == self._peer_beat_id:
            if heartbeat := Heartbeat.unpack(data, now):
                self.peer, self.peer_ns = heartbeat, now
            else:
                self.refused += 1
