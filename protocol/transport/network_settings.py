"""Network settings: where a process meets the others, and how its links are protected."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, Field, field_validator

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.transport.certificate import Certificate
from aeroloop.protocol.transport.endpoint import Endpoint
from aeroloop.protocol.transport.security import Identity, SecurityError, SecuritySettings, certificate_for, secured


class NetworkError(AeroloopError):
    """The network cannot be joined; one line with the reason and what to do."""


def _endpoint(text: str) -> str:
    if text:
        Endpoint.parse(text)
    return text


EndpointText = Annotated[str, AfterValidator(_endpoint)]


class NetworkSettings(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """Zenoh endpoints of this process and its peers."""

    mode: Literal["peer", "client"] = Field(
        default="peer",
        description="peer: processes link to one another; client: each links to a router at the rendezvous and to "
        "nothing else, as `aeroloop router` is one",
    )
    rendezvous: list[EndpointText] = Field(
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
    listen: list[EndpointText] = Field(
        default=[],
        description="further Zenoh endpoints this process can be reached at; port 0 is any free one",
    )
    connect: list[EndpointText] = Field(default=[], description="Zenoh endpoints to connect to besides the rendezvous")
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
        return [str(place) for first in self.rendezvous for place in Endpoint.parse(first).ports(self.ports)]

    @property
    def mixed(self) -> bool:
        """Whether each kind of traffic has a transport of its own: between peers beyond loopback, if so set."""
        return (
            self.transport == "mixed"
            and self.mode == "peer"
            and any(Endpoint.parse(each).leaves_host for each in self.rendezvous)
        )

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
