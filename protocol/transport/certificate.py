"""Certificate of a role: reads one and checks this process's own before it is used.

A host's directory has `ca.pem`, the certificate of the private authority, and for each role that runs there
`ROLE.VEHICLE.pem` with `ROLE.VEHICLE.key`; `ROLE.pem` with `ROLE.key` where the certificate is good for every vehicle.
The common name says the same, `ROLE/VEHICLE` or `ROLE`; what a peer may do follows from it alone.

Why a slash: no public authority signs such a name, while it signs `plant.aero` for the owner of that domain. Zenoh's
connecting side trusts every public authority besides `ca.pem`.
"""

from __future__ import annotations

import stat
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

from aeroloop.protocol.errors import AeroloopError

if TYPE_CHECKING:
    from cryptography import x509

# `cryptography` is imported where it is used: only a process with certificates waits for it.

CertifiedRole = Literal["plant", "controller", "operator", "observer", "recorder", "router"]
ROLES: Final[tuple[CertifiedRole, ...]] = get_args(CertifiedRole)
OF_ONE_VEHICLE: Final = ("plant", "controller")
"""Roles whose certificates name a vehicle; the others' may."""
AUTHORITY: Final = "ca.pem"
SOON_DAYS: Final = 14.0
"""A certificate that expires within this time is due for renewal [days]."""


class CertificateError(AeroloopError):
    """A certificate cannot be used; one line that says what is wrong with which file, and what to do."""


@dataclass(frozen=True)
class Certificate:
    """A role's certificate.

    Attributes:
        file: Where it was read.
        role: What it makes its holder.
        vehicle: Of which vehicle; None of every one.
        name: Host or person that it was issued to.
        not_before: Begin of its validity, UTC.
        not_after: End of its validity, UTC.
        fingerprint: SHA-256 of it, in hexadecimal.
    """

    file: Path
    role: CertifiedRole
    vehicle: str | None
    name: str
    not_before: datetime
    not_after: datetime
    fingerprint: str

    @property
    def key(self) -> Path:
        """File of its private key."""
        return self.file.with_suffix(".key")

    @property
    def days_left(self) -> float:
        """Days until it expires by this host's clock; negative after that."""
        return (self.not_after - datetime.now(UTC)).total_seconds() / 86400


def common_name(role: str, vehicle: str | None) -> str:
    """Common name of a certificate of a role, of one vehicle or of every one (None)."""
    return role if vehicle is None else f"{role}/{vehicle}"


def read_common_name(text: str | None) -> tuple[CertifiedRole, str | None] | None:
    """Role and vehicle of a common name; None of what no certificate of a role has."""
    role, slash, vehicle = (text or "").partition("/")
    if role not in ROLES or bool(slash) != bool(vehicle) or (role in OF_ONE_VEHICLE and not vehicle):
        return None
    return role, vehicle or None


def file_of(directory: Path, role: str, vehicle: str | None) -> Path:
    """File of a role's certificate."""
    return directory / f"{role if vehicle is None else f'{role}.{vehicle}'}.pem"


def read_certificate(file: Path) -> Certificate:
    """Read a role's certificate, without checking it.

    Raises:
        CertificateError: It cannot be read, or is none of a role.
    """
    certificate = load(file)
    from cryptography.hazmat.primitives.hashes import SHA256

    cn, name = names_of(certificate)
    found = read_common_name(cn)
    if found is None:
        raise CertificateError(f"{file} is no role's certificate: its common name is {cn!r}; {_ISSUE}")
    return Certificate(
        file,
        *found,
        name=name,
        not_before=certificate.not_valid_before_utc,
        not_after=certificate.not_valid_after_utc,
        fingerprint=certificate.fingerprint(SHA256()).hex(),
    )


def own_certificate(directory: Path, roles: Sequence[str], vehicle: str | None) -> Certificate:
    """This process's own certificate, checked: of the first of some roles that has one in a directory.

    Args:
        directory: `network.security.directory`.
        roles: Roles that will do, the best one first.
        vehicle: Name of the vehicle; None if any will do.

    Raises:
        CertificateError: There is none, or `check` refuses it.
    """
    if not (directory / AUTHORITY).is_file():
        raise CertificateError(
            f"{directory / AUTHORITY} is missing, without which no peer is trusted: copy it from where "
            "`aeroloop host keys init` made it"
        )
    for role in roles:
        files = [file_of(directory, role, each) for each in dict.fromkeys((vehicle, None))]
        files += sorted(directory.glob(f"{role}.*.pem")) if vehicle is None else []
        for file in files:
            if file.is_file():
                return check(file, role, vehicle)
    wanted, better = file_of(directory, roles[0], vehicle), " --vehicle " + (vehicle or "V")
    raise CertificateError(
        f"{wanted} is missing: issue it with `aeroloop host keys issue {roles[0]} NAME"
        f"{better if vehicle or roles[0] in OF_ONE_VEHICLE else ''}`"
    )


def check(file: Path, role: str, vehicle: str | None) -> Certificate:
    """Read a role's certificate and check that a process of this role and vehicle can use it, with its key, now.

    Args:
        file: The certificate, beside `ca.pem` and its key.
        role: What the process is.
        vehicle: Of which vehicle; None if any will do.

    Raises:
        CertificateError: The key is missing, another one's or readable by others; the certificate is not issued by the
            directory's authority, expired, not yet valid, or another role's or vehicle's.
    """
    found = read_certificate(file)
    if found.role != role or (vehicle and found.vehicle and found.vehicle != vehicle):
        held, wanted = common_name(found.role, found.vehicle), common_name(role, vehicle)
        raise CertificateError(f"{file} is a certificate of {held}, not of {wanted}; {_ISSUE}")
    _check_key(found)
    if not _is_issued_by(file, file.parent / AUTHORITY):
        raise CertificateError(
            f"{file} was not issued by {AUTHORITY} beside it: both must be of one authority; {_ISSUE}"
        )
    if found.days_left < 0:
        raise CertificateError(f"{file} expired at {_utc(found.not_after)}: {_AGAIN}")
    if found.not_before > datetime.now(UTC):
        raise CertificateError(
            f"{file} is not valid before {_utc(found.not_before)}, and this host's clock shows "
            f"{_utc(datetime.now(UTC))}: set the clock, or {_AGAIN}"
        )
    return found


def load(file: Path) -> x509.Certificate:
    """Load a PEM file's first certificate. Raises CertificateError."""
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except OSError as error:
        raise CertificateError(f"{file} cannot be read: {error.strerror}") from None
    except ValueError:
        raise CertificateError(f"{file} is no certificate in PEM") from None


def names_of(holder: x509.Certificate) -> tuple[str, str]:
    """Common name and organizational unit of a subject; empty where there is none."""
    from cryptography.x509.oid import NameOID

    of = holder.subject.get_attributes_for_oid
    cn, unit = (of(oid) for oid in (NameOID.COMMON_NAME, NameOID.ORGANIZATIONAL_UNIT_NAME))
    return str(cn[0].value) if cn else "", str(unit[0].value) if unit else ""


def _is_issued_by(file: Path, authority: Path) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        load(file).verify_directly_issued_by(load(authority))
    except (InvalidSignature, ValueError, TypeError):  # another name, another kind of key
        return False
    return True


def _check_key(certificate: Certificate) -> None:
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    key = certificate.key
    try:
        mode = stat.S_IMODE(key.stat().st_mode)
        text = key.read_bytes()
    except FileNotFoundError:
        raise CertificateError(f"{key} is missing: copy it from where the certificate was issued; {_ISSUE}") from None
    except OSError as error:
        raise CertificateError(f"{key} cannot be read: {error.strerror}") from None
    if mode & 0o077:
        raise CertificateError(f"{key} can be read by others (mode {mode:04o}): `chmod 600 {key}`")
    try:
        secret = load_pem_private_key(text, None)
    except (ValueError, TypeError):  # TypeError: it is encrypted
        raise CertificateError(f"{key} is no private key in PEM without a password; {_ISSUE}") from None
    if secret.public_key() != load(certificate.file).public_key():
        raise CertificateError(f"{key} is not the key of {certificate.file.name}; {_ISSUE}")


_ISSUE: Final = "`aeroloop host keys issue` makes one"
_AGAIN: Final = "move it and its key away, and issue it anew with `aeroloop host keys issue`"


def _utc(time: datetime) -> str:
    return f"{time:%Y-%m-%d %H:%M:%S} UTC"
