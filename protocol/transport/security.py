"""Security of links: mutual TLS beyond loopback, from a host's directory of certificates.

An endpoint of TCP on another host than this becomes one of TLS; on loopback it stays as it is, unless
`network.loopback_secured`. A process uses the certificate of its role and vehicle, to connect and to listen. Names of
hosts do not matter: what a peer may do follows from its certificate's common name alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

from pydantic import BaseModel, Field

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages.topics import NAME
from aeroloop.protocol.transport.certificate import AUTHORITY, Certificate, own_certificate
from aeroloop.protocol.transport.endpoint import LOCAL, TLS, Endpoint


class SecurityError(AeroloopError):
    """Links cannot be secured as configured; one line that says what to do."""


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


class Identity(NamedTuple):
    """What a process is: the first of these roles that the directory has a certificate of.

    Attributes:
        roles: The best one first.
        vehicle: Name of its vehicle; None if a certificate of any will do.
    """

    roles: tuple[str, ...]
    vehicle: str | None = None


READER: Final = Identity(("operator", "observer"))
"""A command or a viewer, of any vehicle."""


def secured(text: str, security: SecuritySettings, *, insecure: bool, loopback_secured: bool) -> str:
    """The endpoint that is opened in place of a configured one.

    Raises:
        SecurityError: Its links would be plain text where they must not be, or there are no certificates for them.
    """
    endpoint = Endpoint.parse(text)
    must = endpoint.is_plain or (loopback_secured and endpoint.protocol not in (*TLS, *LOCAL))
    if security.directory:
        if not must:
            return text
        if endpoint.protocol == "tcp":
            return str(replace(endpoint, protocol="tls"))
        raise SecurityError(f"{endpoint} is plain text: name a tcp or tls endpoint, which mutual TLS protects")
    if endpoint.protocol in TLS or (must and loopback_secured):
        raise SecurityError(
            f"{endpoint} needs certificates: make them with `aeroloop host keys`, and set network.security.directory"
        )
    if must and not insecure:
        raise SecurityError(
            f"{endpoint} would be plain text beyond this host, and anyone there could drive the vehicle: set "
            "network.security.directory (see `aeroloop host keys`), or network.insecure = true on a network of your own"
        )
    return text


def certificate_for(endpoints: Iterable[str], security: SecuritySettings, identity: Identity) -> Certificate | None:
    """This process's own certificate, checked; None where none of its endpoints needs one. Raises CertificateError."""
    if security.folder is None or not any(Endpoint.parse(each).protocol in TLS for each in endpoints):
        return None
    return own_certificate(security.folder, *identity)


def tls_tree(certificate: Certificate) -> dict[str, Any]:
    """Zenoh's configuration at `transport/link/tls`, for links of both directions.

    The links of a peer close when its certificate expires. Zenoh's connecting side trusts the public authorities
    besides ours; none of them signs a role's common name, so such a link is allowed nothing.
    """
    files = str(certificate.file.absolute()), str(certificate.key.absolute())
    return {
        "root_ca_certificate": str(certificate.file.absolute().with_name(AUTHORITY)),
        **{f"{side}_{what}": file for side in ("listen", "connect") for what, file in zip(_FILES, files, strict=True)},
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }


_FILES: Final = "certificate", "private_key"
