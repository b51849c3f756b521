"""A process's place on the Zenoh network: peers, joined at a rendezvous, without a router or multicast.

The rendezvous is an address that everyone knows. Whoever comes first listens there; the others connect, learn of each
other by gossip and link directly, so that nobody is needed to pass frames on. When its holder goes, the rest stay
linked, and the next process to come takes the address, where the rest find it within a fraction of a second.
"""

from __future__ import annotations

import json
import time
from typing import Any, Final

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from aeroloop.protocol.errors import AeroloopError

_PATIENCE_S: Final = 2.0
QUEUE: Final = 16
"""Batches that may wait to be sent on a link, of each priority; the most that Zenoh allows."""
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
"""A program that holds a port and says nothing is given up after this [ms]."""


class NetworkError(AeroloopError):
    """The network cannot be joined; one line that says why and what to do."""


class NetworkSettings(BaseModel):
    """Where this process meets the others."""

    model_config = ConfigDict(extra="forbid")

    rendezvous: str = Field(
        default="tcp/127.0.0.1:7447",
        description="Zenoh endpoint where everyone meets; listened on by whoever comes first; '' for none",
    )
    listen: list[str] = Field(
        default=["tcp/127.0.0.1:0"],
        description="Zenoh endpoints this process can be reached at; port 0 is any free one",
    )
    connect: list[str] = Field(default=[], description="Zenoh endpoints to reach besides the rendezvous")
    gossip: bool = Field(
        default=True, description="learn of further processes from those one is linked to, and link to them directly"
    )
    lease_ms: int = Field(default=1000, ge=100, le=60_000, description="a silent peer is given up after this [ms]")


def _zenoh_config(settings: NetworkSettings, listen: list[str], connect: list[str]) -> zenoh.Config:
    tree: dict[str, Any] = {
        "mode": "peer",
        "listen": {"endpoints": listen, "exit_on_failure": True},
        "connect": {
            "endpoints": connect,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": settings.gossip}},
        "transport": {
            # Useless at seven bytes, and it leaves files behind when a process is killed.
            "shared_memory": {"enabled": False},
            # Zenoh's own lengths are 1 for most priorities: a sending thread kept waiting for 2 ms then drops frames.
            # What comes late is refused where it matters, by the tick that it answers.
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
            pass  # held by somebody, or in another host's hands: connect to it instead
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
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        if session.info.peers_zid() or session.info.routers_zid():
            return True
        time.sleep(0.02)
    return False
