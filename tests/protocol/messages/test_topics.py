"""Topics: every key is parsed back to its topic and fields, and no other key is."""

from __future__ import annotations

import re
import string

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.topics import NAME, RECORDED, ROLES, TOPICS, Address, Topic, key, read_key

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


def test_every_topic_has_a_name_and_a_key_of_its_own_and_is_recorded_if_it_is_published_and_no_frame() -> None:
    assert [topic.name for topic in TOPICS.values()] == list(TOPICS)
    assert len({topic.key for topic in TOPICS.values()}) == len(TOPICS)
    published = [topic.name for topic in TOPICS.values() if topic.kind not in ("query", "token")]
    assert sorted([*RECORDED, "measurement", "command"]) == sorted(published)


@every_topic
def test_a_topic_s_kind_says_what_else_it_has(topic: Topic) -> None:
    assert ("observer" in topic.receivers) == (topic.kind != "query")  # whatever is published may be observed
    if topic.kind != "query":
        assert (topic.model is not None) == (topic.kind == "json")
        # Access rules compare keys, not payloads: on a shared key a recorder could publish an event of the plant's.
        assert ("{role}" in topic.key) == (len(topic.senders) > 1)


def test_each_role_sends_what_is_its_own_and_only_ends_answer() -> None:
    presence = {"description", "status", "event", "alive"}
    assert {role: {topic.name for topic in TOPICS.values() if role in topic.senders} for role in ROLES} == {
        "plant": presence | {"measurement", "truth", "trace"},
        "controller": presence | {"claim", "release", "record", "command", "telemetry", "trace"},
        "recorder": presence | {"loss", "show"},
        "operator": {"arm", "stop", "stand_down", "recall", "show", "set_gains", "track", "inject", "advance"}
        | {"reference"},
        "observer": {"show"},
    }
    queries = [topic for topic in TOPICS.values() if topic.kind == "query"]
    assert {role: {topic.name for topic in queries if role in topic.receivers} for role in ROLES} == {
        "plant": {"claim", "release", "record", "show", "arm", "stop", "inject", "advance"},
        "controller": {"show", "set_gains", "track", "stand_down", "recall"},
        "operator": set(),
        "observer": set(),
        "recorder": set(),
    }


def test_an_unknown_topic_has_no_key() -> None:
    with pytest.raises(KeyError):
        key("references", "aero")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "aeroloop",
        "aeroloop/aero",
        "aeroloop/aero/",
        "aeroloop/aero/unknown",
        "aeroloop/aero/claim/",
        "aeroloop/aero/claim/more",
        "aeroloop/aero/claims",
        "/aeroloop/aero/claim",
        "aeroloop//claim",
        "aeroloop/aero/status",
        "aeroloop/aero/status/",
        "aeroloop/aero/status/plant/more",
        "aeroloop/aero//measurement",
        "aeroloop/aero/measurement",
        "aeroloop/aero/s1/s2/measurement",
        "aeroloop/-aero/claim",
        "aeroloop/a ero/claim",
        "aeroloop/æro/claim",
        f"aeroloop/{'a' * 65}/claim",
        "aeroloop/aero/claim\n",
        "Aeroloop/aero/claim",
        "other/aero/claim",
    ],
)
def test_a_key_that_is_not_in_the_table_is_rejected(text: str) -> None:
    assert read_key(text) is None


@given(st.text(max_size=40))
def test_reading_a_key_never_raises_and_never_invents_a_topic(text: str) -> None:
    assert read_key(text) is None
    address = read_key(f"aeroloop/aero/{text}")
    if address is not None:
        again = key(address.topic.name, address.vehicle, session=address.session or "*", role=address.role or "*")
        assert again == f"aeroloop/aero/{text}"


@pytest.mark.parametrize("name", ["aero", "Aero-2", "0", "a" * 64, "lab_1.processes"])
def test_a_vehicle_s_name_is_a_chunk_of_a_key_and_a_part_of_a_file_s_name(name: str) -> None:
    assert re.fullmatch(NAME, name)
    assert str(zenoh.KeyExpr(key("claim", name))) == f"aeroloop/{name}/claim"


@pytest.mark.parametrize("name", ["", "a/b", "*", "**", "$*", "..", ".aero", "-aero", "_aero", "a b", "a" * 65, "a\n"])
def test_what_could_not_be_a_key_or_a_file_is_no_vehicle_s_name(name: str) -> None:
    assert re.fullmatch(NAME, name) is None
