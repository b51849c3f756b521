"""Keys: makes a private authority in a directory and issues, renews and lists the certificates of a host's roles.

The authority's key stays in the directory where `init` made it. On another host a request is made, and only that
travels: `request` there, `issue_requested` here, and the certificate back, with `ca.pem`. A key is a new file of mode
0600, and nothing is overwritten: `renew` keeps what it replaces under a name with the old certificate's fingerprint.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, cast
from uuid import uuid4

from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.x509.oid import NameOID
from pydantic import BaseModel, Field

from aeroloop.protocol.transport.certificate import (
    AUTHORITY,
    ROLES,
    CertificateError,
    check,
    file_of,
    load,
    names_of,
    read_certificate,
    read_common_name,
)
from aeroloop.service.host import authority

DAYS: Final = 90
"""Lifetime of a certificate. Why so short: Zenoh has no revocation lists, so a stolen key is good until it expires."""
AUTHORITY_DAYS: Final = 3650


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
    certificate, secret = directory / AUTHORITY, directory / authority.KEY
    _make(directory)
    _refuse_existing(certificate, secret)
    key = authority.new_key()
    made = authority.new_authority(key, days)
    _write(secret, authority.pem(key))
    _write(certificate, authority.pem(made), 0o644)
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
    whose, file = authority.subject(role, name, vehicle), file_of(directory, role, vehicle)
    _refuse_existing(file, file.with_suffix(".key"))
    key = authority.new_key()
    made = authority.sign(directory, whose, key.public_key(), days)
    _write(file.with_suffix(".key"), authority.pem(key))
    _write(file, authority.pem(made), 0o644)
    return file


def request(directory: Path, role: str, name: str, vehicle: str | None = None) -> Path:
    """Make a key for a role and a request for its certificate. Returns the request's file, `ROLE.VEHICLE.csr`.

    Arguments and errors are as of `issue`, but for the authority.
    """
    whose, file = authority.subject(role, name, vehicle), file_of(directory, role, vehicle)
    out = file.with_suffix(".csr")
    _make(directory)
    _refuse_existing(file, file.with_suffix(".key"), out)
    key = authority.new_key()
    _write(file.with_suffix(".key"), authority.pem(key))
    _write(out, authority.pem(authority.request(whose, key)), 0o644)
    return out


def issue_requested(directory: Path, file: Path, days: int = DAYS) -> Path:
    """Issue the certificate that a request asks for. Returns its file, beside the request.

    Raises:
        CertificateError: The file is no request of a role, is named as another role's, or the authority's key is not
            here.
    """
    whose, public = authority.read_request(file)
    asks = str(whose.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    out = file.with_suffix(".pem")
    _refuse_existing(out)
    if out != file_of(file.parent, *cast(tuple[str, str | None], read_common_name(asks))):
        raise CertificateError(f"{file} asks for a certificate of {asks}, which its name does not say: not signed")
    _write(out, authority.pem(authority.sign(directory, whose, public, days)), 0o644)
    return out


def renew(directory: Path, which: Sequence[str] = (), days: int = DAYS, *, new_key: bool = False) -> list[Path]:
    """Renew certificates for the same keys. Where the authority's key is not, make requests for that instead.

    Args:
        directory: Where they are.
        which: Roles, or stems of files such as `plant.aero`; all of the directory if none.
        days: How long they are valid.
        new_key: Make new keys, too; only where the authority's key is.

    Returns:
        The new certificates, or the requests.

    Raises:
        CertificateError: There is none of a given name, or one cannot be renewed.
    """
    names = {file: {file.stem, file.stem.partition(".")[0]} for file in _certificates(directory)}
    for each in which:
        if not any(each in own for own in names.values()):
            have = ", ".join(file.stem for file in names) or "none"
            raise CertificateError(f"no certificate of {each} in {directory}; there is {have}")
    chosen = [file for file, own in names.items() if not which or own & set(which)]
    if not chosen:
        raise CertificateError(f"no certificates in {directory}: `aeroloop host keys issue` makes one")
    if (directory / authority.KEY).exists():
        return [_renew(directory, file, days, new_key=new_key) for file in chosen]
    if new_key:
        raise CertificateError(
            f"{directory / authority.KEY} is not here: for a new key, move certificate and key away and request another"
        )
    return [_request_again(file) for file in chosen]


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
        name=names_of(ca)[0],
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
        fingerprint=found.fingerprint,
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


def _renew(directory: Path, file: Path, days: int, *, new_key: bool) -> Path:
    old = read_certificate(file)
    whose, kept = authority.subject(old.role, old.name, old.vehicle), f".{old.fingerprint[:8]}"
    key = authority.new_key() if new_key else None
    public = key.public_key() if key else cast(EllipticCurvePublicKey, load(file).public_key())
    made = authority.sign(directory, whose, public, days)
    if key:
        _replace(old.key, authority.pem(key), 0o600, kept)
    _replace(file, authority.pem(made), 0o644, kept)
    return file


def _request_again(file: Path) -> Path:
    old = read_certificate(file)
    out = file.with_suffix(".csr")
    if not out.exists():  # one that is there is of the same key, and still good
        whose = authority.subject(old.role, old.name, old.vehicle)
        _write(out, authority.pem(authority.request(whose, authority.read_key(old.key))), 0o644)
    return out


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
            raise CertificateError(f"{file} exists, and is not overwritten: renew it, or move it away")


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


def _replace(file: Path, content: bytes, mode: int, kept: str) -> None:
    """Replace a file at once, and keep the old one beside it under a name with another ending."""
    new = file.with_name(f"{file.name}.{uuid4().hex[:8]}")
    _write(new, content, mode)
    try:
        os.link(file, file.with_name(f"{file.name}{kept}"))
        new.replace(file)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise CertificateError(f"cannot replace {file}: {error.strerror}") from None
