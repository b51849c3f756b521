"""Access rules: on real links, each role does exactly what the table of topics says, and a stranger does nothing."""

from __future__ import annotations

from typing import Final

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import ROLES, TOPICS, Action, RoleName, Topic
from aeroloop.protocol.transport.access import access_control
from tests.support.certificates import Authority
from tests.support.certified_link import attempt, linked, with_marker

ACTIONS: Final[tuple[Action, ...]] = ("publish", "subscribe", "query", "answer", "hold", "watch")
KEYS: Final = [
    topics.key(topic.name, vehicle, session="s1", role=role) + cache
    for topic in TOPICS.values()
    for vehicle in ("aero", "bero")
    for role in (ROLES if "{role}" in topic.key else ("",))
    for cache in (("", "/@adv/pub/a1/2/_") if topic.recorded else ("",))
]
"""Of one vehicle with rules and one without; with the key of a cache below each that is published from one."""
VERBS: Final = {topics.key(topic.name, "aero") for topic in TOPICS.values() if topic.carries == "query"}
OTHER_KEYS: Final = ["t/word", "aeroloop/aero/unknown", "aeroloop/aero", "aeroloop/aero/**", "**", "aeroloop/*/stop"]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    made = Authority(tmp_path_factory.mktemp("authority"))
    for role in ROLES:
        made.issue(role, "aero")
    return made


def may(role: RoleName, action: Action, topic: Topic) -> bool:
    """Whether the table lets a role do this with a topic."""
    sending, receiving = topics.ACTIONS[topic.carries]
    return (action in sending and role in topic.senders) or (action in receiving and role in topic.receivers)


def allowed(role: RoleName, action: Action) -> set[str]:
    """Keys on which the table allows an action, written anew: what acts names its vehicle and its own role."""
    found = set()
    for key in KEYS:
        address = topics.read_key(key.partition("/@adv")[0])
        assert address is not None
        acts = action in topics.ACTIONS[address.topic.carries][0]
        if address.vehicle == "aero" and may(role, action, address.topic):
            found |= {key} if address.role in (None, role) or not acts else set()
    return found


@pytest.mark.parametrize("listening", [True, False], ids=["listening", "connecting"])
@pytest.mark.parametrize("role", ROLES)
def test_each_role_does_what_the_table_says_and_no_more(authority: Authority, role: RoleName, listening: bool) -> None:
    guard, hand = (authority.folder / f"{name}.aero.pem" for name in ("observer", role))
    with linked(guard, with_marker(access_control("aero", loopback=False)), hand, listening=listening) as pair:
        assert attempt(pair, KEYS) == {action: allowed(role, action) for action in ACTIONS} | {"delete": set()}
        assert not any(attempt(pair, OTHER_KEYS).values())


@pytest.mark.parametrize("role", ROLES)
def test_what_acts_is_judged_where_it_arrives(authority: Authority, role: RoleName) -> None:
    """A peer of another make may send what it was not asked for: rules of what is sent to it must not be needed."""
    guard, hand = (authority.folder / f"{name}.aero.pem" for name in ("observer", role))
    rules = with_marker(access_control("aero", loopback=False), egress_open=True)
    with linked(guard, rules, hand) as pair:
        achieved = attempt(pair, KEYS)
    for action in ("publish", "answer", "hold"):
        assert achieved[action] == allowed(role, action)
    assert achieved["query"] & VERBS == allowed(role, "query") & VERBS
    assert achieved["delete"] == set()
