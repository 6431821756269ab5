"""Where the page listens, and who may look and act."""

from __future__ import annotations

import ipaddress
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import BAD_ADDRESS, BAD_TEXT
from daqsvc.settings.addresses import ListenAddress  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.files import FilePath  # noqa: TC001
from daqsvc.settings.section import InSchema, Section, Text

DEFAULT = "127.0.0.1:8420"
MOST_NAMES = 32


def _ip_address(text: str) -> str:
    try:
        return f"{ipaddress.ip_address(text)}"
    except ValueError:
        remedy = 'write e.g. "127.0.0.1"'
        raise PydanticCustomError(
            "ip_address", "is no IP address", {"remedy": remedy, "code": BAD_ADDRESS}
        ) from None


def _header(text: str) -> str:
    if not (text.isascii() and text.replace("-", "").isalnum()):
        remedy = 'write a name of letters, digits and -, e.g. "X-Remote-User"'
        raise PydanticCustomError("header", "is no name of a header", {"remedy": remedy, "code": BAD_TEXT})
    return text


_LIKE_AN_ADDRESS = InSchema("an IP address", pattern=r"^[0-9]{1,3}(\.[0-9]{1,3}){3}$|^[^.]*:.*:")
_LETTERS = InSchema("letters, digits and `-`", pattern="^-*[A-Za-z0-9][A-Za-z0-9-]*$")


class Page(Section):
    """The page in a browser, which the service starts as a separate process."""

    listen: ListenAddress = Field(default=DEFAULT, description="host and TCP port where the page listens")
    host_names: Annotated[tuple[Text, ...], Field(strict=False, max_length=MOST_NAMES)] = Field(
        default=(),
        description="host names by which the page is called from other computers",
        examples=['["edge-1.example"]'],
    )
    certificate_file: FilePath | None = Field(
        default=None, description="certificate of TLS, in PEM", examples=["/etc/daqsvc/page.pem"]
    )
    private_key_file: FilePath | None = Field(
        default=None, description="private key of that certificate, in PEM", examples=["/etc/daqsvc/page.key"]
    )
    accounts_file: FilePath | None = Field(
        default=None,
        description="file with accounts to sign in with, made by daqsvc account",
        examples=["/etc/daqsvc/accounts"],
    )
    user_header: Annotated[Text, AfterValidator(_header), _LETTERS] | None = Field(
        default=None,
        description="header in which a reverse proxy names the user who asks",
        examples=["X-Remote-User"],
    )
    proxies: Annotated[
        tuple[Annotated[Text, AfterValidator(_ip_address), _LIKE_AN_ADDRESS], ...],
        Field(strict=False, max_length=MOST_NAMES),
    ] = Field(default=(), description="IP addresses of that proxy", examples=['["127.0.0.1"]'])
    operators: Annotated[tuple[Text, ...], Field(strict=False, max_length=1000)] = Field(
        default=(), description="users of that proxy who may handle alarms", examples=['["ada"]']
    )
