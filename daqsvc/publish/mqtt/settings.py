"""The broker that alarms and diagnoses go to, and what may be asked over it."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias
from urllib.parse import SplitResult, urlsplit

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import BAD_ADDRESS, SECRET_IN_FILE
from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import ClientId, Name, Section, Text

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.settings.models import MachineFile

_HOST = re.compile(r"[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")
_LONGEST_HOST = 254
"""Letters, with the dot at the end that a name may have."""

LONGEST_PASSWORD = 65_535
"""Bytes of the longest password that MQTT can carry."""

_DEFAULT_PORTS = {"mqtt": 1883, "mqtts": 8883}


def _split_url(url: str) -> SplitResult:
    """The parts of a broker's address; the value is kept out of every message, it may hold a password."""
    no_address = PydanticCustomError(
        "broker_url",
        "is not the address of an MQTT broker",
        {
            "remedy": 'write "mqtts://broker.example:8883", or "mqtt://..." with insecure = true',
            "code": BAD_ADDRESS,
        },
    )
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise no_address from None
    if parts.username is not None or parts.password is not None:
        raise PydanticCustomError(
            "broker_url_secret",
            "must not hold a user name or password",
            {
                "remedy": "take them out of the url, write username and password_file instead, "
                "and change the password: it has been in a file that others can read",
                "code": SECRET_IN_FILE,
            },
        )
    if parts.scheme not in _DEFAULT_PORTS or not parts.hostname or port == 0:
        raise no_address
    _check_host(parts.hostname)
    if parts.path not in {"", "/"} or parts.query or parts.fragment:
        raise PydanticCustomError(
            "broker_url",
            "has something after host and port",
            {"remedy": "end the url after the port", "code": BAD_ADDRESS},
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
                "between two parts",
                "code": BAD_ADDRESS,
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


Command: TypeAlias = Literal["acknowledge", "reset", "shelve", "unshelve", "bypass", "unbypass", "snapshot"]
"""What may be asked of an alarm, or of a machine."""


class MqttCommands(Section):
    """What may be asked of alarms and machines over the broker; who may ask is the broker's access list."""

    enabled: bool = Field(default=False, description="whether commands are taken from the broker")
    allow: Annotated[tuple[Command, ...], Field(strict=False, max_length=16)] = Field(
        default=("acknowledge",),
        description="what may be asked: acknowledge, reset, shelve, unshelve, bypass, unbypass, snapshot",
    )
    max_age_s: Annotated[float, Field(ge=0.1, le=3600)] = Field(
        default=60.0, description="how old a command may be when it arrives"
    )
    max_bytes: Annotated[int, Field(ge=256, le=65_536)] = Field(
        default=4096, description="length of the longest command that is read"
    )


FILES = ("password_file", "ca_file", "cert_file", "key_file")
"""The keys of `Mqtt` that name files."""


class Mqtt(Section):
    """The broker that alarms and diagnoses go to.

    A password or key is never in the machine file, only the name of the file or of the systemd credential
    that holds it.
    """

    url: Annotated[
        BrokerUrl, Field(description="address of the broker", examples=["mqtts://broker.example:8883"])
    ]
    insecure: bool = Field(default=False, description="whether mqtt:// without TLS is accepted")
    client_id: ClientId | None = Field(
        default=None,
        description="client id, by which the broker knows this box; daqsvc-<site>:<box> if absent",
        examples=["edge-1"],
    )
    username: Text | None = Field(
        default=None, description="name of the user at the broker", examples=["edge-1"]
    )
    password_file: FilePath | None = Field(
        default=None,
        description="file whose first line is the password",
        examples=["/etc/daqsvc/mqtt.password"],
    )
    password_credential: Name | None = Field(
        default=None,
        description="systemd credential (LoadCredential=) in place of password_file",
        examples=["mqtt-password"],
    )
    ca_file: FilePath | None = Field(
        default=None,
        description="certificates (PEM) to trust in place of the system's",
        examples=["/etc/daqsvc/ca.pem"],
    )
    cert_file: FilePath | None = Field(
        default=None,
        description="certificate (PEM) that the box shows to the broker",
        examples=["/etc/daqsvc/edge-1.pem"],
    )
    key_file: FilePath | None = Field(
        default=None,
        description="private key (PEM) of that certificate, if not in cert_file; not encrypted",
        examples=["/etc/daqsvc/edge-1.key"],
    )
    key_credential: Name | None = Field(
        default=None,
        description="systemd credential (LoadCredential=) in place of key_file",
        examples=["mqtt-key"],
    )
    keepalive_s: Annotated[int, Field(ge=1, le=65535)] = Field(
        default=30, description="how soon the broker notices that the box is gone"
    )
    protocol: Literal["auto", "5", "3.1.1"] = Field(
        default="auto", description="MQTT version; auto asks for 5 and takes 3.1.1 if that is refused"
    )
    topic_root: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$", max_length=256)] = (
        Field(default="daqsvc", description="first part of every topic")
    )
    telemetry_expiry_s: Annotated[float, Field(ge=1, le=86_400)] = Field(
        default=600.0,
        description="age beyond which the broker drops diagnoses and status that it could not deliver",
    )
    commands: MqttCommands = Field(default=MqttCommands(), description="commands that come over the broker")

    @property
    def tls(self) -> bool:
        """Whether the connection is encrypted and the broker's certificate verified."""
        return is_tls(self.url)

    @property
    def host(self) -> str:
        """Host name or address of the broker."""
        return urlsplit(self.url).hostname or ""

    @property
    def port(self) -> int:
        """TCP port of the broker: as in the url, else 1883, with TLS 8883."""
        parts = urlsplit(self.url)
        return parts.port or _DEFAULT_PORTS[parts.scheme]

    def client_id_of(self, machine: MachineFile) -> str:
        """The client id of a box: as in the file, else from site and box."""
        # No name holds a colon, so that no two boxes come to the same.
        return self.client_id or f"daqsvc-{machine.site}:{machine.box}"

    def on(self, machine: MachineFile) -> Mqtt:
        """The same, with the client id of the box and with absolute paths."""
        paths = {key: getattr(self, key) for key in FILES}
        resolved = {key: machine.resolve(path) for key, path in paths.items() if path is not None}
        return self.model_copy(update={"client_id": self.client_id_of(machine), **resolved})


def first_line(file: Path) -> bytes:
    """The first line, as far as it can be a password.

    Raises:
        OSError: it cannot be read.
    """
    # Not to wait for whoever might write into it: what it is may have changed since it was examined.
    handle = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(handle, "rb") as opened:
        return opened.read(LONGEST_PASSWORD + 2).partition(b"\n")[0].rstrip(b"\r")
