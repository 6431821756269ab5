"""The broker as a plugin."""

from __future__ import annotations

import logging
from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded, with_code
from daqsvc.publish.mqtt.checks import checks
from daqsvc.publish.mqtt.conditions import BROKER, CERTIFICATE, REFUSED, UNUSED
from daqsvc.publish.mqtt.link import MqttLinkPlugin
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.publish.plugin import OutputPlugin
from daqsvc.settings.hooks import PluginFailedError
from daqsvc.settings.registry import output_tables, table_at

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import Finding

log = logging.getLogger(__name__)


class MqttPlugin(OutputPlugin[Mqtt]):
    """Alarms, diagnoses and status to one broker, and commands from it."""

    settings = Mqtt
    about = "the broker; none is configured if absent"
    place = 1
    label = "MQTT"
    absent = "no broker configured"
    status_key = "mqtt"
    outdated = MappingProxyType({REFUSED: "there is no broker any more", CERTIFICATE: UNUSED})

    def checks(self, draft: MachineFile, settings: Mqtt) -> Iterator[Iterator[Finding]]:
        """See `OutputTable.checks`."""
        return checks(draft, settings)

    def describe(self, machine: MachineFile, settings: Mqtt) -> str:
        """See `OutputTable.describe`."""
        return "; ".join(_described(machine, settings))

    def conditions(self, settings: Mqtt) -> Iterator[str]:
        """See `OutputPlugin.conditions`."""
        yield REFUSED
        if settings.tls:
            files = {
                BROKER: True,
                "ca": settings.ca_file is not None,
                "client": settings.cert_file is not None,
            }
            yield from (f"{CERTIFICATE}{name}" for name, is_looked_at in files.items() if is_looked_at)

    def build(self, machine: MachineFile, settings: Mqtt, port: OutputPort) -> Output:
        """See `OutputPlugin.build`."""
        from daqsvc.publish.mqtt.publisher import MqttPublisher  # noqa: PLC0415 - paho and cryptography

        mqtt = settings.on(machine)
        links = []
        for path, plugin in output_tables().items():
            if isinstance(plugin, MqttLinkPlugin):
                try:
                    links.append(plugin.link(table_at(machine, path), mqtt, port))
                except PluginFailedError as failed:
                    words = f"output {path} cannot be made and is left out: {failed.words}"
                    log.error("%s", with_code(words, failed.code), extra=coded(failed.code))  # noqa: TRY400
        return MqttPublisher(mqtt, port, [link for link in links if link is not None])


def _described(machine: MachineFile, mqtt: Mqtt) -> Iterator[str]:
    trust = f"certificates from {mqtt.ca_file}" if mqtt.ca_file is not None else "the system's certificates"
    yield f"{mqtt.host} port {mqtt.port}, {f'TLS, {trust}' if mqtt.tls else 'without TLS'}"
    if mqtt.tls and mqtt.cert_file is not None:
        yield f"shows certificate {mqtt.cert_file}"
    if mqtt.username is not None:
        source = mqtt.password_file or (
            f"credential {mqtt.password_credential}" if mqtt.password_credential else None
        )
        yield f"user {mqtt.username}{f', password from {source}' if source else ''}"
    yield f"client {mqtt.client_id_of(machine)}, keep-alive {mqtt.keepalive_s} s"
    yield f"topics {mqtt.topic_root}/{machine.site}/{machine.box}/..."
    if mqtt.commands.enabled:
        yield f"takes commands: {', '.join(mqtt.commands.allow) or 'none'}"
