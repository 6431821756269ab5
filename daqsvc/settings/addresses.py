"""Where a device is: hosts and device files, in the form that the drivers take."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Annotated, NamedTuple, TypeAlias

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import BAD_ADDRESS, BAD_PATH
from daqsvc.settings.buses import Device
from daqsvc.settings.section import InSchema, Text

_LABEL = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")
_LONGEST_HOST = 253
"""Characters of a host name, and 63 of each of its labels (RFC 1035)."""
_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]*://")
_PORT = re.compile(r":(\d{1,5})$")


def _host(text: str) -> str:
    host = text.removeprefix("[").removesuffix("]")
    if host == text and is_host(text):
        return text
    # What is left of a URL that was meant: without scheme, path and port.
    rest = _SCHEME.sub("", text).split("/")[0]
    port = _PORT.search(rest)
    if port is not None:
        rest = rest[: port.start()]
    rest = rest.removeprefix("[").removesuffix("]")
    also = f" and tcp_port = {port[1]}" if port is not None else ""
    example = rest if is_host(rest) else "192.0.2.10"
    raise PydanticCustomError(
        "host",
        "is no name or address of a host" if _SCHEME.match(text) is None else "is a URL, not a host",
        {"remedy": f'write host = "{example}"{also}', "code": BAD_ADDRESS},
    )


def is_host(text: str) -> bool:
    """Whether a text is an IP address, or can be a host's name."""
    try:
        ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        try:
            text = text.encode("idna").decode("ascii")
        except UnicodeError:
            return False
        labels = text.removesuffix(".").split(".")
        # Names all of numbers are addresses that are none, e.g. 192.168.1.
        return (
            len(text) <= _LONGEST_HOST
            and all(_LABEL.fullmatch(label) for label in labels)
            and not labels[-1].isdigit()
        )
    return True


def _device_path(path: str) -> str:
    if not path.startswith("/"):
        port = path if path.startswith("tty") else "ttyUSB0"
        raise PydanticCustomError(
            "device_path",
            "is not the whole path of a port",
            {
                "remedy": f"write it from the root, e.g. /dev/serial/by-id/... or /dev/{port}",
                "code": BAD_PATH,
            },
        )
    return path


Host: TypeAlias = Annotated[Text, AfterValidator(_host)]
"""Name or address of a host, without scheme and port."""

DevicePath: TypeAlias = Annotated[Text, AfterValidator(_device_path)]
"""The whole path of a device file."""


def serial_port(key: str, path: str) -> Device:
    """A serial port that a bus has for itself, whatever it carries and whichever link to it is named.

    Args:
        key: the key that names it.
        path: its device file.
    """
    remedy = "give each bus its own port, or put all streams of the port on one bus"
    return Device(key, ("serial port", Path(path).resolve()), remedy)


MOST_PORT = 65_535


class Address(NamedTuple):
    """A host and a TCP port of it."""

    host: str
    port: int

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches it, as far as its name states."""
        return is_loopback(self.host)


def address_of(text: str) -> Address | None:
    """The address that ``HOST:PORT`` names; None if it is none. A host with colons is in brackets."""
    host, _, port = text.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    if (":" in bare) != (host != bare) or not is_host(bare):
        return None
    if not (port.isascii() and port.isdecimal() and len(port) <= 5 and 1 <= int(port) <= MOST_PORT):
        return None
    return Address(bare, int(port))


def is_loopback(host: str) -> bool:
    """Whether a host is this machine for itself."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_everywhere(host: str) -> bool:
    """Whether who listens there does so at every address of the machine."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def _listening(text: str) -> str:
    if address_of(text) is None:
        remedy = 'write an address of this machine and a port, e.g. listen = "127.0.0.1:9000" or "[::1]:9000"'
        raise PydanticCustomError(
            "listen", "is no address to listen at", {"remedy": remedy, "code": BAD_ADDRESS}
        )
    return text


_PORT_DIGITS = r"0*([1-9][0-9]{0,3}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"
ListenAddress: TypeAlias = Annotated[
    Text,
    AfterValidator(_listening),
    InSchema("`HOST:PORT`, port 1 to 65_535", pattern=rf"^(\[[^\[\]]+\]|[^:\[\]]+):{_PORT_DIGITS}$"),
]
"""``HOST:PORT`` where this machine listens."""
