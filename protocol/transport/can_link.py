"""Frames on a CAN bus, by python-can: any interface, classic CAN or FD. A frame's bytes are the CAN payload.

    id            from → to                what
    0x100 + node  plant → controller       measurement frames
    0x200 + node  controller → plant       command frames
    0x300 + node  plant → controller       heartbeat: state, cause of the last trip, fingerprint of the wire
    0x380 + node  controller → plant       heartbeat: state, number of the session, fingerprint

A CAN bus has no sessions and no names. The controller's heartbeat stands for them: while it says granted, and the
fingerprint is the plant's own, the plant is in the session whose number it gives.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
from contextlib import suppress
from typing import Any, Final, Literal, NamedTuple

import can
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.link import Arrival, Link, Mailbox
from aeroloop.protocol.wire.frames import MIN_COUNTER_BITS, FrameFormat
from aeroloop.protocol.wire.quantizer import MAX_BITS, MIN_BITS
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.protocol.wire.transmit import SILENCE

MEASUREMENT_ID: Final = 0x100
COMMAND_ID: Final = 0x200
PLANT_HEARTBEAT_ID: Final = 0x300
CONTROLLER_HEARTBEAT_ID: Final = 0x380
MAX_NODE: Final = 127
CLASSIC_BYTES: Final = 8
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
HEARTBEAT_S: Final = 0.1

_STATES: Final = list(PlantState)
_CAUSES: Final = list(TripCause)
_FINGERPRINT_BYTES: Final = 7
_BUS_OFF: Final = 0x40  # of a SocketCAN error frame's id
_RECEIVE_S: Final = 0.1
_SEND_S: Final = 0.002
_UNSENT: Final = 20
"""So many frames in a row that could not be handed over are a bus that does not carry them away."""

End = Literal["plant", "controller"]


class CanError(AeroloopError):
    """The bus cannot be used; one line that says why and what to do."""


class CanSettings(BaseModel):
    """The CAN bus, and which node of it is the plant. `options` go to python-can's interface as they are."""

    model_config = ConfigDict(extra="forbid")

    interface: str = Field(
        default="udp_multicast", description="python-can's: socketcan, slcan, gs_usb, pcan, udp_multicast, virtual…"
    )
    channel: str = Field(default="239.74.163.2", description="the interface's: can0, /dev/ttyACM0, a multicast group…")
    node: int = Field(default=1, ge=1, le=MAX_NODE, description="number of the plant on the bus")
    fd: bool = Field(default=False, description="CAN FD, which frames of more than 8 bytes need")
    short_counter: bool = Field(
        default=False,
        description="accept a counter that is too short to tell every late frame from a fresh one; a classic CAN frame "
        "of 10-bit signals needs counter_bits = 4",
    )
    silent_s: float = Field(
        default=0.5, ge=0.2, le=60, description="a peer from which nothing is received for this long is gone [s]"
    )
    options: dict[str, Any] = Field(default={}, description="for the interface, such as bitrate = 1000000")


def check_widths(settings: CanSettings, wire: WireSpec) -> None:
    """Raise CanError if a frame does not fit the bus, with what would fit."""
    longest = 64 if settings.fd else CLASSIC_BYTES
    for name, frame, signals in (
        ("measurement", wire.measurement, "wire.attitude.bits and wire.rate.bits"),
        ("command", wire.command, "wire.voltage.bits"),
    ):
        if frame.size <= longest:
            continue
        widest = max(
            bits
            for bits in range(MIN_BITS, MAX_BITS + 1)
            if FrameFormat([bits] * len(frame.widths), wire.counter_bits).size <= longest
        )
        ways = ["set can.fd = true", f"{signals} to {widest} at the most"]
        if FrameFormat(frame.widths, MIN_COUNTER_BITS).size <= longest:
            ways.append(f"wire.counter_bits = {MIN_COUNTER_BITS} with can.short_counter = true")
        ways_out = ", or ".join(ways)
        raise CanError(
            f"a {name} frame has {frame.size} bytes, and a classic CAN frame holds {CLASSIC_BYTES}: {ways_out}"
        )


def fingerprint(wire: WireSpec, period_ns: int, *, lockstep: bool) -> bytes:
    """Seven bytes that differ where two ends would not understand each other: SHA-256 of what they must agree on."""
    agreed = {"wire": wire.agreed(), "period_ns": period_ns, "lockstep": lockstep}
    return hashlib.sha256(json.dumps(agreed, sort_keys=True).encode()).digest()[:_FINGERPRINT_BYTES]


class Heartbeat(NamedTuple):
    """What one end says of itself ten times a second.

    Attributes:
        state: What it is doing.
        number: Plant: 0, or which of `TripCause` tripped it, from 1. Controller: number of the session, 0…15.
        fingerprint: Of its wire.
        at_ns: When it came, on `time.monotonic_ns()`; 0 in one that is sent.
    """

    state: PlantState
    number: int
    fingerprint: bytes
    at_ns: int = 0

    @property
    def cause(self) -> TripCause | None:
        """What `number` says on a plant's heartbeat."""
        return _CAUSES[self.number - 1] if 0 < self.number <= len(_CAUSES) else None

    def pack(self) -> bytes:
        """Eight bytes: number:4, state:4, fingerprint:56."""
        return bytes([self.number << 4 | _STATES.index(self.state)]) + self.fingerprint

    @classmethod
    def unpack(cls, data: bytes, at_ns: int) -> Heartbeat | None:
        """A heartbeat, or None if it is malformed."""
        if len(data) != 1 + _FINGERPRINT_BYTES or data[0] & 0x0F >= len(_STATES):
            return None
        return cls(_STATES[data[0] & 0x0F], data[0] >> 4, bytes(data[1:]), at_ns)


def number_of(cause: TripCause | None) -> int:
    """A cause's place on the bus; 0 for none."""
    return 0 if cause is None else _CAUSES.index(cause) + 1


class CanLink(Link):
    """One end's frames and heartbeats on a bus. A thread of its own receives.

    Args:
        settings: The bus.
        wire: Sizes of the frames.
        end: SessionKey end this is.
        changed: Notified when a frame comes; see Mailbox.
        lockstep: Whether an empty frame may stand for one that says nothing new.

    Attributes:
        peer: The other end's last heartbeat, or None.
        fault: Why the bus cannot be used now, or None; `reopen` may mend it.
        errors: Error frames, failed sends and receives so far.
        refused: Frames of a wrong length so far.

    Raises:
        CanError: The bus cannot be opened, or a frame does not fit it.
    """

    def __init__(
        self,
        settings: CanSettings,
        wire: WireSpec,
        end: End,
        changed: threading.Condition | None = None,
        *,
        lockstep: bool = False,
    ) -> None:
        check_widths(settings, wire)
        plant = end == "plant"
        self._settings = settings
        self._send_id = (MEASUREMENT_ID if plant else COMMAND_ID) + settings.node
        self._receive_id = (COMMAND_ID if plant else MEASUREMENT_ID) + settings.node
        self._beat_id = (PLANT_HEARTBEAT_ID if plant else CONTROLLER_HEARTBEAT_ID) + settings.node
        self._heard_id = (CONTROLLER_HEARTBEAT_ID if plant else PLANT_HEARTBEAT_ID) + settings.node
        self._receives = wire.command if plant else wire.measurement
        transmit = wire.transmit
        self._may_be_silent = lockstep and (transmit.command if plant else transmit.measurement) == "on_change"
        self._mailbox = Mailbox(changed)
        self._unsent = 0
        self._open = False
        self.peer: Heartbeat | None = None
        self.peer_ns = 0  # when anything of the other end came last
        self.fault: str | None = None
        self.errors = self.refused = 0
        self._connect()

    def send(self, frame: bytes) -> None:
        """Send a frame. A bus that does not take it is a fault after a while, told by `fault`; never an exception."""
        self._put(self._send_id, frame)

    def beat(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat."""
        self._put(self._beat_id, heartbeat.pack())

    @property
    def pending(self) -> bool:
        """Whether a frame has come that was not yet taken."""
        return self._mailbox.pending

    def take(self) -> Arrival | None:
        """The newest frame that was not yet taken, or None."""
        return self._mailbox.take()

    def wait(self, timeout_s: float) -> Arrival | None:
        """As `take`, but wait up to `timeout_s` for a frame to come."""
        return self._mailbox.wait(timeout_s)

    def silent_s(self) -> float:
        """How long nothing has come from the other end [s]; infinite if nothing ever has."""
        return (time.monotonic_ns() - self.peer_ns) * 1e-9 if self.peer_ns else float("inf")

    @property
    def silent(self) -> bool:
        """Whether the other end is gone, as far as can be seen from here."""
        return self.silent_s() > self._settings.silent_s

    def reopen(self) -> bool:
        """Try the bus again after a fault. Whether it could be opened."""
        self._disconnect()
        try:
            self._connect()
        except CanError:
            return False
        return True

    def close(self) -> None:
        """Stop receiving, and leave the bus."""
        self._disconnect()

    # ── the bus ──

    def _connect(self) -> None:
        settings = self._settings
        try:
            self._bus = can.Bus(
                interface=settings.interface, channel=settings.channel, fd=settings.fd, **settings.options
            )
        except (can.CanError, OSError, ValueError, TypeError) as error:
            raise CanError(
                f"cannot open the CAN bus {settings.interface}:{settings.channel}: {str(error).splitlines()[0]}"
            ) from None
        self._open, self.fault, self._unsent = True, None, 0
        self._receiver = threading.Thread(target=self._receive, args=(self._bus,), name="can", daemon=True)
        self._receiver.start()

    def _disconnect(self) -> None:
        if self._open:
            self._open = False
            self._receiver.join(5 * _RECEIVE_S)
            with suppress(can.CanError, OSError):
                self._bus.shutdown()

    def _fail(self, reason: str) -> None:
        self.errors += 1
        if self.fault is None:
            self.fault = reason

    def _put(self, identifier: int, payload: bytes) -> None:
        if not self._open or self.fault is not None:
            return
        fd = len(payload) > CLASSIC_BYTES
        length = next(length for length in FD_LENGTHS if length >= len(payload))
        message = can.Message(
            arbitration_id=identifier,
            is_extended_id=False,
            is_fd=fd,
            bitrate_switch=fd,
            data=payload.ljust(length, b"\0"),
        )
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
        now = time.monotonic_ns()
        if identifier == self._receive_id:
            size = self._receives.size
            if data == SILENCE and self._may_be_silent:
                self.peer_ns = now
                self._mailbox.put(data)
                return
            if len(data) < size or any(data[size:]) or (len(data) != size and size <= CLASSIC_BYTES):
                self.refused += 1
                return
            self.peer_ns = now
            self._mailbox.put(data[:size])
        elif identifier == self._heard_id:
            heartbeat = Heartbeat.unpack(data, now)
            if heartbeat is None:
                self.refused += 1
                return
            self.peer_ns = now
            self.peer = heartbeat
