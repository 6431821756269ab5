"""Whether the parts of a machine file fit each other: everything that one value alone cannot show.

Each check is a generator over a few values. On a faulty file it runs on what is valid, and ends quietly
where it asks for a value that is not (`UnusableValueError`): one mistake never hides another.
"""

from __future__ import annotations

import ipaddress
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from daqsvc.settings.alarm_checks import alarm_checks
from daqsvc.settings.alignment_checks import alignment_checks
from daqsvc.settings.broker_url import is_tls
from daqsvc.settings.bus_checks import check_devices, check_drivers, check_unused
from daqsvc.settings.layout_checks import (
    check_channel_use,
    check_channels,
    check_sensor_channel,
    check_stream_bus,
    unique,
)
from daqsvc.settings.memory_checks import check_memory
from daqsvc.settings.mqtt_files import credential_files
from daqsvc.settings.plugins import bus_tables, configured, driver_of_layout
from daqsvc.settings.problems import Finding
from daqsvc.settings.rotor_physics import physics_checks
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensor_checks import (
    check_alarm_reach,
    check_probe_angles,
    check_reach,
    check_sensitivity,
    check_voltages,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.models import MachineFile, Mqtt, Stream
    from daqsvc.settings.plugins import BusTable
    from daqsvc.settings.problems import KeyPath

_MOST_FINDINGS = 200
"""Whoever has mended these may ask again."""


def check(draft: MachineFile, facts: Mapping[str, Any]) -> list[Finding]:
    """Run every check on a machine file.

    Args:
        draft: the machine file, or what is valid of it.
        facts: by stream, what was read from the files that its layout names.
    """
    findings: list[Finding] = []
    for found in _checks(draft, facts):
        with suppress(UnusableValueError):
            for finding in found:
                findings.append(finding)
                if len(findings) >= _MOST_FINDINGS:
                    return findings
    return findings


def _checks(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
    """Every check with what it is about."""
    with suppress(UnusableValueError):
        for name, stream in draft.streams.items():
            at: KeyPath = ("streams", name)
            yield check_stream_bus(draft, stream, at)
            for plugin in _drivers_of(draft, stream):
                with suppress(UnusableValueError):
                    yield from plugin.stream_checks(draft, stream, facts.get(name), at)
            with suppress(UnusableValueError):
                yield check_channels(stream.layout, (*at, "layout"))
    yield check_unused(draft)
    yield check_drivers(draft)
    yield check_devices(draft)
    for plugin in _drivers(draft):
        with suppress(UnusableValueError):
            yield from plugin.checks(draft, facts)
    yield from _sensor_checks(draft, facts)
    yield check_memory(draft)
    yield _names(draft)
    yield from physics_checks(draft)
    with suppress(UnusableValueError):
        for _, detector, given in configured(draft.pipeline, valid_only=True):
            with suppress(UnusableValueError):
                yield from detector.checks(draft, given)
    yield from alignment_checks(draft)
    yield from alarm_checks(draft)
    with suppress(UnusableValueError):
        if draft.mqtt is not None:
            yield _transport(draft.mqtt)
            yield _credentials(draft.mqtt)
            yield credential_files(draft)
            yield _sparkplug(draft, draft.mqtt)
            yield _open_to_commands(draft.mqtt)


def _drivers_of(draft: MachineFile, stream: Stream) -> list[BusTable]:
    """The driver of a stream's bus, and that of its layout if it is another; in the order of their place."""
    used: set[BusTable | None] = set()
    with suppress(UnusableValueError):
        bus = draft.buses.get(stream.bus)
        used.add(None if bus is None else bus_tables().get(bus.driver))
    with suppress(UnusableValueError):
        if not any(plugin is not None and type(stream.layout) in plugin.layouts for plugin in used):
            used.add(driver_of_layout(stream.layout))
    return [plugin for plugin in bus_tables().values() if plugin in used]


def _drivers(draft: MachineFile) -> list[BusTable]:
    """The drivers that a machine file has a bus or a layout of, in the order of their place."""
    used: set[BusTable] = set()
    with suppress(UnusableValueError):
        for bus in draft.buses.values():
            with suppress(UnusableValueError):
                used.update(plugin for key, plugin in bus_tables().items() if key == bus.driver)
    with suppress(UnusableValueError):
        for stream in draft.streams.values():
            used.update(_drivers_of(draft, stream))
    return [plugin for plugin in bus_tables().values() if plugin in used]


def _sensor_checks(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
    """Every check of the sensors, and of what their channels can carry."""
    with suppress(UnusableValueError):
        for index, sensor in enumerate(draft.sensors):
            at: KeyPath = ("sensors", index)
            yield check_sensor_channel(draft, sensor, at)
            yield check_voltages(draft, sensor, at)
            yield check_sensitivity(sensor, at)
            yield check_reach(draft, sensor, facts, at)
    yield check_channel_use(draft)
    yield check_probe_angles(draft)
    yield check_alarm_reach(draft, facts)


def _names(draft: MachineFile) -> Iterator[Finding]:
    with suppress(UnusableValueError):
        yield from unique([sensor.name for sensor in draft.sensors], ("sensors",), "sensor")
    yield from unique([alarm.name for alarm in draft.alarms], ("alarms",), "alarm")


def _transport(mqtt: Mqtt) -> Iterator[Finding]:
    if not mqtt.tls and not mqtt.insecure:
        yield Finding(
            ("mqtt", "url"),
            "would go over the network unencrypted, and to whoever answers",
            "write mqtts://, or insecure = true if that is meant",
        )
    if mqtt.tls and mqtt.insecure:
        yield Finding(
            ("mqtt", "insecure"),
            "contradicts mqtts://, which always verifies the broker",
            "remove it; a broker with a certificate of your own is trusted by ca_file",
        )
    for key in ("ca_file", "cert_file"):
        if not mqtt.tls and getattr(mqtt, key) is not None:
            yield Finding(
                ("mqtt", key),
                "has no effect with mqtt://, which uses no certificates",
                "write mqtts:// in the url, or remove it",
                fatal=False,
            )


def _sparkplug(draft: MachineFile, mqtt: Mqtt) -> Iterator[Finding]:
    given = mqtt.sparkplug
    if given is None:
        return
    for number, server in enumerate(given.servers):
        if is_tls(server) != mqtt.tls:
            yield Finding(
                ("mqtt", "sparkplug", "servers", number),
                "has other encryption than mqtt.url, whose credentials it would get",
                f"write {'mqtts' if mqtt.tls else 'mqtt'}:// in both",
            )
    if given.client_id is not None and given.client_id == draft.mqtt_client_id:
        yield Finding(
            ("mqtt", "sparkplug", "client_id"),
            f'is "{given.client_id}" like that of [mqtt]: a broker ends one connection for the other',
            "remove it, or write another",
        )


def _credentials(mqtt: Mqtt) -> Iterator[Finding]:
    yield from _one_source(mqtt, "password_file", "password_credential")
    yield from _one_source(mqtt, "key_file", "key_credential")
    for key in ("key_file", "key_credential"):
        if getattr(mqtt, key) is not None and mqtt.cert_file is None:
            yield Finding(
                ("mqtt", key), "is a key without a certificate", "add cert_file to [mqtt], or remove it"
            )
    given = [key for key in ("password_file", "password_credential") if getattr(mqtt, key) is not None]
    if not given:
        return
    host = mqtt.host  # not usable if the user stands in the url: that has been said, with what to do
    if mqtt.username is None:
        yield Finding(
            ("mqtt", given[0]), "is a password without a user", "add username to [mqtt], or remove it"
        )
    if not mqtt.tls and not _is_this_host(host):
        yield Finding(
            ("mqtt", given[0]),
            f"the password would go to {host} unencrypted",
            "write mqtts:// in the url",
            fatal=False,
        )


def _one_source(mqtt: Mqtt, file: str, credential: str) -> Iterator[Finding]:
    if getattr(mqtt, file) is not None and getattr(mqtt, credential) is not None:
        yield Finding(
            ("mqtt", credential), f"is given besides {file}, and only one can be right", "remove one of them"
        )


def _open_to_commands(mqtt: Mqtt) -> Iterator[Finding]:
    if mqtt.commands.enabled and not mqtt.tls and not _is_this_host(mqtt.host):
        yield Finding(
            ("mqtt", "commands", "enabled"),
            f"commands would come from {mqtt.host} unencrypted, and from whoever answers there",
            "write mqtts:// in the url, or enabled = false",
            fatal=False,
        )


def _is_this_host(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
