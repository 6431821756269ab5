"""Home Assistant as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.mqtt.link import MqttLinkPlugin

if TYPE_CHECKING:
    from daqsvc.publish.mqtt.link import MqttLink
    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.publish.output import OutputPort
    from daqsvc.settings.models import MachineFile


class HomeAssistantPlugin(MqttLinkPlugin[HomeAssistant]):
    """The machine as a device of Home Assistant, with its alarms, findings and figures."""

    settings = HomeAssistant
    about = "discovery by Home Assistant"
    place = 2

    def describe(self, machine: MachineFile, settings: HomeAssistant) -> str:
        """See `OutputTable.describe`."""
        del machine
        return f"tells Home Assistant below {settings.prefix}/" if settings.enabled else ""

    def link(self, settings: HomeAssistant | None, mqtt: Mqtt, port: OutputPort) -> MqttLink:
        """See `MqttLinkPlugin.link`."""
        from daqsvc.publish.home_assistant.left_over import LeftOver  # noqa: PLC0415 - brings paho
        from daqsvc.publish.home_assistant.link import HomeAssistantLink  # noqa: PLC0415 - as above

        return LeftOver(port.store) if settings is None else HomeAssistantLink(settings, mqtt.commands, port)
