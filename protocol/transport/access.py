"""Access rules: which messages a session takes from each peer and sends to it, from the table of topics.

Zenoh checks every message of a link, both ways, by the common name of the peer's certificate, whichever end connected.
What no rule allows is dropped without a sign; so are messages of and to a peer of another vehicle, or of no role. A
role's own name stands in the keys it sends on. A plain link on loopback is unrestricted unless it is to be secured,
too. A router has the same rules, and every end lets a router pass what it has checked.

A rule's key must include the message's. So readers may name all vehicles in one key (`aeroloop/*/status/*`), which
brings them nothing of vehicles without rules; what acts names its vehicle.
"""

from __future__ import annotations

from itertools import product
from typing import Any, Final

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import ACTIONS, ROLES, Action, Topic
from aeroloop.protocol.transport.certificate import OF_ONE_VEHICLE, common_name

ROUTER: Final = "router"
_MESSAGES: Final[dict[Action, tuple[str, ...]]] = {
    "publish": ("put",),
    "subscribe": ("declare_subscriber",),
    "query": ("query",),
    "answer": ("declare_queryable", "reply"),
    "hold": ("liveliness_token",),
    "watch": ("liveliness_query", "declare_liveliness_subscriber"),
}
"""Zenoh's messages by action. `delete` is nobody's."""
_EVERYTHING: Final = {
    "id": "everything",
    "messages": ["delete", *(message for messages in _MESSAGES.values() for message in messages)],
    "flows": ["ingress", "egress"],
    "permission": "allow",
    "key_exprs": ["**", topics.cache_key("**")],
}


def access_control(*vehicles: str, loopback: bool = True) -> dict[str, Any]:
    """Zenoh's `access_control` for a peer or a router.

    Args:
        vehicles: Those whose peers have any rights. Every one is named, since Zenoh compares whole common names.
        loopback: Whether plain links within this host (TCP, UDP, Unix sockets) are unrestricted.
    """
    rules, subjects, policies = [], [], []
    if loopback:
        subjects += [
            {"id": "loopback", "interfaces": ["lo"], "link_protocols": ["tcp", "udp"]},
            {"id": "Unix socket", "link_protocols": ["unixsock-stream"]},
        ]
        rules.append(_EVERYTHING)
        policies.append({"rules": ["everything"], "subjects": ["loopback", "Unix socket"]})
    for role, vehicle in product((*ROLES, ROUTER), vehicles):
        name = common_name(role, vehicle)
        subjects.append({"id": name, "cert_common_names": [name] if role in OF_ONE_VEHICLE else [name, role]})
        found = _rules(role, vehicle)
        rules += found
        policies.append({"rules": [rule["id"] for rule in found], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(role: str, vehicle: str) -> list[dict[str, Any]]:
    """What a peer of a role may send (ingress) and is sent (egress): the other half of each topic."""
    rules = []
    for kind, (sending, receiving) in ACTIONS.items():
        rows = [topic for topic in topics.TOPICS.values() if topic.kind == kind]
        sent = [topic for topic in rows if role in (ROUTER, *topic.senders)]
        received = [topic for topic in rows if role in (ROUTER, *topic.receivers)]
        of_role = "*" if role == ROUTER else role
        readable = vehicle if kind == "query" else "*"
        for flow, actions, keys in (
            ("ingress", sending, _keys(sent, vehicle, of_role)),
            ("egress", receiving, _keys(sent, readable)),
            ("ingress", receiving, _keys(received, readable)),
            ("egress", sending, _keys(received, vehicle)),
        ):
            if keys:
                rules.append(
                    {
                        "id": f"{role} of {vehicle}, {kind}, {flow}: {', '.join(actions)}",
                        "messages": [message for action in actions for message in _MESSAGES[action]],
                        "flows": [flow],
                        "permission": "allow",
                        "key_exprs": keys,
                    }
                )
    return rules


def _keys(rows: list[Topic], vehicle: str, role: str = "*") -> list[str]:
    """Keys of these topics. A token's name may follow its role's: `controller-4711`."""
    keys = []
    for topic in rows:
        key = topics.key(topic.name, vehicle, role=role)
        keys.append(key)
        if topic.recorded:
            keys.append(topics.cache_key(key))
        elif topic.kind == "token" and role != "*":
            keys.append(f"{key}-$*")
    return keys
