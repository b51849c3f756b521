"""Certificate of a role: finds, reads and checks one before it is used.

A host's directory has `ca.pem`, the certificate of the private authority, and for each role that runs there
`ROLE.VEHICLE.pem` with `ROLE.VEHICLE.key`; `ROLE.pem` with `ROLE.key` where the certificate is good for every vehicle.
The common name says the same, `ROLE/VEHICLE` or `ROLE`; what a peer may do follows from it alone.

Why a slash: no public authority signs such a name, while it signs `plant.aero` for the owner of that domain. Zenoh's
connecting side trusts every public authority besides `ca.pem`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics

if TYPE_CHECKING:
    from cryptography import x509

# `cryptography` is imported where it is used: only a process with certificates waits for it.

ROUTER: Final = "router"
ROLES: Final[tuple[str, ...]] = (*topics.ROLES, ROUTER)
OF_ONE_VEHICLE: Final = ("plant", "controller")  # roles whose certificates name a vehicle; the others' may
AUTHORITY: Final = "ca.pem"
SOON_DAYS: Final = 14.0  # a certificate that expires within this time is due for renewal [days]
_UTC: Final = "%Y-%m-%d %H:%M:%S UTC"
_ISSUE: Final = "`aeroloop host keys issue` makes one"
_AGAIN: Final = "move it and its key away, and issue it anew with `aeroloop host keys issue`"


class CertificateError(AeroloopError):
    """A certificate cannot be used; one line that says what is wrong with which file, and what to do."""


@dataclass(frozen=True)
class Certificate:
    """A role's certificate, as read from `file`, of one vehicle or of every one (None)."""

    file: Path
    role: str
    vehicle: str | None
    x509: x509.Certificate

    @property
    def key(self) -> Path:
        """File of its private key."""
        return self.file.with_suffix(".key")

    @property
    def name(self) -> str:
        """Host or person that it was issued to."""
        return subject_field(self.x509, "OU")

    @property
    def not_after(self) -> datetime:
        """End of its validity, UTC."""
        return self.x509.not_valid_after_utc

    @property
    def days_left(self) -> float:
        """Days until it expires by this host's clock; negative after that."""
        return (self.not_after - datetime.now(UTC)).total_seconds() / 86400


def common_name(role: str, vehicle: str | None) -> str:
    """Common name of a role's certificate, of one vehicle or of every one (None)."""
    return role if vehicle is None else f"{role}/{vehicle}"


def read_common_name(text: str) -> tuple[str, str | None] | None:
    """Role and vehicle of a common name; None of what no certificate of a role has."""
    role, slash, vehicle = text.partition("/")
    if role not in ROLES or bool(slash) != bool(vehicle) or (role in OF_ONE_VEHICLE and not vehicle):
        return None
    return role, vehicle or None


def file_of(directory: Path, role: str, vehicle: str | None) -> Path:
    """File of a role's certificate."""
    return directory / f"{common_name(role, vehicle).replace('/', '.')}.pem"


def load(file: Path) -> x509.Certificate:
    """Load a PEM file's first certificate. Raises CertificateError."""
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(_content(file))
    except ValueError:
        raise CertificateError(f"{file} is no certificate in PEM") from None


def read_certificate(file: Path) -> Certificate:
    """Read a role's certificate, without checking it. Raises CertificateError."""
    certificate = load(file)
    cn = subject_field(certificate, "CN")
    if (found := read_common_name(cn)) is None:
        raise CertificateError(f"{file} is no role's certificate: its common name is {cn!r}; {_ISSUE}")
    return Certificate(file, *found, certificate)


def own_certificate(directory: Path, roles: Sequence[str], vehicle: str | None) -> Certificate:
    """This process's own certificate, checked: of the first of some roles that has one in a directory.

    The best role comes first; `vehicle` is None if any will do. Raises CertificateError if there is none that is good.
    """
    if not (directory / AUTHORITY).is_file():
        remedy = "copy it from where `aeroloop host keys init` made it"
        raise CertificateError(f"{directory / AUTHORITY} is missing, without which no peer is trusted: {remedy}")
    for role in roles:
        files = [file_of(directory, role, each) for each in dict.fromkeys((vehicle, None))]
        files += sorted(directory.glob(f"{role}.*.pem")) if vehicle is None else []
        for file in files:
            if file.is_file():
                return check(file, role, vehicle)
    option = f" --vehicle {vehicle or 'V'}" if vehicle or roles[0] in OF_ONE_VEHICLE else ""
    remedy = f"`aeroloop host keys issue {roles[0]} NAME{option}`"
    raise CertificateError(f"{file_of(directory, roles[0], vehicle)} is missing: issue it with {remedy}")


def check(file: Path, role: str, vehicle: str | None) -> Certificate:
    """Read a role's certificate and check that a process of this role and vehicle (None: any) can use it now.

    Its key and `ca.pem` are beside it. Raises CertificateError.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    found, now = read_certificate(file), datetime.now(UTC)
    key, begin = found.key, found.x509.not_valid_before_utc
    if found.role != role or (vehicle and found.vehicle and found.vehicle != vehicle):
        held, wanted = common_name(found.role, found.vehicle), common_name(role, vehicle)
        raise CertificateError(f"{file} is a certificate of {held}, not of {wanted}; {_ISSUE}")
    if not key.exists():
        raise CertificateError(f"{key} is missing: copy it from where the certificate was issued; {_ISSUE}")
    content, mode = _content(key), key.stat().st_mode & 0o777
    if mode & 0o077:
        raise CertificateError(f"{key} can be read by others (mode {mode:04o}): `chmod 600 {key}`")
    try:
        public = load_pem_private_key(content, None).public_key()
    except (ValueError, TypeError):  # TypeError: it is encrypted
        raise CertificateError(f"{key} is no private key in PEM without a password; {_ISSUE}") from None
    if public != found.x509.public_key():
        raise CertificateError(f"{key} is not the key of {file.name}; {_ISSUE}")
    try:
        found.x509.verify_directly_issued_by(load(file.parent / AUTHORITY))
    except (InvalidSignature, ValueError, TypeError):  # another name, another kind of key
        raise CertificateError(f"{file} was not issued by {AUTHORITY} beside it; {_ISSUE}") from None
    if not begin <= now <= found.not_after:
        what = f"expired at {found.not_after:{_UTC}}" if begin < now else f"is not valid before {begin:{_UTC}}"
        raise CertificateError(f"{file} {what}, and this host's clock shows {now:{_UTC}}: set the clock, or {_AGAIN}")
    return found


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise CertificateError(f"{file} cannot be read: {error.strerror}") from None


def subject_field(certificate: x509.Certificate, field: Literal["CN", "OU"]) -> str:
    """A field of the subject; empty where there is none."""
    fields = [each for each in certificate.subject if each.rfc4514_attribute_name == field]
    return str(fields[0].value) if fields else ""
