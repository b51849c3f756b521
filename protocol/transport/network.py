"""Network: opens this process's Zenoh session, peer to peer, without a router or multicast.

Every process listens at the first free of `network.ports` consecutive ports from `network.rendezvous` on, and connects
to all of them. So a newcomer joins at any process that answers, and no process is needed by the others: order of start,
end or halt of any of them does not matter. Peers also learn each other's addresses by gossip and link directly.

An operator's command does not listen: it visits, and finds which processes accept a connection but do not answer.
"""

from __future__ import annotations

import json
import os
import re
import select
import socket
import stat
import struct
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import Annotated, Any, Final

import zenoh
from pydantic import AfterValidator, BaseModel, Field, field_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics

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
VISIT_S: Final = 0.5
"""How long a command waits for a process that accepts a connection to answer [s]; usual is some 10 ms."""
SETTLE_S: Final = 0.1
"""Declarations follow a new link within this time [s]; usual is a millisecond."""
POLL_S: Final = 0.005
_RETRY_MS: Final = (50, 1000)
"""First and longest pause between two attempts to connect to an endpoint [ms]."""

# A thread of Zenoh that sends to a peer behind a narrow link may block. By default a pool has one or two, which
# then carry no frames either: a recorder behind 64 kbit/s cost the session 7 times of 14, with these threads 0 of 6.
# One pool for all tasks would save a fifth of the loop's latency, but after such a link later joins cost sessions.
# Read once, at the first session of the process; `tests/benchmarks/third_parties.py` measures it.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx: (worker_threads: 8), tx: (worker_threads: 4), acc: (worker_threads: 2), net: (worker_threads: 4), "
    "app: (worker_threads: 4))",
)

_PLACE = re.compile(r"(?P<protocol>[a-z]+)/(?P<host>[^/]+):(?P<port>\d+)(?P<rest>[?#].*)?")


class NetworkError(AeroloopError):
    """The network cannot be joined; one line with the reason and what to do."""


def _endpoint(text: str) -> str:
    if text and re.fullmatch(r"[a-z][a-z0-9-]*/\S+", text) is None:
        raise ValueError("must be a Zenoh endpoint, PROTOCOL/ADDRESS:PORT such as tcp/127.0.0.1:7447")
    return text


Endpoint = Annotated[str, AfterValidator(_endpoint)]


class NetworkSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """Zenoh endpoints of this process and its peers."""

    rendezvous: list[Endpoint] = Field(
        default=["tcp/127.0.0.1:7447"],
        description="Zenoh endpoints where processes meet, one for each host; a process listens at its own host's and "
        "connects to all; [] for none",
    )
    ports: int = Field(
        default=8,
        ge=1,
        le=64,
        description="consecutive ports from each rendezvous' port on that processes meet at: any of them can be joined",
    )
    listen: list[Endpoint] = Field(
        default=[],
        description="further Zenoh endpoints this process can be reached at; port 0 is any free one",
    )
    connect: list[Endpoint] = Field(default=[], description="Zenoh endpoints to connect to besides the rendezvous")
    gossip: bool = Field(
        default=True, description="learn the addresses of further processes from linked ones, and link to them directly"
    )
    lease_ms: int = Field(default=1000, ge=100, le=60_000, description="a silent peer is disconnected after this [ms]")

    @field_validator("rendezvous", mode="before")
    @classmethod
    def _one_or_more(cls, value: object) -> object:
        return value if isinstance(value, list | tuple) else [value] if value else []

    @property
    def places(self) -> list[str]:
        """Every endpoint at which a process may be met: the rendezvous, port by port."""
        return [place for first in self.rendezvous for place in _ports(first, self.ports)]


class Visit:
    """A session of a command: it has no endpoint of its own, and links to every process that answers.

    Attributes:
        session: The session.
    """

    def __init__(self, session: zenoh.Session, places: list[str]) -> None:
        self.session = session
        self._silent = accepting(places)

    def settle(self, wait_s: float = VISIT_S) -> None:
        """Wait until every process that accepts connections is linked and has declared what it has, or for `wait_s`."""
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < SETTLE_S or (passed < wait_s and self.silent()):
            time.sleep(POLL_S)

    def silent(self) -> list[str]:
        """Endpoints at which a process accepts connections and has not answered as Zenoh so far."""
        if self._silent:
            linked = {str(link.dst) for link in self.session.info.links()}
            self._silent = [place for place in self._silent if place not in linked]
        return self._silent


def join(settings: NetworkSettings, *, listen: bool = True) -> zenoh.Session:
    """Open a session that meets the others at the rendezvous. The caller closes it.

    Args:
        settings: Where.
        listen: Whether others can connect to this process: yes for a role, no for a command that only queries.

    Raises:
        NetworkError: A `listen` endpoint cannot be opened.
    """
    places = settings.places
    for place in places if listen else []:
        if _is_free(place):
            with suppress(zenoh.ZError):  # taken in the meantime
                return _open(settings, [place, *settings.listen], [other for other in places if other != place])
    any_port = [re.sub(r":\d+$", ":0", places[0])] if listen and places and _is_own(places[0]) else []
    try:
        return _open(settings, [*settings.listen, *any_port] if listen else [], places)
    except zenoh.ZError as error:
        raise NetworkError(
            f"cannot listen on {', '.join(settings.listen)}: {_reason(error)}; "
            "give a free one with --set network.listen='[\"tcp/127.0.0.1:0\"]'"
        ) from None


@contextmanager
def visit(settings: NetworkSettings, wait_s: float = VISIT_S) -> Iterator[Visit]:
    """Open a session for a few queries that take at most `wait_s`.

    Why an attempt to connect ends earlier, and no other follows: closing a session waits for a handshake in progress.
    """
    wait_ms = round(wait_s * 1000)
    places = settings.places
    session = _open(settings, [], places, handshake_ms=wait_ms * 4 // 5, retry_ms=(2 * wait_ms, 2 * wait_ms))
    with closing(session):
        yield Visit(session, [*settings.connect, *places])


def accepting(places: list[str]) -> list[str]:
    """Those of some TCP endpoints at which a process accepts connections; the others' silence is waited for briefly."""
    attempts: dict[int, tuple[socket.socket, str]] = {}
    found = []
    for place in places:
        if (parts := _PLACE.fullmatch(place)) and parts["protocol"] == "tcp":
            attempt = socket.socket(_family(parts))
            attempt.setblocking(False)
            with suppress(OSError):
                attempt.connect_ex((parts["host"].strip("[]"), int(parts["port"])))
            attempts[attempt.fileno()] = attempt, place
    deadline = time.monotonic() + VISIT_S / 2
    waiting = select.poll()
    for number in attempts:
        waiting.register(number, select.POLLOUT)
    while attempts and (left := deadline - time.monotonic()) > 0:
        for number, _ in waiting.poll(left * 1000):
            waiting.unregister(number)
            attempt, place = attempts.pop(number)
            with suppress(OSError):
                attempt.getpeername()  # raises if it is not connected
                found.append(place)
            attempt.close()
    for attempt, _ in attempts.values():
        attempt.close()
    return found


def _open(
    settings: NetworkSettings,
    listen: list[str],
    places: list[str],
    handshake_ms: int = HANDSHAKE_MS,
    retry_ms: tuple[int, int] = _RETRY_MS,
) -> zenoh.Session:
    answered = {name: each for name, each in topics.TOPICS.items() if each.answered}
    tree: dict[str, Any] = {
        "mode": "peer",
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
                "id": f"{topic.name} {messages[0]}",
                "flows": ["ingress"],
                "messages": messages,
                "key_exprs": [topics.key(topic.name, "*")],
                "size_limit": most,
            }
            for topic in topics.TOPICS.values()
            for messages, most in ((["put", "reply"], topic.limit), (["query"], topic.request))
        ],
        # By link, whatever a message says of its sender: only a new link, with its handshake, is a new peer.
        "downsampling": [
            {
                "id": "queries",
                "flows": ["ingress"],
                "messages": ["query"],
                "rules": [{"key_expr": topics.key(name, "*"), "freq": each.per_s} for name, each in answered.items()],
            }
        ],
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": settings.gossip}},
        "transport": {
            # No use for frames of seven bytes, and a killed process leaves its files behind.
            "shared_memory": {"enabled": False},
            # Zenoh's default is 1 for most priorities: a sending thread that is blocked for 2 ms then drops frames.
            # Late frames do no harm: the receiver refuses them by their tick.
            "link": {
                "tx": {"lease": settings.lease_ms, "queue": {"size": dict.fromkeys(_QUEUES, QUEUE)}},
                "rx": {"max_message_size": topics.POINTS_BYTES + HEADER_BYTES},  # of fragments: 1 GiB by default
            },
            "unicast": {"open_timeout": handshake_ms, "accept_timeout": HANDSHAKE_MS},
        },
    }
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(tree)))
    session.info.declare_link_events_listener(lambda _: _do_not_linger(), history=True)
    return session


def _do_not_linger() -> None:
    """Make closing a TCP socket of this process return at once.

    Why: Zenoh sets SO_LINGER to 10 s. When a peer's cable is pulled, closing its link then blocks the thread that also
    carries other peers' frames until the peer acknowledges what was sent: the loop stood for 1 to 2 s.
    """
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # closed in the meantime
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            with socket.socket(fileno=os.dup(int(name))) as each:
                each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))


def _ports(first: str, ports: int) -> list[str]:
    """The endpoints of consecutive ports from an endpoint's on; itself where it has no port, as a Unix socket."""
    parts = _PLACE.fullmatch(first)
    if parts is None:
        return [first]
    head, rest = f"{parts['protocol']}/{parts['host']}", parts["rest"] or ""
    start = int(parts["port"])
    return [f"{head}:{port}{rest}" for port in range(start, min(start + ports, 1 << 16))]


def _family(parts: re.Match[str]) -> socket.AddressFamily:
    return socket.AF_INET6 if parts["host"].startswith("[") else socket.AF_INET


def _is_free(place: str) -> bool:
    """Whether this process could listen at an endpoint: it is an address of this host, and its port is free."""
    parts = _PLACE.fullmatch(place)
    if parts is None or parts["protocol"] == "udp":
        return True  # only Zenoh can find out
    address = parts["host"].strip("[]"), int(parts["port"])
    with suppress(OSError), socket.create_server(address, family=_family(parts)):
        return True
    return False


def _is_own(place: str) -> bool:
    """Whether an endpoint's address is this host's."""
    return _is_free(re.sub(r":\d+$", ":0", place))


def _reason(error: Exception) -> str:
    """Zenoh's message without the source locations it carries."""
    return str(error).split(" at /")[0].split(": [")[0].rstrip(". ")
