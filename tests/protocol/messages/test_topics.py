"""Topics: every key is parsed back to its topic and fields, and no other key is."""

from __future__ import annotations

import string

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from aeroloop.protocol.messages.topics import TOPICS, Address, Topic, key, read_key

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


@given(st.text(max_size=40))
def test_reading_a_key_never_raises_and_never_invents_a_topic(text: str) -> None:
    assert read_key(text) is None
    address = read_key(f"aeroloop/aero/{text}")
    if address is not None:
        again = key(address.topic.name, address.vehicle, session=address.session or "*", role=address.role or "*")
        assert again == f"aeroloop/aero/{text}"
