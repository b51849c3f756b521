"""Decoded channels for viewers: measured, commanded and published values, in units for people."""

from __future__ import annotations

from math import degrees, radians

import pytest

from aeroloop.protocol.messages.models import Description, Event, Loss, Truth
from aeroloop.protocol.messages.operator import Message, Setpoint
from aeroloop.protocol.wire.attitude import Quaternion, distance, sent_vector, to_euler
from aeroloop.service.config import load
from aeroloop.service.viewers import views
from aeroloop.service.viewers.channels import Decoder
from tests.support.decoded import (
    ATTITUDE,
    NOW,
    PITCH,
    ROLL,
    STATUS,
    WIRE,
    YAW,
    about,
    address,
    by_topic,
    configured,
    description,
    frame,
    measurement,
    product,
    said,
    telemetry,
)
from tests.support.viewer_double import fields, orientation, quaternion


def test_a_measurement_is_shown_as_the_body_stood_to_within_a_quantizers_step_in_angles_pose_and_transform() -> None:
    payload = measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0)
    found = by_topic(configured().frame(address("measurement"), payload, NOW))
    assert set(found) == {"/aero/measurement", "/aero/pose", "/aero/tf"}
    assert {message.at_ns for message in found.values()} == {NOW}
    shown = said(found["/aero/measurement"])
    angles = [shown["roll_deg"], shown["pitch_deg"], shown["yaw_deg"]]
    step_deg = degrees(4 * WIRE.attitude.quantizer().bound / ATTITUDE[0])  # an angle is twice ε/η
    assert angles == pytest.approx([degrees(angle) for angle in (ROLL, PITCH, YAW)], abs=step_deg)
    rates = [shown[f"{name}_deg_s"] for name in "pqr"]
    within = degrees(WIRE.rate.quantizer().bound)
    assert rates == pytest.approx([degrees(rate) for rate in (0.5, -0.25, 0.0)], abs=within)
    pose, transform = found["/aero/pose"].data, fields(found["/aero/tf"].data)
    assert (transform[2], transform[3]) == ([b"world"], [b"aero"])
    assert quaternion(transform[5][0]) == orientation(pose)
    assert angles == pytest.approx([degrees(part) for part in to_euler(orientation(pose))], abs=1e-4)
    at = fields(fields(pose)[1][0])
    assert (at[1], at.get(2, [0])) == ([NOW // 10**9], [0])


def test_what_a_measurement_does_not_know_is_null_and_gives_no_pose() -> None:
    decoder = configured()
    (shown,) = decoder.frame(address("measurement"), measurement(0.1, None, 0.1, 0.5, None, 0.0), NOW)
    values = said(shown)
    assert [values[name] for name in ("roll_deg", "pitch_deg", "yaw_deg", "q_deg_s")] == [None] * 4
    assert values["p_deg_s"] == pytest.approx(degrees(0.5), abs=degrees(WIRE.rate.quantizer().bound))
    assert decoder.malformed == 0


@pytest.mark.parametrize(
    ("sent", "shown", "saturated"), [(24.0, WIRE.voltage.quantizer().outermost, True), (None, None, None)]
)
def test_a_command_is_shown_in_volts_by_the_motors_own_numbers_with_saturation_or_null(
    sent: float | None, shown: float | None, saturated: bool | None
) -> None:
    volts = WIRE.voltage.quantizer()
    (command,) = configured().frame(address("command"), frame(WIRE.command, [volts, volts], [sent, -3.0]), NOW)
    assert said(command) == dict.fromkeys(views.Voltages.model_fields) | {
        "voltage_1_v": None,
        "voltage_2_v": shown if shown is None else pytest.approx(shown, abs=1e-4),
        "voltage_3_v": pytest.approx(volts.quantize(-3.0), abs=1e-4),
        "saturated_1": None,
        "saturated_2": saturated,
        "saturated_3": False,
    }


@pytest.mark.parametrize("actuators", [1, 3, 8])
def test_any_number_of_motors_without_a_quantizer_is_shown_and_no_more(actuators: int) -> None:
    overrides = [f"wire.actuators={actuators}", "wire.voltage.bits=cont"]
    volts = [1.5, -24.0, 0.0, 1.0, 2.0, 3.0, 4.0, 24.0][:actuators]
    (shown,) = configured(None, *overrides).frame(
        address("command"), load(None, overrides).wire.command.pack(0, volts), NOW
    )
    absent = [None] * (8 - actuators)
    assert list(said(shown).values()) == [*volts, *absent, *(abs(u) == 24.0 for u in volts), *absent]


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


def test_truth_and_set_points_are_shown_as_they_were_published() -> None:
    truth = Truth(tick=1, attitude=ATTITUDE, rate=(radians(1.0), radians(-2.0), 0.0), voltages=(1.0, 2.0))
    (shown,) = configured().take(address("truth"), truth.encode(), NOW)
    assert list(said(shown)) == ["roll_deg", "pitch_deg", "yaw_deg", "p_deg_s", "q_deg_s", "r_deg_s"]
    expected = [*(degrees(angle) for angle in (ROLL, PITCH, YAW)), 1.0, -2.0, 0.0]
    assert list(said(shown).values()) == pytest.approx(expected, abs=1e-3)
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
def test_what_happens_is_a_line_of_the_log_of_the_role_in_its_key(
    name: str, message: Message, level: int, words: bytes
) -> None:
    (shown,) = configured(1.0).take(address(name, "recorder"), message.encode(), NOW)
    assert (shown.topic, shown.shape.name) == ("/aero/log", "foxglove.Log")
    line = fields(shown.data)
    assert line[2] == [level]
    assert line[3][0].startswith(words)
    assert line[4] == [b"recorder"]  # by its key, whatever it claims to be


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
