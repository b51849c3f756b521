"""DBC file of one node: the meaning of every bit on the CAN bus, for CAN tools.

A CAN payload is the wire frame byte for byte, so the whole file follows from the `WireSpec`: widths place the signals,
and the quantizer gives factor, bounds and the code of "no valid value". For a uniform quantizer with half-step dead
zone, with or without hysteresis, the level of code i is i·l, which a DBC can express. For any other the signal is the
bare code, and its comment has the formula. Many tools read DBC files as cp1252, so the text is ASCII.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from itertools import accumulate
from math import isclose
from typing import Any, Final

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
    MEASUREMENT_ID,
    PLANT_HEARTBEAT_ID,
    carried_bytes,
)
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import LogarithmicQuantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

_SAME_STEP: Final = 1e-12  # a dead zone this near to l/2, relatively, shifts no level by more than 1e-12 l


def dbc(wire: WireSpec, node: int, period_ns: int) -> str:
    """The DBC file of a plant's node and the controller that drives it. `period_ns` is the plant grid's [ns].

    Raises CanError if a frame is longer than CAN FD's.
    """
    cycle_ms, beat_ms = -(-period_ns // 1_000_000), round(1000 * HEARTBEAT_S)
    every = (
        f"one every {period_ns} ns ({1e9 / period_ns:.6g} Hz; the cycle time is in whole ms, rounded up). Every bit "
        "that belongs to no signal must be 0."
    )
    beat = f"one every {beat_ms} ms, and at once on a change."
    counted = f"Tick of the plant modulo {1 << wire.counter_bits}; 0 in a session's first measurement."
    echoed = "Counter of the measurement that this command answers."
    part = "of the attitude quaternion's vector part, where the scalar part is >= 0."
    axes = {1: "x, roll", 2: "y, pitch", 3: "z, yaw"}
    measured = [(f"eps{i}", "", f"Component {i} {part}", wire.attitude) for i in axes]
    measured += [(f"omega{i}", "rad/s", f"Angular velocity about the body's {axes[i]}.", wire.rate) for i in axes]
    commanded = [(f"u{i}", "V", f"Command u{i}.", wire.voltage) for i in wire.motors]
    causes = {0: "none"} | {cause.number: str(cause) for cause in TripCause}
    requested = "State of the plant, or the state that the controller requests."
    state = _unsigned("state", 4, 4, requested, dict(enumerate(map(str, PlantState))))
    hashed = "Wire, period and lockstep, on which both ends must agree, as seven bytes of a hash."
    agreed = _unsigned("fingerprint", 8, 56, hashed)
    cause = _unsigned("cause", 0, 4, "Cause of the plant's last trip.", causes)
    session = _unsigned("session", 0, 4, "Number of the session, modulo 16.")
    messages = [
        _message(name, identifier + node, sender, size, signals, cycle, comment)
        for name, identifier, sender, size, signals, cycle, comment in (
            ("Measurement", MEASUREMENT_ID, "Plant", wire.measurement.size,
             [_unsigned("counter", 0, wire.counter_bits, counted), *_codes(wire.measurement, measured)],
             cycle_ms, f"Measurement of the plant: {every}"),
            ("Command", COMMAND_ID, "Controller", wire.command.size,
             [_unsigned("echo", 0, wire.counter_bits, echoed), *_codes(wire.command, commanded)],
             cycle_ms, f"Command of the controller, which answers a measurement: {every}"),
            ("PlantHeartbeat", PLANT_HEARTBEAT_ID, "Plant", CLASSIC_BYTES,
             [cause, state, agreed], beat_ms, f"Sign of life of the plant: {beat}"),
            ("ControllerHeartbeat", CONTROLLER_HEARTBEAT_ID, "Controller", CLASSIC_BYTES,
             [session, state, agreed], beat_ms, f"Sign of life of the controller: {beat}"),
        )
    ]  # fmt: skip
    # Only with BusType "CAN FD" does cantools write which messages are FD.
    definition = DbcAttributeDefinition("BusType", default_value="CAN", type_name="STRING")
    bus = DbcAttribute("CAN FD" if any(message.is_fd for message in messages) else "CAN", definition)
    specifics = DbcSpecifics(
        attributes=OrderedDict([("BusType", bus)]), attribute_definitions=OrderedDict([("BusType", definition)])
    )
    ends = {"Plant": "Sensors and motors: node", "Controller": "Computes the commands of node"}
    nodes = [Node(name, f"{comment} {node}.") for name, comment in ends.items()]
    database = Database(messages, nodes, version=f"aeroloop protocol {PROTOCOL_VERSION}", dbc_specifics=specifics)
    return database.as_dbc_string(sort_signals=None, sort_attribute_signals=None)


def _message(name: str, identifier: int, sender: str, size: int, signals: list[Any], cycle: int, about: str) -> Message:
    """A message that carries `size` bytes from `sender` to the other end, one every `cycle` ms."""
    length, receiver = carried_bytes(size), "Controller" if sender == "Plant" else "Plant"
    received = [Signal(receivers=[receiver], byte_order="big_endian", **signal) for signal in signals]
    fd = length > CLASSIC_BYTES
    return Message(identifier, name, length, received, comment=about, senders=[sender], cycle_time=cycle, is_fd=fd)


def _unsigned(name: str, at: int, width: int, comment: str, choices: Mapping[int, str] | None = None) -> dict[str, Any]:
    """Arguments of a signal whose first bit is `at`, counted from the frame's first."""
    conversion = BaseConversion.factory(choices=OrderedDict(choices) if choices else None)
    top = max(choices) if choices else 2**width - 1
    placed = {"name": name, "start": _start(at), "length": width}
    return placed | {"conversion": conversion, "comment": comment, "minimum": 0, "maximum": top}


def _codes(layout: FrameFormat, quantities: list[tuple[str, str, str, SignalSpec]]) -> list[dict[str, Any]]:
    """Arguments of the quantized signals (name, unit, comment, spec) that follow a frame's counter."""
    widths = [64 if width is None else width for width in layout.widths]
    return [
        {"name": name, "start": _start(at), "length": width, "is_signed": True, **_quantized(unit, comment, spec)}
        for (name, unit, comment, spec), at, width in zip(
            quantities, accumulate(widths, initial=layout.first_bit), widths, strict=False
        )
    ]


def _quantized(unit: str, comment: str, spec: SignalSpec) -> dict[str, Any]:
    """Unit, comment, bounds and conversion of a quantized signal."""
    quantizer, formula = spec.quantizer(), ""
    scale: float = 1
    choices: Choices | None = None
    if not isinstance(quantizer, UniformQuantizer | LogarithmicQuantizer):
        top = quantizer.limit
        comment += " IEEE 754 double; NaN means: no valid value."
    else:
        top, choices = quantizer.top, OrderedDict([(quantizer.invalid, "no_valid_value")])
        comment += f" Quantized; code {quantizer.invalid} means: no valid value."
        constants = f"y0 = {quantizer.deadzone!r} and l = {quantizer.step!r}"
        if isinstance(quantizer, LogarithmicQuantizer):
            formula = f"sgn(i) * (e(|i| - 1) + e(|i|)) / 2 [{unit or 1}]"
            constants = (
                "e(k) = y0 * (yt / y0) ** (k / m) for k < m, else yt + (k - m) * l; "
                f"y0 = {quantizer.deadzone!r}, yt = {quantizer.threshold!r}, m = {quantizer.growing}"
                f" and l = {quantizer.step!r}"
            )
        elif not isclose(quantizer.deadzone, quantizer.step / 2, rel_tol=_SAME_STEP):
            formula = f"sgn(i) * (y0 + l/2 + (|i| - 1) * l) [{unit or 1}]"
        if formula:
            unit = ""
            comment += f" This is the bare code i; the level is 0 for i = 0, else {formula} with {constants}."
        else:
            scale = quantizer.step
    conversion = BaseConversion.factory(scale=scale, choices=choices, is_float=spec.bits is None)
    return {"unit": unit, "comment": comment, "conversion": conversion, "minimum": -top * scale, "maximum": top * scale}


def _start(at: int) -> int:
    """A DBC counts bits from each byte's least significant, and a big-endian signal starts at its most significant."""
    return at // 8 * 8 + 7 - at % 8
