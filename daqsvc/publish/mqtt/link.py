"""Who else speaks over the connection to the broker, in the broker's own topics or in others."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from daqsvc.publish.plugin import OutputPlugin
from daqsvc.settings.hooks import contract, may_raise
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import Section

if TYPE_CHECKING:
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.publish.mqtt.connection import Connection, Incoming
    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.publish.output import OutputPort
    from daqsvc.settings.models import MachineFile

SettingsT = TypeVar("SettingsT", bound=Section)


class MqttLink:
    """Speaks over each connection to the broker, for as long as that lasts.

    Attributes:
        name: what it speaks to, for a person.
        reserved: topics below which no answer to a command goes.
    """

    name: str
    reserved: tuple[str, ...] = ()

    async def run(self, connection: Connection) -> None:
        """Tell what there is to tell over one connection; may end before that does.

        Raises:
            MqttError: the connection is lost.
        """
        raise NotImplementedError

    def note(self, message: OutboxMessage) -> None:
        """Take in an alarm's message that the broker has."""

    def report(self, diagnosis: Diagnosis) -> None:
        """Take in what a detector states; never waits."""

    def take(self, message: Incoming) -> bool:
        """Take in a message from the broker; whether it was meant for this link."""
        del message
        return False


@contract
class MqttLinkPlugin(OutputPlugin[SettingsT]):
    """An output whose table is below ``[mqtt]`` and that uses that connection."""

    @may_raise(AssemblyError)
    def link(self, settings: SettingsT | None, mqtt: Mqtt, port: OutputPort) -> MqttLink | None:
        """What speaks; None for nothing.

        Args:
            settings: the table; None if the machine file has none, for what an earlier run has left.
            mqtt: the connection.
            port: what outputs work with.
        """
        raise NotImplementedError

    def build(self, machine: MachineFile, settings: SettingsT, port: OutputPort) -> None:
        """See `OutputPlugin.build`: the broker's output takes it with it."""
        del machine, settings, port
