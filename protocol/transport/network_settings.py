"""Network settings: where a process meets the others, and which of its links become mutual TLS.

An endpoint of TCP beyond loopback becomes one of TLS; on loopback it stays as it is, so `tls/127.0.0.1:7447` is mutual
TLS on this host, too. Names of hosts do not matter: what a peer may do follows from its certificate's common name.
"""

from __future__ import annotations

import re
import socket
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, Field, field_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.topics import NAME
from aeroloop.protocol.transport.certificate import Certificate, own_certificate

PORTS: Final = 8  # consecutive ones from each rendezvous on that processes meet at: one that hangs keeps none out
TLS: Final = ("tls", "quic")  # links are encrypted, both ends with a certificate
STREAMS: Final = ("tcp", "tls")
LOCAL: Final = ("unixsock-stream", "unixpipe", "shm")  # stays on this host; the file's mode says who may connect
_FORM: Final = re.compile(
    r"(?P<protocol>[a-z][a-z0-9_-]*)/(?P<host>\[[^]]*\]|[^:?#\s]+)(:(?P<port>\d+))?(?P<words>[?#]\S*)?"
)


class NetworkError(AeroloopError):
    """The network cannot be joined as configured; one line with the reason and what to do."""


@dataclass(frozen=True)
class Endpoint:
    """An endpoint. An IPv6 `host` is in brackets, that of a Unix socket is a path; `words` begin with `?` or `#`."""

    protocol: str
    host: str
    port: int | None
    words: str = ""

    @staticmethod
    @lru_cache(maxsize=256)
    def parse(text: str) -> Endpoint:
        """The endpoint that a text names. Raises ValueError if it names none."""
        if (found := _FORM.fullmatch(text)) is None:
            raise ValueError("must be a Zenoh endpoint, PROTOCOL/ADDRESS:PORT such as tcp/127.0.0.1:7447")
        port = found["port"]
        return Endpoint(found["protocol"], found["host"], None if port is None else int(port), found["words"] or "")

    def __str__(self) -> str:
        port = "" if self.port is None else f":{self.port}"
        return f"{self.protocol}/{self.host}{port}{self.words}"

    def at_port(self, port: int) -> Endpoint:
        """The same with another port; itself where it has none."""
        return self if self.port is None else replace(self, port=port)

    def ports(self, count: int) -> list[Endpoint]:
        """The endpoints of consecutive ports from this one's on; itself where it has no port."""
        if self.port is None:
            return [self]
        return [self.at_port(port) for port in range(self.port, min(self.port + count, 1 << 16))]

    @property
    def address(self) -> tuple[str, int]:
        """Host and port as sockets take them; port 0 where it has none."""
        return self.host.strip("[]"), self.port or 0

    @property
    def on_loopback(self) -> bool:
        """Whether its links stay within this host."""
        if self.protocol in LOCAL or self.host == "localhost":
            return True
        try:
            return ip_address(self.address[0]).is_loopback
        except ValueError:  # a name
            return False

    @property
    def is_plain(self) -> bool:
        """Whether its links are plain text that leaves this host, or may."""
        return self.protocol not in TLS and not self.on_loopback

    @property
    def leaves_host(self) -> bool:
        """Whether it is one of TCP or TLS beyond loopback."""
        return self.protocol in STREAMS and not self.on_loopback

    @property
    def is_free(self) -> bool:
        """Whether this process could listen at it: it is an address of this host, and its port is free."""
        if self.port is None:
            return True  # only Zenoh can find out
        family = socket.AF_INET6 if self.host.startswith("[") else socket.AF_INET
        with suppress(OSError):
            if self.protocol in ("udp", "quic"):
                with socket.socket(family, socket.SOCK_DGRAM) as probe:
                    probe.bind(self.address)
            else:
                socket.create_server(self.address, family=family).close()
            return True
        return False

    @property
    def is_own(self) -> bool:
        """Whether its address is this host's."""
        return self.at_port(0).is_free


EndpointText = Annotated[str, AfterValidator(lambda text: str(Endpoint.parse(text)) if text else text)]


class SecuritySettings(BaseModel, extra="forbid"):
    """Certificates of this host."""

    directory: str = Field(
        default="",
        description="folder of this host's certificates, as `aeroloop host keys` makes it; every link beyond loopback "
        "is then mutual TLS; empty for none",
    )
    vehicles: list[Annotated[str, Field(pattern=f"^{NAME}$")]] = Field(
        default=[],
        description="vehicles whose peers have rights here; the configured one always, further ones for a recorder, an "
        "operator or an observer of several",
    )

    @property
    def folder(self) -> Path | None:
        """The directory, with `~` expanded."""
        return Path(self.directory).expanduser() if self.directory else None


class NetworkSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """Zenoh endpoints of this process and its peers."""

    mode: Literal["peer", "client"] = Field(
        default="peer",
        description="peer: processes link to one another; client: each links to a router at the rendezvous and to "
        "nothing else, as `aeroloop router` is one",
    )
    rendezvous: list[EndpointText] = Field(
        default=["tcp/127.0.0.1:7447"],
        description="Zenoh endpoints where processes meet, one for each host; a process listens at the first free "
        "one of 8 ports of its own host's and connects to all; tls/… is mutual TLS on loopback, too; [] for none",
    )
    listen: list[EndpointText] = Field(
        default=[], description="further endpoints this process can be reached at; port 0 is any free one"
    )
    connect: list[EndpointText] = Field(default=[], description="Zenoh endpoints to connect to besides the rendezvous")
    transport: Literal["mixed", "tcp"] = Field(
        default="mixed",
        description="of the loop's frames beyond loopback, in real time; mixed: datagrams by QUIC, over UDP at the "
        "same ports, and what stays on TCP or TLS is compressed; tcp: the same links as everything else",
    )
    security: SecuritySettings = Field(default=SecuritySettings(), description="certificates of this host")
    insecure: bool = Field(
        default=False, description="allow plain text beyond loopback: anyone there can then drive the vehicle"
    )

    @field_validator("rendezvous", mode="before")
    @classmethod
    def _one_or_more(cls, value: object) -> object:
        return value if isinstance(value, list | tuple) else [value] if value else []

    @property
    def rendezvous_endpoints(self) -> list[str]:
        """Every endpoint at which a process may be met: the rendezvous, port by port; by a client, the routers."""
        if self.mode == "client":
            return self.rendezvous
        return [str(each) for first in self.rendezvous for each in Endpoint.parse(first).ports(PORTS)]

    @property
    def endpoints(self) -> list[str]:
        """Every endpoint that is connected to or listened on."""
        return [*self.rendezvous_endpoints, *self.connect, *self.listen]

    @property
    def mixed(self) -> bool:
        """Whether each kind of traffic has a transport of its own: between peers beyond loopback, if so set."""
        beyond = any(Endpoint.parse(each).leaves_host for each in self.rendezvous)
        return self.transport == "mixed" and self.mode == "peer" and beyond


class Identity(NamedTuple):
    """What a process is: the first of `roles` that the directory has a certificate of; of any vehicle if None."""

    roles: tuple[str, ...]
    vehicle: str | None = None


READER: Final = Identity(("operator", "observer"))  # a command or a viewer, of any vehicle


class Protected(NamedTuple):
    """A process's own network, with the endpoints that it opens in place of the configured ones.

    `certificate` is None where no link needs one. With one, messages are taken of peers of these `vehicles` only.
    """

    settings: NetworkSettings
    certificate: Certificate | None
    vehicles: tuple[str, ...] = ()


def protected(settings: NetworkSettings, identity: Identity) -> Protected:
    """Replace endpoints by those of mutual TLS where they must be, and find this process's certificate.

    Raises:
        NetworkError: An endpoint must not be opened as configured.
        CertificateError: A certificate is needed, and this process has none that is good.
    """
    names = ("rendezvous", "listen", "connect")
    update = {name: [opened(text, settings) for text in getattr(settings, name)] for name in names}
    network, folder = settings.model_copy(update=update), settings.security.folder
    if folder is None or not any(Endpoint.parse(each).protocol in TLS for each in network.endpoints):
        return Protected(network, None)
    certificate = own_certificate(folder, *identity)
    named = [name for name in (identity.vehicle, certificate.vehicle, *settings.security.vehicles) if name is not None]
    if not named:
        raise NetworkError(f"{certificate.file} is good for every vehicle: name them in network.security.vehicles")
    return Protected(network, certificate, tuple(dict.fromkeys(named)))


def opened(text: str, settings: NetworkSettings) -> str:
    """The endpoint that is opened in place of a configured one. Raises NetworkError."""
    endpoint = Endpoint.parse(text)
    if settings.security.directory:
        if endpoint.is_plain and endpoint.protocol != "tcp":
            raise NetworkError(f"{endpoint} is plain text: name a tcp or tls endpoint, which mutual TLS protects")
        return str(replace(endpoint, protocol="tls")) if endpoint.is_plain else text
    remedy = "make certificates with `aeroloop host keys`, and set network.security.directory"
    if endpoint.protocol in TLS:
        raise NetworkError(f"{endpoint} needs certificates: {remedy}")
    if endpoint.is_plain and not settings.insecure:
        problem = f"{endpoint} would be plain text beyond this host, and anyone there could drive the vehicle"
        raise NetworkError(f"{problem}: {remedy}; or set network.insecure = true on a network of your own")
    return text
