"""How long certificates last: read from the files and from what the broker shows.

The standard library verifies certificates but tells the dates of a peer's certificate only, not of those in
files. `cryptography` reads both; it is imported where there is TLS only.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from cryptography import x509


class CertificateError(ValueError):
    """Bytes that are no X.509 certificate."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """What matters here of one certificate.

    Attributes:
        issuer: distinguished name of the authority that has signed it.
        subject: distinguished name of its owner.
        not_after_ns: end of its validity, wall clock.
    """

    issuer: x509.Name
    subject: x509.Name
    not_after_ns: int


def certificate(der: bytes) -> Certificate:
    """Read a certificate.

    Args:
        der: its DER encoding, e.g. of `ssl.SSLSocket.getpeercert`.

    Raises:
        CertificateError: it is none.
    """
    from cryptography import x509  # noqa: PLC0415 - 10 MB that only TLS needs

    try:
        return _read(x509.load_der_x509_certificate(der))
    except (ValueError, x509.InvalidVersion) as error:
        raise CertificateError(f"not an X.509 certificate: {error}") from error


def certificates(path: Path) -> list[Certificate]:
    """The certificates of a PEM file, in its order; blocks.

    Raises:
        OSError: it cannot be read.
        CertificateError: it holds none, or something else between the marks of a certificate.
    """
    from cryptography import x509  # noqa: PLC0415 - 10 MB that only TLS needs

    try:
        return [_read(one) for one in x509.load_pem_x509_certificates(path.read_bytes())]
    except (ValueError, x509.InvalidVersion) as error:
        raise CertificateError(f"not an X.509 certificate: {error}") from error


def issuer_of(shown: Certificate, trusted: Iterable[Certificate]) -> Certificate | None:
    """Which of the trusted authorities has signed a certificate, by their names.

    A file of authorities may hold the outgoing and the coming one: only the one in use matters. If none of
    them has signed it itself, because there is an intermediate certificate, the first to end is meant.
    """
    trusted = list(trusted)
    issuers = [one for one in trusted if one.subject == shown.issuer]
    # Of two with the same name, the renewed one counts when the old one has ended.
    return max(issuers, key=_end) if issuers else min(trusted, key=_end, default=None)


def _end(one: Certificate) -> int:
    return one.not_after_ns


def _read(parsed: x509.Certificate) -> Certificate:
    since_1970 = parsed.not_valid_after_utc - datetime(1970, 1, 1, tzinfo=UTC)
    not_after_s = since_1970.days * 86_400 + since_1970.seconds
    return Certificate(parsed.issuer, parsed.subject, not_after_s * NS_PER_S)
