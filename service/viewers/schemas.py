"""What viewers show: schemas of MCAP and WebSocket channels, the views in people's units, and a layout of panels.

Lichtblick rejects a channel whose JSON schema has a `$ref`, an `anyOf`, a null or an array of arrays (its
parseJsonSchema.ts). So a model's schema is inlined and reduced: a nullable field has the schema of its other type, and
a field that cannot be described is left out of the schema, not of the messages.
"""

from __future__ import annotations

import json
import re
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pydantic import BaseModel, create_model

from aeroloop.protocol.wire.spec import MAX_ACTUATORS

if TYPE_CHECKING:  # recorder and reader of logs do without
    import foxglove

MOTORS: Final = range(1, MAX_ACTUATORS + 1)
_KEPT: Final[tuple[str, ...]] = ("description", "minimum", "exclusiveMinimum")


class Shape(NamedTuple):
    """Schema of a topic's messages, by name and encoding (`protobuf` or `jsonschema`), and the messages' encoding."""

    name: str
    encoding: str
    schema: bytes
    message_encoding: str


class Decoded(NamedTuple):
    """A message to show on a topic, with the topic's schema and when its source was published [ns since 1970]."""

    topic: str
    shape: Shape
    data: bytes
    at_ns: int


def protobuf_shape(schema: foxglove.Schema) -> Shape:
    """The shape of one of Foxglove's own messages, from its `get_schema()`."""
    return Shape(schema.name, schema.encoding, schema.data, "protobuf")


def json_shape(model: type[BaseModel]) -> Shape:
    """The shape of a model's JSON."""
    schema = json.dumps(plain_schema(model), ensure_ascii=False).encode()
    return Shape(f"aeroloop.{model.__name__}", "jsonschema", schema, "json")


def plain_schema(model: type[BaseModel]) -> dict[str, Any]:
    """A model's JSON schema in the subset that Lichtblick accepts."""
    tree = model.model_json_schema(mode="serialization")
    return _plain(tree, tree.get("$defs", {})) or {"type": "object", "properties": {}}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any] | None:
    """A schema without references and alternatives; None if that is impossible."""
    kept = {key: schema[key] for key in _KEPT if key in schema}
    if "$ref" in schema:
        return _plain({**definitions[schema["$ref"].rpartition("/")[2]], **kept}, definitions)
    alternatives = [one for one in schema.get("anyOf", []) if one.get("type") != "null"]
    if alternatives:
        only = _plain(alternatives[0], definitions) if len(alternatives) == 1 else None
        return only and {**only, **kept}
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


# ── views: units stand in their fields' names, and any value may be null ──


def _view(name: str, fields: str, **others: type) -> type[BaseModel]:
    """A model of numbers by their names; `others` have another type."""
    types = dict.fromkeys(fields.split(), float) | others
    optional: dict[str, Any] = {field: (kind | None, None) for field, kind in types.items()}
    made: type[BaseModel] = create_model(name, **optional)
    return made


Attitude: Final = _view("Attitude", "roll_deg pitch_deg yaw_deg p_deg_s q_deg_s r_deg_s")
"""Attitude by Z–Y–X, body relative to inertial, and rates about the body's axes."""
Voltages: Final = _view(
    "Voltages", " ".join(f"voltage_{i}_v" for i in MOTORS), **{f"saturated_{i}": bool for i in MOTORS}
)
"""Voltages as commanded, quantized, and whether each is at the outermost level; null: no valid value, or no motor."""
Tracking: Final = _view(
    "Tracking",
    "time_s error_deg desired_roll_deg desired_pitch_deg desired_yaw_deg "
    "error_p_deg_s error_q_deg_s error_r_deg_s damping_1 damping_2 damping_3",
    sign=int,
)
"""The controller at one tick: the law's time, the angle of the error, the desired attitude, ω_e, θ̂ of the paper's law
[N·m·s/rad], and the sign of the equilibrium that it approaches."""


# ── panels ──


def layout(vehicle: str, motors: range) -> str:
    """A layout for Foxglove and Lichtblick, as JSON to import; `motors` are the numbers of those there are.

    Both read `configById` with a panel's settings under `Type!name`, and `layout`, a tree of splits. The keys of the
    settings are those of Lichtblick's sources (suite-base/src/panels: 3D, Plot, StateTransitions, and Log, whose type
    is still RosOut); both ignore unknown keys. Plots show 20 s of a live loop, and all of a log.
    """
    text = files(__package__).joinpath("layout.json").read_text(encoding="utf-8")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", vehicle):  # in a message path, such a topic is quoted
        text = re.sub(r'"value": "(/VEHICLE/[^.]+)\.', r'"value": "\\"\1\\".', text)
    tree = json.loads(text.replace("VEHICLE", vehicle))
    voltages = tree["configById"]["Plot!voltages"]
    first = json.dumps(voltages["paths"][0])
    voltages["paths"] = [json.loads(first.replace("_1_", f"_{i}_").replace('"u1"', f'"u{i}"')) for i in motors]
    return json.dumps(tree, indent=2, ensure_ascii=False)
