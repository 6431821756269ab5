"""The broker that alarms and diagnoses go to."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from daqsvc.settings.broker_url import BrokerUrl, host_of, is_tls, port_of
from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import ClientId, Name, Section, Text
from daqsvc.settings.sparkplug import Sparkplug  # noqa: TC001 - pydantic reads the annotations

Command: TypeAlias = Literal["acknowledge", "reset", "shelve", "unshelve", "bypass", "unbypass"]
"""What may be asked of an alarm."""


class MqttCommands(Section):
    """What may be asked of alarms over the broker; who may ask is the broker's access list."""

    enabled: bool = Field(default=False, description="says that commands are taken from the broker")
    allow: Annotated[tuple[Command, ...], Field(strict=False, max_length=16)] = Field(
        default=("acknowledge",),
        description="what may be asked: acknowledge, reset, shelve, unshelve, bypass, unbypass",
    )
    max_age_s: Annotated[float, Field(ge=0.1, le=3600)] = Field(
        default=60.0, description="how old a command may be when it arrives"
    )
    max_bytes: Annotated[int, Field(ge=256, le=65_536)] = Field(
        default=4096, description="the longest command that is looked at"
    )


class HomeAssistant(Section):
    """Home Assistant's discovery: the machine shows up there by itself."""

    enabled: bool = Field(
        default=True, description="false takes away what has been told to Home Assistant before"
    )
    prefix: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$", max_length=256)] = Field(
        default="homeassistant", description="its discovery prefix"
    )
    every_s: Annotated[float, Field(ge=10, le=3600)] = Field(
        default=60.0, description="how often figures are told that do not move"
    )
    deadband_percent: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=10.0, description="by how much a figure must move to be told before, every 10 s at most"
    )


class Mqtt(Section):
    """The broker that alarms and diagnoses go to.

    A password or key never stands in the machine file, only the name of the file or of the systemd credential
    that holds it.
    """

    url: Annotated[
        BrokerUrl, Field(description="address of the broker", examples=["mqtts://broker.example:8883"])
    ]
    insecure: bool = Field(default=False, description="says that mqtt:// without TLS is meant")
    client_id: ClientId | None = Field(
        default=None, description="how the broker knows this box; daqsvc-<site>:<box> if absent"
    )
    username: Text | None = Field(default=None, description="user at the broker")
    password_file: FilePath | None = Field(default=None, description="file whose first line is the password")
    password_credential: Name | None = Field(
        default=None, description="systemd credential (LoadCredential=) in place of password_file"
    )
    ca_file: FilePath | None = Field(
        default=None, description="certificates (PEM) to trust in place of the system's"
    )
    cert_file: FilePath | None = Field(
        default=None, description="certificate (PEM) that the box shows to the broker"
    )
    key_file: FilePath | None = Field(
        default=None, description="its private key (PEM), if not in cert_file; not encrypted"
    )
    key_credential: Name | None = Field(
        default=None, description="systemd credential (LoadCredential=) in place of key_file"
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
        default=600.0, description="how long diagnoses and status are worth being delivered late"
    )
    commands: MqttCommands = Field(default=MqttCommands(), description="commands that come over the broker")
    home_assistant: HomeAssistant | None = Field(default=None, description="discovery by Home Assistant")
    sparkplug: Sparkplug | None = Field(default=None, description="the box as a Sparkplug B edge node, too")

    @property
    def tls(self) -> bool:
        """Whether the connection is encrypted and the broker's certificate verified."""
        return is_tls(self.url)

    @property
    def host(self) -> str:
        """Host name or address of the broker."""
        return host_of(self.url)

    @property
    def port(self) -> int:
        """TCP port of the broker: as in the url, else 1883, with TLS 8883."""
        return port_of(self.url)
