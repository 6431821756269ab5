"""Live data over the broker as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.publish.live.settings import Live
from daqsvc.publish.mqtt.link import MqttLinkPlugin

if TYPE_CHECKING:
    from daqsvc.publish.mqtt.link import MqttLink
    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.publish.output import OutputPort
    from daqsvc.settings.models import MachineFile


class LivePlugin(MqttLinkPlugin[Live]):
    """Live waveforms, statements and alarms to viewers over the broker, while they ask for them."""

    settings = Live
    about = "live waveforms to viewers over the broker"
    place = 4

    def describe(self, machine: MachineFile, settings: Live) -> str:
        """See `OutputTable.describe`."""
        del machine
        most, rate = settings.max_viewers, settings.max_kb_per_s
        return f"waveforms to at most {most} viewers, {rate:g} kB/s" if settings.enabled else ""

    def link(self, settings: Live | None, mqtt: Mqtt, port: OutputPort) -> MqttLink | None:
        """See `MqttLinkPlugin.link`."""
        del mqtt
        if settings is None or not settings.enabled or port.look is None:
            return None
        from daqsvc.publish.live.link import LiveLink  # noqa: PLC0415 - brings paho

        return LiveLink(settings, port.look, port.topics)
