"""Keys: makes a private authority in a directory, and issues and lists the certificates of roles. Keys are EC P-256.

The authority's key stays in the directory where `init` made it. A key is a new file of mode 0600, and nothing is
overwritten. Imports `cryptography` at once, so it is itself imported where it is used.
"""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime, timedelta
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Final, cast
from uuid import uuid4

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
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
EXPIRED: Final = "{} has expired: make a new authority in another directory"
_EARLIER: Final = timedelta(hours=1)
"""A certificate is valid from so long before it is issued: hosts' clocks differ."""
_LONGEST: Final = 64
"""Characters of a name in a certificate, by RFC 5280."""


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


def init(directory: Path) -> Path:
    """Make a private authority, `ca.pem` and `ca.key`, in a new or existing directory. Returns `ca.pem`.

    It has a name of its own: an authority that replaces another must not be taken for it.

    Raises:
        CertificateError: There is one, or the directory cannot be written.
    """
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        if directory.stat().st_mode & 0o077:
            raise CertificateError(f"{directory} can be entered by others: `chmod 700 {directory}`, or name another")
    except OSError as error:
        raise CertificateError(f"cannot make {directory}: {error.strerror}") from None
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"aeroloop authority {uuid4().hex[:8]}")])
    key, until = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC) + timedelta(days=AUTHORITY_DAYS)
    made = _signed(key, name, name, key.public_key(), until, authority=True)
    return _write_pair(directory / AUTHORITY, directory / KEY, made, key)


def issue(directory: Path, role: str, name: str, vehicle: str | None = None) -> Path:
    """Make a key and its certificate for a role, for `DAYS`. Returns the certificate's file, `ROLE.VEHICLE.pem`.

    `name` is the host or person that gets it; a vehicle of None is every one.

    Raises:
        CertificateError: Role, name or vehicle will not do; a file exists; the authority's key is not here.
    """
    subject, file = _subject(role, name, vehicle), file_of(directory, role, vehicle)
    secret, authority = _read_key(directory / KEY), load(directory / AUTHORITY)
    if authority.public_key() != secret.public_key():
        raise CertificateError(f"{directory / KEY} is not the key of {AUTHORITY} beside it")
    now = datetime.now(UTC)
    if authority.not_valid_after_utc <= now:
        raise CertificateError(EXPIRED.format(directory / AUTHORITY))
    key, until = ec.generate_private_key(ec.SECP256R1()), min(now + timedelta(days=DAYS), authority.not_valid_after_utc)
    made = _signed(secret, authority.subject, subject, key.public_key(), until)
    return _write_pair(file, file.with_suffix(".key"), made, key)


def show(directory: Path) -> list[KeyFile]:
    """The authority and every certificate of a directory, each with what keeps it from being used.

    Raises CertificateError if the directory has no authority.
    """
    ca = load(directory / AUTHORITY)
    expired = EXPIRED.format(directory / AUTHORITY) if ca.not_valid_after_utc < datetime.now(UTC) else None
    named = (file for file in sorted(directory.glob("*.pem")) if file.stem.partition(".")[0] in ROLES)
    return [_row(ca, AUTHORITY, "authority", None, subject_field(ca, "CN"), expired), *map(_shown, named)]


def _shown(file: Path) -> KeyFile:
    role, _, vehicle = file.stem.partition(".")
    problem = None
    try:
        found = read_certificate(file)
    except CertificateError as error:
        return KeyFile(file=file.name, problem=str(error))
    try:
        check(file, role, vehicle or None)
    except CertificateError as error:
        problem = str(error)
    return _row(found.x509, file.name, found.role, found.vehicle, found.name, problem)


def _row(made: x509.Certificate, file: str, role: str, vehicle: str | None, name: str, problem: str | None) -> KeyFile:
    until = made.not_valid_after_utc
    return KeyFile(
        file=file,
        role=role,
        vehicle=vehicle,
        name=name,
        valid_until=until,
        days_left=(until - datetime.now(UTC)).total_seconds() / 86400,
        fingerprint=made.fingerprint(SHA256()).hex(),
        problem=problem,
    )


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
    fields = {NameOID.COMMON_NAME: cn, NameOID.ORGANIZATIONAL_UNIT_NAME: name}
    return x509.Name([x509.NameAttribute(field, text) for field, text in fields.items()])


def _signed(
    secret: ec.EllipticCurvePrivateKey, issuer: x509.Name, subject: x509.Name, public: ec.EllipticCurvePublicKey,
    until: datetime, *, authority: bool = False,
) -> x509.Certificate:  # fmt: skip
    uses = dict.fromkeys(signature(x509.KeyUsage).parameters, False)
    uses["key_cert_sign" if authority else "digital_signature"] = True
    begin = datetime.now(UTC) - _EARLIER
    builder = (
        x509.CertificateBuilder(issuer, subject, public, x509.random_serial_number(), begin, until)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
        .add_extension(x509.KeyUsage(**uses), critical=True)
    )
    if not authority:  # a peer connects and listens
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = builder.add_extension(x509.ExtendedKeyUsage(both), critical=False)
    return builder.sign(secret, SHA256())


def _read_key(file: Path) -> ec.EllipticCurvePrivateKey:
    """Read the authority's private key. Raises CertificateError."""
    if not file.exists():
        raise CertificateError(f"{file} is not here: it stays where `aeroloop host keys init` made it; issue there")
    try:
        return cast(ec.EllipticCurvePrivateKey, load_pem_private_key(file.read_bytes(), None))
    except OSError as error:
        raise CertificateError(f"{file} cannot be read: {error.strerror}") from None
    except (ValueError, TypeError):  # TypeError: it is encrypted
        raise CertificateError(f"{file} is no private key in PEM without a password") from None


def _write_pair(file: Path, secret: Path, made: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Path:
    """Write a certificate and its key as new files, of their mode from the first byte on."""
    for path in (file, secret):
        if os.path.lexists(path):
            raise CertificateError(f"{path} exists, and is not overwritten: move it away first")
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    for path, content, mode in ((secret, pem, 0o600), (file, made.public_bytes(Encoding.PEM), 0o644)):
        try:
            with open(path, "xb", opener=partial(os.open, mode=mode)) as out:
                out.write(content)
        except OSError as error:
            raise CertificateError(f"cannot write {path}: {error.strerror}") from None
    return file
