"""Decoding of messages: whatever comes, it is the message or one short line, and the work is bounded."""

from __future__ import annotations

import json
from contextlib import suppress
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.models import FaultStatus, Grant, Status
from aeroloop.protocol.messages.operator import MAX_POINTS, Inject, Message, MessageError, Points, Request, Track
from aeroloop.protocol.messages.topics import POINTS_BYTES, STATUS_BYTES, TOPICS
from tests.support.every_message import MESSAGES
from tests.support.hostile import mutated

MODELS = sorted({type(message) for message in MESSAGES}, key=lambda model: model.__name__)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
@settings(max_examples=60)
@given(chance=st.randoms(use_true_random=False))
def test_a_mutated_message_is_read_or_refused_in_one_short_line(message: Message, chance: Random) -> None:
    payload = mutated(message.encode(), chance)
    for model in (type(message), chance.choice(MODELS)):
        try:
            assert isinstance(model.decode(payload), model)
        except MessageError as error:
            (line,) = str(error).splitlines()
            assert len(line) < 2000


@given(payload=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(payload: bytes) -> None:
    for model in MODELS:
        with suppress(MessageError):
            model.decode(payload)


def test_an_unknown_kind_is_refused_also_within_what_may_be_absent() -> None:
    """A plant's answer to a claim, with the vehicle's last session."""
    record: dict[str, Any] = {"controller": "c", "session": "s", "gains": {}, "gains_from": "operator"}
    record |= {"reference": {"kind": "x"}, "reference_from": "operator", "within_s": 1.0, "since_tick": 0}
    with pytest.raises(MessageError, match=r'last\.reference\.kind must be "hold", .* or "stream", not "x"'):
        Grant.decode(json.dumps({"session": "s", "last": record}).encode())


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_more_values_than_a_message_may_have_are_refused_unparsed(
    model: type[Message], monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[int] = []
    monkeypatch.setattr(model, "model_validate_json", lambda payload, **_: parsed.append(len(payload)))
    fits = b"[" + b"0," * model.max_values + b"0]"
    model.decode(fits)
    with pytest.raises(MessageError, match=f"^not a {model.__name__}: more than {model.max_values} values$"):
        model.decode(fits.replace(b"[", b"[0,"))
    assert parsed == [len(fits)]


def test_every_message_that_a_role_may_send_is_read() -> None:
    """The longest reference, the longest injection, and a status with every fault that may act."""
    triple = (-179.123456789012345, 1 / 3, 123.456789012345678)
    points = Points(times=[n * 1.000123456789 for n in range(MAX_POINTS)], attitudes=[triple] * MAX_POINTS)
    track = Track(reference=points).encode()
    assert len(track) <= TOPICS["track"].request == POINTS_BYTES
    assert Track.decode(track).reference == points
    longest = Inject(faults=[f"command:delay={n / 7:.15f}@1.5..2.5" for n in range(64)])
    assert Inject.decode(longest.encode()) == longest
    status = next(message for message in MESSAGES if isinstance(message, Status))
    fault = next(message for message in MESSAGES if isinstance(message, FaultStatus))
    full = status.model_copy(update={"faults": [fault] * 256})
    assert len(full.encode()) <= STATUS_BYTES
    assert Status.decode(full.encode()) == full


def test_a_status_of_another_version_is_read_as_far_as_it_is_known() -> None:
    """By an end that only needs to know which process it is, and in which state."""
    status = next(message for message in MESSAGES if isinstance(message, Status))
    newer = status.encode()[:-1] + b',"mood":{"good":true}}'
    assert Status.decode(newer, extra="ignore") == status
    with pytest.raises(MessageError, match="unknown key mood"):
        Status.decode(newer)


def test_an_unknown_key_of_any_length_is_shown_in_part() -> None:
    with pytest.raises(MessageError) as refused:
        Request.decode(b'{"' + b"x" * 16_000 + b'":0}')
    assert len(str(refused.value)) < 200
