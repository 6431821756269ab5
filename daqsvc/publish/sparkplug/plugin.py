"""Sparkplug as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.errors.outputs import ONE_DEVICE, OTHER_ENCRYPTION, SAME_CLIENT_ID
from daqsvc.publish.mqtt.settings import Mqtt, is_tls
from daqsvc.publish.plugin import OutputPlugin
from daqsvc.publish.sparkplug.settings import Sparkplug
from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.settings.models import MachineFile


class SparkplugPlugin(OutputPlugin[Sparkplug]):
    """The box as an edge node of Sparkplug B, beside its own topics."""

    settings = Sparkplug
    about = "the box as a Sparkplug B edge node, too"
    place = 3
    status_key = "sparkplug"

    def checks(self, draft: MachineFile, settings: Sparkplug) -> Iterator[Iterator[Finding]]:
        """See `OutputTable.checks`."""
        yield _beside_mqtt(draft, settings)

    def several_checks(self, settings: Sparkplug) -> Iterator[Finding]:
        """See `OutputTable.several_checks`."""
        if settings.device is not None:
            yield Finding(
                ("mqtt", "sparkplug", "device"),
                f'"{settings.device}" names one device, and each of several machines is one',
                "remove it: the name of each machine is its device id",
                code=ONE_DEVICE,
            )

    def describe(self, machine: MachineFile, settings: Sparkplug) -> str:
        """See `OutputTable.describe`."""
        group, node = settings.group or machine.site, settings.edge_node or machine.box
        host = settings.primary_host
        return f"Sparkplug B edge node {group}/{node}{f', waits for host {host}' if host is not None else ''}"

    def build(self, machine: MachineFile, settings: Sparkplug, port: OutputPort) -> Output:
        """See `OutputPlugin.build`."""
        from daqsvc.publish.sparkplug.edge import SparkplugEdge  # noqa: PLC0415 - paho and protobuf

        mqtt = machine.output(Mqtt)
        assert mqtt is not None  # noqa: S101 - its table is below that one
        return SparkplugEdge(settings, mqtt.on(machine), port)


def _beside_mqtt(draft: MachineFile, settings: Sparkplug) -> Iterator[Finding]:
    mqtt = draft.output(Mqtt)
    if mqtt is None:
        return
    for number, server in enumerate(settings.servers):
        if is_tls(server) != mqtt.tls:
            yield Finding(
                ("mqtt", "sparkplug", "servers", number),
                "has other encryption than mqtt.url, whose credentials it would get",
                f"write {'mqtts' if mqtt.tls else 'mqtt'}:// in both",
                code=OTHER_ENCRYPTION,
            )
    if settings.client_id is not None and settings.client_id == mqtt.client_id_of(draft):
        yield Finding(
            ("mqtt", "sparkplug", "client_id"),
            f'is "{settings.client_id}" like that of [mqtt]: a broker ends one connection for the other',
            "remove it, or write another",
            code=SAME_CLIENT_ID,
        )
