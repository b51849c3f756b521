"""DBC file of one node: the meaning of every bit on the CAN bus, for CAN tools.

A CAN payload is the wire frame byte for byte, so the whole file follows from the `WireSpec`: widths place the signals,
and the quantizer gives factor, bounds and the code of "no valid value". For a uniform quantizer with half-step dead
zone, with or without hysteresis, the level of code i is i·l, which a DBC can express. For any other the signal is the
bare code. Many tools read DBC files as cp1252, so the text is ASCII.
"""

from __future__ import annotations

from collections import OrderedDict
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
from aeroloop.protocol.wire.quantizer import LogarithmicQuantizer, UniformQuantizer
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

_SAME_STEP: Final = 1e-12  # a dead zone this near to l/2, relatively, shifts no level by more than 1e-12 l
_AXES: Final = {1: "x, roll", 2: "y, pitch", 3: "z, yaw"}
_HASH: Final = "Wire, period and lockstep, on which both ends must agree, as seven bytes of a hash."


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
    count = f"Tick of the plant modulo {1 << wire.counter_bits}; 0 in a session's first measurement."
    part = "of the attitude quaternion's vector part, where the scalar part is >= 0."
    measured = [(f"eps{i}", f"Component {i} {part}", "", wire.attitude) for i in _AXES]
    measured += [
        (f"omega{i}", f"Angular velocity about the body's {axis}.", "rad/s", wire.rate) for i, axis in _AXES.items()
    ]
    commanded = [(f"u{i}", f"Command u{i}.", "V", wire.voltage) for i in wire.motors]
    causes = {0: "none"} | {cause.number: str(cause) for cause in TripCause}
    states = dict(enumerate(map(str, PlantState)))
    state = _unsigned("state", 4, "State of the plant, or the state that the controller requests.", states)
    cause = _unsigned("cause", 4, "Cause of the plant's last trip.", causes)
    session = _unsigned("session", 4, "Number of the session, modulo 16.")
    agreed = _unsigned("fingerprint", 56, _HASH)
    counter = _unsigned("counter", wire.counter_bits, count)
    echo = _unsigned("echo", wire.counter_bits, "Counter of the measurement that this command answers.")
    table = [  # name, id, sender, bytes, bit of the second signal, signals in order, cycle time [ms], comment
        ("Measurement", MEASUREMENT_ID, "Plant", wire.measurement.size, wire.measurement.first_bit,
         [counter, *map(_quantized, measured)], cycle_ms, f"Measurement of the plant: {every}"),
        ("Command", COMMAND_ID, "Controller", wire.command.size, wire.command.first_bit,
         [echo, *map(_quantized, commanded)], cycle_ms,
         f"Command of the controller, which answers a measurement: {every}"),
        ("PlantHeartbeat", PLANT_HEARTBEAT_ID, "Plant", CLASSIC_BYTES, 4,
         [cause, state, agreed], beat_ms, f"Sign of life of the plant: {beat}"),
        ("ControllerHeartbeat", CONTROLLER_HEARTBEAT_ID, "Controller", CLASSIC_BYTES, 4,
         [session, state, agreed], beat_ms, f"Sign of life of the controller: {beat}"),
    ]  # fmt: skip
    messages = []
    for name, identifier, sender, size, second, signals, cycle, comment in table:
        length, at, placed = carried_bytes(size), 0, list[Signal]()
        receivers = ["Controller" if sender == "Plant" else "Plant"]
        for signal in signals:
            start = at // 8 * 8 + 7 - at % 8  # a DBC counts bits from each byte's least significant
            placed.append(Signal(start=start, receivers=receivers, byte_order="big_endian", **signal))
            at = max(at + signal["length"], second)
        fd = length > CLASSIC_BYTES
        kwargs: dict[str, Any] = {"comment": comment, "senders": [sender], "cycle_time": cycle, "is_fd": fd}
        messages.append(Message(identifier + node, name, length, placed, **kwargs))
    # Only with BusType "CAN FD" does cantools write which messages are FD.
    definition = DbcAttributeDefinition("BusType", default_value="CAN", type_name="STRING")
    bus = DbcAttribute("CAN FD" if any(message.is_fd for message in messages) else "CAN", definition)
    specifics = DbcSpecifics(
        attributes=OrderedDict([("BusType", bus)]), attribute_definitions=OrderedDict([("BusType", definition)])
    )
    nodes = [
        Node("Plant", f"Sensors and motors: node {node}."),
        Node("Controller", f"Computes the commands of node {node}."),
    ]
    database = Database(messages, nodes, version=f"aeroloop protocol {PROTOCOL_VERSION}", dbc_specifics=specifics)
    return database.as_dbc_string(sort_signals=None, sort_attribute_signals=None)


def _unsigned(name: str, width: int, comment: str, choices: dict[int, str] | None = None) -> dict[str, Any]:
    """Arguments of a signal that is a number or one of some choices."""
    conversion = BaseConversion.factory(choices=OrderedDict(choices) if choices else None)
    top = max(choices) if choices else 2**width - 1
    return {
        "name": name, "length": width, "conversion": conversion, "comment": comment, "minimum": 0, "maximum": top
    }  # fmt: skip


def _quantized(quantity: tuple[str, str, str, SignalSpec]) -> dict[str, Any]:
    """Arguments of a quantized signal, from its name, comment, unit and quantizer."""
    name, comment, unit, spec = quantity
    quantizer, scale = spec.quantizer(), 1.0
    choices: Choices | None = None
    if not isinstance(quantizer, UniformQuantizer | LogarithmicQuantizer):
        top = quantizer.limit
        comment += " IEEE 754 double; NaN means: no valid value."
    else:
        top, choices = quantizer.top, OrderedDict([(quantizer.invalid, "no_valid_value")])
        comment += f" Quantized; code {quantizer.invalid} means: no valid value."
        half = isclose(quantizer.deadzone, quantizer.step / 2, rel_tol=_SAME_STEP)
        if half and isinstance(quantizer, UniformQuantizer):
            scale = quantizer.step
        else:
            comment += (
                f" This is the bare code, whose level [{unit or 1}] has no factor: see aeroloop's SPEC.md, section 2."
            )
            unit = ""
    return {
        "name": name, "length": spec.bits or 64, "is_signed": True, "unit": unit, "comment": comment,
        "conversion": BaseConversion.factory(scale=scale, choices=choices, is_float=spec.bits is None),
        "minimum": -top * scale, "maximum": top * scale,
    }  # fmt: skip
