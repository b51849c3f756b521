"""Intake: whatever comes, it is the message or one short line, and the work is bounded."""

from __future__ import annotations

import json
from contextlib import suppress
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol import wording
from aeroloop.protocol.messages.intake import FEW, REFERENCE, STATUS, IntakeError, read
from aeroloop.protocol.messages.models import FaultStatus, Grant, Status, Tenure
from aeroloop.protocol.messages.operator import MAX_POINTS, Inject, Message, Points, Request, Track
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
            assert isinstance(read(model, payload), model)
        except IntakeError as error:
            (line,) = str(error).splitlines()
            assert len(line) < 2000


def test_an_unknown_kind_is_refused_also_within_what_may_be_absent() -> None:
    """A plant's answer to a claim, with the vehicle's last session."""
    record: dict[str, Any] = {
        "controller": "c",
        "session": "s",
        "gains": {},
        "gains_from": "operator",
        "reference": {"kind": "x"},
    }
    record |= {"reference_from": "operator", "within_s": 1.0, "since_tick": 0}
    with pytest.raises(IntakeError, match=r"last\.reference\.kind: tag 'x' .* 'hold', .* 'stream'"):
        read(Grant, json.dumps({"session": "s", "last": record}).encode())


@settings(max_examples=100)
@given(payload=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(payload: bytes) -> None:
    for model in MODELS:
        with suppress(IntakeError):
            read(model, payload)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_more_values_than_a_message_may_have_are_refused_unparsed(
    model: type[Message], monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[int] = []
    monkeypatch.setattr(model, "model_validate_json", lambda payload: parsed.append(len(payload)))
    fits = "{" + ",".join(f'"k{number}":0' for number in range(FEW)) + "}"
    read(model, fits.encode())
    with pytest.raises(IntakeError, match=f"not a {model.__name__}: more than {FEW} values"):
        read(model, fits.replace("{", '{"more":0,').encode())
    assert parsed == [len(fits)]


def test_every_message_that_a_role_may_send_is_read() -> None:
    """The longest reference, and a status with every fault that may act."""
    triple = (-179.123456789012345, 1 / 3, 123.456789012345678)
    points = Points(times=[n * 1.000123456789 for n in range(MAX_POINTS)], attitudes=[triple] * MAX_POINTS)
    track = Track(reference=points).encode()
    assert len(track) <= TOPICS["track"].request == POINTS_BYTES
    assert read(Track, track, REFERENCE).reference == points
    longest = Inject(faults=[f"command:delay={n / 7:.15f}@1.5..2.5" for n in range(64)])
    assert read(Inject, longest.encode()) == longest
    assert all(read(type(message), message.encode()) == message for message in MESSAGES)
    status = next(message for message in MESSAGES if isinstance(message, Status))
    fault = next(message for message in MESSAGES if isinstance(message, FaultStatus))
    full = status.model_copy(update={"faults": [fault] * 256, "process": "here, pid 7"}).encode()
    assert len(full) <= STATUS_BYTES
    assert read(Tenure, full, STATUS).process == "here, pid 7"


def test_only_the_first_of_many_errors_is_put_into_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Words for all of them took a second."""
    searched: list[str] = []
    monkeypatch.setattr(wording, "closest", lambda key, _: searched.append(key))
    keys = "{" + ",".join(f'"k{number}":0' for number in range(FEW)) + "}"
    with pytest.raises(IntakeError, match=r"^not a Request: unknown key k0$"):
        read(Request, keys.encode())
    assert searched == ["k0"]


def test_an_unknown_key_of_any_length_is_shown_in_part_and_nothing_like_it_is_looked_for() -> None:
    with pytest.raises(IntakeError) as refused:
        read(Request, b'{"' + b"x" * 16_000 + b'":0}')
    assert len(str(refused.value)) < 200
    assert wording.closest("x" * 200, ["x" * 201]) is None


def test_what_a_stranger_sends_cannot_move_the_terminals_cursor() -> None:
    for payload in (b'{"\\u001b[2J\\n": 0}', b'{"by": "\\u001b[2J\\n"}', b'{"by": {"\\u001b[2J\\n": 0}}'):
        with pytest.raises(IntakeError) as refused:
            read(Request, payload)
        assert str(refused.value).isprintable()
    with pytest.raises(IntakeError, match=r"reference\.kind: tag ' \[2J ' found") as refused:
        read(Track, b'{"reference": {"kind": "\\u001b[2J\\n"}}')
    assert str(refused.value).isprintable()
