"""From a machine file to the broker."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.publish.mqtt import MqttSettings

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def mqtt_settings(machine: MachineFile) -> MqttSettings | None:
    """How to reach the broker; None if the machine file has none."""
    given = machine.mqtt
    if given is None:
        return None
    return MqttSettings(
        host=given.host,
        port=given.port,
        client_id=machine.mqtt_client_id,
        tls=given.tls,
        ca_file=None if given.ca_file is None else machine.resolve(given.ca_file),
        username=given.username,
        password_file=None if given.password_file is None else machine.resolve(given.password_file),
        keepalive_s=given.keepalive_s,
        topic_root=given.topic_root,
        protocol=given.protocol,
    )
