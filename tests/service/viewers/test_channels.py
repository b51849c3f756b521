"""Decoded channels for viewers: values in units for people, a bounded rate, and what is broken."""

from __future__ import annotations

import json
from itertools import pairwise
from math import degrees, radians

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import Description, Event, Loss, Truth
from aeroloop.protocol.messages.operator import Message, Setpoint
from aeroloop.protocol.messages.trace import ENDS, Sent
from aeroloop.protocol.wire.attitude import Quaternion, distance, sent_vector, to_euler
from aeroloop.service.config import load
from aeroloop.service.viewers import schemas
from aeroloop.service.viewers.channels import Decoder
from tests.support.decoded import (
    ATTITUDE,
    NOW,
    PITCH,
    RAW,
    ROLL,
    STATUS,
    WIRE,
    YAW,
    about,
    address,
    batch,
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

VOLTS = WIRE.voltage.quantizer()


# ── what is shown ──


def test_a_measurement_is_shown_as_the_body_stood_to_within_a_quantizers_step_in_angles_pose_and_transform() -> None:
    payload = measurement(*sent_vector(ATTITUDE), 0.5, -0.25, 0.0)
    found = by_topic(configured().take(address("measurement"), payload, NOW))
    assert set(found) == {"/aero/measurement", "/aero/pose", "/aero/tf"}
    assert {message.at_ns for message in found.values()} == {NOW}
    shown = list(said(found["/aero/measurement"]).values())
    step_deg = degrees(4 * WIRE.attitude.quantizer().bound / ATTITUDE[0])  # an angle is twice ε/η
    assert shown[:3] == pytest.approx([degrees(angle) for angle in (ROLL, PITCH, YAW)], abs=step_deg)
    within = degrees(WIRE.rate.quantizer().bound)
    assert shown[3:] == pytest.approx([degrees(rate) for rate in (0.5, -0.25, 0.0)], abs=within)
    pose, transform = found["/aero/pose"].data, fields(found["/aero/tf"].data)
    assert (transform[2], transform[3]) == ([b"world"], [b"aero"])
    assert quaternion(transform[5][0]) == orientation(pose)
    assert shown[:3] == pytest.approx([degrees(part) for part in to_euler(orientation(pose))], abs=1e-4)
    at = fields(fields(pose)[1][0])
    assert (at[1], at.get(2, [0])) == ([NOW // 10**9], [0])


def test_what_a_measurement_does_not_know_is_null_and_gives_no_pose() -> None:
    decoder = configured()
    (shown,) = decoder.take(address("measurement"), measurement(0.1, None, 0.1, 0.5, None, 0.0), NOW)
    values = said(shown)
    assert [values[name] for name in ("roll_deg", "pitch_deg", "yaw_deg", "q_deg_s")] == [None] * 4
    assert values["p_deg_s"] == pytest.approx(degrees(0.5), abs=degrees(WIRE.rate.quantizer().bound))
    assert decoder.malformed == 0


@pytest.mark.parametrize(("sent", "shown", "saturated"), [(24.0, VOLTS.outermost, True), (None, None, None)])
def test_a_command_is_shown_in_volts_by_the_motors_own_numbers_with_saturation_or_null(
    sent: float | None, shown: float | None, saturated: bool | None
) -> None:
    (command,) = configured().take(address("command"), frame(WIRE.command, [VOLTS, VOLTS], [sent, -3.0]), NOW)
    assert said(command) == dict.fromkeys(schemas.Voltages.model_fields) | {
        "voltage_2_v": shown if shown is None else pytest.approx(shown, abs=1e-4),
        "voltage_3_v": pytest.approx(VOLTS.quantize(-3.0), abs=1e-4),
        "saturated_2": saturated,
        "saturated_3": False,
    }


@pytest.mark.parametrize("sign", [1, -1])
def test_tracking_has_the_measured_attitude_where_the_error_puts_it(sign: int) -> None:
    error = about(2, radians(10.0))
    wired: Quaternion = tuple(sign * part for part in error)  # type: ignore[assignment]  # z₁₋: the same turn, as −e
    found = by_topic(configured().take(address("telemetry"), telemetry(wired, sign).encode(), NOW))
    assert set(found) == {"/aero/tracking", "/aero/desired_pose", "/aero/desired_tf"}
    shown = said(found["/aero/tracking"])
    assert shown["error_deg"] == pytest.approx(10.0, abs=1e-4)
    assert shown["time_s"] == 0.5
    for prefix, q in (("", product(ATTITUDE, error)), ("desired_", ATTITUDE)):
        for name, expected in zip(("roll", "pitch", "yaw"), to_euler(q), strict=True):
            assert shown[f"{prefix}{name}_deg"] == pytest.approx(degrees(expected), abs=1e-3)
    assert [shown["error_q_deg_s"], shown["error_r_deg_s"]] == [2.0, -3.0]
    assert [shown["damping_2"], shown["damping_3"], shown["sign"]] == [0.007, 0.0095, sign]
    assert distance(orientation(found["/aero/desired_pose"].data), ATTITUDE) == pytest.approx(0.0, abs=1e-6)
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
def test_a_status_shows_state_and_recent_times_and_a_plants_brings_the_body_in_the_frame_that_moves_it(
    kind: str, rotors: int, stands: int
) -> None:
    described = description()
    described.config["plant"]["kind"] = kind
    decoder = Decoder(None)
    decoder.configure(described)
    found = by_topic(decoder.take(address("status"), STATUS.encode(), NOW))
    assert set(found) == {"/aero/status/plant", "/aero/scene"}
    shown = said(found["/aero/status/plant"])
    assert shown == json.loads(STATUS.encode())
    (controllers,) = decoder.take(address("status", "controller"), STATUS.encode(), NOW)
    assert controllers.topic == "/aero/status/controller"
    entities = [fields(entity) for entity in fields(found["/aero/scene"].data)[2]]
    assert [entity[2] for entity in entities] == [[b"aero"], [b"aero_desired"], *[[b"world"]] * stands]
    assert all(entity[5] == [1] for entity in entities)  # frame_locked: it moves with its frame
    assert len({entity[3][0] for entity in entities}) == len(entities)
    for entity in entities[:2]:
        assert len(entity.get(10, [])) == rotors
        assert len(entity[8]) >= 1


@pytest.mark.parametrize(
    ("name", "message", "level", "words"),
    [
        ("event", Event(role="plant", kind="tripped", text="over 60°"), 4, b"tripped: over 60\xc2\xb0"),
        ("event", Event(role="controller", kind="lost", text="no measurement"), 3, b"lost: no measurement"),
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
    malformed, shown = [], []
    steps: tuple[list[Description], ...] = (
        [],
        [description("recorder")],
        [description("controller", "wire.attitude.bits=12")],
        [description("plant"), description("controller", "wire.attitude.bits=12")],
    )
    for descriptions in steps:
        for one in descriptions:
            decoder.configure(one)
        shown.append(len(decoder.take(address("measurement"), payload, NOW)))
        malformed.append(decoder.malformed)
    assert (shown, malformed) == ([0, 0, 0, 3], [0, 0, 1, 1])


def test_a_description_of_another_version_changes_nothing_and_is_counted() -> None:
    decoder = configured()
    for config in ({"wire": {"bits": 3}}, {}):
        decoder.configure(Description(protocol=2, role="plant", vehicle="aero", host="h", versions={}, config=config))
    assert decoder.malformed == 2
    assert decoder.take(address("measurement"), RAW["measurement"], NOW)


# ── at which rate ──


def test_a_topic_that_streams_gives_at_most_so_many_a_second_by_time_of_publication() -> None:
    decoder, times = configured(30.0), range(NOW, NOW + 3 * 10**9, 1_000_000)
    shown = [at_ns for at_ns in times if decoder.take(address("truth"), RAW["truth"], at_ns)]
    assert len(shown) == pytest.approx(90, abs=1)
    assert max(b - a for a, b in pairwise(shown)) < 2 / 30 * 1e9
    assert decoder.take(address("truth"), RAW["truth"], NOW - 3600 * 10**9), "after its clock was set back"


def test_without_a_rate_everything_is_given_and_what_happens_once_whatever_the_rate() -> None:
    for rate_hz, names in ((None, list(RAW)), (0.001, ["event", "loss", "status"])):
        decoder = configured(rate_hz)
        assert all(decoder.take(address(name), RAW[name], NOW + k) for name in names for k in range(5))


@given(times=st.lists(st.integers(0, 3000), max_size=60).map(sorted), cuts=st.sets(st.integers(1, 59)))
def test_of_the_rows_in_a_slot_of_time_the_first_is_given_however_they_are_batched(
    times: list[int], cuts: set[int]
) -> None:
    """Times in ms; at 10 Hz."""
    rows = [(NOW + ms * 1_000_000, Sent.FRAME, RAW["measurement"]) for ms in times]
    edges = [0, *sorted(cut for cut in cuts if cut < len(rows)), len(rows)]
    decoder = configured(10.0)
    shown = [
        one.at_ns
        for begin, end in pairwise(edges)
        for one in decoder.take(address("trace"), batch("plant", rows[begin:end]), 0)
        if one.topic == "/aero/pose"
    ]
    first = {at_ns // 10**8: at_ns for at_ns, *_ in reversed(rows)}
    assert shown == sorted(first.values())


# ── what is broken ──


def test_rows_of_another_wire_spec_are_counted_and_those_of_no_time_are_left_out() -> None:
    other = load(None, ["wire.attitude.bits=12"]).wire
    decoder = configured()
    rows = [(NOW, Sent.FRAME, bytes(other.measurement.size))]
    assert decoder.take(address("trace"), batch("plant", rows, other), NOW) == []
    assert decoder.malformed == 1
    payload = bytearray(RAW["trace"])
    payload[40:48] = (-(2**62)).to_bytes(8, "little", signed=True)  # the header's wall clock
    assert configured().take(address("trace"), bytes(payload), NOW) == []


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


def test_numbers_beyond_all_bounds_are_null() -> None:
    text = RAW["telemetry"].replace(b"[0.0,0.0349", b"[1e999,0.0349")
    found = by_topic(configured().take(address("telemetry"), text, NOW))
    assert said(found["/aero/tracking"])["error_p_deg_s"] is None
