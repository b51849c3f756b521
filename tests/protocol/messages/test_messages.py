"""Messages, their keys, and the states that they report: round trips, bounds of every field, bounded work."""

from __future__ import annotations

import json
import string
from math import inf, nan
from random import Random
from typing import Any

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from aeroloop.protocol.messages.models import Claim, FaultStatus, Status
from aeroloop.protocol.messages.operator import (
    MAX_GAINS,
    MAX_POINTS,
    Gains,
    Hold,
    Inject,
    Mark,
    Message,
    MessageError,
    Points,
    Request,
    Setpoint,
    Sinusoid,
    Track,
)
from aeroloop.protocol.messages.states import (
    CONTROLLER_TABLE,
    PLANT_TABLE,
    ControllerState,
    ControllerTrigger,
    Machine,
    PlantState,
    PlantTrigger,
)
from aeroloop.protocol.messages.topics import POINTS_BYTES, STATUS_BYTES, TOPICS, Address, Topic, key, read_key
from tests.support.every_message import MESSAGES
from tests.support.hostile import mutated

MODELS = sorted({type(message) for message in MESSAGES}, key=lambda model: model.__name__)

every_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)


def test_every_kind_of_message_is_tried_here() -> None:
    assert {type(message) for message in MESSAGES} == set(Message.__subclasses__())


@every_message
def test_a_message_survives_json_lacks_nothing_and_cannot_be_changed(message: Message) -> None:
    model, tree = type(message), json.loads(message.encode())
    again = model.decode(message.encode())
    assert again == message
    assert again.encode() == message.encode()
    for name, field in model.model_fields.items():
        with pytest.raises(ValidationError, match="frozen"):
            setattr(message, name, getattr(message, name))
        if field.is_required():
            with pytest.raises(MessageError, match=name):
                model.decode(json.dumps({key: value for key, value in tree.items() if key != name}).encode())
    if model is not Gains:  # the running law refuses those that it does not have
        with pytest.raises(MessageError, match="surprise"):
            model.decode(json.dumps({**tree, "surprise": 1}).encode())


# Whatever comes is the message or one short line


@every_message
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
    status = next(message for message in MESSAGES if isinstance(message, Status))
    newer = status.encode()[:-1] + b',"mood":{"good":true}}'
    assert Status.decode(newer, extra="ignore") == status
    with pytest.raises(MessageError, match="mood"):
        Status.decode(newer)


def test_what_a_stranger_sends_cannot_move_the_terminals_cursor() -> None:
    for model, payload in (
        (Request, b'{"\\u001b[2J\\n": 0}'),
        (Mark, b'{"text": {"\\u001b[2J\\n": 0}}'),
        (Track, b'{"reference": {"kind": "\\u001b[2J\\n"}}'),
    ):
        with pytest.raises(MessageError) as refused:
            model.decode(payload)
        assert str(refused.value).isprintable()


# Bounds of fields

TWO = [(0.0, 0.0, 0.0)] * 2
CLAIM = {"controller": "c", "session": "s", "period_ns": 1, "lockstep": False, "wire": {}}
NUMBER = "Input should be a finite number"


@pytest.mark.parametrize(
    ("model", "fields", "expected"),
    [
        (Claim, {**CLAIM, "controller": "a/b"}, "controller: String should match pattern"),
        (Claim, {**CLAIM, "session": "s*"}, "session: String should match pattern"),
        (Claim, {**CLAIM, "session": "status"}, "session: 'status' is the key of a topic and cannot name a session"),
        (Gains, {"C1": (nan, 0.3, 0.3)}, f"C1: {NUMBER}"),
        (Gains, {"C1": (0.3,) * (MAX_GAINS + 1)}, f"C1: Tuple should have at most {MAX_GAINS} items"),
        (Gains, {f"K{i}": 0.3 for i in range(MAX_GAINS + 1)}, f"Gains: a law has {MAX_GAINS} gains at the most"),
        (Points, {"times": [0, 1, 2], "attitudes": TWO}, "Points: 3 times for 2 attitudes"),
        (Points, {"times": [1, 2], "attitudes": TWO}, "Points: the first time must be 0"),
        (Points, {"times": [0, nan], "attitudes": TWO}, f"times: {NUMBER}"),
        (Points, {"times": [0, 0.0009], "attitudes": TWO}, "Points: times must rise by at least a millisecond"),
        (Points, {"times": [0, 1], "attitudes": [TWO[0], (0, nan, 0)]}, f"attitudes: {NUMBER}"),
        (Points, {"times": range(MAX_POINTS + 1), "attitudes": TWO}, f"times: List should have at most {MAX_POINTS}"),
        (Hold, {"attitude": (0.0, inf, 0.0)}, f"attitude: {NUMBER}"),
        (Setpoint, {"attitude": (0.0, nan, 0.0)}, f"attitude: {NUMBER}"),
        (Sinusoid, {"amplitude": (0.0, nan, 0.0)}, f"amplitude: {NUMBER}"),
        (Sinusoid, {"frequency": (0.0, inf, 0.0)}, "frequency: Input should be less than or equal to 100"),
        (Track, {"reference": Hold(), "within_s": 0.0}, "within_s: Input should be greater than or equal to 0.02"),
        (Mark, {"text": "a" * 201}, "text: String should have at most 200 characters"),
        (Mark, {"text": "\x1b[2J"}, "text: every character must be printable"),
    ],
)
def test_a_verb_that_makes_no_sense_is_refused_with_one_clear_message(
    model: type[Message], fields: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ValidationError) as refused:
        model.model_validate(fields)
    error, *_ = refused.value.errors()
    said = f"{error['loc'][0] if error['loc'] else model.__name__}: {error['msg'].removeprefix('Value error, ')}"
    assert said.startswith(expected)


# ── topics: every key is parsed back to its topic and fields, and no other key is ──


every_topic = pytest.mark.parametrize("topic", TOPICS.values(), ids=list(TOPICS))

LETTERS = string.ascii_letters + string.digits
vehicles = st.builds(str.__add__, st.sampled_from(LETTERS), st.text(LETTERS + "_.-", max_size=63))
chunks = st.text("0123456789abcdef", min_size=8, max_size=32)
"""Sessions and roles. A session called like a topic ("status") would be read as one; none is made."""


@every_topic
@settings(max_examples=25)
@given(vehicle=vehicles, session=chunks, role=chunks)
def test_a_key_is_read_back_as_what_it_was_made_from(topic: Topic, vehicle: str, session: str, role: str) -> None:
    text = key(topic.name, vehicle, session=session, role=role)
    of_session = session if "{session}" in topic.key else None
    of_role = role if "{role}" in topic.key else None
    assert text.startswith(f"aeroloop/{vehicle}/")
    assert read_key(text) == Address(topic, vehicle, of_session, of_role)


@every_topic
def test_what_is_left_out_of_a_key_is_a_wildcard_and_others_have_other_keys(topic: Topic) -> None:
    pattern, mine = zenoh.KeyExpr(key(topic.name, "aero")), key(topic.name, "aero", session="s1", role="plant")
    assert pattern.includes(zenoh.KeyExpr(mine))
    assert not pattern.intersects(zenoh.KeyExpr(key(topic.name, "other", session="s1", role="plant")))
    assert (mine == key(topic.name, "aero", session="s2", role="recorder")) == ("{" not in topic.key)


@every_topic
def test_a_topic_s_kind_says_what_else_it_has(topic: Topic) -> None:
    assert ("observer" in topic.receivers) == (topic.kind != "query")  # whatever is published may be observed
    if topic.kind != "query":
        assert (topic.model is not None) == (topic.kind == "json")
        # Access rules compare keys, not payloads: on a shared key a recorder could publish an event of the plant's.
        assert ("{role}" in topic.key) == (len(topic.senders) > 1)


@pytest.mark.parametrize("more", ["/x", "x", "\n", "/@cache"])
def test_a_key_with_something_after_it_is_another_key(more: str) -> None:
    assert read_key("aeroloop/aero/telemetry") is not None
    assert read_key(f"aeroloop/aero/telemetry{more}") is None


@given(st.text(max_size=40))
def test_reading_a_key_never_raises_and_never_invents_a_topic(text: str) -> None:
    assert read_key(text) is None
    address = read_key(f"aeroloop/aero/{text}")
    if address is not None:
        again = key(address.topic.name, address.vehicle, session=address.session or "*", role=address.role or "*")
        assert again == f"aeroloop/aero/{text}"


# ── state tables of both ends, SPEC.md, sections 5 and 6 ──


def reached(start: ControllerState, without: ControllerTrigger | None = None) -> set[ControllerState]:
    """Every state of a controller that can be reached, the first included, without one of the triggers."""
    found, fresh = {start}, {start}
    while fresh:
        edges = CONTROLLER_TABLE.items()
        fresh = {after for (state, trigger), after in edges if state in fresh and trigger is not without} - found
        found |= fresh
    return found


def test_any_plant_can_be_tripped_only_arming_clears_it_and_only_a_granted_one_is_driven() -> None:
    edges = PLANT_TABLE.items()
    assert {state for (state, trigger), after in edges if trigger is PlantTrigger.TRIP} == set(PlantState)
    assert {after for (_, trigger), after in edges if trigger is PlantTrigger.TRIP} == {PlantState.TRIPPED}
    out = {trigger for (state, trigger), after in edges if state is PlantState.TRIPPED is not after}
    assert out == {PlantTrigger.ARM}
    into = {goal: {edge for edge, after in edges if after is goal} for goal in (PlantState.GRANTED, PlantState.DRIVEN)}
    assert into == {
        PlantState.GRANTED: {(PlantState.IDLE, PlantTrigger.GRANT)},
        PlantState.DRIVEN: {(state, PlantTrigger.COMMAND) for state in (PlantState.GRANTED, PlantState.DRIVEN)},
    }


def test_a_controller_stands_down_from_any_state_and_has_a_vehicle_only_by_a_grant() -> None:
    aside = {ControllerState.HOLDING, ControllerState.FAULTED}
    driving = {ControllerState.CLAIMED, ControllerState.READY, ControllerState.RUNNING}
    for state in ControllerState:
        assert CONTROLLER_TABLE[state, ControllerTrigger.STAND_DOWN] is ControllerState.HOLDING
        assert reached(state) == set(ControllerState)  # none is without a way back
    for state in aside:
        assert reached(state, without=ControllerTrigger.RECALL) <= aside
        assert CONTROLLER_TABLE[state, ControllerTrigger.RECALL] is ControllerState.SEARCHING
    assert not reached(ControllerState.SEARCHING, without=ControllerTrigger.GRANT) & driving


def test_a_trigger_that_the_table_does_not_have_is_refused_and_changes_nothing() -> None:
    machine = Machine(PlantState.IDLE, PLANT_TABLE)
    with pytest.raises(KeyError, match=r"idle.*command"):
        machine.fire(PlantTrigger.COMMAND)
    assert machine.state is PlantState.IDLE
