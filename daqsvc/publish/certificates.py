"""How long certificates last: read from the files and from what the broker shows.

The standard library verifies certificates but tells the dates of a peer's certificate only, not of those in
files. The few fields that are needed here are read from the DER encoding (ITU-T X.690) of RFC 5280.
"""

from __future__ import annotations

import re
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

_PEM = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)

_INTEGER, _SEQUENCE, _UTC_TIME, _GENERALIZED_TIME, _VERSION = 0x02, 0x30, 0x17, 0x18, 0xA0


class CertificateError(ValueError):
    """Bytes that are no X.509 certificate."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """What matters here of one certificate.

    Attributes:
        issuer: distinguished name of who vouches for it, DER.
        subject: distinguished name of whom it is about, DER.
        not_after_ns: end of its validity, wall clock.
    """

    issuer: bytes
    subject: bytes
    not_after_ns: int


def certificate(der: bytes) -> Certificate:
    """Read a certificate (RFC 5280, section 4.1).

    Args:
        der: its DER encoding, e.g. of `ssl.SSLSocket.getpeercert`.

    Raises:
        CertificateError: it is none.
    """
    try:
        (_, outer), *_ = _parts(der)
        (_, signed), *_ = _parts(outer)
        fields = [part for part in _parts(signed) if part[0] != _VERSION]
        (serial_tag, _), _, (_, issuer), (validity_tag, validity), (_, subject), *_ = fields
        _, (time_tag, not_after) = _parts(validity)
        if (serial_tag, validity_tag) != (_INTEGER, _SEQUENCE):
            raise CertificateError("its fields are not those of RFC 5280")
        return Certificate(issuer, subject, _wall_ns(time_tag, not_after))
    except (ValueError, IndexError) as error:
        raise CertificateError(f"not an X.509 certificate: {error}") from error


def certificates(path: Path) -> list[Certificate]:
    """The certificates of a PEM file, in its order; blocks.

    Raises:
        OSError: it cannot be read.
        CertificateError: it holds something else between the marks of a certificate.
    """
    text = path.read_text(encoding="ascii", errors="replace")
    return [certificate(ssl.PEM_cert_to_DER_cert(pem)) for pem in _PEM.findall(text)]


def voucher(shown: Certificate, trusted: Iterable[Certificate]) -> Certificate | None:
    """Which of the trusted authorities vouches for a certificate.

    A file of authorities may hold the outgoing and the coming one: only the one in use matters. If none of
    them has signed it itself, because another certificate stands between, the first to end is meant.
    """
    trusted = list(trusted)
    issuers = [one for one in trusted if one.subject == shown.issuer]
    # Of two with the same name, the renewed one vouches when the old one has ended.
    return max(issuers, key=_end) if issuers else min(trusted, key=_end, default=None)


def _end(one: Certificate) -> int:
    return one.not_after_ns


def _parts(der: bytes) -> Iterator[tuple[int, bytes]]:
    """Tag and content of each element, one after the other."""
    at = 0
    while at < len(der):
        tag, length, at = der[at], der[at + 1], at + 2
        if length & 0x80:
            size = length & 0x7F
            length, at = int.from_bytes(der[at : at + size]), at + size
        if at + length > len(der):
            raise CertificateError("it ends too early")
        yield tag, der[at : at + length]
        at += length


def _wall_ns(tag: int, text: bytes) -> int:
    """Nanoseconds since 1970 of a UTCTime or GeneralizedTime (RFC 5280, section 4.1.2.5)."""
    digits = text.decode("ascii")
    if tag == _UTC_TIME:
        digits = ("19" if int(digits[:2]) >= 50 else "20") + digits
    elif tag != _GENERALIZED_TIME:
        raise CertificateError("its validity is no time")
    moment = datetime.strptime(digits, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
    return int(moment.timestamp()) * NS_PER_S
