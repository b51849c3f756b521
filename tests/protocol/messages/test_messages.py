"""Messages: JSON round trips, and refusal of unknown fields."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from aeroloop.protocol.messages.models import (
    PROTOCOL_VERSION,
    Claim,
    Description,
    Event,
    FaultStatus,
    Grant,
    Loss,
    Percentiles,
    Refusal,
    Release,
    SessionRecord,
    Status,
    Telemetry,
    Timing,
    Truth,
)
from aeroloop.protocol.messages.operator import (
    Advance,
    Answer,
    Change,
    Gains,
    Hold,
    Inject,
    Message,
    Points,
    Request,
    Setpoint,
    Sinusoid,
    Stream,
    Track,
)
from aeroloop.protocol.messages.states import TripCause
from aeroloop.protocol.messages.trace import Operation, Tail
from aeroloop.protocol.runtime.timing import Histogram, summary
from aeroloop.protocol.wire.spec import SignalSpec, WireSpec

LATENCY = Percentiles(count=3, p50=230.5, p99=700.25, p999=800.0, max=812.0)
FAULT = FaultStatus(
    fault="command:drop=0.1@2", source="injected", begin_tick=1001, end_tick=None, changed=7, effect="commands dropped"
)
RECORD = SessionRecord(
    controller="c1", session="5f0b", gains=Gains(C1=(0.3, 0.3, 0.3), C2=(0.15, 0.15, 0.15), Gamma=(0.03, 0.03, 0.03)),
    gains_from="operator", reference=Hold(attitude=(0.0, -10.0, 90.0)), reference_from="resumed", within_s=5.0,
    since_tick=12, ended=TripCause.HOLDER_GONE, ended_tick=700,
)  # fmt: skip

MESSAGES: list[Message] = [
    Claim(controller="c1", session="5f0c", period_ns=2_000_000, lockstep=False, wire=WireSpec()),
    Claim(
        controller="c1",
        session="5f0c",
        period_ns=1,
        lockstep=True,
        wire=WireSpec(attitude=SignalSpec(bits=None, limit=1.0), rate=SignalSpec(bits=10, limit=2.0, deadzone=0.1)),
    ),
    RECORD,
    Grant(session="5f0c"),
    Grant(session="5f0c", last=RECORD),
    Refusal(reason="held by c2 since 3 s", holder="c2", differences=["rate.bits: 8, not 10"]),
    Refusal(reason="not now"),
    Release(session="5f0c"),
    Description(
        protocol=PROTOCOL_VERSION,
        role="plant",
        vehicle="aero",
        host="bench",
        versions={"python": "3.11"},
        config={"loop": {"rate_hz": 500.0}, "list": [1, "a", None, True]},
    ),
    LATENCY,
    Status(role="plant", state="idle", uptime_s=0.5, ticks=1, rate_hz=500.0, skipped=0),
    Status(
        role="plant",
        state="driven",
        session="5f0c",
        uptime_s=1e6,
        ticks=2**40,
        rate_hz=499.9,
        skipped=1,
        received=2,
        sent=3,
        refused=4,
        saturated=5,
        latency_us=LATENCY,
        notes=["SCHED_FIFO: Operation not permitted"],
        faults=[FAULT],
    ),
    FAULT,
    Telemetry(
        session="5f0c",
        tick=7,
        counter=15,
        attitude_error=(0.1, -0.2, 1e-17),
        rate_error=(0.0, 1 / 3, -2.0),
        desired=(1.0, 0.0, 0.0, 0.0),
        damping_estimate=(0.0, 0.0071, 0.022),
        voltages=(12.5, -24.0),
        sign=-1,
    ),
    Truth(tick=0, attitude=(1.0, 0.0, 0.0, 0.0), rate=(0.0, -0.5, 0.1), voltages=(0.0, 24.0, 3.0)),
    Timing(wake=LATENCY, busy=LATENCY, period=LATENCY, recent_wake=LATENCY, recent_busy=None, recent_period=None),
    Event(role="plant", kind="tripped", text="no fresh command for 100 ms", session="5f0c", tick=1207),
    Loss(key="aeroloop/aero/5f0c/command", count=3, reason="network"),
    Event(role="recorder", kind="started", text="η and ω, ≥ 0"),
    Sinusoid(),
    Hold(),
    Hold(attitude=(0.0, -10.5, 1 / 3)),
    Points(times=[0.0, 1.5], attitudes=[(0.0, 0.0, 0.0), (0.0, 5.0, -0.1)]),
    Stream(timeout_s=0.3),
    Setpoint(attitude=(0.0, 1.0, 2.0)),
    Gains(C1=(0.3, 0.3, 0.3), Gamma=(0.02, 0.01, 1e-3)),
    Change(session="5f0c", tick=1234, gains=Gains(), reference=Hold(), within_s=0.1),
    Change(session="5f0c", tick=0),
    Request(),
    Track(reference=Points(times=[0.0, 1.0], attitudes=[(0.0, 0.0, 0.0)] * 2), within_s=2.5),
    Inject(faults=["rate:off@2", "command:drop=0.1"]),
    Inject(clear=True),
    Advance(seconds=0.5),
    Answer(done=True, text="armed"),
    Operation(tick=-1, kind="inject", name="rate:off@2"),
    Tail(
        state={"uptime": 3},
        changes=[Change(session="5f0c", tick=0)],
        operations=[Operation(tick=7, kind="release", name="5f0c")],
    ),
]

every_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)


def test_every_kind_of_message_is_tried_here() -> None:
    assert {type(message) for message in MESSAGES} == set(Message.__subclasses__())


@every_message
def test_a_message_survives_json(message: Message) -> None:
    again = type(message).model_validate_json(message.encode())
    assert again == message
    assert again.encode() == message.encode()


@every_message
def test_an_unknown_field_is_refused(message: Message) -> None:
    tree = json.loads(message.encode())
    with pytest.raises(ValidationError, match="surprise"):
        type(message).model_validate_json(json.dumps({**tree, "surprise": 1}))


@every_message
def test_a_field_without_a_default_must_be_there(message: Message) -> None:
    tree = json.loads(message.encode())
    required = [name for name, field in type(message).model_fields.items() if field.is_required()]
    for name in required:
        with pytest.raises(ValidationError, match=name):
            type(message).model_validate_json(json.dumps({k: v for k, v in tree.items() if k != name}))


@every_message
def test_a_message_cannot_be_changed(message: Message) -> None:
    for name in type(message).model_fields:
        with pytest.raises(ValidationError, match="frozen"):
            setattr(message, name, getattr(message, name))


def test_an_unknown_field_is_refused_deep_inside_a_claim() -> None:
    tree = json.loads(MESSAGES[0].encode())
    tree["wire"]["rate"]["offset"] = 0.0
    with pytest.raises(ValidationError, match="offset"):
        Claim.model_validate_json(json.dumps(tree))


def test_yes_cannot_be_read_as_no() -> None:
    with pytest.raises(ValidationError):
        Refusal.model_validate_json(Grant(session="5f0c").encode())
    with pytest.raises(ValidationError):
        Grant.model_validate_json(Refusal(reason="not now").encode())


def test_a_claim_carries_the_protocol_s_version() -> None:
    assert json.loads(MESSAGES[0].encode())["protocol"] == PROTOCOL_VERSION


@pytest.mark.parametrize(
    ("model", "broken"),
    [
        (Claim, {"controller": "c", "session": "s", "period_ns": 0, "lockstep": False, "wire": {}}),
        (Event, {"role": "plant", "kind": "surprised", "text": ""}),
        (Truth, {"tick": 0, "attitude": [1, 0, 0], "rate": [0, 0, 0], "voltages": []}),
    ],
)
def test_a_value_out_of_bounds_is_refused(model: type[Message], broken: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        model.model_validate_json(json.dumps(broken))


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.tuples(finite, finite, finite, finite), st.tuples(finite, finite, finite), st.lists(finite, max_size=3))
def test_every_finite_float_survives_json_to_the_bit(
    attitude: tuple[float, float, float, float], rate: tuple[float, float, float], voltages: list[float]
) -> None:
    truth = Truth(tick=1, attitude=attitude, rate=rate, voltages=tuple(voltages))
    again = Truth.model_validate_json(truth.encode())
    assert repr(again) == repr(truth)  # repr: −0.0 is not 0.0


def test_a_summary_of_nothing_is_none() -> None:
    assert summary(Histogram()) is None


def test_a_summary_is_that_of_the_histogram_in_tenths_of_a_microsecond() -> None:
    durations = Histogram()
    for us in range(1, 101):
        durations.add(us * 1000)
    percentiles = summary(durations)
    assert percentiles is not None
    assert (percentiles.count, percentiles.max) == (100, 100.0)
    assert percentiles.p50 == round(durations.percentile(50), 1)
    assert percentiles.p99 == round(durations.percentile(99), 1)
    assert percentiles.p50 < percentiles.p99
