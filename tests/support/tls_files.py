"""Certificates for tests: authorities, and those that they issue."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import trustme
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

if TYPE_CHECKING:
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes


@dataclass(frozen=True)
class Pair:
    """Files of a certificate and its key, and when it ends, in s since 1970."""

    cert: Path
    key: Path
    not_after_s: float

    def replaces(self, other: Pair) -> None:
        """Put this pair in the place of another one, as a renewal does."""
        for mine, theirs in ((self.key, other.key), (self.cert, other.cert)):
            arriving = theirs.with_suffix(".new")
            arriving.write_bytes(mine.read_bytes())
            arriving.replace(theirs)

    def encrypt_key(self, password: str) -> None:
        key = serialization.load_pem_private_key(self.key.read_bytes(), None)
        self.key.write_bytes(_pem(key, serialization.BestAvailableEncryption(password.encode())))


def self_signed(
    directory: Path, name: str, host: str | None, *, days: int = 2, key: Path | None = None
) -> Pair:
    """A certificate that is its own authority; for ``host`` unless that is None.

    Args:
        directory: where the files go.
        name: common name, and name of the files.
        host: a name or an address.
        days: until it ends.
        key: the key to use again, as a renewal may; a new one if None.
    """
    private = (
        ec.generate_private_key(ec.SECP256R1())
        if key is None
        else serialization.load_pem_private_key(key.read_bytes(), None)
    )
    assert isinstance(private, ec.EllipticCurvePrivateKey)
    own = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    end = _in(days)
    made = (
        x509.CertificateBuilder(own, own, private.public_key(), x509.random_serial_number(), _in(-2), end)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(private.public_key()), critical=False)
    )
    if host is not None:
        made = made.add_extension(x509.SubjectAlternativeName([_general_name(host)]), critical=False)
    pem = made.sign(private, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    return _written(directory, name, pem, _pem(private, serialization.NoEncryption()), end)


def authority(directory: Path, name: str, *, days: int = 30) -> Pair:
    """A certificate authority."""
    return self_signed(directory, name, None, days=days)


def signed(directory: Path, name: str, by: Pair, *, host: str | None = None, days: int = 5) -> Pair:
    """A certificate that an authority has issued: for a broker at ``host``, or for a client."""
    issuer = trustme.CA.from_pem(by.cert.read_bytes(), by.key.read_bytes())
    end = _in(days)
    leaf = issuer.issue_cert(*([] if host is None else [host]), common_name=name, not_after=end)
    return _written(directory, name, leaf.cert_chain_pems[0].bytes(), leaf.private_key_pem.bytes(), end)


def _in(days: int) -> datetime:
    return datetime.now(UTC).replace(microsecond=0) + timedelta(days=days)


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(key: PrivateKeyTypes, encryption: serialization.KeySerializationEncryption) -> bytes:
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)


def _written(directory: Path, name: str, cert: bytes, key: bytes, end: datetime) -> Pair:
    pair = Pair(directory / f"{name}.crt", directory / f"{name}.key", end.timestamp())
    pair.cert.write_bytes(cert)
    pair.key.write_bytes(key)
    return pair
