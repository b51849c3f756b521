"""Access rules: on real links, each role does exactly what the table of topics says, and a stranger does nothing."""

from __future__ import annotations

from typing import Final

import pytest

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import ROLES, TOPICS, Action, RoleName, Topic
from aeroloop.protocol.transport.zenoh_config import access_control
from tests.support.certificates import Authority
from tests.support.certified_link import attempt, linked, with_marker

ACTIONS: Final[tuple[Action, ...]] = ("publish", "subscribe", "query", "answer", "hold", "watch")
KEYS: Final = [
    topics.key(topic.name, vehicle, session="s1", role=role) + cache
    for topic in TOPICS.values()
    for vehicle in ("aero", "bero")
    for role in (ROLES if "{role}" in topic.key else ("",))
    for cache in (("", topics.cache_key("")) if topic.recorded else ("",))
]
"""Of one vehicle with rules and one without; with the key of a cache below each that is published from one."""
VERBS: Final = {topics.key(topic.name, "aero") for topic in TOPICS.values() if topic.kind == "query"}
OTHER_KEYS: Final = ["t/word", "aeroloop/aero/unknown", "aeroloop/aero", "aeroloop/aero/**", "**", "aeroloop/*/stop"]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    made = Authority(tmp_path_factory.mktemp("authority"))
    for role in ROLES:
        made.issue(role, "aero")
    return made


def may(role: RoleName, action: Action, topic: Topic) -> bool:
    """Whether the table lets a role do this with a topic."""
    sending, receiving = topics.ACTIONS[topic.kind]
    return (action in sending and role in topic.senders) or (action in receiving and role in topic.receivers)


def allowed(role: RoleName, action: Action) -> set[str]:
    """Keys on which the table allows an action, written anew: what acts names its vehicle and its own role."""
    found = set()
    for key in KEYS:
        address = topics.read_key(topics.cached_key(key))
        assert address is not None
        acts = action in topics.ACTIONS[address.topic.kind][0]
        if address.vehicle == "aero" and may(role, action, address.topic):
            found |= {key} if address.role in (None, role) or not acts else set()
    return found


@pytest.mark.parametrize("way", ["listening", "connecting", "open"])
@pytest.mark.parametrize("role", ROLES)
def test_each_role_does_what_the_table_says_and_no_more(authority: Authority, role: RoleName, way: str) -> None:
    """Open: a peer of another make may send what it was not asked for. What acts is judged where it arrives."""
    guard, hand = (authority.folder / f"{name}.aero.pem" for name in ("observer", role))
    rules = with_marker(access_control("aero", loopback=False), egress_open=way == "open")
    with linked(guard, rules, hand, listening=way != "connecting") as pair:
        achieved = attempt(pair, KEYS)
        assert way == "open" or not any(attempt(pair, OTHER_KEYS).values())
    expected: dict[str, set[str]] = {"delete": set(), **{action: allowed(role, action) for action in ACTIONS}}
    if way == "open":
        achieved = {action: keys for action, keys in achieved.items() if action not in ("subscribe", "watch")}
        achieved["query"], expected["query"] = achieved["query"] & VERBS, expected["query"] & VERBS
    assert achieved == {action: expected[action] for action in achieved}


def test_a_token_bears_the_name_of_its_own_role(authority: Authority) -> None:
    """A controller's goes on after it: there may be several."""
    own, wrong = (
        [topics.key("alive", "aero", role=name) for name in names]
        for names in (("controller", "controller-4711-9f"), ("plant-4711", "controllers", "recorder", "$*-9f", "*"))
    )
    rules = with_marker(access_control("aero", loopback=False))
    with linked(authority.folder / "plant.aero.pem", rules, authority.folder / "controller.aero.pem") as pair:
        tokens = [pair.hand.liveliness().declare_token(name) for name in own + wrong]
        pair.settle()
        seen = [str(reply.ok.key_expr) for reply in pair.guard.liveliness().get("aeroloop/**") if reply.ok]
        assert sorted(seen) == sorted(own)
        for token in tokens:
            token.undeclare()


@pytest.mark.parametrize("name", ["plant/bero", "controller/bero", "operator/bero", "recorder/bero", "plant", "lab-2"])
@pytest.mark.parametrize("listening", [True, False], ids=["listening", "connecting"])
def test_another_vehicle_s_certificate_and_one_of_no_role_do_nothing(
    authority: Authority, name: str, listening: bool
) -> None:
    hand = authority.issue("stranger", file=name.replace("/", "."), cn=name)
    rules = with_marker(access_control("aero", loopback=False))
    with linked(authority.folder / "plant.aero.pem", rules, hand, listening=listening) as pair:
        assert not any(attempt(pair, KEYS + OTHER_KEYS).values())


def test_a_router_s_certificate_passes_what_any_role_may_and_no_other_vehicle_s(authority: Authority) -> None:
    """The router has checked it. What names all vehicles it may read, as any reader."""
    authority.issue("router")
    rules = with_marker(access_control("aero", loopback=False))
    with linked(authority.folder / "plant.aero.pem", rules, authority.folder / "router.pem") as pair:
        achieved = attempt(pair, KEYS)
        assert not any(attempt(pair, OTHER_KEYS).values())
    for action in ACTIONS:
        of_any = set.union(*(allowed(role, action) for role in ROLES))
        assert achieved[action] >= of_any
        assert not any("/bero/" in key for key in achieved[action])


def test_a_certificate_of_every_vehicle_has_the_rights_of_each_that_is_named(authority: Authority) -> None:
    role: RoleName = "operator"
    every, rules = authority.issue(role), with_marker(access_control("aero", "bero", loopback=False))
    keys = [key for key in KEYS if "/aero/" in key]
    others = [key.replace("/aero/", f"/{other}/") for other in ("bero", "cero") for key in keys]
    with linked(authority.folder / "plant.aero.pem", rules, every) as pair:
        achieved = attempt(pair, keys + others)
    for action in ACTIONS:
        mine = allowed(role, action)
        assert achieved[action] == mine | {key.replace("/aero/", "/bero/") for key in mine}


@pytest.mark.parametrize("free", [True, False])
def test_plain_links_on_loopback_are_free_unless_they_are_secured(authority: Authority, free: bool) -> None:
    guard, hand = authority.folder / "plant.aero.pem", authority.folder / "observer.aero.pem"
    with linked(guard, with_marker(access_control("aero", loopback=free)), hand, protocol="tcp") as pair:
        found = attempt(pair, [*KEYS, "t/word"])
    assert all(found.values()) == any(found.values()) == free
    assert found["publish"] == ({*KEYS, "t/word"} if free else set())
