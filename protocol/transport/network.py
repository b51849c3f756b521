"""Network: opens this process's Zenoh session, peer to peer, without a router or multicast.

Every process connects to `network.rendezvous`; the first one started listens there. Peers learn each other's addresses
by gossip and link directly, so no process relays frames. When the listening process ends, the others stay linked; the
next process to start listens on the address, and the others connect to it within a fraction of a second.
"""

from __future__ import annotations

import json
import re
import time
from typing import Annotated, Any, Final

import zenoh
from pydantic import AfterValidator, BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics

_PEER_TIMEOUT_S: Final = 2.0
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
HANDSHAKE_MS: Final = 2000
"""Time-out of the handshake with a program that accepts a connection and sends nothing [ms]."""


class NetworkError(AeroloopError):
    """The network cannot be joined; one line with the reason and what to do."""


def _endpoint(text: str) -> str:
    if text and re.fullmatch(r"[a-z][a-z0-9-]*/\S+", text) is None:
        raise ValueError("must be a Zenoh endpoint, PROTOCOL/ADDRESS:PORT such as tcp/127.0.0.1:7447")
    return text


Endpoint = Annotated[str, AfterValidator(_endpoint)]


class NetworkSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """Zenoh endpoints of this process and its peers."""

    rendezvous: Endpoint = Field(
        default="tcp/127.0.0.1:7447",
        description="Zenoh endpoint every process connects to; the first one started listens there; '' for none",
    )
    listen: list[Endpoint] = Field(
        default=["tcp/127.0.0.1:0"],
        description="Zenoh endpoints this process can be reached at; port 0 is any free one",
    )
    connect: list[Endpoint] = Field(default=[], description="Zenoh endpoints to reach besides the rendezvous")
    gossip: bool = Field(
        default=True, description="learn the addresses of further processes from linked ones, and link to them directly"
    )
    lease_ms: int = Field(default=1000, ge=100, le=60_000, description="a silent peer is disconnected after this [ms]")


def _zenoh_config(settings: NetworkSettings, listen: list[str], connect: list[str]) -> zenoh.Config:
    tree: dict[str, Any] = {
        "mode": "peer",
        "listen": {"endpoints": listen, "exit_on_failure": True},
        "connect": {
            "endpoints": connect,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        # Before it is queued, parsed or stored: what waits in memory is bounded, whoever publishes.
        "low_pass_filter": [
            {
                "id": topic.name,
                "flows": ["ingress"],
                "messages": ["put", "query", "reply"],
                "key_exprs": [topics.key(topic.name, "*")],
                "size_limit": topic.limit,
            }
            for topic in topics.TOPICS.values()
        ],
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": settings.gossip}},
        "transport": {
            # No use for frames of seven bytes, and a killed process leaves its files behind.
            "shared_memory": {"enabled": False},
            # Zenoh's default is 1 for most priorities: a sending thread that is blocked for 2 ms then drops frames.
            # Late frames do no harm: the receiver refuses them by their tick.
            "link": {"tx": {"lease": settings.lease_ms, "queue": {"size": dict.fromkeys(_QUEUES, QUEUE)}}},
            "unicast": {"open_timeout": HANDSHAKE_MS, "accept_timeout": HANDSHAKE_MS},
        },
    }
    return zenoh.Config.from_json5(json.dumps(tree))


def _reason(error: Exception) -> str:
    """Zenoh's message without the source locations it carries."""
    return str(error).split(" at /")[0].split(": [")[0].rstrip(". ")


def join(settings: NetworkSettings) -> zenoh.Session:
    """Open a session at the rendezvous, as its first member or as one more. The caller closes it.

    Raises:
        NetworkError: A `listen` endpoint cannot be opened, or what holds the rendezvous is not Zenoh.
    """
    if settings.rendezvous:
        try:
            config = _zenoh_config(settings, [*settings.listen, settings.rendezvous], settings.connect)
            return zenoh.open(config)
        except zenoh.ZError:
            pass  # in use, or on another host: connect to it instead
    connect = [*settings.connect, *([settings.rendezvous] if settings.rendezvous else [])]
    try:
        session = zenoh.open(_zenoh_config(settings, settings.listen, connect))
    except zenoh.ZError as error:
        raise NetworkError(
            f"cannot listen on {', '.join(settings.listen)}: {_reason(error)}; "
            "give a free one with --set network.listen='[\"tcp/127.0.0.1:0\"]'"
        ) from None
    if settings.rendezvous and not settings.connect and not _has_peer(session):
        session.close()
        raise NetworkError(
            f"the rendezvous {settings.rendezvous} does not answer as Zenoh; its port is in use by another program, or "
            "its host is out of reach: choose another with --set network.rendezvous=tcp/127.0.0.1:PORT"
        )
    return session


def _has_peer(session: zenoh.Session) -> bool:
    deadline = time.monotonic() + _PEER_TIMEOUT_S
    while time.monotonic() < deadline:
        if session.info.peers_zid() or session.info.routers_zid():
            return True
        time.sleep(0.02)
    return False
