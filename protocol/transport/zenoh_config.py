"""Zenoh's configuration of every session: bounded queues and sizes, rates of queries, certificates, access rules.

Zenoh checks every message of a link, both ways, by the common name of the peer's certificate, whichever end connected.
What no rule allows is dropped without a sign; so are messages of and to a peer of another vehicle, or of no role. The
rules are the table of topics: which messages a session takes from each peer and sends to it. A router has the same
rules, and every end lets a router pass what it has checked. A rule's key must include the message's, so readers may
name all vehicles in one key (`aeroloop/*/status/*`); what acts names its vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from secrets import token_hex
from typing import Any, Final, Literal

from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.topics import ACTIONS, TOPICS, Action, Topic
from aeroloop.protocol.transport.certificate import AUTHORITY, OF_ONE_VEHICLE, ROLES, ROUTER, Certificate, common_name
from aeroloop.protocol.transport.history import PAGE_BYTES
from aeroloop.protocol.transport.network_settings import TLS, Endpoint, Protected

THREADS: Final = (
    "(rx: (worker_threads: 8), tx: (worker_threads: 4), acc: (worker_threads: 2), net: (worker_threads: 4), "
    "app: (worker_threads: 4))"
)
"""Zenoh's threads in a daemon, as ZENOH_RUNTIME: a thread that waits for one slow peer holds up no other."""
QUEUE: Final = 16  # batches that may wait to be sent on a link, per priority; the most that Zenoh allows
_QUEUES: Final = ("control", "real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low")
HEADER_BYTES: Final = 65_536  # more than Zenoh adds to a payload
HANDSHAKE_MS: Final = 2000  # time-out of the handshake with a program that accepts a connection and sends nothing
LEASE_MS: Final = 1000  # a silent peer is disconnected after this [ms]
PATIENT_LEASE_MS: Final = 10_000  # between hosts: at 20 % loss TCP is silent for seconds
LAST: Final = 0xFF  # rank of a session without a port of a rendezvous; Zenoh compares identifiers by their last byte
RETRY_MS: Final = (50, 500)  # first and longest pause between two attempts to connect to an endpoint


def zenoh_config(
    network: Protected,
    mode: Literal["peer", "client", "router"],
    listen: list[str],
    connect: list[str],
    handshake_ms: int = HANDSHAKE_MS,
    retry_ms: tuple[int, int] = RETRY_MS,
    rank: int = LAST,
) -> dict[str, Any]:
    """Zenoh's configuration of a session that listens at some endpoints and connects to others.

    Of two peers that learn of each other by gossip, the one of the higher rank connects.
    """
    settings, certificate, vehicles = network
    table = TOPICS.values()
    caches = {topics.cache_key(topics.key(each.name, "*")): each for each in table if each.recorded}
    limits = [(topics.key(each.name, "*"), each.limit, each.request) for each in table]
    limits += [(key, max(each.limit, PAGE_BYTES), topics.MESSAGE_BYTES) for key, each in caches.items()]
    config: dict[str, Any] = {
        "id": f"1{token_hex(14)}0{rank:02x}",
        "mode": mode,
        "listen": {"endpoints": listen, "exit_on_failure": True},
        "connect": {
            "endpoints": [*settings.connect, *connect],
            "exit_on_failure": False,
            "retry": {"period_init_ms": retry_ms[0], "period_max_ms": retry_ms[1], "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False}},  # otherwise it takes 0.5 s, whatever is linked
        # Before it is queued, parsed or stored: what waits in memory is bounded for every publisher.
        "low_pass_filter": [
            {"id": f"{key} {kinds[0]}", "flows": ["ingress"], "messages": kinds, "key_exprs": [key], "size_limit": most}
            for key, answer, request in limits
            for kinds, most in ((["put", "reply"], answer), (["query"], request))
        ],
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {"enabled": True, "autoconnect_strategy": "greater-zid"},
        },
        "transport": {
            # No use for frames of seven bytes, and a killed process leaves its files behind.
            "shared_memory": {"enabled": False},
            # Zenoh's default is 1 for most priorities: a sending thread that is blocked for 2 ms then drops frames.
            # Late frames do no harm: the receiver refuses them by their tick.
            "link": {
                "tx": {
                    "lease": PATIENT_LEASE_MS if settings.between_hosts else LEASE_MS,
                    "queue": {"size": dict.fromkeys((*_QUEUES, "background"), QUEUE)},
                },
                "rx": {"max_message_size": topics.POINTS_BYTES + HEADER_BYTES},  # of fragments: 1 GiB by default
            },
            "unicast": {
                "open_timeout": handshake_ms,
                "accept_timeout": HANDSHAKE_MS,
                "compression": {"enabled": settings.mixed},
            },
        },
    }
    if mode != "client":  # a client's one link carries the queries of all: its router limits each of them
        # By link, whatever a message says of its sender: only a new link, with its handshake, is a new peer.
        queried = {topics.key(each.name, "*"): each for each in table if each.answered} | caches
        rules = [{"key_expr": key, "freq": topics.QUERIES_PER_S} for key in queried]
        config["downsampling"] = [{"id": "queries", "flows": ["ingress"], "messages": ["query"], "rules": rules}]
    if certificate is not None:
        config["transport"]["link"]["tls"] = tls_config(certificate)
        # Peers gossip addresses of any kind: none of them leads to a link that the configuration does not have.
        protocols = {Endpoint.parse(each).protocol for each in [*settings.endpoints, *listen, *connect]}
        config["transport"]["link"]["protocols"] = sorted(protocols)
        config["access_control"] = access_control(*vehicles, loopback=not protocols <= {*TLS})
    return config


def router_config(network: Protected, by_datagrams: Sequence[str] = ()) -> dict[str, Any]:
    """Zenoh's configuration of a router, which listens at this host's rendezvous and connects to the others.

    It also listens at the endpoints of QUIC in `by_datagrams`, for operators that a flooded port of TLS keeps out.
    """
    rendezvous = network.settings.rendezvous
    here = [each for each in rendezvous if Endpoint.parse(each).is_own] or rendezvous
    others = [each for each in rendezvous if each not in here]
    config = zenoh_config(network, "router", [*here, *network.settings.listen, *by_datagrams], others)
    config["scouting"]["delay"] = 0  # otherwise it takes 0.5 s to open, whatever is linked
    config["timestamping"] = {"enabled": False}  # a router stamps messages by default: 26 bytes that nothing reads
    config["adminspace"] = {"enabled": False, "permissions": {"read": False, "write": False}}
    return config


def tls_config(certificate: Certificate) -> dict[str, Any]:
    """Zenoh's configuration at `transport/link/tls`, for links of both directions; they end with a certificate.

    Zenoh's connecting side trusts public authorities, too; none of them signs a role's common name, so such a link is
    allowed nothing.
    """
    file, key = str(certificate.file.absolute()), str(certificate.key.absolute())
    return {
        "root_ca_certificate": str(certificate.file.absolute().with_name(AUTHORITY)),
        "listen_certificate": file,
        "listen_private_key": key,
        "connect_certificate": file,
        "connect_private_key": key,
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }


# ── access rules ──

_MESSAGES: Final[dict[Action, tuple[str, ...]]] = {
    "publish": ("put",),
    "subscribe": ("declare_subscriber",),
    "query": ("query",),
    "answer": ("declare_queryable", "reply"),
    "hold": ("liveliness_token",),
    "watch": ("liveliness_query", "declare_liveliness_subscriber"),
}
"""Zenoh's messages by action. `delete` is allowed to no role."""


def access_control(*vehicles: str, loopback: bool = True) -> dict[str, Any]:
    """Zenoh's `access_control` for a peer or a router. Only peers of these `vehicles` have any rights.

    If `loopback`, plain links within this host (TCP, UDP, Unix sockets) are unrestricted.
    """
    rules, subjects, policies = [], [], []
    if loopback:
        subjects += [
            {"id": "loopback", "interfaces": ["lo"], "link_protocols": ["tcp", "udp"]},
            {"id": "Unix socket", "link_protocols": ["unixsock-stream"]},
        ]
        everything = ["delete", *(message for messages in _MESSAGES.values() for message in messages)]
        rules.append(_rule("everything", everything, ["ingress", "egress"], ["**", topics.cache_key("**")]))
        policies.append({"rules": ["everything"], "subjects": ["loopback", "Unix socket"]})
    for role, vehicle in product(ROLES, vehicles):
        name = common_name(role, vehicle)
        subjects.append({"id": name, "cert_common_names": [name] if role in OF_ONE_VEHICLE else [name, role]})
        found = _rules(role, vehicle)
        rules += found
        policies.append({"rules": [rule["id"] for rule in found], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rules(role: str, vehicle: str) -> list[dict[str, Any]]:
    """What a peer of a role may send (ingress) and is sent (egress): the other half of each topic."""
    rules = []
    for carries, (sending, receiving) in ACTIONS.items():
        rows = [topic for topic in TOPICS.values() if topic.kind == carries]
        sent = [topic for topic in rows if role in (ROUTER, *topic.senders)]
        received = [topic for topic in rows if role in (ROUTER, *topic.receivers)]
        of_role = "*" if role == ROUTER else role
        readable = vehicle if carries == "query" else "*"
        for flow, actions, keys in (
            ("ingress", sending, _keys(sent, vehicle, of_role)),
            ("egress", receiving, _keys(sent, readable)),
            ("ingress", receiving, _keys(received, readable)),
            ("egress", sending, _keys(received, vehicle)),
        ):
            if keys:
                name = f"{role} of {vehicle}, {carries}, {flow}: {', '.join(actions)}"
                messages = [message for action in actions for message in _MESSAGES[action]]
                rules.append(_rule(name, messages, [flow], keys))
    return rules


def _rule(name: str, messages: list[str], flows: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "messages": messages, "flows": flows, "permission": "allow", "key_exprs": keys}


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
