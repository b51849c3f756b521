"""Schemas of decoded channels: every topic is listed, its JSON is as its schema says, and viewers read it."""

from __future__ import annotations

import json
from typing import Any

from aeroloop.protocol.messages import topics
from aeroloop.service.viewers.channels import SHAPES
from tests.support.decoded import NOW, RAW, STATUS, address, configured, said
from tests.support.viewer_double import fields


def readable(schema: dict[str, Any]) -> bool:
    """Whether Lichtblick reads it: its parseJsonSchema.ts."""
    match schema.get("type"):
        case "object":
            return all(readable(field) for field in schema["properties"].values())
        case "array":
            return schema["items"]["type"] != "array" and readable(schema["items"])
        case kind:
            return kind in ("boolean", "string", "number", "integer") and not {"oneOf", "anyOf", "$ref"} & set(schema)


TYPES: dict[str, type | tuple[type, ...]] = {
    "boolean": bool, "string": str, "number": (int, float), "integer": int, "array": list, "object": dict
}  # fmt: skip


def test_every_topic_that_is_given_is_listed_and_its_json_is_as_its_schema_says() -> None:
    decoder = configured()
    assert set(RAW) == {
        topic.name for topic in topics.TOPICS.values() if topic.decoded or topic.kind in ("frame", "trace")
    }
    given = [shown for name, payload in RAW.items() for shown in decoder.take(address(name), payload, NOW)]
    given += decoder.take(address("status", "controller"), STATUS.encode(), NOW)
    given += decoder.take(address("status", "recorder"), STATUS.encode(), NOW)
    assert {shown.topic: shown.shape for shown in given} == {f"/aero/{name}": shape for name, shape in SHAPES.items()}
    for shown in given:
        if shown.shape.encoding == "jsonschema":
            schema, message = json.loads(shown.shape.schema), said(shown)
            assert set(message) == set(schema["properties"])
            for name, value in message.items():
                assert value is None or isinstance(value, TYPES[schema["properties"][name]["type"]]), name


def test_every_schema_is_one_that_viewers_read() -> None:
    for name, shape in SHAPES.items():
        if shape.encoding == "jsonschema":
            assert readable(json.loads(shape.schema)), name
            continue
        package, _, message = shape.name.partition(".")
        files = [fields(file) for file in fields(shape.schema)[1]]  # a FileDescriptorSet
        declared = {(file[2][0].decode(), fields(found)[1][0].decode()) for file in files for found in file.get(4, [])}
        assert (package, message) in declared, name
