"""Addresses of MQTT brokers."""

from __future__ import annotations

import re
from typing import Annotated, TypeAlias
from urllib.parse import SplitResult, urlsplit

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from daqsvc.settings.section import Text

_HOST = re.compile(r"[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")
_LONGEST_HOST = 254
"""Letters, with the dot at the end that a name may have."""

_DEFAULT_PORTS = {"mqtt": 1883, "mqtts": 8883}


def _split_url(url: str) -> SplitResult:
    """The parts of a broker's address; the value is kept out of every message, it may hold a password."""
    remedy = {"remedy": 'write "mqtts://broker.example:8883", or "mqtt://..." with insecure = true'}
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise PydanticCustomError("broker_url", "is not the address of an MQTT broker", remedy) from None
    if parts.username is not None or parts.password is not None:
        raise PydanticCustomError(
            "broker_url_secret",
            "must not hold a user name or password",
            {
                "remedy": "take them out of the url, write username and password_file instead, "
                "and change the password: it has been in a file that others can read"
            },
        )
    if parts.scheme not in _DEFAULT_PORTS or not parts.hostname or port == 0:
        raise PydanticCustomError("broker_url", "is not the address of an MQTT broker", remedy)
    _check_host(parts.hostname)
    if parts.path not in {"", "/"} or parts.query or parts.fragment:
        raise PydanticCustomError(
            "broker_url", "has something after host and port", {"remedy": "end the url after the port"}
        )
    return parts


def _check_host(host: str) -> None:
    """See that a name can be looked up at all (RFC 1035, section 2.3.4; RFC 3490)."""
    if ":" in host:
        return  # an IPv6 address, which urlsplit has checked
    try:
        name = host.encode("idna").decode("ascii")
    except UnicodeError:
        name = ""
    if not _HOST.fullmatch(name) or len(name) > _LONGEST_HOST:
        raise PydanticCustomError(
            "broker_host",
            "has a host that cannot be the name of one",
            {
                "remedy": "correct it: parts of letters, digits and '-', 1 to 63 of them each, with a dot "
                "between two parts"
            },
        )


def _broker_url(url: str) -> str:
    _split_url(url)
    return url


BrokerUrl: TypeAlias = Annotated[Text, AfterValidator(_broker_url)]
"""``mqtts://host:port``, or ``mqtt://`` without TLS; no credentials, no path."""


def is_tls(url: str) -> bool:
    """Whether the connection is encrypted and the broker's certificate verified."""
    return urlsplit(url).scheme == "mqtts"


def host_of(url: str) -> str:
    """Host name or address."""
    return urlsplit(url).hostname or ""


def port_of(url: str) -> int:
    """TCP port: as in the url, else 1883, with TLS 8883."""
    parts = urlsplit(url)
    return parts.port or _DEFAULT_PORTS[parts.scheme]
