"""Schemas of MCAP and WebSocket channels, in the subset that viewers accept.

Lichtblick rejects a channel whose JSON schema has a `$ref`, an `anyOf`, a null or an array of arrays (its
parseJsonSchema.ts). So a model's schema is inlined and reduced here: a nullable field has the schema of its other type,
and a field that cannot be described is left out of the schema, not of the messages.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pydantic import BaseModel

if TYPE_CHECKING:  # recorder and reader of logs do without
    import foxglove

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


def json_shape(name: str, model: type[BaseModel]) -> Shape:
    """The shape of a model's JSON."""
    return Shape(name, "jsonschema", json.dumps(plain_schema(model), ensure_ascii=False).encode(), "json")


def plain_schema(model: type[BaseModel]) -> dict[str, Any]:
    """A model's JSON schema in the subset that Lichtblick accepts."""
    tree = model.model_json_schema(mode="serialization")
    return _plain(tree, tree.get("$defs", {})) or {"type": "object", "properties": {}}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any] | None:
    """A schema without references and alternatives; None if that is impossible."""
    if "$ref" in schema:
        target = definitions[schema["$ref"].rpartition("/")[2]]
        return _plain({**target, **{key: schema[key] for key in _KEPT if key in schema}}, definitions)
    kept = {key: schema[key] for key in _KEPT if key in schema}
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
