"""From a machine file to the broker, and to what Home Assistant and Sparkplug hosts are told."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.expected import handling_conditions
from daqsvc.detectors.make import plugins
from daqsvc.publish.settings import CommandSettings, HomeAssistantSettings, MqttSettings
from daqsvc.publish.sparkplug.settings import Server, SparkplugSettings
from daqsvc.self_check import conditions
from daqsvc.settings.alarms import DiagnosisAlarm
from daqsvc.settings.broker_url import host_of, is_tls, port_of
from drivers.make import bus_self_checks

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.diagnosis.reading import Reading
    from daqsvc.settings.alarms import Alarm
    from daqsvc.settings.models import MachineFile


def mqtt_settings(machine: MachineFile) -> MqttSettings | None:
    """How to reach the broker; None if the machine file has none."""
    given = machine.mqtt
    if given is None:
        return None

    def file(path: Path | None) -> Path | None:
        return None if path is None else machine.resolve(path)

    settings = MqttSettings(
        host=given.host,
        port=given.port,
        client_id=machine.mqtt_client_id,
        tls=given.tls,
        ca_file=file(given.ca_file),
        cert_file=file(given.cert_file),
        key_file=file(given.key_file),
        key_credential=given.key_credential,
        username=given.username,
        password_file=file(given.password_file),
        password_credential=given.password_credential,
        keepalive_s=given.keepalive_s,
        topic_root=given.topic_root,
        protocol=given.protocol,
        telemetry_expiry_s=given.telemetry_expiry_s,
        commands=_commands(machine),
    )
    return replace(settings, home_assistant=_home_assistant(machine, settings))


def sparkplug_settings(machine: MachineFile, store: Path) -> SparkplugSettings | None:
    """What the box is to Sparkplug; None if the machine file does not ask for it.

    Args:
        machine: the machine file.
        store: directory of what survives a restart.
    """
    mqtt = machine.mqtt
    if mqtt is None or mqtt.sparkplug is None:
        return None
    given = mqtt.sparkplug
    return SparkplugSettings(
        group=given.group or machine.site,
        edge_node=given.edge_node or machine.box,
        device=given.device or machine.machine.name,
        machine=machine.machine.name,
        servers=tuple(
            Server(host_of(url), port_of(url), is_tls(url)) for url in given.servers or (mqtt.url,)
        ),
        client_id=given.client_id or f"{machine.mqtt_client_id}:sparkplug",
        memory=store / "sparkplug.json",
        primary_host=given.primary_host,
        alarms=(*(alarm.name for alarm in machine.alarms), *_services(machine, mqtt_settings(machine))),
        readings=_readings(machine),
    )


def _commands(machine: MachineFile) -> CommandSettings | None:
    given = None if machine.mqtt is None else machine.mqtt.commands
    if given is None or not given.enabled:
        return None
    home_assistant = None if machine.mqtt is None else machine.mqtt.home_assistant
    return CommandSettings(
        machines=(machine.machine.name,),
        allow=frozenset(Verb(verb) for verb in given.allow),
        max_age_s=given.max_age_s,
        max_bytes=given.max_bytes,
        reserved=() if home_assistant is None else (home_assistant.prefix,),
    )


def _home_assistant(machine: MachineFile, mqtt: MqttSettings) -> HomeAssistantSettings | None:
    given = None if machine.mqtt is None else machine.mqtt.home_assistant
    if given is None:
        return None
    return HomeAssistantSettings(
        machine=machine.machine.name,
        description=machine.machine.description,
        alarms=tuple(alarm.name for alarm in machine.alarms),
        services=tuple(_services(machine, mqtt)),
        readings=_readings(machine),
        prefix=given.prefix,
        enabled=given.enabled,
        rests_on={alarm.name: tuple(_rests_on(alarm)) for alarm in machine.alarms},
        findings=machine.detectors,
        buttons=()
        if mqtt.commands is None
        else tuple(verb for verb in (Verb.ACKNOWLEDGE, Verb.RESET) if verb in mqtt.commands.allow),
        every_s=given.every_s,
        deadband_percent=given.deadband_percent,
    )


def _rests_on(alarm: Alarm) -> Iterator[str]:
    """The alarms about sensors and detectors without which nobody can say that this one is not raised."""
    if isinstance(alarm, DiagnosisAlarm):
        yield f"detector-ok/{alarm.detector}"
    else:
        yield from (f"sensor-ok/{sensor}" for sensor in alarm.watched)


def _services(machine: MachineFile, mqtt: MqttSettings | None) -> Iterator[str]:
    """The alarms that are there by themselves: about sensors, detectors, all alarms and the service."""
    for plugin, given in plugins(machine):
        yield from plugin.quality_alarms(machine, given)
    handling = machine.alarm_handling
    yield from handling_conditions(flood=handling.flood_alarms or None, start_up=handling.start_up)
    yield from conditions(mqtt, bus_self_checks(machine))


def _readings(machine: MachineFile) -> tuple[Reading, ...]:
    """What is shown by itself: vibration levels of every sensor, speed, 1X, probabilities of the modes."""
    return tuple(reading for plugin, given in plugins(machine) for reading in plugin.readings(machine, given))
