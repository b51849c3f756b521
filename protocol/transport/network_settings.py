"""Network settings: where a process meets the others, and which of its links become mutual TLS.

An endpoint of TCP beyond loopback becomes one of TLS; on loopback it stays as it is, so `tls/127.0.0.1:7447` is mutual
TLS on this host, too. A process uses the certificate of its role and vehicle, to connect and to listen. Names of hosts
do not matter: what a peer may do follows from its certificate's common name alone.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, Field, field_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.topics import NAME
from aeroloop.protocol.transport.certificate import Certificate, own_certificate
from aeroloop.protocol.transport.endpoint import TLS, Endpoint

PORTS: Final = 8
"""Consecutive ports from each rendezvous' port on that processes meet at: one that hangs keeps none out."""


class NetworkError(AeroloopError):
    """The network cannot be joined as configured; one line with the reason and what to do."""


def _endpoint(text: str) -> str:
    if text:
        Endpoint.parse(text)
    return text


EndpointText = Annotated[str, AfterValidator(_endpoint)]


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


READER: Final = Identity(("operator", "observer"))
"""A command or a viewer, of any vehicle."""


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
    if endpoint.protocol in TLS:
        raise NetworkError(
            f"{endpoint} needs certificates: make them with `aeroloop host keys`, and set network.security.directory"
        )
    if endpoint.is_plain and not settings.insecure:
        raise NetworkError(
            f"{endpoint} would be plain text beyond this host, and anyone there could drive the vehicle: set "
            "network.security.directory (see `aeroloop host keys`), or network.insecure = true on a network of your own"
        )
    return text
