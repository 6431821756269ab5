"""What the box shows to the broker and what it trusts: read from files again for every connection.

So a password or certificate that was replaced takes effect at the next connection, and nothing secret
stays in the settings. Secrets are in no message of this module and in no ``repr``.

The standard library verifies certificates but tells the dates of a peer's certificate only, not of those in
files. `cryptography` reads both; it is imported where there is TLS only.
"""

from __future__ import annotations

import contextlib
import logging
import os
import ssl
import stat
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import CERTIFICATE_UNKNOWN
from daqsvc.publish.mqtt.settings import LONGEST_PASSWORD, first_line

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cryptography import x509

    from daqsvc.publish.mqtt.settings import Mqtt

log = logging.getLogger(__name__)

CREDENTIALS_DIRECTORY = "CREDENTIALS_DIRECTORY"
"""Where systemd tells a service the directory of its credentials (systemd.exec, LoadCredential=)."""


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


@dataclass(frozen=True, slots=True)
class Credentials:
    """What one connection is made with.

    Attributes:
        password: None without one.
        context: None without TLS.
        own: the box's certificate; None without one.
        trusted: the authorities of `ca_file`; empty for those of the system.
        stamp: changes whenever one of the files does; see `stamp_of`.
        exposed: files with a secret that every user of the machine can read.
    """

    password: str | None = field(repr=False)
    context: ssl.SSLContext | None
    own: Certificate | None
    trusted: tuple[Certificate, ...]
    stamp: tuple[object, ...]
    exposed: tuple[Path, ...] = ()


def read_credentials(settings: Mqtt) -> Credentials:
    """Read password, key and certificates as the files are now; blocks.

    Raises:
        OSError: a file cannot be read, or does not hold what it should; the message names it.
    """
    stamp = stamp_of(settings)  # before reading: what is replaced meanwhile is seen as changed later
    for path in _files(settings):
        _check_regular(path)
    password = _password(settings)
    exposed = tuple(path for path in _secrets(settings) if _is_exposed(path))
    if not settings.tls:
        return Credentials(password, None, None, (), stamp, exposed)
    context = tls_context(settings.ca_file)
    own = None
    if settings.cert_file is not None:
        key = _key_file(settings)
        _show(context, settings.cert_file, key)
        own = next(iter(_watched(settings.cert_file)), None)
    trusted = () if settings.ca_file is None else tuple(_watched(settings.ca_file))
    return Credentials(password, context, own, trusted, stamp, exposed)


def stamp_of(settings: Mqtt) -> tuple[object, ...]:
    """Which files there are now: identity, size and time of change of each; blocks."""
    return tuple(_stamp(path) for path in _files(settings))


def tls_context(ca_file: Path | None) -> ssl.SSLContext:
    """A context that verifies the broker's certificate and host name; reads files.

    Args:
        ca_file: certificate authorities in PEM; None for those of the system.

    Raises:
        OSError: the file cannot be read, or holds no certificate.
    """
    try:
        context = ssl.create_default_context(cafile=ca_file)
    except ssl.SSLError as error:
        raise OSError(f"ca_file {ca_file} holds no certificate in PEM: {error}") from error
    except OSError as error:
        raise OSError(f"ca_file {ca_file} cannot be read: {error.strerror or error}") from error
    # A certificate without alternative names states of no host that it is its own (RFC 9525, section 6.3).
    context.hostname_checks_common_name = False
    return context


def _show(context: ssl.SSLContext, cert_file: Path, key_file: Path | None) -> None:
    """Let the context show a certificate to the broker."""

    def no_password() -> str:
        # OpenSSL would ask at the terminal, and the service would wait there for ever.
        raise OSError(f"the key of {cert_file} is encrypted; give one that is not, e.g. as a credential")

    try:
        context.load_cert_chain(cert_file, key_file, no_password)
    except ssl.SSLError as error:
        raise OSError(
            f"cert_file {cert_file} and its key {key_file or cert_file} cannot be used together: {error}"
        ) from error
    except FileNotFoundError as error:
        missing = next((path for path in (cert_file, key_file) if path and not path.exists()), cert_file)
        raise FileNotFoundError(
            f"{missing} is not there; put it there, or correct cert_file and key_file"
        ) from error


def _watched(path: Path) -> list[Certificate]:
    """The certificates of a file, to know when they end; none if only OpenSSL can read them."""
    try:
        return certificates(path)
    except CertificateError as error:
        log.warning(
            "no alarm will warn before the certificates in %s end: %s",
            path,
            error,
            extra=coded(CERTIFICATE_UNKNOWN),
        )
        return []


def _password(settings: Mqtt) -> str | None:
    file = _password_file(settings)
    if file is None:
        return None
    line = first_line(file)
    if len(line) > LONGEST_PASSWORD:
        raise OSError(
            f"the first line of {file} has more than {LONGEST_PASSWORD} bytes, which MQTT cannot carry; "
            "write the password, and nothing else, into it"
        )
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        # The error itself would hold the bytes of the password.
        raise OSError(f"{file} is not UTF-8 text; write the password into it, in its first line") from None


def _check_regular(path: Path) -> None:
    """Refuse what might never end, such as a pipe; what is not there is reported by whoever reads it."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return
    if not stat.S_ISREG(mode):
        raise OSError(f"{path} is no regular file, and reading it might never end; put a file there")


def _is_exposed(path: Path) -> bool:
    try:
        return bool(path.stat().st_mode & stat.S_IROTH)
    except OSError:
        return False


def _secrets(settings: Mqtt) -> list[Path]:
    """The files of password and key, as far as there are any."""
    secrets = []
    for wanted in (_password_file, _key_file) if settings.tls else (_password_file,):
        with contextlib.suppress(FileNotFoundError):  # reported when it is read
            path = wanted(settings)
            if path is not None:
                secrets.append(path)
    return secrets


def _password_file(settings: Mqtt) -> Path | None:
    if settings.password_credential is not None:
        return _credential(settings.password_credential)
    return settings.password_file


def _key_file(settings: Mqtt) -> Path | None:
    if settings.key_credential is not None:
        return _credential(settings.key_credential)
    return settings.key_file


def _credential(name: str) -> Path:
    """Where systemd has put a credential of the service."""
    directory = os.environ.get(CREDENTIALS_DIRECTORY)
    if directory is None:
        raise FileNotFoundError(
            f"there is no credential {name!r}: ${CREDENTIALS_DIRECTORY} is not set; write "
            f"LoadCredential={name}:/path/to/it in the systemd unit, or name a file in the machine file"
        )
    return Path(directory) / name


def _files(settings: Mqtt) -> list[Path]:
    shown = [settings.ca_file, settings.cert_file] if settings.tls else []
    return [*(path for path in shown if path is not None), *_secrets(settings)]


def _stamp(path: Path) -> object:
    try:
        status = path.stat()
    except OSError:
        return path, None
    return path, status.st_ino, status.st_size, status.st_mtime_ns
