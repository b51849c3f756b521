"""Network: opens Zenoh's sessions of this process, peer to peer or at a router, without multicast.

Every peer listens at the first free of `PORTS` consecutive ports from a rendezvous on, and connects to those below, as
those above connect to it, and to all of other rendezvous. So a newcomer joins at any process that answers, and none is
needed by the others. Why not all to all: a process that is halted for longer than the lease, and connects as it goes
on, adds that link to its session with a peer that has ended the session; neither would get what the other has declared.
The end of a pair that connects does so once its own session has ended, and the other end accepts no second link.
"""

from __future__ import annotations

import json
import logging
import socket
import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from math import inf
from typing import Any, Final

import zenoh

from aeroloop.protocol.transport.certificate import AUTHORITY, Certificate
from aeroloop.protocol.transport.network_settings import (
    PORTS,
    READER,
    STREAMS,
    TLS,
    Endpoint,
    Identity,
    NetworkError,
    NetworkSettings,
    Protected,
    protected,
)
from aeroloop.protocol.transport.zenoh_config import PATIENT_LEASE_MS, router_config, zenoh_config

log: Final = logging.getLogger("aeroloop")
COMMAND_S: Final = 0.5  # how long a command waits for a process that accepts a connection to answer; usual is 10 ms
DECLARED_S: Final = 0.1  # declarations follow a new link within this time; usual is a millisecond
ACCEPT_S: Final = 0.25  # how long `accepting` waits for a connection
HANDSHAKE_S: Final = 0.5  # how long a command waits for a message of a TLS handshake; usual is a millisecond
PLAIN_S: Final = 3.0  # the same for a peer of Zenoh without TLS, which hangs up after 2 s; a halted process does not
POLL_S: Final = 0.005
ROUTER_AGAIN_S: Final = 0.2  # pause before a client that finds no router looks again
ROUTER_PATIENCE_S: Final = 3.0  # a client logs a warning after this time without a router: it may have started first


class NoRouterError(NetworkError):
    """No router answers a command; one line. `is_deserted` is whether every router's endpoint refuses connections."""

    def __init__(self, network: Protected) -> None:
        probed = probe([*network.settings.connect, *network.settings.rendezvous])
        super().__init__(_no_router(network, probed))
        self.is_deserted = all(accepts is False for accepts in probed.values())


def join(settings: NetworkSettings, identity: Identity = READER, *, listen: bool = True) -> zenoh.Session:
    """Open a session that meets the others at the rendezvous, or at a router as soon as one answers. Close it.

    `listen` is whether others can connect to it: yes for a role, no for a command that only queries. Raises
    NetworkError if an endpoint cannot be opened as configured, CertificateError for want of a good certificate.
    """
    network = protected(settings, identity)
    if listen:
        _warn_of_plain(network)
    if settings.mode == "client":
        return _join_router(network)
    meeting, further = network.settings.rendezvous_endpoints, network.settings.listen
    for first in network.settings.rendezvous if listen else []:
        ports = [str(each) for each in Endpoint.parse(first).ports(PORTS)]
        for rank, each in enumerate(ports):
            if Endpoint.parse(each).is_free:
                others = [one for one in meeting if one not in ports[rank:]]
                with suppress(zenoh.ZError):  # taken in the meantime
                    return _open(zenoh_config(network, "peer", [each, *further], others, rank=rank))
    any_port = [str(first.at_port(0)) for first in map(Endpoint.parse, meeting[:1]) if first.is_own]
    try:
        return _open(zenoh_config(network, "peer", [*further, *any_port] if listen else [], meeting))
    except zenoh.ZError as error:
        free = json.dumps([str(Endpoint.parse(each).at_port(0)) for each in settings.listen])
        problem = f"cannot listen on {', '.join(further)}: {_reason(error)}"
        raise NetworkError(f"{problem}; give free ones with --set network.listen='{free}'") from None


def route(settings: NetworkSettings, identity: Identity) -> zenoh.Session:
    """Open a router's session, which passes on what its clients publish and query. Closing and errors as of `join`."""
    network = protected(settings, identity)
    _warn_of_plain(network)
    config = router_config(network, _free_datagram_endpoints(network.settings))
    try:
        return _open(config)
    except zenoh.ZError as error:
        problem = f"cannot listen on {', '.join(config['listen']['endpoints']) or 'nothing'}: {_reason(error)}"
        remedy = "name a free endpoint of this host in network.rendezvous or network.listen"
        raise NetworkError(f"{problem}; {remedy}") from None


class CommandSession:
    """A command's session: it does not listen, and links to every process that answers. `certificate` is its own.

    `vehicles` are all that it can reach, where every link needs a certificate; empty where that is unknown.
    """

    def __init__(self, session: zenoh.Session, network: Protected) -> None:
        settings = network.settings
        self.session = session
        self.certificate = network.certificate
        only_tls = all(Endpoint.parse(text).protocol in TLS for text in settings.endpoints)
        self.vehicles = network.vehicles if only_tls else ()
        self._network = network
        self._endpoints: list[str] = []
        if settings.mode == "peer":  # a client is linked from the start
            self._endpoints = [*settings.connect, *settings.rendezvous_endpoints]
        self._probed: dict[str, bool | None] | None = None

    def anew(self) -> CommandSession:
        """The same session, for another command: which endpoints accept connections is found out again."""
        return CommandSession(self.session, self._network)

    def wait_for_links(self, wait_s: float = COMMAND_S) -> None:
        """Wait until every process that accepts connections is linked and has declared what it has, or for `wait_s`."""
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < DECLARED_S or (passed < wait_s and self.unanswered()):
            time.sleep(POLL_S)

    def unanswered(self) -> list[str]:
        """Endpoints at which a process accepts connections and has not answered as Zenoh so far.

        Each without a link is tried once: after a try Zenoh's listener of TLS accepts no connection for 0.1 s.
        """
        if self._probed is None:
            self._probed = probe(self._unlinked(self._endpoints))
        return self._unlinked([text for text, accepts in self._probed.items() if accepts])

    @property
    def is_deserted(self) -> bool:
        """Whether there is no process to wait for: there is no link, and every endpoint refuses connections.

        False before `unanswered` has tried them.
        """
        is_refused = self._probed is not None and all(accepts is False for accepts in self._probed.values())
        return is_refused and not self.session.info.links()

    def _unlinked(self, endpoints: list[str]) -> list[str]:
        """Those of some endpoints without a link of this session's own; one that the peer has made is none."""
        linked = {str(link.dst) for link in self.session.info.links()}
        return [each for each in endpoints if each not in linked]


@contextmanager
def command_session(
    settings: NetworkSettings,
    wait_s: float = COMMAND_S,
    identity: Identity = READER,
    *,
    patient: bool = False,
    by_datagrams: bool = False,
) -> Iterator[CommandSession]:
    """Open a session for a few queries that take at most `wait_s`. If `patient`, a client waits for a router.

    With `by_datagrams` it also links by QUIC, to the sessions of frames (`FrameSession`), where plants answer `stop`; a
    client does so if no router answers by TLS. Errors are those of `join`, and NoRouterError if it is a client's and no
    router answers.
    """
    wait_ms = round(wait_s * 1000)  # of one attempt to connect, as closing a session waits for a handshake in progress
    network = protected(settings, identity)
    meeting = network.settings.rendezvous_endpoints
    if by_datagrams:
        meeting = [*meeting, *_datagram_endpoints(network.settings)]
    try:
        if patient and settings.mode == "client":
            session = _join_router(network)
        else:
            retry_ms = (2 * wait_ms, 2 * wait_ms)
            session = _open(zenoh_config(network, settings.mode, [], meeting, wait_ms * 4 // 5, retry_ms))
    except zenoh.ZError:
        raise NoRouterError(network) from None
    with closing(session):
        yield CommandSession(session, network)


@contextmanager
def joined_session(settings: NetworkSettings, identity: Identity = READER) -> Iterator[CommandSession]:
    """A session as of `join`, for as long as its owner lives, that does not listen and sends commands, too."""
    network = protected(settings, identity)
    with closing(join(settings, identity, listen=False)) as session:
        yield CommandSession(session, network)


class FrameSession:
    """A second session of a loop's two ends, which carries their frames over UDP; none on loopback, or if not set.

    Over TCP, and so over TLS, one lost packet holds back all that follow for 0.2 s and more, in which the plant's
    watchdog trips. So between hosts frames are datagrams of a QUIC connection, whose stream has what Zenoh
    declares: it would get lost with UDP as the first link of one session for all.

    The plant listens at the first free port of its host's endpoints, by UDP, and names the `endpoint` in its status.
    The controller connects to it before it claims; without such a link its frames stay on the first session. A plant
    answers `stop` there, too: a flood of TCP connections keeps no operator from it.
    """

    LINK_S = 5.0  # how long claims wait for the link to a plant: a handshake takes 0.02 s, and up to 4 s at 20 % loss

    def __init__(self, settings: NetworkSettings, identity: Identity) -> None:
        self._network = protected(settings, identity)
        self._endpoints = _datagram_endpoints(self._network.settings)
        self._deadline = 0.0
        self.session: zenoh.Session | None = None
        self.endpoint = ""

    @property
    def wanted(self) -> bool:
        """Whether frames are to travel by datagrams."""
        return self._network.settings.mixed

    @property
    def linked(self) -> bool:
        """Whether there is a link to a peer now."""
        return self.session is not None and bool(self.session.info.peers_zid())

    def listen(self) -> None:
        """Listen at the first free one of this host's endpoints, if datagrams are wanted; `endpoint` then names it."""
        for each in _free_datagram_endpoints(self._network.settings) if self.wanted else []:
            with suppress(zenoh.ZError):  # taken in the meantime
                self.session, self.endpoint = self._open(listen=[each]), each
                return

    def connect(self, endpoint: str) -> bool | None:
        """Connect to a plant's endpoint; whether there is a link. None while that is not decided, for up to `LINK_S`.

        An endpoint that is not among the network's own is refused: a status from elsewhere leads nowhere.
        """
        if endpoint not in self._endpoints:
            return False
        if endpoint != self.endpoint or self.session is None:
            self.close()
            self.session, self.endpoint = self._open(connect=[endpoint]), endpoint
            self._deadline = time.monotonic() + self.LINK_S
        soon = min(time.monotonic() + 0.2, self._deadline)
        while not self.linked and time.monotonic() < soon:
            time.sleep(POLL_S)
        return self.linked or (None if time.monotonic() < self._deadline else False)

    def close(self) -> None:
        """Close the session, if there is one."""
        if self.session is not None:
            self.session.close()
            self.session = None

    def _open(self, *, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> zenoh.Session:
        """Open a session at these endpoints and no others, and without compression. Raises zenoh.ZError."""
        only = {"rendezvous": [*listen, *connect], "listen": [], "connect": [], "transport": "tcp"}
        network = self._network._replace(settings=self._network.settings.model_copy(update=only))
        config = zenoh_config(network, "peer", list(listen), list(connect))
        config["scouting"]["gossip"]["enabled"] = False
        config["transport"]["link"]["tx"]["lease"] = PATIENT_LEASE_MS
        return _open(config)


def _free_datagram_endpoints(settings: NetworkSettings) -> list[str]:
    """Those endpoints of datagrams at which this process could listen."""
    return [text for text in _datagram_endpoints(settings) if Endpoint.parse(text).is_free]


def _datagram_endpoints(settings: NetworkSettings) -> list[str]:
    """The endpoints of datagrams beside those of the rendezvous: the same address and port, by UDP; not on loopback.

    Empty with `transport = "tcp"`.
    """
    if settings.transport == "tcp":
        return []
    carriers = {"tcp": "udp", "tls": "quic"}
    words = "?rel=1;mixed_rel=1"  # Zenoh's for a QUIC connection with a reliable stream and with datagrams
    beyond = [each for each in map(Endpoint.parse, settings.rendezvous_endpoints) if each.leaves_host]
    return [str(replace(each, protocol=carriers[each.protocol], words=words)) for each in beyond]


def _join_router(network: Protected) -> zenoh.Session:
    """Link to a router, as soon as one answers; Zenoh links again whenever the link is lost."""
    if not [*network.settings.connect, *network.settings.rendezvous]:
        raise NetworkError('network.mode = "client" needs a router in network.rendezvous')
    warn_at = time.monotonic() + ROUTER_PATIENCE_S
    while True:
        with suppress(zenoh.ZError):
            return _open(zenoh_config(network, "client", [], network.settings.rendezvous))
        if time.monotonic() > warn_at:
            log.warning("waiting for a router: %s", NoRouterError(network))
            warn_at = inf
        time.sleep(ROUTER_AGAIN_S)


def _no_router(network: Protected, probed: Mapping[str, bool | None]) -> str:
    """One line about routers that do not answer, which were probed."""
    for text, accepts in probed.items():
        if accepts:
            why = refusal(text, network.certificate) if network.certificate else None
            return why or f"a process at {text} accepts connections and does not answer as a router"
    return f"no router answers at {', '.join(probed)}; is `aeroloop router` running?"


def _warn_of_plain(network: Protected) -> None:
    """Log a warning where links are plain text, because that is allowed."""
    plain = [each for each in network.settings.endpoints if Endpoint.parse(each).is_plain]
    if network.settings.insecure and plain:
        log.warning("network.insecure: links at %s are plain text, open to anyone on that network", plain[0])


def _open(config: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def _reason(error: Exception) -> str:
    """Zenoh's message without the source locations it carries."""
    return str(error).split(" at /")[0].split(": [")[0].rstrip(". ")


def accepting(endpoints: Sequence[str]) -> list[str]:
    """Those of some endpoints of TCP or TLS at which a process accepts connections; waits briefly for the others."""
    return [text for text, accepts in probe(endpoints).items() if accepts]


def probe(endpoints: Sequence[str]) -> dict[str, bool | None]:
    """For each endpoint whether a process accepts connections there; waits briefly.

    False is a host's word that no process listens; None is no answer, or an endpoint of neither TCP nor TLS.
    """

    def accepts(text: str) -> bool | None:
        endpoint = Endpoint.parse(text)
        if endpoint.protocol in STREAMS and endpoint.port is not None:
            try:
                socket.create_connection(endpoint.address, ACCEPT_S).close()
            except ConnectionRefusedError:
                return False
            except OSError:
                return None
            return True
        return None

    with ThreadPoolExecutor(max(1, len(endpoints))) as pool:
        return dict(zip(endpoints, pool.map(accepts, endpoints), strict=True))


def refusal(text: str, certificate: Certificate, wait_s: float = HANDSHAKE_S) -> str | None:
    """One line about why a peer at an endpoint of TLS and a process with this certificate do not link.

    None if nothing speaks against it, and where no process answers. Zenoh writes the reason only into its own log. TLS
    1.3 shows a client at once what is wrong with the server's certificate, and in an alert, after the handshake, what
    the server has against its own.
    """
    endpoint = Endpoint.parse(text)
    if endpoint.protocol != "tls":
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # as Zenoh here: names of hosts do not matter
    # The hello of OpenSSL 3.5 has keys of 1 kB. A plain peer of Zenoh takes its first bytes for the length of a message
    # that has come whole, and hangs up at once. It waits for the rest of a shorter hello, which shows that it is plain.
    context.set_ecdh_curve("prime256v1")
    remedy = f"compare the clocks and {AUTHORITY} of both hosts, or issue it anew with `aeroloop host keys issue`"
    plain_text = f"{text} does not speak TLS: has its process a network.security.directory?"
    link, begun = None, time.monotonic()
    try:
        context.load_verify_locations(certificate.file.with_name(AUTHORITY))
        context.load_cert_chain(certificate.file, certificate.key)
        with socket.create_connection(endpoint.address, HANDSHAKE_S) as plain:
            plain.settimeout(wait_s)
            begun = time.monotonic()
            with context.wrap_socket(plain) as link:
                link.recv(1)  # an alert, if any; a server of Zenoh's says nothing first
    except ssl.SSLCertVerificationError as error:
        return f"{text} is refused: its certificate: {error.verify_message}; {remedy}"
    except (ssl.SSLEOFError, ConnectionError):  # at once: it ends, or nothing listens
        return plain_text if link is None and time.monotonic() - begun > HANDSHAKE_S else None
    except ssl.SSLError as error:
        alert = (error.reason or "").lower().replace("_", " ")
        return f"{text} refuses {certificate.file}: {alert}; {remedy}" if "alert" in alert else plain_text
    except OSError:  # no answer in time; files that were just replaced
        return None
    return None
