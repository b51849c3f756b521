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
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from math import inf
from typing import Any, Final

import zenoh

from aeroloop.protocol.transport.certificate import Certificate
from aeroloop.protocol.transport.endpoint import Endpoint, accepting
from aeroloop.protocol.transport.network_settings import NetworkError, NetworkSettings, Protected, protected
from aeroloop.protocol.transport.refusal import refusal
from aeroloop.protocol.transport.security import READER, Identity
from aeroloop.protocol.transport.session_tree import (
    HANDSHAKE_MS,
    PATIENT_LEASE_MS,
    RETRY_MS,
    open_tree,
    reason,
    session_tree,
)

log: Final = logging.getLogger("aeroloop")
VISIT_S: Final = 0.5
"""How long a command waits for a process that accepts a connection to answer [s]; usual is some 10 ms."""
SETTLE_S: Final = 0.1
"""Declarations follow a new link within this time [s]; usual is a millisecond."""
POLL_S: Final = 0.005
ROUTER_AGAIN_S: Final = 0.2
"""Pause before a client that finds no router looks again [s]."""
ROUTER_PATIENCE_S: Final = 3.0
"""After this time without a router a client logs a warning [s]: it may have started first."""


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
        if Endpoint.parse(place).is_free:
            with suppress(zenoh.ZError):  # taken in the meantime
                return _open(network, [place, *further], [other for other in places if other != place])
    first = Endpoint.parse(places[0]) if listen and places else None
    any_port = [str(first.at_port(0))] if first is not None and first.is_own else []
    try:
        return _open(network, [*further, *any_port] if listen else [], places)
    except zenoh.ZError as error:
        raise NetworkError(
            f"cannot listen on {', '.join(further)}: {reason(error)}; give free ones with --set network.listen="
            f"'{json.dumps([str(Endpoint.parse(each).at_port(0)) for each in settings.listen])}'"
        ) from None


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


def warn_of_plain(network: Protected) -> None:
    """Log a warning where links are plain text, because that is allowed."""
    plain = [each for each in network.settings.endpoints if Endpoint.parse(each).is_plain]
    if network.settings.insecure and plain:
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


def _open(
    network: Protected,
    listen: list[str],
    places: list[str],
    handshake_ms: int = HANDSHAKE_MS,
    retry_ms: tuple[int, int] = RETRY_MS,
) -> zenoh.Session:
    return open_tree(session_tree(network, network.settings.mode, listen, places, handshake_ms, retry_ms))
