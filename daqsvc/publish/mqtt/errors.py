"""What goes wrong between the box and a broker: its names, its words for a person, each logged once."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import traceback
from typing import TYPE_CHECKING, Any, Final, TypeVar

from paho.mqtt.client import error_string

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import (
    BROKER_AWAY,
    BROKER_REFUSES,
    BROKER_TLS,
    CLIENT_ID_TAKEN,
    CREDENTIAL_FILE,
    OUTPUT_FAILED,
)

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from paho.mqtt.reasoncodes import ReasonCode

    from daqsvc.errors.code import Code

log = logging.getLogger(__name__)

_T = TypeVar("_T")

MOST_REASONS = 8
"""Reasons that are logged in one outage: one with a number in it must not fill the log."""

_EXPIRED = 10
_VERIFICATION = {
    9: "its certificate is not valid yet; look at the clock of the box",
    _EXPIRED: "its certificate, or that of its authority, has expired; renew it there, or set the clock of "
    "the box",
}
_OTHER_HOST = {62, 64}
_UNKNOWN_AUTHORITY = {18, 19, 20, 21}
"""Verification results of OpenSSL (X509_V_ERR_...)."""

_CODES = {
    128: "the broker gave no reason",
    134: "it refuses the user name or the password",
    135: "this client is not authorised; look at its user name and certificate and the broker's list",
    141: "nothing was heard for longer than the keep-alive",
}
"""Reason codes of MQTT 5 (2.4) that have better words than their name; paho makes them of those of 3.1.1."""

MOST_CAUSES: Final = 32
"""Causes that are remembered as logged; after these nothing more is logged, only counted."""


class MqttError(Exception):
    """The broker refuses, or the connection to it is lost."""


class MqttCodeError(MqttError):
    """The broker, or the library, has given a code as the reason.

    Args:
        rc: a reason code of MQTT 5 (paho makes them of those of 3.1.1), or a number of the library's.
        text: what could not be done.
    """

    def __init__(self, rc: ReasonCode | int, text: str = "") -> None:
        super().__init__(f"{text}: {rc}" if text else str(rc))
        self.rc = rc


class NoConsentError(MqttError):
    """The broker was reached, but did not answer whether it accepts the connection."""


class PublishRefusedError(MqttError):
    """The broker will not take one message; the connection stands."""


class SilentBrokerError(MqttError):
    """The connection stands, but no acknowledgement came over it in time."""


class TakenOverError(MqttError):
    """Another client has connected with the same client id."""


class Outage:
    """What has been logged of a broker that is away.

    Args:
        log: where it is reported.
    """

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._reported: list[tuple[str, str]] = []

    @property
    def is_reported(self) -> bool:
        """Whether it has been logged that the broker is away."""
        return bool(self._reported)

    def tell(self, broker: str, error: Exception, until: str) -> None:
        """Log why a broker is away, unless that has been logged.

        Args:
            broker: which one, e.g. ``"MQTT broker 10.0.0.1:8883"``.
            error: the reason.
            until: what is going on about it.
        """
        reason = in_words(error)
        still = "still " if any(sentence == broker for sentence, _ in self._reported) else ""
        if self.note(broker, reason):
            self._log.warning(
                "%s is %saway: %s; %s", broker, still, reason, until, extra=coded(kind_of(error))
            )

    def tell_lost(self, broker: str, error: Exception) -> None:
        """Log why a connection has ended, once; the broker may be there all the same."""
        reason = in_words(error)
        if self.note(broker, reason):
            self._log.warning("%s: %s; connecting again", broker, reason, extra=coded(kind_of(error)))

    def note(self, broker: str, reason: str) -> bool:
        """Take a reason as reported; whether it is a new one that may be logged."""
        if (broker, reason) in self._reported or len(self._reported) >= MOST_REASONS:
            return False
        self._reported.append((broker, reason))
        return True

    def end(self) -> None:
        """The broker is there: what comes next is another outage."""
        self._reported.clear()


def has_expired(error: Exception) -> bool:
    """Whether the broker was refused because a certificate that it shows has expired."""
    return isinstance(error, ssl.SSLCertVerificationError) and error.verify_code == _EXPIRED


def in_words(error: Exception | None) -> str:
    """A failure to connect, or the end of a connection, in words."""
    words = str(error or "closed")
    match error:
        case ssl.SSLCertVerificationError():
            words = _unverified(error)
        case ssl.SSLError():
            words = f"TLS failed: {(getattr(error, 'reason', None) or words).lower().replace('_', ' ')}"
        case ConnectionRefusedError():
            words = "nothing listens there"
        case socket.gaierror():
            words = f"its name is not known: {error.strerror}"
        case TimeoutError():
            words = "it does not answer"
        case MqttCodeError():
            words = _coded(error)
        case FileNotFoundError() if error.filename is not None:
            words = f"{error.filename} is missing; put it there, or correct its path in the machine file"
        case OSError() if error.strerror is not None:
            words = error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return words


def kind_of(error: Exception | None) -> Code:
    """The code of a failure to connect, or of the end of a connection."""
    match error:
        case ssl.SSLError():
            return BROKER_TLS
        case TakenOverError():
            return CLIENT_ID_TAKEN
        case MqttCodeError() if not isinstance(error.rc, int):
            return BROKER_REFUSES
        case FileNotFoundError() if error.filename is not None:
            return CREDENTIAL_FILE
    return BROKER_AWAY


def _unverified(error: ssl.SSLCertVerificationError) -> str:
    problem = error.verify_message.rstrip(".")
    if error.verify_code in _OTHER_HOST:
        return f"its certificate is for another host: {problem}"
    if error.verify_code in _UNKNOWN_AUTHORITY:
        return f"its certificate is not signed by an authority in ca_file: {problem}"
    return _VERIFICATION.get(error.verify_code, f"its certificate is refused: {problem}")


def _coded(error: MqttCodeError) -> str:
    if isinstance(error.rc, int):
        return error_string(error.rc).rstrip(".")  # a number of the library's, not of the standard
    return _CODES.get(getattr(error.rc, "value", 0), str(error.rc))


class Faults:
    """What went wrong unexpectedly.

    Attributes:
        count: how often.
    """

    def __init__(self) -> None:
        self.count = 0
        self._logged: set[tuple[str, str]] = set()

    def note(self, what: str, error: Exception) -> None:
        """Count an error, and log each cause once, in one line that names where it came from.

        Args:
            what: what could not be done, and what follows.
            error: the reason.
        """
        self.count += 1
        frames = traceback.extract_tb(error.__traceback__)
        where = f"{frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno}" if frames else "?"
        cause = (what, f"{type(error).__name__} at {where}")
        if cause in self._logged or len(self._logged) >= MOST_CAUSES:
            return
        self._logged.add(cause)
        log.error(
            "%s: %s (%.200s); please report this",
            what,
            cause[1],
            ascii(str(error)),
            extra=coded(OUTPUT_FAILED),
        )


async def unless(stopping: asyncio.Event, work: Coroutine[Any, Any, _T]) -> _T | None:
    """The result of ``work``; None, and ``work`` cancelled, if ``stopping`` is set before."""
    task = asyncio.ensure_future(work)
    stopped = asyncio.ensure_future(stopping.wait())
    try:
        await asyncio.wait({task, stopped}, return_when=asyncio.FIRST_COMPLETED)
        return task.result() if task.done() else None
    finally:
        for each in (task, stopped):
            each.cancel()
        await asyncio.gather(task, stopped, return_exceptions=True)
