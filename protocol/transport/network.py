"""Network: opens this process's Zenoh session, peer to peer or at a router, without multicast.

Every peer listens at the first free of `network.ports` consecutive ports from `network.rendezvous` on, and connects to
all of them. So a newcomer joins at any process that answers, and no process is needed by the others: order of start,
end or halt of any of them does not matter. Peers also learn each other's addresses by gossip and link directly.

A client links to a router alone (`router.py`), does not listen, and waits until there is one.

An operator's command does not listen: it visits, and finds which processes accept a connection but do not answer.
"""

from __future__ import annotations

import json
import logging
import os
import re
import select
import socket
import stat
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from math import inf
from typing import Annotated, Any, Final, Literal, NamedTuple

import zenoh
from pydantic import AfterValidator, BaseModel, Field, field_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.access import access_control
from aeroloop.protocol.transport.certificate import Certificate
from aeroloop.protocol.transport.refusal import refusal
from aeroloop.protocol.transport.security import (
    READER,
    Identity,
    SecurityError,
    SecuritySettings,
    certificate_for,
    is_plain,
    secured,
    tls_tree,
)

log: Final = logging.getLogger("aeroloop")

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
VISIT_S: Final = 0.5
"""How long a command waits for a process that accepts a connection to answer [s]; usual is some 10 ms."""
SETTLE_S: Final = 0.1
"""Declarations follow a new link within this time [s]; usual is a millisecond."""
POLL_S: Final = 0.005
PATIENT_LEASE_MS: Final = 10_000
"""Least lease where frames have a transport of their own: a link of TCP is silent for seconds at 20 % loss [ms]."""
ROUTER_AGAIN_S: Final = 0.2
"""Pause before a client that finds no router looks again [s]."""
ROUTER_PATIENCE_S: Final = 3.0
"""After this time without a router a client logs a warning [s]: it may have started first."""
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

DATAGRAMS: Final = ("udp", "quic")
"""Protocols over UDP."""
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

    mode: Literal["peer", "client"] = Field(
        default="peer",
        description="peer: processes link to one another; client: each links to a router at the rendezvous and to "
        "nothing else, as `aeroloop router` is one",
    )
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
    transport: Literal["mixed", "tcp"] = Field(
        default="mixed",
        description="of the loop's frames beyond loopback, in real time; mixed: datagrams by QUIC, over UDP at the "
        "same ports, and what stays on TCP or TLS is compressed; tcp: the same links as everything else",
    )
    lease_ms: int = Field(
        default=1000,
        ge=100,
        le=60_000,
        description="a silent peer is disconnected after this, or 10 s if longer where `transport` is mixed [ms]",
    )
    security: SecuritySettings = Field(default=SecuritySettings(), description="certificates of this host")
    insecure: bool = Field(
        default=False,
        description="allow plain text beyond loopback: anyone on that network can then drive the vehicle",
    )
    loopback_secured: bool = Field(
        default=False, description="mutual TLS on loopback, too: the users of this host need certificates, as others do"
    )

    @field_validator("rendezvous", mode="before")
    @classmethod
    def _one_or_more(cls, value: object) -> object:
        return value if isinstance(value, list | tuple) else [value] if value else []

    @property
    def places(self) -> list[str]:
        """Every endpoint at which a process may be met: the rendezvous, port by port; by a client, the routers."""
        if self.mode == "client":
            return self.rendezvous
        return [place for first in self.rendezvous for place in _ports(first, self.ports)]

    @property
    def mixed(self) -> bool:
        """Whether each kind of traffic has a transport of its own: between peers beyond loopback, if so set."""
        return self.transport == "mixed" and self.mode == "peer" and any(map(leaves_host, self.rendezvous))

    @property
    def endpoints(self) -> list[str]:
        """Every endpoint that is connected to or listened on."""
        return [*self.places, *self.connect, *self.listen]


class Protected(NamedTuple):
    """A process's own network, with the endpoints that it opens in place of the configured ones.

    Attributes:
        settings: The network.
        certificate: Its certificate; None where no link needs one.
        vehicles: Those whose peers it takes messages of, if it has a certificate.
    """

    settings: NetworkSettings
    certificate: Certificate | None
    vehicles: tuple[str, ...] = ()


def protected(settings: NetworkSettings, identity: Identity) -> Protected:
    """Replace endpoints by those of mutual TLS where `security.secured` says so, and find this process's certificate.

    Raises:
        SecurityError: An endpoint must not be opened as configured.
        CertificateError: A certificate is needed, and this process has none that is good.
    """
    insecure, loopback = settings.insecure, settings.loopback_secured
    update = {
        name: [
            secured(each, settings.security, insecure=insecure, loopback_secured=loopback)
            for each in getattr(settings, name)
        ]
        for name in ("rendezvous", "listen", "connect")
    }
    network = settings.model_copy(update=update)
    certificate = certificate_for(network.endpoints, settings.security, identity)
    own = (identity.vehicle, certificate.vehicle) if certificate else ()
    named = [name for name in (*own, *settings.security.vehicles) if name is not None]
    if certificate and not named:
        raise SecurityError(f"{certificate.file} is good for every vehicle: name them in network.security.vehicles")
    return Protected(network, certificate, tuple(dict.fromkeys(named)))


class Visit:
    """A session of a command: it has no endpoint of its own, and links to every process that answers.

    Attributes:
        session: The session.
        certificate: Its own; None where no link needs one.
    """

    def __init__(self, session: zenoh.Session, places: list[str], certificate: Certificate | None) -> None:
        self.session = session
        self.certificate = certificate
        self._places = places
        self._silent: list[str] | None = None

    def settle(self, wait_s: float = VISIT_S) -> None:
        """Wait until every process that accepts connections is linked and has declared what it has, or for `wait_s`."""
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < SETTLE_S or (passed < wait_s and self.silent()):
            time.sleep(POLL_S)

    def silent(self) -> list[str]:
        """Endpoints at which a process accepts connections and has not answered as Zenoh so far.

        Tried are only those without a link, at the first call: after a connection that ends before its handshake,
        Zenoh's listener of TLS accepts none for 0.1 s.
        """
        if self._silent is None:
            self._silent = accepting(unlinked(self.session, self._places))
        if self._silent:
            self._silent = unlinked(self.session, self._silent)
        return self._silent


def join(settings: NetworkSettings, identity: Identity = READER, *, listen: bool = True) -> zenoh.Session:
    """Open a session that meets the others at the rendezvous. The caller closes it.

    Args:
        settings: Where.
        identity: What the process is.
        listen: Whether others can connect to this process: yes for a role, no for a command that only queries.

    Raises:
        NetworkError: A `listen` endpoint cannot be opened, or a client's settings name no router.
        SecurityError, CertificateError: Its links cannot be secured, see `protected`.
    """
    network = protected(settings, identity)
    if listen:
        warn_of_plain(network)
    if settings.mode == "client":
        return _join_router(network)
    places, further = network.settings.places, network.settings.listen
    for place in places if listen else []:
        if is_free(place):
            with suppress(zenoh.ZError):  # taken in the meantime
                return _open(network, [place, *further], [other for other in places if other != place])
    any_port = [_at_port(places[0], 0)] if listen and places and is_own(places[0]) else []
    try:
        return _open(network, [*further, *any_port] if listen else [], places)
    except zenoh.ZError as error:
        raise NetworkError(
            f"cannot listen on {', '.join(further)}: {reason(error)}; give free ones with --set network.listen="
            f"'{json.dumps([_at_port(each, 0) for each in settings.listen])}'"
        ) from None


def warn_of_plain(network: Protected) -> None:
    """Log a warning where links are plain text, because that is allowed."""
    if network.settings.insecure and (plain := [each for each in network.settings.endpoints if is_plain(each)]):
        log.warning("network.insecure: links at %s are plain text, open to anyone on that network", plain[0])


def _join_router(network: Protected) -> zenoh.Session:
    """Link to a router, as soon as one answers; Zenoh links again whenever the link is lost."""
    places = network.settings.places
    warn_at = time.monotonic() + ROUTER_PATIENCE_S
    while True:
        try:
            return _open(network, [], places)
        except zenoh.ZError:
            if not [*network.settings.connect, *places]:
                raise NetworkError('network.mode = "client" needs a router in network.rendezvous') from None
        if time.monotonic() > warn_at:
            log.warning("waiting for a router: %s", _no_router(network))
            warn_at = inf
        time.sleep(ROUTER_AGAIN_S)


def _no_router(network: Protected) -> str:
    """One line about routers that do not answer."""
    places = [*network.settings.connect, *network.settings.places]
    for place in accepting(places):
        why = refusal(place, network.certificate) if network.certificate else None
        return why or f"a process at {place} accepts connections and does not answer as a router"
    return f"no router answers at {', '.join(places)}; is `aeroloop router` running?"


@contextmanager
def visit(
    settings: NetworkSettings, wait_s: float = VISIT_S, identity: Identity = READER, *, patient: bool = False
) -> Iterator[Visit]:
    """Open a session for a few queries that take at most `wait_s`. If `patient`, a client waits for a router.

    Why an attempt to connect ends earlier, and no other follows: closing a session waits for a handshake in progress.

    Raises:
        NetworkError: It is a client's, and no router answers.
    """
    wait_ms = round(wait_s * 1000)
    network = protected(settings, identity)
    places = network.settings.places
    try:
        if patient and settings.mode == "client":
            session = _join_router(network)
        else:
            session = _open(network, [], places, handshake_ms=wait_ms * 4 // 5, retry_ms=(2 * wait_ms, 2 * wait_ms))
    except zenoh.ZError:
        raise NetworkError(_no_router(network)) from None
    with closing(session):  # a client is linked from the start
        met = [*network.settings.connect, *places] if settings.mode == "peer" else []
        yield Visit(session, met, network.certificate)


def open_session(network: Protected, *, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> zenoh.Session:
    """Open a session at these endpoints and no others. Raises zenoh.ZError."""
    at = [*listen, *connect]
    here: dict[str, Any] = {
        "rendezvous": at,
        "ports": 1,
        "listen": [],
        "connect": [],
        "gossip": False,
        "transport": "tcp",
        "mode": "peer",
    }
    here["lease_ms"] = max(network.settings.lease_ms, PATIENT_LEASE_MS)
    only = network._replace(settings=network.settings.model_copy(update=here))
    return _open(only, list(listen), list(connect))


def unlinked(session: zenoh.Session, places: list[str]) -> list[str]:
    """Those of some endpoints to which a session has no link of its own; one that the peer has made is none."""
    linked = {str(link.dst) for link in session.info.links()}
    return [place for place in places if place not in linked]


def accepting(places: list[str]) -> list[str]:
    """Those of some endpoints of TCP or TLS at which a process accepts connections; waits briefly for the others."""
    attempts: dict[int, tuple[socket.socket, str]] = {}
    found = []
    for place in places:
        if (parts := _PLACE.fullmatch(place)) and parts["protocol"] in ("tcp", "tls"):
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
    network: Protected,
    listen: list[str],
    places: list[str],
    handshake_ms: int = HANDSHAKE_MS,
    retry_ms: tuple[int, int] = _RETRY_MS,
) -> zenoh.Session:
    return open_tree(session_tree(network, network.settings.mode, listen, places, handshake_ms, retry_ms))


def session_tree(
    network: Protected,
    mode: Mode,
    listen: list[str],
    places: list[str],
    handshake_ms: int = HANDSHAKE_MS,
    retry_ms: tuple[int, int] = _RETRY_MS,
) -> dict[str, Any]:
    """Zenoh's configuration of a session that listens at some endpoints and connects to others."""
    settings, certificate, vehicles = network
    lease_ms = max(settings.lease_ms, PATIENT_LEASE_MS) if settings.mixed else settings.lease_ms
    answered = {name: each for name, each in topics.TOPICS.items() if each.answered}
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
                "id": f"{topic.name} {messages[0]}",
                "flows": ["ingress"],
                "messages": messages,
                "key_exprs": [topics.key(topic.name, "*")],
                "size_limit": most,
            }
            for topic in topics.TOPICS.values()
            for messages, most in ((["put", "reply"], topic.limit), (["query"], topic.request))
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
        rules = [{"key_expr": topics.key(name, "*"), "freq": each.per_s} for name, each in answered.items()]
        tree["downsampling"] = [{"id": "queries", "flows": ["ingress"], "messages": ["query"], "rules": rules}]
    if certificate is not None:
        tree["transport"]["link"]["tls"] = tls_tree(certificate)
        # Peers gossip addresses of any kind: none of them leads to a link that the configuration does not have.
        tree["transport"]["link"]["protocols"] = sorted({each.partition("/")[0] for each in settings.endpoints})
        tree["access_control"] = access_control(*vehicles, loopback=not settings.loopback_secured)
    return tree


def open_tree(tree: dict[str, Any]) -> zenoh.Session:
    """Open a session with a configuration of Zenoh. Raises zenoh.ZError."""
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


def leaves_host(place: str) -> bool:
    """Whether an endpoint is one of TCP or TLS beyond loopback."""
    protocol, _, address = place.partition("/")
    return protocol in ("tcp", "tls") and is_plain(f"tcp/{address}")


def _family(parts: re.Match[str]) -> socket.AddressFamily:
    return socket.AF_INET6 if parts["host"].startswith("[") else socket.AF_INET


def is_free(place: str) -> bool:
    """Whether this process could listen at an endpoint: it is an address of this host, and its port is free."""
    parts = _PLACE.fullmatch(place)
    if parts is None:
        return True  # only Zenoh can find out
    address, family = (parts["host"].strip("[]"), int(parts["port"])), _family(parts)
    with suppress(OSError):
        if parts["protocol"] in DATAGRAMS:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.bind(address)
        else:
            socket.create_server(address, family=family).close()
        return True
    return False


def is_own(place: str) -> bool:
    """Whether an endpoint's address is this host's."""
    return is_free(_at_port(place, 0))


def _at_port(endpoint: str, port: int) -> str:
    """An endpoint with another port; itself where it has none."""
    parts = _PLACE.fullmatch(endpoint)
    return endpoint if parts is None else f"{parts['protocol']}/{parts['host']}:{port}{parts['rest'] or ''}"


def reason(error: Exception) -> str:
    """Zenoh's message without the source locations it carries."""
    return str(error).split(" at /")[0].split(": [")[0].rstrip(". ")
