"""A board with the node in C: the port's functions are this process's, so each call is seen, in order."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Sequence
from math import isnan
from pathlib import Path
from typing import Any, Final, NamedTuple

from aeroloop.plant_emulator.plant import Measurement
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import (
    COMMAND_ID,
    CONTROLLER_HEARTBEAT_ID,
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    Heartbeat,
    fingerprint,
)
from aeroloop.service.config import Settings
from tests.support.firmware import SOURCE, library

NODE_SOURCES: Final = (SOURCE / "aero_wire.c", SOURCE / "aero_node.c")
PORT: Final = r"""
#include "aero_port.h"
struct port {
    int64_t (*now)(void);
    void (*actuate)(int64_t, const double *);
    void (*enable)(int);
    void (*measure)(int64_t, double *, double *);
    void (*send)(uint32_t, const uint8_t *, size_t);
    int (*receive)(uint32_t *, uint8_t *, size_t *);
} port;
int64_t aero_port_now(void) { return port.now(); }
void aero_port_actuate(int64_t k, const double volts[AERO_ACTUATORS]) { port.actuate(k, volts); }
void aero_port_enable(int on) { port.enable(on); }
void aero_port_measure(int64_t k, double q[4], double w[3]) { port.measure(k, q, w); }
void aero_port_send(uint32_t id, const uint8_t *data, size_t size) { port.send(id, data, size); }
int aero_port_receive(uint32_t *id, uint8_t data[64], size_t *size) { return port.receive(id, data, size); }
"""
_DOUBLES: Final = ctypes.POINTER(ctypes.c_double)
_BYTES: Final = ctypes.POINTER(ctypes.c_uint8)
_NOW: Final = ctypes.CFUNCTYPE(ctypes.c_int64)
_ACTUATE: Final = ctypes.CFUNCTYPE(None, ctypes.c_int64, _DOUBLES)
_ENABLE: Final = ctypes.CFUNCTYPE(None, ctypes.c_int)
_MEASURE: Final = ctypes.CFUNCTYPE(None, ctypes.c_int64, _DOUBLES, _DOUBLES)
_SEND: Final = ctypes.CFUNCTYPE(None, ctypes.c_uint32, _BYTES, ctypes.c_size_t)
_RECEIVE: Final = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.POINTER(ctypes.c_uint32), _BYTES, ctypes.POINTER(ctypes.c_size_t)
)


class Actuated(NamedTuple):
    """A call of `aero_port_actuate`."""

    tick: int
    volts: tuple[float, ...]


class Enabled(NamedTuple):
    """A call of `aero_port_enable`."""

    on: bool


class Sent(NamedTuple):
    """A call of `aero_port_send`."""

    identifier: int
    data: bytes


class _Port(ctypes.Structure):
    _fields_ = (
        ("now", _NOW),
        ("actuate", _ACTUATE),
        ("enable", _ENABLE),
        ("measure", _MEASURE),
        ("send", _SEND),
        ("receive", _RECEIVE),
    )


def board_library(
    settings: Settings, folder: Path, sources: Sequence[Path] = NODE_SOURCES, *, may_warn: bool = False
) -> ctypes.CDLL:
    """The node of a configuration, or other sources, compiled with a port for `Board` in a folder."""
    (folder / "port.c").write_text(PORT)
    return library(settings, folder, *sources, folder / "port.c", may_warn=may_warn)


class Board:
    """The node of a configuration, and a controller's side that answers its measurements.

    Attributes:
        calls: What the node called of the port, but for `now`, `measure` and `receive`, in order.
        received: Frames that the node has not taken yet: identifier and data.
        receives: How often the node asked for a frame.
        babbles: A frame that the bus delivers without end, once `received` is empty; None for none.
        reading: What the sensors measure.
        echo: Counter of the last measurement sent; None before the first of a session.
        tick: The last one, −1 before.
    """

    def __init__(self, settings: Settings, c: ctypes.CDLL) -> None:
        self.settings, self.wire = settings, settings.wire
        self.off = (0.0,) * self.wire.actuators
        self.calls: list[Actuated | Enabled | Sent] = []
        self.received: deque[tuple[int, bytes]] = deque()
        self.receives = 0
        self.babbles: tuple[int, bytes] | None = None
        self.reading = Measurement((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self.echo: int | None = None
        self.tick = -1
        self.now_ns = 1
        self.c = c
        self._port = _Port.in_dll(self.c, "port")  # it keeps the callbacks
        self._port.now = _NOW(lambda: self.now_ns)
        self._port.actuate = _ACTUATE(self._actuate)
        self._port.enable = _ENABLE(lambda on: self.calls.append(Enabled(bool(on))))
        self._port.measure = _MEASURE(self._measure)
        self._port.send = _SEND(self._send)
        self._port.receive = _RECEIVE(self._receive)
        self.c.aero_tick.argtypes = [ctypes.c_void_p, ctypes.c_int64]
        self._node = ctypes.create_string_buffer(1 << 16)
        self.start()

    # ── what the board does ──

    def start(self) -> None:
        """Reset the node."""
        self.c.aero_start(self._node)

    def poll(self) -> None:
        """Call `aero_poll`."""
        self.c.aero_poll(self._node)

    def turn(self, *frames: tuple[int, bytes], k: int | None = None) -> None:
        """Receive frames; then one period later, or at tick k, poll and tick."""
        self.received.extend(frames)
        self.now_ns += self.settings.loop.period_ns
        self.tick = self.tick + 1 if k is None else k
        self.poll()
        self.c.aero_tick(self._node, self.tick)

    def trip(self, cause: TripCause) -> None:
        """End the session for a cause of the board's own."""
        self.c.aero_trip(self._node, cause.number)

    def leave(self) -> None:
        """Call `aero_leave`."""
        self.c.aero_leave(self._node)

    # ── what the controller's side sends ──

    def beat(self, number: int = 1, state: PlantState = PlantState.GRANTED) -> tuple[int, bytes]:
        """The controller's heartbeat."""
        loop = self.settings.loop
        mark = fingerprint(self.wire, loop.period_ns, lockstep=loop.lockstep)
        return CONTROLLER_HEARTBEAT_ID + self.settings.can.node, Heartbeat(state, number, mark).pack()

    def command(self, *volts: float, echo: int | None = None) -> tuple[int, bytes]:
        """A command that answers the last measurement, or that of a counter; NaN stands for no valid value."""
        quantizer = self.wire.voltage.quantizer()
        counter = self.echo if echo is None else echo
        assert counter is not None
        codes = [quantizer.invalid if isnan(value) else quantizer.encode(value) for value in volts]
        frame = self.wire.command.pack(counter, codes)
        return COMMAND_ID + self.settings.can.node, frame

    def begin(self, number: int = 1) -> None:
        """Begin a session, up to its first measurement."""
        self.echo = None
        self.turn(self.beat(number))
        assert self.state is PlantState.GRANTED
        assert self.echo == 0

    def drive(self, *volts: float, ticks: int = 1) -> None:
        """Answer each measurement of so many ticks."""
        for _ in range(ticks):
            self.turn(self.command(*volts))

    # ── what the node is ──

    @property
    def state(self) -> PlantState:
        """The node's state."""
        index: int = self._front.state
        return list(PlantState)[index]

    @property
    def cause(self) -> TripCause | None:
        """Of its last trip."""
        number: int = self._front.cause
        return list(TripCause)[number - 1] if number else None

    @property
    def refused(self) -> int:
        """Frames that it refused."""
        return int(self._front.refused)

    @property
    def volts(self) -> tuple[float, ...]:
        """What the motors were given last [V]."""
        return [call.volts for call in self.calls if isinstance(call, Actuated)][-1]

    @property
    def is_powered(self) -> bool:
        """Whether the power stage is on."""
        return [call.on for call in self.calls if isinstance(call, Enabled)][-1]

    @property
    def heartbeat(self) -> Heartbeat:
        """The last that it sent."""
        own = PLANT_HEARTBEAT_ID + self.settings.can.node
        sent = [call.data for call in self.calls if isinstance(call, Sent) and call.identifier == own]
        heartbeat = Heartbeat.unpack(sent[-1], 0)
        assert heartbeat is not None
        return heartbeat

    @property
    def _front(self) -> Any:
        class Front(ctypes.Structure):
            _fields_ = (
                ("state", ctypes.c_int),
                ("cause", ctypes.c_int),
                ("voltages", ctypes.c_double * self.wire.actuators),
                ("refused", ctypes.c_uint32),
            )

        return Front.from_buffer(self._node)

    # ── the port ──

    def _actuate(self, k: int, volts: Any) -> None:
        self.calls.append(Actuated(k, tuple(volts[: self.wire.actuators])))

    def _measure(self, k: int, attitude: Any, rate: Any) -> None:
        del k
        for i, value in enumerate(self.reading.attitude):
            attitude[i] = value
        for i, value in enumerate(self.reading.rate):
            rate[i] = value

    def _send(self, identifier: int, data: Any, size: int) -> None:
        frame = bytes(data[:size])
        self.calls.append(Sent(identifier, frame))
        if identifier == MEASUREMENT_ID + self.settings.can.node:
            self.echo = self.wire.measurement.counter(frame[: self.wire.measurement.size])

    def _receive(self, identifier: Any, data: Any, size: Any) -> int:
        self.receives += 1
        if self.received:
            identifier[0], frame = self.received.popleft()
        elif self.babbles is not None and self.receives < 100_000:
            identifier[0], frame = self.babbles
        else:
            return 0
        size[0] = len(frame)
        for i, byte in enumerate(frame):
            data[i] = byte
        return 1
