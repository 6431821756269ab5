"""Where metrics are served."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.settings.addresses import is_host
from daqsvc.settings.section import Section, Text

DEFAULT = "127.0.0.1:9464"
MOST_PORT = 65_535


class Address(NamedTuple):
    """A host and a TCP port of it."""

    host: str
    port: int


def address_of(text: str) -> Address | None:
    """The address that ``HOST:PORT`` names; None if it is none. A host of colons stands in brackets."""
    host, _, port = text.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    if (":" in bare) != (host != bare) or not is_host(bare):
        return None
    if not (port.isascii() and port.isdecimal() and len(port) <= 5 and 1 <= int(port) <= MOST_PORT):
        return None
    return Address(bare, int(port))


def _listening(text: str) -> str:
    if address_of(text) is None:
        remedy = f'write an address of this machine and a port, e.g. listen = "{DEFAULT}" or "[::1]:9464"'
        raise PydanticCustomError("listen", "is no address to listen at", {"remedy": remedy})
    return text


class Metrics(Section):
    """Metrics for Prometheus, and a health endpoint."""

    listen: Annotated[Text, AfterValidator(_listening)] = Field(
        default=DEFAULT, description="host and TCP port at which /metrics and /healthz are served"
    )
