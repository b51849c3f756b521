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
    Event,
    Grant,
    Refusal,
    Truth,
)
from aeroloop.protocol.messages.operator import Gains, Message
from aeroloop.protocol.runtime.timing import Histogram, summary
from tests.support.every_message import MESSAGES


def named(message: Message) -> str:
    return type(message).__name__


every_message = pytest.mark.parametrize("message", MESSAGES, ids=named)


def test_every_kind_of_message_is_tried_here() -> None:
    assert {type(message) for message in MESSAGES} == set(Message.__subclasses__())


@every_message
def test_a_message_survives_json(message: Message) -> None:
    again = type(message).model_validate_json(message.encode())
    assert again == message
    assert again.encode() == message.encode()


@pytest.mark.parametrize("message", [message for message in MESSAGES if not isinstance(message, Gains)], ids=named)
def test_an_unknown_field_is_refused(message: Message) -> None:
    """Gains are the running law's business, which refuses those that it does not have."""
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
