"""Schemas of decoded channels and the layout of panels: as topics are decoded, and such that viewers read them."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.cli.main import execute
from aeroloop.service.viewers.channels import SHAPES
from aeroloop.service.viewers.schemas import layout
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


# ── layout ──


def leaves(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


@pytest.mark.parametrize(("vehicle", "actuators", "motors"), [("aero", 2, {2, 3}), ("bench.2", 3, {1, 2, 3})])
def test_every_path_is_a_field_of_a_topic_that_is_decoded_and_voltages_are_those_of_the_motors_there_are(
    vehicle: str, actuators: int, motors: set[int], capfd: pytest.CaptureFixture[str]
) -> None:
    """A topic with a dot in it stands in quotes."""
    assert execute(["show", "layout", "--set", f"vehicle={vehicle}", "--set", f"wire.actuators={actuators}"]) == 0
    panels = json.loads(capfd.readouterr().out)["configById"].values()
    found = [path["value"] for panel in panels for path in panel.get("paths", [])]
    for path in found:
        parts = re.fullmatch(
            r'(?P<q>"?)/(?P<vehicle>[^/]+)/(?P<name>[a-z_/]+)(?P=q)\.(?P<field>\w+)(\.p[59][09])?', path
        )
        assert parts is not None, path
        assert (parts["vehicle"], parts["q"]) == (vehicle, '"' if "." in vehicle else ""), path
        assert parts["field"] in json.loads(SHAPES[parts["name"]].schema)["properties"], path
    shown = {path.rpartition(".")[2] for path in found}
    assert {"pitch_deg", "desired_pitch_deg", "error_deg", "p99", "state"} <= shown
    assert {field for field in shown if field.startswith("voltage")} == {f"voltage_{i}_v" for i in motors}


def test_topics_that_panels_name_are_decoded_in_the_schema_that_the_panel_draws_and_every_panel_has_its_place() -> None:
    made = json.loads(layout("aero", WireSpec().motors))
    panels = made["configById"]
    assert sorted(leaves(made["layout"])) == sorted(panels)
    (body,) = (panel for name, panel in panels.items() if name.startswith("3D!"))
    assert set(body["topics"]) <= {f"/aero/{name}" for name in SHAPES}
    assert [name for name, settings in body["topics"].items() if settings["visible"]] == ["/aero/scene"]
    assert SHAPES["scene"].name == "foxglove.SceneUpdate"
    (log,) = (panel for name, panel in panels.items() if name.startswith("RosOut!"))
    assert SHAPES[log["topicToRender"].removeprefix("/aero/")].name == "foxglove.Log"
