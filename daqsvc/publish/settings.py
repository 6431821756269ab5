"""How to reach the broker, and what goes there besides alarms and telemetry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from daqsvc.alarms.commands import Verb
    from daqsvc.diagnosis.reading import Reading


@dataclass(frozen=True, slots=True)
class CommandSettings:
    """Which commands are taken from the broker.

    Attributes:
        machines: the machines that they may be for.
        allow: what may be asked; everything else is refused.
        max_age_s: how old a command may be when it arrives, and how far ahead its clock may be.
        max_bytes: the longest payload that is looked at.
        reserved: topics below which no answer goes, besides the box's own, e.g. a discovery prefix.
    """

    machines: tuple[str, ...]
    allow: frozenset[Verb]
    max_age_s: float = 60.0
    max_bytes: int = 4096
    reserved: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HomeAssistantSettings:
    """What Home Assistant is told of a machine.

    Attributes:
        machine: name of the machine.
        description: what a person should know about it.
        alarms: names of its alarms.
        services: alarms about sensors, detectors and the service, rather than the machine.
        readings: the figures to show.
        prefix: Home Assistant's discovery prefix.
        enabled: False to take away what an earlier start has told.
        rests_on: by alarm, the alarms about sensors and detectors that say whether it can be judged at all.
        findings: the detectors whose decision is shown.
        buttons: what a person may do with an alarm from there: the commands that the box obeys.
        every_s: how often figures are told that do not move.
        deadband_percent: by how much a figure must move to be told before its time.
    """

    machine: str
    description: str = ""
    alarms: tuple[str, ...] = ()
    services: tuple[str, ...] = ()
    readings: tuple[Reading, ...] = ()
    prefix: str = "homeassistant"
    enabled: bool = True
    rests_on: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    buttons: tuple[Verb, ...] = ()
    every_s: float = 60.0
    deadband_percent: float = 10.0


@dataclass(frozen=True, slots=True)
class MqttSettings:
    """How to reach the broker.

    Attributes:
        host: host name or address of the broker.
        port: TCP port.
        client_id: MQTT client id, unique at the broker.
        tls: whether to use TLS; the broker's certificate and host name are always verified.
        ca_file: certificate authorities in PEM; None for those of the system.
        username: None for an anonymous connection.
        password_file: file with the password.
        keepalive_s: MQTT keep-alive.
        topic_root: first part of every topic.
        protocol: MQTT version; ``"auto"`` asks for 5 and takes 3.1.1 if the broker knows no better.
        password_credential: name of a systemd credential with the password, in place of a file.
        cert_file: certificate of the box in PEM, with the chain to its authority; None without one.
        key_file: its private key in PEM, if that does not stand in `cert_file`.
        key_credential: name of a systemd credential with the private key, in place of a file.
        telemetry_expiry_s: how long telemetry is of use; the outbox and an MQTT 5 broker drop it then.
        commands: None takes none.
        home_assistant: None leaves Home Assistant alone.
    """

    host: str
    port: int
    client_id: str
    tls: bool = False
    ca_file: Path | None = None
    username: str | None = None
    password_file: Path | None = None
    keepalive_s: int = 30
    topic_root: str = "daqsvc"
    protocol: Literal["auto", "5", "3.1.1"] = "auto"
    password_credential: str | None = None
    cert_file: Path | None = None
    key_file: Path | None = None
    key_credential: str | None = None
    telemetry_expiry_s: float = 600.0
    commands: CommandSettings | None = None
    home_assistant: HomeAssistantSettings | None = None
