"""Decoded channels for viewers: values in units for people, a bounded rate, what is broken, schemas, and the layout."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from math import degrees, radians
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import Description, Event, Loss, Truth
from aeroloop.protocol.messages.operator import Message, Setpoint
from aeroloop.protocol.messages.trace import ENDS, Sent
from aeroloop.protocol.wire.attitude import Quaternion, distance, sent_vector, to_euler
from aeroloop.service.cli.main import execute
from aeroloop.service.config import load
from aeroloop.service.viewers.channels import SHAPES, Decoder
from tests.support.decoded import (
    ATTITUDE,
    NOW,
    PITCH,
    RAW,
    ROLL,
    SETTINGS,
    STATUS,
    WIRE,
    YAW,
    about,
    address,
    batch,
    by_topic,
    configured,
    frame,
    measurement,
    quaternion_of,
    said,
    telemetry,
)
from tests.support.made_log import description
from tests.support.viewer_double import fields, orientation

VOLTS = WIRE.voltage.quantizer()


# ── what is shown ──


def test_a_measurement_is_shown_as_the_body_stood_to_within_a_quantizers_step_in_angles_and_transform() -> None:
    payload = measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0)
    found = by_topic(configured().take(address("measurement"), payload, NOW))
    assert set(found) == {"/aero/measurement", "/aero/tf"}
    assert {message.at_ns for message in found.values()} == {NOW}
    shown = list(said(found["/aero/measurement"]).values())
    step_deg = degrees(4 * WIRE.attitude.quantizer().bound / ATTITUDE[0])  # an angle is twice ε/η
    assert shown[:3] == pytest.approx([degrees(angle) for angle in (ROLL, PITCH, YAW)], abs=step_deg)
    within = degrees(WIRE.rate.quantizer().bound)
    assert shown[3:] == pytest.approx([degrees(rate) for rate in (0.5, -0.25, 0.0)], abs=within)
    transform = found["/aero/tf"].data
    assert (fields(transform)[2], fields(transform)[3]) == ([b"world"], [b"aero"])
    assert shown[:3] == pytest.approx([degrees(part) for part in to_euler(orientation(transform))], abs=1e-4)
    at = fields(fields(transform)[1][0])
    assert (at[1], at.get(2, [0])) == ([NOW // 10**9], [0])


def test_what_a_measurement_does_not_know_is_null_and_gives_no_transform() -> None:
    decoder = configured()
    (shown,) = decoder.take(address("measurement"), measurement(0.1, None, 0.1, 0.5, None, 0.0), NOW)
    values = said(shown)
    assert [values[name] for name in ("roll_deg", "pitch_deg", "yaw_deg", "q_deg_s")] == [None] * 4
    assert values["p_deg_s"] == pytest.approx(degrees(0.5), abs=degrees(WIRE.rate.quantizer().bound))
    assert decoder.malformed == 0


def test_a_command_is_shown_in_volts_by_the_motors_own_numbers_with_saturation_or_null() -> None:
    for sent, shown, saturated in ((24.0, VOLTS.outermost, True), (None, None, None)):
        (command,) = configured().take(address("command"), frame(WIRE.command, [VOLTS, VOLTS], [sent, -3.0]), NOW)
        values = said(command)
        expected = [shown, VOLTS.level(VOLTS.encode(-3.0))]
        assert [values["voltage_2_v"], values["voltage_3_v"]] == [v and pytest.approx(v, abs=1e-4) for v in expected]
        assert (values["saturated_2"], values["saturated_3"], values["voltage_1_v"]) == (saturated, False, None)


@pytest.mark.parametrize("sign", [1, -1])
def test_tracking_has_the_error_and_the_desired_attitude_on_either_side(sign: int) -> None:
    wired: Quaternion = tuple(  # type: ignore[assignment]  # z₁₋: −e
        sign * part for part in quaternion_of(about(2, radians(10.0)))
    )
    found = by_topic(configured().take(address("telemetry"), telemetry(wired, sign).encode(), NOW))
    assert set(found) == {"/aero/tracking", "/aero/desired_tf"}
    shown = said(found["/aero/tracking"])
    assert shown["error_deg"] == pytest.approx(10.0, abs=1e-4)
    assert shown["time_s"] == 0.5
    for name, expected in zip(("roll", "pitch", "yaw"), to_euler(ATTITUDE), strict=True):
        assert shown[f"desired_{name}_deg"] == pytest.approx(degrees(expected), abs=1e-3)
    assert [shown["error_q_deg_s"], shown["error_r_deg_s"]] == [2.0, -3.0]
    assert [shown["damping_2"], shown["damping_3"], shown["sign"]] == [0.007, 0.0095, sign]
    assert distance(orientation(found["/aero/desired_tf"].data), ATTITUDE) == pytest.approx(0.0, abs=1e-6)
    assert fields(found["/aero/desired_tf"].data)[3] == [b"aero_desired"]


def test_truth_and_set_points_are_shown_as_they_were_published() -> None:
    truth = Truth(tick=1, attitude=ATTITUDE, rate=(radians(1.0), radians(-2.0), 0.0), voltages=(1.0, 2.0))
    (shown,) = configured().take(address("truth"), truth.encode(), NOW)
    expected = [*(degrees(angle) for angle in (ROLL, PITCH, YAW)), 1.0, -2.0, 0.0]
    assert list(said(shown).values()) == pytest.approx(expected, abs=1e-3)
    (shown,) = configured().take(address("reference"), Setpoint(attitude=(1.0, 2.0, 350.0)).encode(), NOW)
    assert shown.topic == "/aero/setpoint"
    assert said(shown)["attitude"] == [1.0, 2.0, 350.0]


@pytest.mark.parametrize(("kind", "rotors", "stands"), [("aero", 2, 1), ("rigid_body", 0, 0)])
def test_a_status_is_shown_as_it_is_and_a_plants_brings_the_body_in_the_frame_that_moves_it(
    kind: str, rotors: int, stands: int
) -> None:
    described = description(SETTINGS, "plant")
    described.config["plant"]["kind"] = kind
    decoder = Decoder(None)
    decoder.configure(described)
    found = by_topic(decoder.take(address("status"), STATUS.encode(), NOW))
    assert set(found) == {"/aero/status/plant", "/aero/scene"}
    assert said(found["/aero/status/plant"]) == json.loads(STATUS.encode())
    entities = [fields(entity) for entity in fields(found["/aero/scene"].data)[2]]
    assert [entity[2] for entity in entities] == [[b"aero"], [b"aero_desired"], *[[b"world"]] * stands]
    assert all(entity[5] == [1] for entity in entities)  # frame_locked: it moves with its frame
    assert [len(entity.get(10, [])) for entity in entities[:2]] == [rotors, rotors]


@pytest.mark.parametrize(
    ("name", "message", "level", "words"),
    [
        ("event", Event(role="plant", kind="tripped", text="over 60°"), 4, b"tripped: over 60\xc2\xb0"),
        ("event", Event(role="controller", kind="claimed", text="aero"), 2, b"claimed: aero"),
        ("loss", Loss(key="k", count=7, reason="cache"), 3, b"7 messages of k"),
    ],
)
def test_what_happens_is_a_line_of_the_log_of_the_role_in_its_key(
    name: str, message: Message, level: int, words: bytes
) -> None:
    (shown,) = configured(1.0).take(address(name, "recorder"), message.encode(), NOW)
    assert (shown.topic, shown.shape.name) == ("/aero/log", "foxglove.Log")
    line = fields(shown.data)
    assert line[2] == [level]
    assert line[3][0].startswith(words)
    assert line[4] == [b"recorder"]  # by its key, whatever it claims to be


def test_the_rows_of_each_end_give_what_it_sent_as_frames_do_at_the_times_of_sending() -> None:
    frames = {
        "plant": ("measurement", measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0)),
        "controller": ("command", frame(WIRE.command, [VOLTS] * 2, [24.0, None])),
    }
    for end in ENDS:
        name, sent = frames[end]
        rows = [(NOW, Sent.FRAME, sent), (NOW + 1000, Sent.NONE, sent), (NOW + 2000, Sent.FRAME, sent)]
        assert configured().take(address("trace", end), batch(end, rows), 5) == [
            shown for at_ns in (NOW, NOW + 2000) for shown in configured().take(address(name), sent, at_ns)
        ]


# ── by which description ──


def test_frames_give_nothing_before_a_description_and_are_read_by_the_plants() -> None:
    decoder, payload = Decoder(None), measurement(*sent_vector(ATTITUDE), 0, 0, 0)
    plant, controller = description(SETTINGS, "plant"), description(load(None, ["wire.attitude.bits=12"]), "controller")
    found = []
    steps: tuple[list[Description], ...] = ([], [description(SETTINGS, "recorder")], [controller], [plant, controller])
    for descriptions in steps:
        for one in descriptions:
            decoder.configure(one)
        found.append((len(decoder.take(address("measurement"), payload, NOW)), decoder.malformed))
    assert found == [(0, 0), (0, 0), (0, 1), (2, 1)]
    other_version = plant.model_copy(update={"protocol": 1, "config": {"wire": {"bits": 3}}})
    decoder.configure(other_version)
    assert decoder.malformed == 2
    assert decoder.take(address("measurement"), payload, NOW)


# ── at which rate ──


def test_a_topic_that_streams_gives_at_most_so_many_a_second_by_time_of_publication_and_one_that_does_not_all() -> None:
    decoder, times = configured(30.0), range(NOW, NOW + 3 * 10**9, 1_000_000)
    shown = [at_ns for at_ns in times if decoder.take(address("truth"), RAW["truth"], at_ns)]
    assert len(shown) == pytest.approx(90, abs=1)
    assert max(b - a for a, b in pairwise(shown)) < 2 / 30 * 1e9
    assert decoder.take(address("truth"), RAW["truth"], NOW - 3600 * 10**9), "after its clock was set back"
    assert all(decoder.take(address(name), RAW[name], NOW) for name in ("event", "loss", "status") for _ in range(5))


@given(times=st.lists(st.integers(0, 3000), max_size=60).map(sorted), cuts=st.sets(st.integers(1, 59)))
def test_of_the_rows_in_a_slot_of_time_the_first_is_given_however_they_are_batched(
    times: list[int], cuts: set[int]
) -> None:
    """Times [ms], at 10 Hz."""
    rows = [(NOW + ms * 1_000_000, Sent.FRAME, RAW["measurement"]) for ms in times]
    edges = [0, *sorted(cut for cut in cuts if cut < len(rows)), len(rows)]
    decoder = configured(10.0)
    shown = [
        one.at_ns
        for begin, end in pairwise(edges)
        for one in decoder.take(address("trace"), batch("plant", rows[begin:end]), 0)
        if one.topic == "/aero/tf"
    ]
    first = {at_ns // 10**8: at_ns for at_ns, *_ in reversed(rows)}
    assert shown == sorted(first.values())


# ── what is broken ──


def test_rows_of_another_wire_spec_are_counted_those_of_no_time_are_left_out_and_numbers_beyond_bounds_null() -> None:
    other = load(None, ["wire.attitude.bits=12"]).wire
    decoder = configured()
    rows = [(NOW, Sent.FRAME, bytes(other.measurement.size))]
    assert decoder.take(address("trace"), batch("plant", rows, other), NOW) == []
    assert decoder.malformed == 1
    payload = bytearray(RAW["trace"])
    payload[40:48] = (-(2**62)).to_bytes(8, "little", signed=True)  # the header's wall clock
    assert configured().take(address("trace"), bytes(payload), NOW) == []
    text = RAW["telemetry"].replace(b"[0.0,0.0349", b"[1e999,0.0349")
    found = by_topic(configured().take(address("telemetry"), text, NOW))
    assert said(found["/aero/tracking"])["error_p_deg_s"] is None


@given(
    name=st.sampled_from(sorted(RAW)),
    payload=st.binary(max_size=80) | st.sampled_from(sorted(RAW.values())),
    at_ns=st.integers(0, 2**64 - 1),
)
def test_any_bytes_at_any_time_give_something_or_are_counted_and_never_raise(
    name: str, payload: bytes, at_ns: int
) -> None:
    decoder = configured()
    assert bool(decoder.take(address(name), payload, at_ns)) != bool(decoder.malformed)


# ── schemas ──


TYPES: dict[str, type | tuple[type, ...]] = {
    "boolean": bool, "string": str, "number": (int, float), "integer": int, "array": list, "object": dict
}  # fmt: skip


def readable(schema: dict[str, Any]) -> bool:
    """Whether Lichtblick reads it: its parseJsonSchema.ts."""
    match schema.get("type"):
        case "object":
            return all(readable(field) for field in schema["properties"].values())
        case "array":
            return schema["items"]["type"] != "array" and readable(schema["items"])
        case kind:
            return kind in TYPES and not {"oneOf", "anyOf", "$ref"} & set(schema)


def test_every_topic_that_is_given_is_listed_and_is_as_its_schema_says_in_one_that_viewers_read() -> None:
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
            assert readable(schema)
            assert set(message) == set(schema["properties"])
            for name, value in message.items():
                assert value is None or isinstance(value, TYPES[schema["properties"][name]["type"]]), name
        else:
            package, _, kind = shown.shape.name.partition(".")
            files = [fields(file) for file in fields(shown.shape.schema)[1]]  # a FileDescriptorSet
            declared = {(file[2][0].decode(), fields(one)[1][0].decode()) for file in files for one in file.get(4, [])}
            assert (package, kind) in declared


# ── layout ──


def leaves(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


@pytest.mark.parametrize(("vehicle", "actuators", "motors"), [("aero", 2, {2, 3}), ("bench.2", 3, {1, 2, 3})])
def test_every_path_is_a_field_of_a_topic_that_is_decoded_and_voltages_are_those_of_the_motors_there_are(
    vehicle: str, actuators: int, motors: set[int], capfd: pytest.CaptureFixture[str]
) -> None:
    """A topic with a dot in it stands in quotes."""
    assert execute(["show", "layout", "--set", f"vehicle={vehicle}", "--set", f"wire.actuators={actuators}"]) == 0
    made = json.loads(capfd.readouterr().out)
    panels = made["configById"]
    assert sorted(leaves(made["layout"])) == sorted(panels)
    (body,) = (panel for name, panel in panels.items() if name.startswith("3D!"))
    assert [name for name, settings in body["topics"].items() if settings["visible"]] == [f"/{vehicle}/scene"]
    (log,) = (panel for name, panel in panels.items() if name.startswith("RosOut!"))
    assert {*body["topics"], log["topicToRender"]} <= {f"/{vehicle}/{name}" for name in SHAPES}
    found = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
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
