"""DBC file of one node: the meaning of every bit on the CAN bus, for CAN tools.

A CAN payload is the wire frame byte for byte, so the whole file follows from the `WireSpec`: widths place the signals,
and the quantizer gives factor, bounds and the code of "no valid value". For a uniform quantizer with half-step dead
zone, with or without hysteresis, the level of code i is i·l, which a DBC can express. For any other the signal is the
bare code, and its comment has the formula. Many tools read DBC files as cp1252, so the text is ASCII.

Identifiers and lengths are those of `can_link`. cantools takes about half a second to import: import this module where
it is used, not at a program's head.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator
from math import isclose
from typing import Final, NamedTuple

from cantools.database.can import Database, Message, Node, Signal
from cantools.database.can.formats.dbc import DbcAttribute, DbcAttributeDefinition, DbcSpecifics
from cantools.database.conversion import BaseConversion
from cantools.typechecking import Choices

from aeroloop.protocol.messages.models import PROTOCOL_VERSION
from aeroloop.protocol.messages.states import PlantState, TripCause
from aeroloop.protocol.transport.can_format import (
    CLASSIC_BYTES,
    COMMAND_ID,
    CONTROLLER_HEARTBEAT_ID,
    HEARTBEAT_S,
    MAX_NODE,
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    carried_bytes,
)
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import LogarithmicQuantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

NO_VALID_VALUE: Final = "no_valid_value"
"""Name of the code −2^(R−1)."""

_HEARTBEAT_MS: Final = round(1000 * HEARTBEAT_S)
_FINGERPRINT_BITS: Final = 56
_PLANT: Final = "Plant"
_CONTROLLER: Final = "Controller"
_MAX_CYCLE_MS: Final = 2**16 - 1  # what cantools declares for GenMsgCycleTime
_SAME_STEP: Final = 1e-12  # a dead zone this near to l/2, relatively, shifts no level by more than 1e-12 l


class _Quantity(NamedTuple):
    """A quantized signal with its name, unit and comment."""

    name: str
    unit: str
    comment: str
    spec: SignalSpec


def dbc(wire: WireSpec, node: int, period_ns: int) -> str:
    """The DBC file of a plant's node, 1…127, and the controller that drives it. `period_ns` is the plant grid's [ns].

    Raises:
        ValueError: A node or a period out of bounds.
    """
    if not 1 <= node <= MAX_NODE:
        raise ValueError(f"a node's number is 1 to {MAX_NODE}, not {node}")
    cycle_ms = -(-period_ns // 1_000_000)
    if not 1 <= cycle_ms <= _MAX_CYCLE_MS:
        raise ValueError(f"a period of {period_ns} ns is not between 1 ns and {_MAX_CYCLE_MS} ms")
    rate = f"one every {period_ns} ns ({1e9 / period_ns:.6g} Hz; the cycle time is in whole ms, rounded up)"
    idle = "Every bit that belongs to no signal must be 0."
    bits = wire.counter_bits
    counted = f"Tick of the plant modulo {1 << bits}; 0 in a session's first measurement."
    measurement = _message(
        "Measurement",
        MEASUREMENT_ID + node,
        _PLANT,
        wire.measurement.size,
        [_unsigned("counter", 0, bits, counted), *_codes(wire.measurement, _measured(wire))],
        cycle_ms,
        f"Measurement of the plant: {rate}. {idle}",
    )
    echo = _unsigned("echo", 0, bits, "Counter of the measurement that this command answers.")
    command = _message(
        "Command",
        COMMAND_ID + node,
        _CONTROLLER,
        wire.command.size,
        [echo, *_codes(wire.command, _commanded(wire))],
        cycle_ms,
        f"Command of the controller, which answers a measurement: {rate}. {idle}",
    )
    causes: Choices = OrderedDict([(0, "none"), *((cause.number, str(cause)) for cause in TripCause)])
    cause = _unsigned("cause", 0, 4, "Cause of the plant's last trip.", causes)
    session = _unsigned("session", 0, 4, "Number of the session, modulo 16.")
    messages = [
        measurement,
        command,
        _heartbeat("PlantHeartbeat", PLANT_HEARTBEAT_ID + node, _PLANT, cause),
        _heartbeat("ControllerHeartbeat", CONTROLLER_HEARTBEAT_ID + node, _CONTROLLER, session),
    ]
    database = Database(
        messages,
        [
            Node(_PLANT, f"Sensors and motors: node {node}."),
            Node(_CONTROLLER, f"Computes the commands of node {node}."),
        ],
        version=f"aeroloop protocol {PROTOCOL_VERSION}",
        dbc_specifics=_bus_type("CAN FD" if any(message.is_fd for message in messages) else "CAN"),
    )
    return database.as_dbc_string(sort_signals=None, sort_attribute_signals=None)


def _measured(wire: WireSpec) -> list[_Quantity]:
    part = "of the attitude quaternion's vector part, where the scalar part is >= 0."
    axes = {1: "x, roll", 2: "y, pitch", 3: "z, yaw"}
    return [
        *(_Quantity(f"eps{i}", "", f"Component {i} {part}", wire.attitude) for i in axes),
        *(_Quantity(f"omega{i}", "rad/s", f"Angular velocity about the body's {axes[i]}.", wire.rate) for i in axes),
    ]


def _commanded(wire: WireSpec) -> list[_Quantity]:
    return [_Quantity(f"u{i}", "V", f"Command u{i}.", wire.voltage) for i in wire.motors]


def _message(
    name: str, identifier: int, sender: str, size: int, signals: list[Signal], cycle_ms: int, comment: str
) -> Message:
    """A message that carries `size` bytes from `sender` to the other end."""
    for signal in signals:
        signal.receivers = [_CONTROLLER if sender == _PLANT else _PLANT]
    length = carried_bytes(size)
    fd = length > CLASSIC_BYTES
    return Message(identifier, name, length, signals, comment=comment, senders=[sender], cycle_time=cycle_ms, is_fd=fd)


def _heartbeat(name: str, identifier: int, sender: str, number: Signal) -> Message:
    """A heartbeat, whose first four bits are `number`."""
    states: Choices = OrderedDict((code, str(state)) for code, state in enumerate(PlantState))
    state = _unsigned("state", 4, 4, "State of the plant, or the state that the controller requests.", states)
    agreed = "Wire, period and lockstep, on which both ends must agree, as seven bytes of a hash."
    fingerprint = _unsigned("fingerprint", 8, _FINGERPRINT_BITS, agreed)
    comment = f"Sign of life of the {sender.lower()}: one every {_HEARTBEAT_MS} ms, and at once on a change."
    return _message(name, identifier, sender, CLASSIC_BYTES, [number, state, fingerprint], _HEARTBEAT_MS, comment)


def _codes(layout: FrameFormat, quantities: Iterable[_Quantity]) -> Iterator[Signal]:
    """The signals that follow a frame's counter."""
    at = layout.first_bit
    for quantity, width in zip(quantities, layout.widths, strict=True):
        yield _signal(quantity, at)
        at += 64 if width is None else width


def _unsigned(name: str, at: int, width: int, comment: str, choices: Choices | None = None) -> Signal:
    return Signal(
        name,
        _start(at),
        width,
        "big_endian",
        conversion=BaseConversion.factory(choices=choices),
        minimum=0,
        maximum=max(choices) if choices else 2**width - 1,
        comment=comment,
    )


def _signal(quantity: _Quantity, at: int) -> Signal:
    """One quantized signal whose first bit is `at`, counted from the frame's first."""
    quantizer = quantity.spec.quantizer()
    comment, unit = quantity.comment, quantity.unit
    scale: float = 1
    choices: Choices | None = None
    if not isinstance(quantizer, UniformQuantizer | LogarithmicQuantizer):
        width, top = 64, quantizer.limit
        comment += " IEEE 754 double; NaN means: no valid value."
    else:
        width, top = quantizer.bits, quantizer.top
        choices = OrderedDict([(quantizer.invalid, NO_VALID_VALUE)])
        comment += f" Quantized; code {quantizer.invalid} means: no valid value."
        formula = _formula(quantizer)
        if formula is None:
            scale = quantizer.step
        else:
            level, constants = f"{formula[0]} [{unit or 1}]", formula[1]
            comment += f" This is the bare code i; the level is 0 for i = 0, else {level} with {constants}."
            unit = ""
    return Signal(
        quantity.name,
        _start(at),
        width,
        "big_endian",
        is_signed=True,
        conversion=BaseConversion.factory(scale=scale, choices=choices, is_float=quantity.spec.bits is None),
        minimum=-top * scale,
        maximum=top * scale,
        unit=unit,
        comment=comment,
    )


def _formula(quantizer: UniformQuantizer | LogarithmicQuantizer) -> tuple[str, str] | None:
    """Formula of code i's level, and its constants; None if the level is i times the step."""
    if isinstance(quantizer, LogarithmicQuantizer):
        return "sgn(i) * (e(|i| - 1) + e(|i|)) / 2", (
            "e(k) = y0 * (yt / y0) ** (k / m) for k < m, else yt + (k - m) * l;"
            f" y0 = {quantizer.deadzone!r}, yt = {quantizer.threshold!r},"
            f" m = {quantizer.growing} and l = {quantizer.step!r}"
        )
    if isclose(quantizer.deadzone, quantizer.step / 2, rel_tol=_SAME_STEP):
        return None
    return "sgn(i) * (y0 + l/2 + (|i| - 1) * l)", f"y0 = {quantizer.deadzone!r} and l = {quantizer.step!r}"


def _start(at: int) -> int:
    """A DBC counts bits from each byte's least significant, and a big-endian signal starts at its most significant."""
    return at // 8 * 8 + 7 - at % 8


def _bus_type(bus: str) -> DbcSpecifics:
    """The database's bus type. Only with BusType "CAN FD" does cantools write which messages are FD."""
    definition = DbcAttributeDefinition("BusType", default_value="CAN", type_name="STRING")
    return DbcSpecifics(
        attributes=OrderedDict([("BusType", DbcAttribute(bus, definition))]),
        attribute_definitions=OrderedDict([("BusType", definition)]),
    )
