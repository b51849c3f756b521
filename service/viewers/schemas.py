"""Schemas of MCAP and WebSocket channels: what viewers show, and the JSON messages of the network.

Lichtblick rejects a channel whose JSON schema has a `$ref`, an `anyOf`, a null or an array of arrays (its
parseJsonSchema.ts). So a view is a flat table of fields, and a model's schema is inlined and reduced: a nullable field
has the schema of its other type, and a field that cannot be described is left out of the schema, not of the messages.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pydantic import BaseModel

from aeroloop.protocol.wire.spec import MAX_ACTUATORS

if TYPE_CHECKING:  # recorder and reader of logs do without
    import foxglove

_KEPT: Final[tuple[str, ...]] = ("description", "minimum", "exclusiveMinimum")


class Shape(NamedTuple):
    """Schema of a topic's messages, by name and encoding (`protobuf` or `jsonschema`), and the messages' encoding.

    `fields` are the names of a view's values, in order.
    """

    name: str
    encoding: str
    schema: bytes
    message_encoding: str
    fields: tuple[str, ...] = ()


class Decoded(NamedTuple):
    """A message to show on a topic, with the topic's schema and when its source was published [ns since 1970]."""

    topic: str
    shape: Shape
    data: bytes
    at_ns: int


def protobuf_shape(schema: foxglove.Schema) -> Shape:
    """The shape of one of Foxglove's own messages, from its `get_schema()`."""
    return Shape(schema.name, schema.encoding, schema.data, "protobuf")


# ── views: what is shown, in degrees, volts and microseconds ──


_Field = str | tuple[str, str]
"""Description of a number, or type and description."""


def _view(name: str, about: str, fields: Mapping[str, _Field]) -> Shape:
    """A view of these fields; any value may be null."""
    properties = {}
    for field, described in fields.items():
        kind, text = ("number", described) if isinstance(described, str) else described
        properties[field] = {"type": kind, "description": text} if text else {"type": kind}
    schema = {"type": "object", "properties": properties, "description": about}
    data = json.dumps(schema, ensure_ascii=False).encode()
    return Shape(f"aeroloop.{name}", "jsonschema", data, "json", tuple(fields))


_ANGLES: Final = "Z–Y–X, body relative to inertial"
_NO_MOTOR: Final = "null: no valid value, or no such motor"
_SATURATED: Final = "is at the quantizer's outermost level"
_MOTORS: Final = list(zip(range(1, MAX_ACTUATORS + 1), "₁₂₃₄₅₆₇₈", strict=True))


def _angles(prefix: str = "", text: str = _ANGLES, yaw: str = ", −180…180") -> dict[str, str]:
    return {
        f"{prefix}roll_deg": f"{text} [deg]",
        f"{prefix}pitch_deg": f"{text} [deg]",
        f"{prefix}yaw_deg": f"{text}{yaw} [deg]",
    }


ATTITUDE: Final = _view(
    "Attitude",
    "Attitude and rates.",
    _angles()
    | {f"{rate}_deg_s": f"rate about the body's {axis} axis [deg/s]" for rate, axis in zip("pqr", "xyz", strict=True)},
)
SETPOINT: Final = _view("Setpoint", "An operator's set-point.", _angles(yaw=""))
VOLTAGES: Final = _view(
    "Voltages",
    "Voltages as commanded, quantized.",
    {f"voltage_{i}_v": f"u{sub}; {_NO_MOTOR} [V]" for i, sub in _MOTORS}
    | {f"saturated_{i}": ("boolean", f"u{sub} {_SATURATED}; {_NO_MOTOR}") for i, sub in _MOTORS},
)
TRACKING: Final = _view(
    "Tracking",
    "How well the body follows its reference, as the controller saw it at one tick.",
    {
        "time_s": "on the law's clock; null if its period is not known [s]",
        "error_deg": "angle from the desired to the measured attitude, 0…180 [deg]",
        **_angles("", f"measured; {_ANGLES}"),
        **_angles("desired_"),
        "error_p_deg_s": "ω_e about the body's x axis [deg/s]",
        "error_q_deg_s": "ω_e about the body's y axis [deg/s]",
        "error_r_deg_s": "ω_e about the body's z axis [deg/s]",
        "damping_1": "θ̂₁; null with another law than the paper's [N·m·s/rad]",
        "damping_2": "θ̂₂ [N·m·s/rad]",
        "damping_3": "θ̂₃ [N·m·s/rad]",
        "sign": ("integer", "the equilibrium approached, z₁₊ or z₁₋; null with a law that has none"),
    },
)
STATUS: Final = _view(
    "RoleStatus",
    "Status of a role. Percentiles are of the last ten seconds.",
    {
        "state": ("string", ""),
        "cause": ("string", "plant: why it may not be driven, where that is so"),
        "session": ("string", ""),
        "rate_hz": "ticks (recorder: messages) a second since the last status [Hz]",
        "skipped": ("integer", "grid ticks of the session that were missed"),
        "refused": ("integer", "malformed frames since start"),
        "stale": ("integer", "frames since start that were received too late to be acted upon"),
        "saturated": ("integer", "values beyond a quantizer's range since start"),
        "latency_p50_us": "plant: from a measurement to the command that answers it [µs]",
        "latency_p99_us": "the same, 99th percentile [µs]",
        "age_p50_us": "controller: how much later than the fastest a measurement was received [µs]",
        "age_p99_us": "the same, 99th percentile [µs]",
        "wake_p50_us": "from when a tick was due to when it began [µs]",
        "wake_p99_us": "the same, 99th percentile [µs]",
        "uptime_s": "since it joined the network [s]",
    },
)


# ── JSON messages of the network, as they are recorded ──


def json_shape(name: str, model: type[BaseModel]) -> Shape:
    """The shape of a model's JSON."""
    return Shape(name, "jsonschema", json.dumps(plain_schema(model), ensure_ascii=False).encode(), "json")


def plain_schema(model: type[BaseModel]) -> dict[str, Any]:
    """A model's JSON schema in the subset that Lichtblick accepts."""
    tree = model.model_json_schema(mode="serialization")
    return _plain(tree, tree.get("$defs", {})) or {"type": "object", "properties": {}}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any] | None:
    """A schema without references and alternatives; None if that is impossible."""
    kept = {key: schema[key] for key in _KEPT if key in schema}
    if "$ref" in schema:
        return _plain({**definitions[schema["$ref"].rpartition("/")[2]], **kept}, definitions)
    alternatives = [one for one in schema.get("anyOf") or schema.get("oneOf") or [] if one.get("type") != "null"]
    if alternatives:
        found = [_plain(one, definitions) for one in alternatives]
        if all(one is not None and one["type"] == "object" for one in found):
            together = {name: field for one in found if one for name, field in one["properties"].items()}
            return {"type": "object", "properties": together, **kept}
        return {**found[0], **kept} if len(found) == 1 and found[0] else None
    match schema.get("type"):
        case "object":
            fields = {name: _plain(field, definitions) for name, field in schema.get("properties", {}).items()}
            return {"type": "object", "properties": {name: field for name, field in fields.items() if field}, **kept}
        case "array":
            items = _plain(schema.get("items") or schema.get("prefixItems", [{}])[0], definitions)
            return {"type": "array", "items": items, **kept} if items and items["type"] != "array" else None
        case "number" | "integer" | "boolean" | "string" as kind:
            return {"type": kind, **kept}
        case _:
            return None
