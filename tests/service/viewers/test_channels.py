"""Decoded channels for viewers: measured, commanded and published values, in units for people."""

from __future__ import annotations

import json
from itertools import pairwise
from math import cos, degrees, radians, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import (
    PROTOCOL_VERSION,
    Description,
    Event,
    Loss,
    Percentiles,
    Status,
    Telemetry,
    Timing,
    Truth,
)
from aeroloop.protocol.messages.operator import Message, Setpoint
from aeroloop.protocol.messages.trace import ENDS, End, Outcome, Sent, TraceWriter
from aeroloop.protocol.messages.trace import Received as ReceivedAs
from aeroloop.protocol.wire.attitude import Quaternion, distance, sent_vector, to_euler
from aeroloop.protocol.wire.frames import FrameFormat
from aeroloop.protocol.wire.quantizer import Quantizer
from aeroloop.protocol.wire.spec import WireSpec
from aeroloop.service.config import load
from aeroloop.service.viewers.channels import LIMITED, SHAPES, UNLIMITED, Decoder
from aeroloop.service.viewers.schemas import Decoded, json_shape, plain_schema
from tests.support.viewer_double import fields, orientation, quaternion

NOW = 1_800_000_000_000_000_000
SETTINGS = load()
WIRE = SETTINGS.wire
ROLL, PITCH, YAW = 0.1, -0.5, 0.9


def about(axis: int, by: float) -> Quaternion:
    turned = [cos(by / 2), 0.0, 0.0, 0.0]
    turned[axis] = sin(by / 2)
    return tuple(turned)  # type: ignore[return-value]  # four elements


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    a, (b, c, d) = p[0], p[1:]
    w, (x, y, z) = q[0], q[1:]
    return (
        a * w - b * x - c * y - d * z,
        a * x + w * b + c * z - d * y,
        a * y + w * c + d * x - b * z,
        a * z + w * d + b * y - c * x,
    )


ATTITUDE = product(about(3, YAW), product(about(2, PITCH), about(1, ROLL)))


def description(role: str = "plant", *overrides: str, vehicle: str = "aero") -> Description:
    return Description(
        protocol=PROTOCOL_VERSION,
        role=role,
        vehicle=vehicle,
        host="h",
        versions={},
        config=load(None, overrides).description(),
    )


def address(name: str, role: str = "plant", vehicle: str = "aero") -> topics.Address:
    found = topics.read_key(topics.key(name, vehicle, session="s1", role=role))
    assert found is not None
    return found


def configured(rate_hz: float | None = None, *overrides: str) -> Decoder:
    decoder = Decoder(rate_hz)
    decoder.configure(description("plant", *overrides))
    return decoder


def frame(form: FrameFormat, quantizers: list[Quantizer], values: list[float | None]) -> bytes:
    return form.pack(3, [q.invalid if v is None else q.encode(v) for q, v in zip(quantizers, values, strict=True)])


def measurement(*values: float | None) -> bytes:
    quantizers = [WIRE.attitude.quantizer()] * 3 + [WIRE.rate.quantizer()] * 3
    return frame(WIRE.measurement, quantizers, list(values))


def batch(end: End, rows: list[tuple[int, Sent, bytes]], wire: WireSpec = WIRE) -> bytes:
    """A batch with rows of times [ns since 1970], what was sent, and the frame that was; the other frame is zero."""
    writer = TraceWriter(end, wire, 1, 10**8)
    writer.session = "s1"
    ahead_ns = NOW - 10**12  # of the wall clock to the monotonic clock
    for tick, (at_ns, sent_as, frame) in enumerate(rows):
        sent_ns = at_ns - ahead_ns
        if end == "plant":
            echo = bytes(wire.command.size)
            volts = [0.0] * wire.actuators
            writer.plant_row(tick, tick, sent_as, Sent.NONE, Outcome.NONE, 0, -1, sent_ns, 0, frame, echo, volts)
        else:
            taken = bytes(wire.measurement.size)
            writer.controller_row(tick, ReceivedAs.FRAME, sent_as, sent_ns - 200_000, sent_ns, taken, frame)
    return writer.take(NOW - ahead_ns, NOW)


def by_topic(decoded: list[Decoded]) -> dict[str, Decoded]:
    found = {message.topic: message for message in decoded}
    assert len(found) == len(decoded)
    return found


def said(decoded: Decoded) -> dict[str, Any]:
    tree: dict[str, Any] = json.loads(decoded.data)
    return tree


def telemetry(error: Quaternion, sign: int = 1) -> Telemetry:
    return Telemetry(
        session="s1",
        tick=250,
        counter=3,
        attitude_error=error[1:],
        rate_error=(0.0, radians(2.0), radians(-3.0)),
        desired=ATTITUDE,
        damping_estimate=(0.0, 0.007, 0.0095),
        voltages=(1.0, 2.0),
        sign=sign,
    )


STATUS = Status(
    role="plant",
    state="driven",
    uptime_s=12.0,
    ticks=6000,
    rate_hz=500.0,
    skipped=2,
    recent_latency_us=Percentiles(count=5000, p50=310.0, p99=620.0, p999=900.0, max=1000.0),
    timing=Timing(
        wake=None,
        busy=None,
        period=None,
        recent_wake=Percentiles(count=5000, p50=50.0, p99=90.0, p999=100.0, max=110.0),
        recent_busy=None,
        recent_period=None,
    ),
)


RAW = {
    "measurement": measurement(0, 0, 0, 0, 0, 0),
    "command": frame(WIRE.command, [WIRE.voltage.quantizer()] * 2, [1.0, None]),
    "telemetry": telemetry(about(1, 0.1)).encode(),
    "truth": Truth(tick=1, attitude=ATTITUDE, rate=(0.0, 0.0, 0.0), voltages=(1.0, 2.0)).encode(),
    "reference": Setpoint(attitude=(0.0, 0.0, 0.0)).encode(),
    "status": STATUS.encode(),
    "event": Event(role="plant", kind="started", text="x").encode(),
    "loss": Loss(key="k", count=1, reason="queue").encode(),
    "trace": batch("plant", [(NOW, Sent.FRAME, measurement(0, 0, 0, 0, 0, 0))]),
}
"""A message of every topic that is decoded."""


def decode(decoder: Decoder, name: str, payload: bytes, at_ns: int) -> list[Decoded]:
    return (decoder.frame if name in topics.FRAMES else decoder.take)(address(name), payload, at_ns)


# ── what was measured ──


def test_a_measurement_is_shown_as_the_body_stood_to_within_a_quantizers_step() -> None:
    found = by_topic(
        configured().frame(address("measurement"), measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0), NOW)
    )
    assert set(found) == {"/aero/measurement", "/aero/pose", "/aero/tf"}
    shown = said(found["/aero/measurement"])
    step_deg = degrees(4 * WIRE.attitude.quantizer().bound / ATTITUDE[0])  # an angle is twice ε/η
    for name, expected in zip(("roll", "pitch", "yaw"), (ROLL, PITCH, YAW), strict=True):
        assert shown[f"{name}_deg"] == pytest.approx(degrees(expected), abs=step_deg)
    for name, rate in zip("pqr", (0.5, -0.25, 0.0), strict=True):
        assert shown[f"{name}_deg_s"] == pytest.approx(degrees(rate), abs=degrees(WIRE.rate.quantizer().bound))


def test_pose_transform_and_angles_of_a_measurement_are_the_same_attitude() -> None:
    found = by_topic(configured().frame(address("measurement"), measurement(*sent_vector(ATTITUDE), 0, 0, 0), NOW))
    pose, transform = found["/aero/pose"].data, fields(found["/aero/tf"].data)
    assert (transform[2], transform[3]) == ([b"world"], [b"aero"])
    assert quaternion(transform[5][0]) == orientation(pose)
    shown = said(found["/aero/measurement"])
    expected = [degrees(part) for part in to_euler(orientation(pose))]
    assert [shown["roll_deg"], shown["pitch_deg"], shown["yaw_deg"]] == pytest.approx(expected, abs=1e-4)
    at = fields(fields(pose)[1][0])
    assert (at[1], at.get(2, [0])) == ([NOW // 10**9], [0])
    assert {message.at_ns for message in found.values()} == {NOW}


def test_what_a_measurement_does_not_know_is_null_and_gives_no_pose() -> None:
    decoder = configured()
    (shown,) = decoder.frame(address("measurement"), measurement(0.1, None, 0.1, 0.5, None, 0.0), NOW)
    values = said(shown)
    assert [values[name] for name in ("roll_deg", "pitch_deg", "yaw_deg", "q_deg_s")] == [None] * 4
    assert values["p_deg_s"] == pytest.approx(degrees(0.5), abs=degrees(WIRE.rate.quantizer().bound))
    assert decoder.malformed == 0


# ── what was commanded ──


def test_a_command_is_shown_in_volts_by_the_motors_own_numbers_and_saturation_is_marked() -> None:
    volts = WIRE.voltage.quantizer()
    payload = frame(WIRE.command, [volts, volts], [24.0, -3.0])
    (shown,) = configured().frame(address("command"), payload, NOW)
    assert said(shown) == {
        "voltage_1_v": None,
        "voltage_2_v": pytest.approx(volts.outermost, abs=1e-4),
        "voltage_3_v": pytest.approx(volts.quantize(-3.0), abs=1e-4),
        "saturated_1": None,
        "saturated_2": True,
        "saturated_3": False,
    }


def test_a_command_without_a_valid_value_is_null() -> None:
    volts = WIRE.voltage.quantizer()
    (shown,) = configured().frame(address("command"), frame(WIRE.command, [volts, volts], [None, 5.0]), NOW)
    assert said(shown)["voltage_2_v"] is said(shown)["saturated_2"] is None
    assert said(shown)["voltage_3_v"] == pytest.approx(volts.quantize(5.0), abs=1e-4)


def test_a_body_with_three_motors_and_no_quantizer_shows_all_three() -> None:
    decoder = configured(None, "wire.actuators=3", "wire.voltage.bits=cont")
    wire = load(None, ["wire.actuators=3", "wire.voltage.bits=cont"]).wire
    (shown,) = decoder.frame(address("command"), wire.command.pack(0, [1.5, -24.0, 0.0]), NOW)
    assert list(said(shown).values()) == [1.5, -24.0, 0.0, False, True, False]


# ── what was published ──


@pytest.mark.parametrize("sign", [1, -1])
def test_tracking_has_the_measured_attitude_where_the_error_puts_it(sign: int) -> None:
    error = about(2, radians(10.0))
    measured = product(ATTITUDE, error)
    wired: Quaternion = tuple(sign * part for part in error)  # type: ignore[assignment]  # z₁₋: the same turn, as −e
    found = by_topic(configured().take(address("telemetry"), telemetry(wired, sign).encode(), NOW))
    assert set(found) == {"/aero/tracking", "/aero/desired_pose", "/aero/desired_tf"}
    shown = said(found["/aero/tracking"])
    assert shown["error_deg"] == pytest.approx(10.0, abs=1e-4)
    assert shown["time_s"] == 0.5
    for prefix, q in (("", measured), ("desired_", ATTITUDE)):
        for name, expected in zip(("roll", "pitch", "yaw"), to_euler(q), strict=True):
            assert shown[f"{prefix}{name}_deg"] == pytest.approx(degrees(expected), abs=1e-3)
    assert [shown["error_q_deg_s"], shown["error_r_deg_s"]] == [2.0, -3.0]
    assert distance(orientation(found["/aero/desired_pose"].data), ATTITUDE) == pytest.approx(0.0, abs=1e-6)
    assert fields(found["/aero/desired_tf"].data)[3] == [b"aero_desired"]


def test_the_truth_is_shown_as_the_emulator_published_it() -> None:
    truth = Truth(tick=1, attitude=ATTITUDE, rate=(radians(1.0), radians(-2.0), 0.0), voltages=(1.0, 2.0))
    (shown,) = configured().take(address("truth"), truth.encode(), NOW)
    assert said(shown) == {
        "roll_deg": pytest.approx(degrees(ROLL), abs=1e-3),
        "pitch_deg": pytest.approx(degrees(PITCH), abs=1e-3),
        "yaw_deg": pytest.approx(degrees(YAW), abs=1e-3),
        "p_deg_s": 1.0,
        "q_deg_s": -2.0,
        "r_deg_s": 0.0,
    }


def test_a_set_point_is_shown() -> None:
    (shown,) = configured().take(address("reference"), Setpoint(attitude=(1.0, 2.0, 350.0)).encode(), NOW)
    assert shown.topic == "/aero/setpoint"
    assert said(shown) == {"roll_deg": 1.0, "pitch_deg": 2.0, "yaw_deg": 350.0}


def test_a_status_shows_state_and_recent_times_and_a_plants_brings_the_body() -> None:
    found = by_topic(configured().take(address("status"), STATUS.encode(), NOW))
    assert set(found) == {"/aero/status/plant", "/aero/scene"}
    shown = said(found["/aero/status/plant"])
    names = ("state", "rate_hz", "skipped", "latency_p50_us", "latency_p99_us", "wake_p50_us", "age_p50_us")
    assert [shown[name] for name in names] == ["driven", 500.0, 2, 310.0, 620.0, 50.0, None]
    (controllers,) = configured().take(address("status", "controller"), STATUS.encode(), NOW)
    assert controllers.topic == "/aero/status/controller"


@pytest.mark.parametrize(("kind", "rotors", "stands"), [("aero", 2, 1), ("rigid_body", 0, 0)])
def test_the_body_hangs_in_the_frame_that_its_transform_moves(kind: str, rotors: int, stands: int) -> None:
    described = description()
    described.config["plant"]["kind"] = kind
    decoder = Decoder(None)
    decoder.configure(described)
    scene = by_topic(decoder.take(address("status"), STATUS.encode(), NOW))["/aero/scene"]
    entities = [fields(entity) for entity in fields(scene.data)[2]]
    body, desired, *others = entities
    assert [entity[2] for entity in entities] == [[b"aero"], [b"aero_desired"], *[[b"world"]] * stands]
    assert all(entity[5] == [1] for entity in entities)  # frame_locked: it moves with its frame
    assert len({entity[3][0] for entity in entities}) == len(entities)
    for entity in (body, desired):
        assert len(entity.get(10, [])) == rotors
        assert len(entity[8]) >= 1
    assert len(others) == stands


@pytest.mark.parametrize(
    ("name", "message", "level", "words"),
    [
        ("event", Event(role="plant", kind="tripped", text="over 60°"), 4, b"tripped: over 60\xc2\xb0"),
        ("event", Event(role="controller", kind="lost", text="no measurement"), 3, b"lost: no measurement"),
        ("event", Event(role="controller", kind="claimed", text="aero"), 2, b"claimed: aero"),
        ("loss", Loss(key="k", count=7, reason="disk"), 3, b"7 messages of k"),
    ],
)
def test_what_happens_is_a_line_of_the_log(name: str, message: Message, level: int, words: bytes) -> None:
    (shown,) = configured(1.0).take(address(name), message.encode(), NOW)
    assert (shown.topic, shown.shape.name) == ("/aero/log", "foxglove.Log")
    line = fields(shown.data)
    assert line[2] == [level]
    assert line[3][0].startswith(words)


# ── descriptions ──


def test_frames_give_nothing_before_a_description_and_are_read_by_the_plants() -> None:
    decoder = Decoder(None)
    payload = measurement(*sent_vector(ATTITUDE), 0, 0, 0)
    assert decoder.frame(address("measurement"), payload, NOW) == []
    decoder.configure(description("recorder"))
    assert decoder.frame(address("measurement"), payload, NOW) == []
    assert decoder.malformed == 0
    decoder.configure(description("controller", "wire.attitude.bits=12"))
    assert decoder.frame(address("measurement"), payload, NOW) == []
    decoder.configure(description("plant"))
    decoder.configure(description("controller", "wire.attitude.bits=12"))
    assert len(decoder.frame(address("measurement"), payload, NOW)) == 3


def test_silence_in_lockstep_shows_nothing_new_and_takes_no_frames_turn() -> None:
    decoder = Decoder(25.0)
    decoder.configure(description("plant", "wire.transmit.measurement=on_change"))
    frame = WIRE.measurement.pack(3, (1, 2, 3, 4, 5, 6))
    assert decoder.frame(address("measurement"), b"", NOW) == []
    assert decoder.frame(address("measurement"), frame, NOW + 1)
    assert decoder.malformed == 0
    assert decoder.frame(address("command"), b"", NOW) == []  # which are periodic
    assert decoder.malformed == 1


def test_a_description_of_another_version_changes_nothing_and_is_counted() -> None:
    decoder = configured()
    decoder.configure(
        Description(protocol=2, role="plant", vehicle="aero", host="h", versions={}, config={"wire": {"bits": 3}})
    )
    decoder.configure(Description(protocol=2, role="plant", vehicle="aero", host="h", versions={}, config={}))
    assert decoder.malformed == 2
    assert decoder.frame(address("measurement"), measurement(0, 0, 0, 0, 0, 0), NOW)


def test_vehicles_do_not_get_in_each_others_way() -> None:
    decoder = configured(1.0)
    decoder.configure(description("plant", vehicle="other"))
    payload = measurement(0, 0, 0, 0, 0, 0)
    for vehicle in ("aero", "other"):
        assert {
            m.topic.split("/")[1] for m in decoder.frame(address("measurement", vehicle=vehicle), payload, NOW)
        } == {vehicle}


# ── the rate ──


def test_a_topic_that_streams_gives_at_most_so_many_a_second_by_time_of_publication() -> None:
    decoder = configured(30.0)
    given = [NOW + k * 1_000_000 for k in range(3000) if decode(decoder, "truth", RAW["truth"], NOW + k * 1_000_000)]
    assert len(given) == pytest.approx(90, abs=1)
    assert max(b - a for a, b in pairwise(given)) < 2 / 30 * 1e9


def test_without_a_rate_everything_is_given() -> None:
    decoder = configured(None)
    assert all(decode(decoder, name, RAW[name], NOW) for name in RAW for _ in range(10))


def test_what_happens_once_is_given_whatever_the_rate() -> None:
    decoder = configured(0.001)
    event = Event(role="plant", kind="tripped", text="x").encode()
    loss = Loss(key="k", count=1, reason="queue").encode()
    for name, payload in (("event", event), ("loss", loss), ("status", STATUS.encode())):
        assert all(decoder.take(address(name), payload, NOW + k) for k in range(5))


def test_a_clock_that_is_set_back_does_not_silence_a_topic() -> None:
    decoder = configured(30.0)
    assert decode(decoder, "truth", RAW["truth"], NOW)
    assert decode(decoder, "truth", RAW["truth"], NOW - 3600 * 10**9)


# ── traces ──


def test_the_rows_of_each_end_give_what_it_sent_as_frames_do_at_the_times_of_sending() -> None:
    frames = {
        "plant": ("measurement", measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0)),
        "controller": ("command", frame(WIRE.command, [WIRE.voltage.quantizer()] * 2, [24.0, None])),
    }
    for end in ENDS:
        name, sent = frames[end]
        given = configured().take(
            address("trace", end), batch(end, [(NOW, Sent.FRAME, sent), (NOW + 2_000_000, Sent.FRAME, sent)]), 5
        )
        assert given == [
            shown for at_ns in (NOW, NOW + 2_000_000) for shown in configured().frame(address(name), sent, at_ns)
        ]


def test_ticks_at_which_nothing_or_silence_was_sent_give_nothing() -> None:
    sent = measurement(0, 0, 0, 0, 0, 0)
    rows = [(NOW, Sent.NONE, sent), (NOW + 1000, Sent.SILENT, sent), (NOW + 2000, Sent.FRAME, sent)]
    given = configured(25.0).take(address("trace"), batch("plant", rows), NOW)
    assert {shown.at_ns for shown in given} == {NOW + 2000}


@given(
    times=st.lists(st.integers(0, 3000), max_size=60).map(sorted),
    cuts=st.sets(st.integers(1, 59)),
)
def test_of_the_rows_in_a_slot_of_time_the_first_is_given_however_they_are_batched(
    times: list[int], cuts: set[int]
) -> None:
    """Times in ms; at 10 Hz."""
    sent = measurement(0, 0, 0, 0, 0, 0)
    rows = [(NOW + ms * 1_000_000, Sent.FRAME, sent) for ms in times]
    edges = [0, *sorted(cut for cut in cuts if cut < len(rows)), len(rows)]
    decoder = configured(10.0)
    given = [
        shown.at_ns
        for begin, end in pairwise(edges)
        for shown in decoder.take(address("trace"), batch("plant", rows[begin:end]), 0)
        if shown.topic == "/aero/pose"
    ]
    first = {at_ns // 10**8: at_ns for at_ns, *_ in reversed(rows)}
    assert given == sorted(first.values())


def test_frames_beside_a_trace_are_not_decoded_twice() -> None:
    """A log may hold both; `take` is for what a log holds."""
    decoder = configured()
    assert [decoder.take(address(name), RAW[name], NOW) for name in topics.FRAMES] == [[], []]
    assert decoder.malformed == 0


def test_rows_of_another_wire_spec_are_counted_and_those_of_no_time_are_left_out() -> None:
    other = load(None, ["wire.attitude.bits=12"]).wire
    decoder = configured()
    rows = [(NOW, Sent.FRAME, bytes(other.measurement.size))]
    assert decoder.take(address("trace"), batch("plant", rows, other), NOW) == []
    assert decoder.malformed == 1
    payload = bytearray(RAW["trace"])
    payload[40:48] = (-(2**62)).to_bytes(8, "little", signed=True)  # the header's wall clock
    assert configured().take(address("trace"), bytes(payload), NOW) == []


# ── what is broken ──


@given(
    name=st.sampled_from(sorted(RAW)),
    payload=st.binary(max_size=80) | st.sampled_from(sorted(RAW.values())),
    at_ns=st.integers(0, 2**64 - 1),
)
def test_any_bytes_at_any_time_give_something_or_nothing_and_never_raise(name: str, payload: bytes, at_ns: int) -> None:
    decoder = configured()
    assert bool(decode(decoder, name, payload, at_ns)) != bool(decoder.malformed)


@given(st.integers(0, len(RAW["trace"]) - 1), st.binary(min_size=1, max_size=8))
def test_a_damaged_trace_gives_something_or_nothing_and_never_raises(place: int, damage: bytes) -> None:
    payload = RAW["trace"][:place] + damage + RAW["trace"][place + len(damage) :]
    assert all(0 <= shown.at_ns < 2**64 for shown in configured(25.0).take(address("trace"), payload, NOW))


@pytest.mark.parametrize("name", sorted(RAW))
def test_a_time_beyond_what_viewers_can_hold_is_the_last_they_can(name: str) -> None:
    for shown in decode(configured(), name, RAW[name], 2**64 - 1):
        assert shown.at_ns == 2**64 - 1 or name == "trace"  # whose rows have their own
        if shown.shape.name == "foxglove.PoseInFrame" and name != "trace":
            assert fields(fields(shown.data)[1][0])[1] == [2**32 - 1]


def test_numbers_beyond_all_bounds_are_shown_or_null() -> None:
    text = telemetry(about(1, 0.1)).encode().replace(b"[0.0,0.0349", b"[1e999,0.0349")
    for shown in configured().take(address("telemetry"), text, NOW):
        assert shown.shape.encoding == "protobuf" or said(shown)["error_p_deg_s"] is None


# ── schemas ──


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
    "boolean": bool,
    "string": str,
    "number": (int, float),
    "integer": int,
}


def test_every_topic_that_is_given_is_listed_and_its_json_is_as_its_schema_says() -> None:
    decoder = configured()
    assert set(RAW) == LIMITED | UNLIMITED | {"trace", *topics.FRAMES}
    given = [shown for name, payload in RAW.items() for shown in decode(decoder, name, payload, NOW)]
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


def test_fields_that_are_numbers_have_a_unit_in_their_names_or_count_something() -> None:
    units = ("_deg", "_deg_s", "_v", "_s", "_hz", "_us")
    plain = {"damping_1", "damping_2", "damping_3", "sign", "skipped", "refused", "stale", "saturated"}
    for shape in {shape for shape in SHAPES.values() if shape.encoding == "jsonschema"}:
        for name, field in json.loads(shape.schema)["properties"].items():
            assert field["type"] in ("string", "boolean") or name.endswith(units) or name in plain, name


@pytest.mark.parametrize("name", [topic.name for topic in topics.TOPICS.values() if topic.carries == "json"])
def test_messages_of_the_network_can_be_described_so_that_viewers_read_them(name: str) -> None:
    model = topics.TOPICS[name].model
    assert model is not None
    schema = plain_schema(model)
    assert readable(schema)
    assert set(schema["properties"]) == set(model.model_fields)
    assert json.loads(json_shape("x", model).schema) == schema
