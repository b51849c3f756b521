"""Private authority: builds and signs X.509 certificates of roles, and requests for them. Keys are EC P-256.

Imports `cryptography` at once, so it is itself imported where it is used.
"""

from __future__ import annotations

import re
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

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.certificate import (
    AUTHORITY,
    OF_ONE_VEHICLE,
    ROLES,
    CertificateError,
    common_name,
    load,
    names_of,
    read_common_name,
)

KEY: Final = "ca.key"
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


def new_key() -> EllipticCurvePrivateKey:
    """A new private key."""
    return generate_private_key(SECP256R1())


def read_key(file: Path) -> EllipticCurvePrivateKey:
    """Read a private key. Raises CertificateError."""
    try:
        return cast(EllipticCurvePrivateKey, load_pem_private_key(file.read_bytes(), None))
    except OSError as error:
        raise CertificateError(f"{file} cannot be read: {error.strerror}") from None
    except (ValueError, TypeError):  # TypeError: it is encrypted
        raise CertificateError(f"{file} is no private key in PEM without a password") from None


def pem(made: x509.Certificate | x509.CertificateSigningRequest | EllipticCurvePrivateKey) -> bytes:
    """The text of a certificate's, a request's or a private key's file."""
    if isinstance(made, EllipticCurvePrivateKey):
        return made.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return made.public_bytes(Encoding.PEM)


def subject(role: str, name: str, vehicle: str | None) -> x509.Name:
    """Subject of a role's certificate. Raises CertificateError for what cannot be one."""
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


def new_authority(key: EllipticCurvePrivateKey, days: int) -> x509.Certificate:
    """A new authority's certificate, under a name of its own: one that replaces another must not be taken for it."""
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"aeroloop authority {uuid4().hex[:8]}")])
    until = datetime.now(UTC) + timedelta(days=days)
    return _signed(key, name, name, key.public_key(), until, authority=True)


def sign(directory: Path, whose: x509.Name, public: EllipticCurvePublicKey, days: int) -> x509.Certificate:
    """A certificate for a key, of the authority in a directory; it ends with the authority's at the latest.

    Raises:
        CertificateError: The authority's key is not here, or it has expired.
    """
    secret = directory / KEY
    if not secret.exists():
        raise CertificateError(
            f"{secret} is not here: it stays where `aeroloop host keys init` made it; issue there, or "
            "make a request here with `aeroloop host keys request`"
        )
    key, authority = read_key(secret), load(directory / AUTHORITY)
    if authority.public_key() != key.public_key():
        raise CertificateError(f"{secret} is not the key of {AUTHORITY} beside it")
    now = datetime.now(UTC)
    if authority.not_valid_after_utc <= now:
        raise CertificateError(f"{directory / AUTHORITY} has expired: make a new authority in another directory")
    until = min(now + timedelta(days=days), authority.not_valid_after_utc)
    return _signed(key, authority.subject, whose, public, until)


def request(whose: x509.Name, key: EllipticCurvePrivateKey) -> x509.CertificateSigningRequest:
    """A request for a certificate of a key."""
    return x509.CertificateSigningRequestBuilder(whose).sign(key, SHA256())


def read_request(file: Path) -> tuple[x509.Name, EllipticCurvePublicKey]:
    """Subject and key of a request. Raises CertificateError if it is none for a role's certificate."""
    try:
        asked = x509.load_pem_x509_csr(file.read_bytes())
    except OSError as error:
        raise CertificateError(f"{file} cannot be read: {error.strerror}") from None
    except ValueError:
        raise CertificateError(f"{file} is no request in PEM, as `aeroloop host keys request` makes it") from None
    cn, name = names_of(asked)
    found, public = read_common_name(cn), asked.public_key()
    if found is None or not asked.is_signature_valid or not isinstance(public, EllipticCurvePublicKey):
        raise CertificateError(f"{file} is no request for a role's certificate: its common name is {cn!r}")
    role, vehicle = found
    return subject(role, name, vehicle), public


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
