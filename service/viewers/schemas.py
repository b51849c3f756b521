"""Schemas that viewers read: what an MCAP channel, or one on a WebSocket, says of its messages.

Lichtblick turns away a channel whose JSON schema has a `$ref`, an `anyOf`, a null or an array of arrays (its
parseJsonSchema.ts). So a model's schema is put in line here, in the few words that it knows: a field that may be null
is described by what it is when it is not, and what cannot be described is left out. It is in the messages all the same.
"""

from __future__ import annotations

import json
from typing import Any, Final, NamedTuple, Protocol

from pydantic import BaseModel

_SAID: Final[tuple[str, ...]] = ("description", "minimum", "exclusiveMinimum")


class Shape(NamedTuple):
    """How the messages of a topic are to be read.

    Attributes:
        name: Such as `foxglove.PoseInFrame` or `aeroloop.Tracking`.
        encoding: Of the schema: `protobuf` or `jsonschema`.
        schema: The schema itself.
        message_encoding: `protobuf` or `json`.
    """

    name: str
    encoding: str
    schema: bytes
    message_encoding: str


class Described(Protocol):
    """A schema of foxglove-sdk's."""

    name: str
    encoding: str
    data: bytes


def protobuf_shape(schema: Described) -> Shape:
    """The shape of one of Foxglove's own messages, of what its `get_schema()` says."""
    return Shape(schema.name, schema.encoding, schema.data, "protobuf")


def json_shape(name: str, model: type[BaseModel]) -> Shape:
    """The shape of a model's JSON."""
    return Shape(name, "jsonschema", json.dumps(plain_schema(model), ensure_ascii=False).encode(), "json")


def plain_schema(model: type[BaseModel]) -> dict[str, Any]:
    """A model's JSON schema in the words that Lichtblick knows."""
    tree = model.model_json_schema(mode="serialization")
    return _plain(tree, tree.get("$defs", {})) or {"type": "object", "properties": {}}


def _plain(schema: dict[str, Any], known: dict[str, Any]) -> dict[str, Any] | None:
    """A schema without references and alternatives; None if there is no such thing."""
    if "$ref" in schema:
        meant = known[schema["$ref"].rpartition("/")[2]]
        return _plain({**meant, **{key: schema[key] for key in _SAID if key in schema}}, known)
    said = {key: schema[key] for key in _SAID if key in schema}
    alternatives = [one for one in schema.get("anyOf") or schema.get("oneOf") or [] if one.get("type") != "null"]
    if alternatives:
        found = [_plain(one, known) for one in alternatives]
        if all(one is not None and one["type"] == "object" for one in found):
            together = {name: field for one in found if one for name, field in one["properties"].items()}
            return {"type": "object", "properties": together, **said}
        return {**found[0], **said} if len(found) == 1 and found[0] else None
    match schema.get("type"):
        case "object":
            fields = {name: _plain(field, known) for name, field in schema.get("properties", {}).items()}
            return {"type": "object", "properties": {name: field for name, field in fields.items() if field}, **said}
        case "array":
            items = _plain(schema.get("items") or schema.get("prefixItems", [{}])[0], known)
            return {"type": "array", "items": items, **said} if items and items["type"] != "array" else None
        case "number" | "integer" | "boolean" | "string" as kind:
            return {"type": kind, **said}
        case _:
            return None
