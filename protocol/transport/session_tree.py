"""Zenoh's configuration of every session: bounded queues and sizes, rates of queries, certificates, access rules."""

from __future__ import annotations

import json
from typing import Any, Final, Literal

import zenoh

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.access import access_control
from aeroloop.protocol.transport.endpoint import Endpoint
from aeroloop.protocol.transport.history import PAGE_BYTES
from aeroloop.protocol.transport.network_settings import Protected
from aeroloop.protocol.transport.security import tls_tree

Mode = Literal["peer", "client", "router"]
QUEUE: Final = 16
"""Batches that may wait to be sent on a link, per priority; the most that Zenoh allows."""
_QUEUES: Final = (
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
)
HEADER_BYTES: Final = 65_536
"""More than Zenoh adds to a payload: the key, and what goes with it."""
HANDSHAKE_MS: Final = 2000
"""Time-out of the handshake with a program that accepts a connection and sends nothing [ms]."""
PATIENT_LEASE_MS: Final = 10_000
"""Least lease where frames have a transport of their own: a link of TCP is silent for seconds at 20 % loss [ms]."""
RETRY_MS: Final = (50, 1000)
"""First and longest pause between two attempts to connect to an endpoint [ms]."""

THREADS: Final = (
    "(rx: (worker_threads: 8), tx: (worker_threads: 4), acc: (worker_threads: 2), net: (worker_threads: 4), "
    "app: (worker_threads: 4))"
)
"""Zenoh's threads in a daemon, as ZENOH_RUNTIME: a thread that waits for one slow peer holds up no other."""


def session_tree(
    network: Protected,
    mode: Mode,
    listen: list[str],
    places: list[str],
    handshake_ms: int = HANDSHAKE_MS,
    retry_ms: tuple[int, int] = RETRY_MS,
) -> dict[str, Any]:
    """Zenoh's configuration of a session that listens at some endpoints and connects to others."""
    settings, certificate, vehicles = network
    lease_ms = max(settings.lease_ms, PATIENT_LEASE_MS) if settings.mixed else settings.lease_ms
    table = topics.TOPICS.values()
    caches = {topics.cache_key(topics.key(each.name, "*")): each for each in table if each.recorded}
    limits = [(topics.key(each.name, "*"), each.limit, each.request) for each in table]
    limits += [(key, max(each.limit, PAGE_BYTES), topics.MESSAGE_BYTES) for key, each in caches.items()]
    tree: dict[str, Any] = {
        "mode": mode,
        "listen": {"endpoints": listen, "exit_on_failure": True},
        "connect": {
            "endpoints": [*settings.connect, *places],
            "exit_on_failure": False,
            "retry": {"period_init_ms": retry_ms[0], "period_max_ms": retry_ms[1], "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False}},  # otherwise it takes 0.5 s, whatever is linked
        # Before it is queued, parsed or stored: what waits in memory is bounded for every publisher.
        "low_pass_filter": [
            {
                "id": f"{key} {messages[0]}",
                "flows": ["ingress"],
                "messages": messages,
                "key_exprs": [key],
                "size_limit": most,
            }
            for key, answer, request in limits
            for messages, most in ((["put", "reply"], answer), (["query"], request))
        ],
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": settings.gossip}},
        "transport": {
            # No use for frames of seven bytes, and a killed process leaves its files behind.
            "shared_memory": {"enabled": False},
            # Zenoh's default is 1 for most priorities: a sending thread that is blocked for 2 ms then drops frames.
            # Late frames do no harm: the receiver refuses them by their tick.
            "link": {
                "tx": {"lease": lease_ms, "queue": {"size": dict.fromkeys(_QUEUES, QUEUE)}},
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
        tree["downsampling"] = [{"id": "queries", "flows": ["ingress"], "messages": ["query"], "rules": rules}]
    if certificate is not None:
        tree["transport"]["link"]["tls"] = tls_tree(certificate)
        # Peers gossip addresses of any kind: none of them leads to a link that the configuration does not have.
        tree["transport"]["link"]["protocols"] = sorted({Endpoint.parse(each).protocol for each in settings.endpoints})
        tree["access_control"] = access_control(*vehicles, loopback=not settings.loopback_secured)
    return tree


def open_tree(tree: dict[str, Any]) -> zenoh.Session:
    """Open a session with a configuration of Zenoh. Raises zenoh.ZError."""
    return zenoh.open(zenoh.Config.from_json5(json.dumps(tree)))


def reason(error: Exception) -> str:
    """Zenoh's message without the source locations it carries."""
    return str(error).split(" at /")[0].split(": [")[0].rstrip(". ")
