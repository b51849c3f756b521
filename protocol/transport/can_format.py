"""CAN format: identifiers, heartbeats and settings of a bus. Bytes only; `can_link` opens the bus.

    id            from → to                what
    0x100 + node  plant → controller       measurement frames
    0x200 + node  controller → plant       command frames
    0x300 + node  plant → controller       heartbeat: state, cause of the last trip, fingerprint of the wire
    0x380 + node  controller → plant       heartbeat: state, number of the session, fingerprint

A CAN bus has no sessions and no names. The controller's heartbeat replaces them: while its state is granted and its
fingerprint is the plant's own, the plant is in the session whose number it carries.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any, Final, NamedTuple

from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.wire.spec import WireSpec

MEASUREMENT_ID: Final = 0x100
COMMAND_ID: Final = 0x200
PLANT_HEARTBEAT_ID: Final = 0x300
CONTROLLER_HEARTBEAT_ID: Final = 0x380
MAX_NODE: Final = 127
CLASSIC_BYTES: Final = 8
FD_LENGTHS: Final[tuple[int, ...]] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
HEARTBEAT_S: Final = 0.1
SILENT_S: Final = 0.5  # a peer from which nothing is received for this long, five heartbeats, is gone [s]
LOCKSTEP_SILENT_S: Final = 10.0  # the same in lockstep, where a busy machine may hold up a heartbeat for long [s]

_STATES: Final = list(PlantState)
_CAUSES: Final = list(TripCause)
_FINGERPRINT_BYTES: Final = 7


class CanError(AeroloopError):
    """The bus cannot be used; one line with the reason and what to do."""


class CanSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """The CAN bus, and which node of it is the plant. `options` go to python-can's interface as they are."""

    interface: str = Field(
        default="udp_multicast", description="python-can's: socketcan, slcan, gs_usb, pcan, udp_multicast, virtual…"
    )
    channel: str = Field(default="239.74.163.2", description="the interface's: can0, /dev/ttyACM0, a multicast group…")
    node: int = Field(default=1, ge=1, le=MAX_NODE, description="number of the plant on the bus")
    fd: bool = Field(default=False, description="CAN FD, which frames of more than 8 bytes need")
    node_in_c: bool = Field(default=False, description="`aeroloop can-node` runs the firmware's C instead of Python")
    options: dict[str, Any] = Field(default={}, description="for the interface, such as bitrate = 1000000")


def carried_bytes(size: int) -> int:
    """Length of the CAN payload that carries this many bytes. Raises CanError if none does."""
    for length in FD_LENGTHS:
        if length >= size:
            return length
    raise CanError(f"a frame of {size} bytes does not fit into CAN FD's {FD_LENGTHS[-1]}: give its signals fewer bits")


def check_widths(settings: CanSettings, wire: WireSpec) -> None:
    """Raise CanError if a frame does not fit the bus, with what to do."""
    bus, longest = ("CAN FD", FD_LENGTHS[-1]) if settings.fd else ("classic CAN", CLASSIC_BYTES)
    or_fd = "" if settings.fd else ", or set can.fd = true"
    for name, signals in {
        "measurement": "wire.attitude.bits and wire.rate.bits",
        "command": "wire.voltage.bits",
    }.items():
        if (size := getattr(wire, name).size) > longest:
            problem = f"a {name} frame has {size} bytes, and a {bus} frame holds {longest}"
            raise CanError(f"{problem}: lower {signals}{or_fd}")


def counter_fills_frame(settings: CanSettings, wire: WireSpec) -> bool:
    """Whether no longer counter fits into a measurement frame: six 10-bit codes leave 4 bits of a classic frame."""
    return wire.measurement.bits == 8 * (FD_LENGTHS[-1] if settings.fd else CLASSIC_BYTES)


def fingerprint(wire: WireSpec, period_ns: int, *, lockstep: bool) -> bytes:
    """First seven bytes of SHA-256 over wire, period and lockstep, on which both ends must agree."""
    agreed = {"wire": wire.agreed(), "period_ns": period_ns, "lockstep": lockstep}
    return hashlib.sha256(json.dumps(agreed, sort_keys=True).encode()).digest()[:_FINGERPRINT_BYTES]


class Heartbeat(NamedTuple):
    """State of one end, sent ten times a second and on a change."""

    state: PlantState  # the plant's own; of the controller, the one that it requests
    number: int  # plant: 0, or which of `TripCause` tripped it, from 1; controller: number of the session, 0…15
    fingerprint: bytes  # of its wire, period and lockstep
    at_ns: int = 0  # when it was received, on `time.monotonic_ns()`; 0 in one that is sent

    @property
    def cause(self) -> TripCause | None:
        """Cause of the last trip, from a plant's heartbeat."""
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
