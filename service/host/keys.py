"""Keys: makes a private authority in a directory, and issues and lists the certificates of roles. Keys are EC P-256.

The authority's key stays in the directory where `init` made it. A key is a new file of mode 0600, and nothing is
overwritten. Imports `cryptography` at once, so it is itself imported where it is used.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, cast
from uuid import uuid4

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ec import (
    SECP256R1,
    EllipticCurvePrivateKey,
    EllipticCurvePublicKey,
    generate_private_key,
)
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from pydantic import BaseModel, Field

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.certificate import (
    AUTHORITY,
    OF_ONE_VEHICLE,
    ROLES,
    CertificateError,
    check,
    common_name,
    file_of,
    load,
    read_certificate,
    subject_field,
)

KEY: Final = "ca.key"
DAYS: Final = 90
"""Lifetime of a certificate. Why so short: Zenoh has no revocation lists, so a stolen key is good until it expires."""
AUTHORITY_DAYS: Final = 3650
_EARLIER: Final = timedelta(hours=1)
"""A certificate is valid from so long before it is issued: hosts' clocks differ."""
_LONGEST: Final = 64
"""Characters of a name in a certificate, by RFC 5280."""
_USES: Final = (
    "digital_signature",
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "key_cert_sign",
    "crl_sign",
    "encipher_only",
    "decipher_only",
)


class KeyFile(BaseModel, frozen=True):
    """One certificate of a directory."""

    file: str
    role: str | None = Field(default=None, description="`authority` of ca.pem; null where it is none of a role")
    vehicle: str | None = Field(default=None, description="null of every vehicle")
    name: str = Field(default="", description="host or person that it was issued to")
    valid_until: datetime | None = None
    days_left: float | None = None
    fingerprint: str = Field(default="", description="SHA-256")
    problem: str | None = Field(default=None, description="why it cannot be used; null if it can")


def init(directory: Path, days: int = AUTHORITY_DAYS) -> Path:
    """Make a private authority, `ca.pem` and `ca.key`, in a new or existing directory. Returns `ca.pem`.

    Raises:
        CertificateError: There is one, or the directory cannot be written.
    """
    certificate, secret = directory / AUTHORITY, directory / KEY
    _make(directory)
    _refuse_existing(certificate, secret)
    key = generate_private_key(SECP256R1())
    made = _new_authority(key, days)
    _write(secret, _pem(key))
    _write(certificate, _pem(made), 0o644)
    return certificate


def issue(directory: Path, role: str, name: str, vehicle: str | None = None, days: int = DAYS) -> Path:
    """Make a key and its certificate for a role. Returns the certificate's file, `ROLE.VEHICLE.pem`.

    Args:
        directory: Where the authority's key is.
        role: One of `ROLES`.
        name: Host or person that gets it.
        vehicle: Its vehicle; None is every one.
        days: How long it is valid.

    Raises:
        CertificateError: Role, name or vehicle will not do; a file exists; the authority's key is not here.
    """
    whose, file = _subject(role, name, vehicle), file_of(directory, role, vehicle)
    _refuse_existing(file, file.with_suffix(".key"))
    key = generate_private_key(SECP256R1())
    made = _sign(directory, whose, key.public_key(), days)
    _write(file.with_suffix(".key"), _pem(key))
    _write(file, _pem(made), 0o644)
    return file


def show(directory: Path) -> list[KeyFile]:
    """The authority and every certificate of a directory, each with what keeps it from being used.

    Raises:
        CertificateError: The directory has no authority.
    """
    ca = load(directory / AUTHORITY)
    days_left = (ca.not_valid_after_utc - datetime.now(UTC)).total_seconds() / 86400
    first = KeyFile(
        file=AUTHORITY,
        role="authority",
        name=subject_field(ca, "CN"),
        valid_until=ca.not_valid_after_utc,
        days_left=days_left,
        fingerprint=ca.fingerprint(SHA256()).hex(),
        problem=f"{directory / AUTHORITY} has expired: make a new authority in another directory"
        if days_left < 0
        else None,
    )
    return [first, *map(_shown, _certificates(directory))]


def _shown(file: Path) -> KeyFile:
    try:
        found = read_certificate(file)
    except CertificateError as error:
        return KeyFile(file=file.name, problem=str(error))
    row = KeyFile(
        file=file.name,
        role=found.role,
        vehicle=found.vehicle,
        name=found.name,
        valid_until=found.not_after,
        days_left=found.days_left,
        fingerprint=found.x509.fingerprint(SHA256()).hex(),
    )
    role, _, vehicle = file.stem.partition(".")
    try:
        check(file, role, vehicle or None)
    except CertificateError as error:
        return row.model_copy(update={"problem": str(error)})
    return row


def _certificates(directory: Path) -> Iterator[Path]:
    """The files of a directory that are named as roles' certificates."""
    return (file for file in sorted(directory.glob("*.pem")) if file.stem.partition(".")[0] in ROLES)


def _subject(role: str, name: str, vehicle: str | None) -> x509.Name:
    if role not in ROLES:
        raise CertificateError(f"there is no role {role!r}; roles are {', '.join(ROLES)}")
    if vehicle is None and role in OF_ONE_VEHICLE:
        raise CertificateError(f"a {role}'s certificate is of one vehicle: name it with --vehicle V")
    if vehicle is not None and re.fullmatch(topics.NAME, vehicle) is None:
        raise CertificateError(f"{vehicle!r} cannot name a vehicle: letters, digits, '.', '_' and '-'")
    cn = common_name(role, vehicle)
    if len(cn) > _LONGEST:
        raise CertificateError(f"{cn} is too long for a certificate: {_LONGEST} characters at most")
    if not (name.isprintable() and 0 < len(name) <= _LONGEST):
        raise CertificateError(f"NAME is a host or a person, in 1 to {_LONGEST} printable characters")
    return x509.Name(
        [x509.NameAttribute(NameOID.COMMON_NAME, cn), x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, name)]
    )


def _new_authority(key: EllipticCurvePrivateKey, days: int) -> x509.Certificate:
    """An authority under a name of its own: one that replaces another must not be taken for it."""
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"aeroloop authority {uuid4().hex[:8]}")])
    until = datetime.now(UTC) + timedelta(days=days)
    return _signed(key, name, name, key.public_key(), until, authority=True)


def _sign(directory: Path, whose: x509.Name, public: EllipticCurvePublicKey, days: int) -> x509.Certificate:
    """A certificate for a key, of the authority in a directory; it ends with the authority's at the latest."""
    secret = directory / KEY
    if not secret.exists():
        raise CertificateError(f"{secret} is not here: it stays where `aeroloop host keys init` made it; issue there")
    key, authority = _read_key(secret), load(directory / AUTHORITY)
    if authority.public_key() != key.public_key():
        raise CertificateError(f"{secret} is not the key of {AUTHORITY} beside it")
    now = datetime.now(UTC)
    if authority.not_valid_after_utc <= now:
        raise CertificateError(f"{directory / AUTHORITY} has expired: make a new authority in another directory")
    until = min(now + timedelta(days=days), authority.not_valid_after_utc)
    return _signed(key, authority.subject, whose, public, until)


def _signed(
    key: EllipticCurvePrivateKey,
    issuer: x509.Name,
    whose: x509.Name,
    public: EllipticCurvePublicKey,
    until: datetime,
    *,
    authority: bool = False,
) -> x509.Certificate:
    begin = datetime.now(UTC) - _EARLIER
    uses = dict.fromkeys(_USES, False) | {"key_cert_sign" if authority else "digital_signature": True}
    both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]  # a peer connects and listens
    builder = (
        x509.CertificateBuilder(issuer, whose, public, x509.random_serial_number(), begin, until)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
        .add_extension(x509.KeyUsage(**uses), critical=True)
    )
    if not authority:
        builder = builder.add_extension(x509.ExtendedKeyUsage(both), critical=False)
    return builder.sign(key, SHA256())


def _read_key(file: Path) -> EllipticCurvePrivateKey:
    """Read a private key. Raises CertificateError."""
    try:
        return cast(EllipticCurvePrivateKey, load_pem_private_key(file.read_bytes(), None))
    except OSError as error:
        raise CertificateError(f"{file} cannot be read: {error.strerror}") from None
    except (ValueError, TypeError):  # TypeError: it is encrypted
        raise CertificateError(f"{file} is no private key in PEM without a password") from None


def _pem(made: x509.Certificate | EllipticCurvePrivateKey) -> bytes:
    if isinstance(made, EllipticCurvePrivateKey):
        return made.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return made.public_bytes(Encoding.PEM)


def _make(directory: Path) -> None:
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        if directory.stat().st_mode & 0o077:
            raise CertificateError(f"{directory} can be entered by others: `chmod 700 {directory}`, or name another")
    except OSError as error:
        raise CertificateError(f"cannot make {directory}: {error.strerror}") from None


def _refuse_existing(*files: Path) -> None:
    for file in files:
        if os.path.lexists(file):
            raise CertificateError(f"{file} exists, and is not overwritten: move it away first")


def _write(file: Path, content: bytes, mode: int = 0o600) -> None:
    """Write a new file; complete or absent, of this mode from its first byte on."""
    try:
        number = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except OSError as error:
        _refuse_existing(file)
        raise CertificateError(f"cannot write {file}: {error.strerror}") from None
    try:
        with os.fdopen(number, "wb") as out:
            out.write(content)
            out.flush()
            os.fsync(number)
    except BaseException:
        file.unlink()
        raise
