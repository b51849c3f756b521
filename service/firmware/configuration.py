"""Configuration of the firmware: `aero_config.h`, with which its C is compiled. Only numbers, no code."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from hashlib import sha256
from math import isinf

from aeroloop.plant_emulator.endpoint.endpoint import Freshness
from aeroloop.plant_emulator.endpoint.limits import LimitMonitor
from aeroloop.protocol.transport.can_format import HEARTBEAT_S, LOCKSTEP_SILENT_S, SILENT_S, carried_bytes, fingerprint
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import CodedQuantizer, LogarithmicQuantizer
from aeroloop.protocol.wire.spec import SignalSpec
from aeroloop.service.config import Settings

_KINDS = {"uniform": "UNIFORM", "hysteresis-uniform": "HYSTERESIS", "logarithmic-uniform": "LOGARITHMIC"}
_LENGTHS = ("limit", "deadzone", "step", "hysteresis", "threshold")


def config_header(settings: Settings) -> str:
    """Text of `aero_config.h` for a configuration."""
    wire, loop, plant, can = settings.wire, settings.loop, settings.plant, settings.can
    counters, period_ns = wire.measurement.counters, loop.period_ns
    freshness = Freshness(counters, period_ns, plant.watchdog_s)
    full = min(plant.voltage_limit, wire.voltage.quantizer().outermost)
    limits = LimitMonitor(plant.limits, period_ns, full)
    identity = ", ".join(f"0x{byte:02x}" for byte in fingerprint(wire, period_ns, lockstep=loop.lockstep))
    silent_s = LOCKSTEP_SILENT_S if loop.lockstep else SILENT_S
    defined: list[tuple[str, int | str, str]] = [
        ("ACTUATORS", wire.actuators, "motors"),
        ("PERIOD_NS", period_ns, "of a tick [ns]"),
        ("LOCKSTEP", int(loop.lockstep), "the plant waits for each command before it steps"),
        ("COUNTER_BITS", wire.counter_bits, "of both frames"),
        ("COUNTERS", counters, "values of the counter"),
        ("MEASUREMENT_BYTES", wire.measurement.size, "of a frame"),
        ("MEASUREMENT_CAN_BYTES", carried_bytes(wire.measurement.size), "of the CAN frame that carries it"),
        ("MEASUREMENT_GAP", _gap(wire.measurement), "zero bits after the counter"),
        ("COMMAND_BYTES", wire.command.size, "of a frame"),
        ("COMMAND_GAP", _gap(wire.command), "zero bits after the counter"),
        ("MEASUREMENT_ON_CHANGE", int(wire.transmit.measurement == "on_change"), "else at every tick"),
        ("COMMAND_ON_CHANGE", int(wire.transmit.command == "on_change"), "else at every tick"),
        (
            "HEARTBEAT_TICKS",
            wire.transmit.heartbeat_ticks(period_ns, counters),
            "on change: from frame to frame at most",
        ),
        ("WATCHDOG_TICKS", freshness.watchdog_ticks, "0 V after so many without a fresh command"),
        ("FIRST_COMMAND_TICKS", freshness.first_ticks, "0 V after so many without a session's first command"),
        ("VOLTAGE_LIMIT", exact(plant.voltage_limit), f"{plant.voltage_limit:g} V, of the supply"),
        ("FULL_VOLTAGE", exact(full), f"{full:g} V: from here on a motor counts as saturated"),
        (
            "LEAST_UPRIGHT",
            exact(limits.least_upright),
            f"cosine of {plant.limits.max_tilt_deg:g} deg, the largest tilt",
        ),
        ("MAX_RATE", exact(plant.limits.max_rate), f"{plant.limits.max_rate:g} rad/s"),
        (
            "MAX_SATURATED_S",
            exact(plant.limits.max_saturated_s),
            f"{plant.limits.max_saturated_s:g} s at full voltage",
        ),
        ("MAX_INVALID_S", exact(plant.limits.max_invalid_s), f"{plant.limits.max_invalid_s:g} s without valid values"),
        ("CAN_NODE", can.node, "number of the plant on the bus"),
        ("CAN_FD", int(can.fd), "CAN FD, which frames of more than 8 bytes need"),
        ("CAN_HEARTBEAT_NS", round(HEARTBEAT_S * 1e9), "from heartbeat to heartbeat [ns]"),
        ("CAN_SILENT_NS", round(silent_s * 1e9), "a peer that is silent for longer is gone [ns]"),
        ("FINGERPRINT", f"{{{identity}}}", "of wire, period and lockstep"),
        ("CONFIG", config_number(settings), "of all settings: what is linked together has the same"),
    ]
    lines = [
        *(f"#define AERO_{name} {value} /* {comment} */" for name, value, comment in defined),
        "",
        "/* quantizers, as initializers of aero_quantizer */",
        *_quantizer("ATTITUDE", wire.attitude, "1"),
        *_quantizer("RATE", wire.rate, "rad/s"),
        *_quantizer("VOLTAGE", wire.voltage, "V"),
    ]
    return header("aero_config", lines)


def settings_digest(settings: Settings) -> str:
    """SHA-256 of the effective configuration, in hexadecimal digits."""
    text = json.dumps(settings.description(), sort_keys=True)
    return sha256(text.encode()).hexdigest()


def config_number(settings: Settings) -> str:
    """First 64 bits of `settings_digest`, as C's literal."""
    return f"0x{settings_digest(settings)[:16]}U"


def header(name: str, lines: Sequence[str]) -> str:
    """A header's text around these lines."""
    guard = f"{name.upper()}_H"
    top = "/* Generated by aeroloop: do not edit. */", f"#ifndef {guard}", f"#define {guard}", ""
    return "\n".join([*top, *lines, "", "#endif", ""])


def exact(value: float) -> str:
    """A number as C's literal, in every bit."""
    return "HUGE_VAL" if isinf(value) else value.hex()


def _gap(form: FrameFormat) -> int:
    return form.first_bit - form.counter_bits


def _quantizer(name: str, signal: SignalSpec, unit: str) -> Iterator[str]:
    """A macro, a line for each member."""
    quantizer = signal.quantizer()
    coded = isinstance(quantizer, CodedQuantizer)
    members = [
        (".kind", f"AERO_{_KINDS[signal.kind] if coded else 'CONTINUOUS'}", ""),
        (".bits", signal.bits or 64, ""),
    ]
    for length in _LENGTHS:
        if (value := getattr(quantizer, length, None)) is not None:
            members.append((f".{length}", exact(value), f"{value:.9g} {unit}"))
    if isinstance(quantizer, CodedQuantizer):
        members.append((".top", quantizer.top, "outermost code"))
    if isinstance(quantizer, LogarithmicQuantizer):
        members.append((".growing", quantizer.growing, "geometric intervals"))
        edges = ", \\\n        ".join(exact(edge) for edge in quantizer.edges)
        members.append((".edges", f"(const double[]){{ \\\n        {edges}}}", unit))
    yield f"#define AERO_{name} {{ \\"
    for member, value, comment in members:
        yield f"    {member} = {value},{f' /* {comment} */' * bool(comment)} \\"
    yield "}"
