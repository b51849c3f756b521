"""A private authority in a folder, and certificates of every kind: good, expired, not yet valid, foreign, misnamed.

Written with the `cryptography` library alone, so that it is a second opinion on what `aeroloop host keys` makes.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

DAY = timedelta(days=1)


def common_name(role: str, vehicle: str | None) -> str:
    """Common name of a certificate: no name that a public authority signs, which Zenoh's connecting side trusts."""
    return f"{role}/{vehicle}" if vehicle else role


class Authority:
    """A private authority, whose `ca.pem` and certificates stand in one `folder`, as a host has them."""

    def __init__(self, folder: Path, days: float = 10.0) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"authority of {folder.name}")])
        now = datetime.now(UTC)
        self.certificate = (
            x509.CertificateBuilder(self._name, self._name, self._key.public_key(), x509.random_serial_number())
            .not_valid_before(now - DAY)
            .not_valid_after(now + days * DAY)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .sign(self._key, SHA256())
        )
        (folder / "ca.pem").write_bytes(self.certificate.public_bytes(Encoding.PEM))

    def issue(
        self,
        role: str,
        vehicle: str | None = None,
        *,
        file: str | None = None,
        folder: Path | None = None,
        begins: timedelta = -DAY / 24,
        ends: timedelta = DAY,
        cn: str | None = None,
    ) -> Path:
        """Issue a certificate with a key of its own and return its file, `ROLE.VEHICLE.pem`, beside which the key is.

        `file` is another stem for it, for a certificate under a wrong name; `folder` another folder, for a foreign one
        among others; `begins` and `ends` bound its validity from now on; `cn` is a common name of another role or none.
        """
        key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
        subject = [
            x509.NameAttribute(NameOID.COMMON_NAME, cn or common_name(role, vehicle)),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, "a test"),
        ]
        certificate = (
            x509.CertificateBuilder(self._name, x509.Name(subject), key.public_key(), x509.random_serial_number())
            .not_valid_before(now + min(begins, ends - DAY))
            .not_valid_after(now + ends)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .sign(self._key, SHA256())
        )
        path = (folder or self.folder) / f"{file or '.'.join(filter(None, (role, vehicle)))}.pem"
        path.write_bytes(certificate.public_bytes(Encoding.PEM))
        secret = path.with_suffix(".key")
        secret.touch(mode=0o600)
        secret.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
        return path
