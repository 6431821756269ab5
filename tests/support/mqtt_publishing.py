"""Outputs under test, who carries out their commands, and a client that sends one message."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from support.waiting import PATIENCE_S

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import CommandOutcome
from daqsvc.publish.home_assistant.left_over import LeftOver
from daqsvc.publish.home_assistant.link import HomeAssistantLink
from daqsvc.publish.mqtt.publisher import MqttPublisher
from daqsvc.publish.mqtt.settings import Mqtt, MqttCommands
from daqsvc.publish.output import Output, OutputPort, OutputSet, Watched
from daqsvc.publish.sparkplug.edge import SparkplugEdge
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import AlarmCommand, CommandHandler
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.home_assistant.settings import HomeAssistant
    from daqsvc.publish.mqtt.link import MqttLink
    from daqsvc.publish.sparkplug.settings import Sparkplug

CLOCK = SystemClock()
RIG = Watched("rig")


def mqtt(
    port: int, client_id: str = "daqsvc-test", host: str = "127.0.0.1", *, tls: bool = False, **given: Any
) -> Mqtt:
    """The table [mqtt] for a broker; what is ``given`` is not compared with its bounds."""
    url = f"mqtt{'s' * tls}://{host}:{port}"
    return Mqtt(url="mqtt://broker", client_id=client_id).model_copy(update={"url": url} | given)


def commands(*allow: str, **given: Any) -> MqttCommands:
    """The table [mqtt.commands] that allows these verbs."""
    return MqttCommands(enabled=True, allow=allow, **given)  # type: ignore[arg-type]


def output_port(
    outbox: Outbox,
    watched: Watched = RIG,
    *,
    box: str = "edge-1",
    handler: CommandHandler | None = None,
    clock: Clock = CLOCK,
) -> OutputPort:
    """What an output of a box at site ``lab`` works with."""
    return OutputPort(
        machines={watched.machine: watched},
        store=outbox.directory,
        clock=clock,
        outbox=outbox,
        topics=Topics("daqsvc", "lab", box),
        commands=handler,
    )


def publisher_of(settings: Mqtt, port: OutputPort, home_assistant: HomeAssistant | None) -> MqttPublisher:
    """The publisher as its plugin makes it."""
    link: MqttLink = LeftOver(port.store)
    if home_assistant is not None:
        link = HomeAssistantLink(home_assistant, settings.commands, port)
    return MqttPublisher(settings, port, [link])


def outputs(
    settings: Mqtt,
    watched: Watched = RIG,
    *,
    home_assistant: HomeAssistant | None = None,
    sparkplug: Sparkplug | None = None,
) -> OutputSet:
    """What a machine file with these tables asks for."""

    def make(port: OutputPort) -> Mapping[str, Output]:
        made: dict[str, Output] = {"mqtt": publisher_of(settings, port, home_assistant)}
        if sparkplug is not None:
            made["mqtt.sparkplug"] = SparkplugEdge(sparkplug, settings, port)
        return made

    return OutputSet(machines={watched.machine: watched}, make=make, topic_root=settings.topic_root)


@contextlib.asynccontextmanager
async def running_output(output: MqttPublisher) -> AsyncIterator[MqttPublisher]:
    """The publisher at work, until it is stopped."""
    running = asyncio.create_task(output.run())
    try:
        yield output
    finally:
        await output.stop()
        await running


def publishing(
    outbox: Outbox,
    port: int,
    protocol: str = "5",
    *,
    client_id: str = "daqsvc-test",
    handler: CommandHandler | None = None,
    home_assistant: HomeAssistant | None = None,
    watched: Watched = RIG,
    **settings: Any,
) -> contextlib.AbstractAsyncContextManager[MqttPublisher]:
    """A running publisher of box ``edge-1`` at site ``lab``."""
    table = mqtt(port, client_id, protocol=protocol, **settings)
    return running_output(publisher_of(table, output_port(outbox, watched, handler=handler), home_assistant))


class Desk:
    """Accepts every command and keeps it."""

    def __init__(self) -> None:
        self.asked: list[AlarmCommand] = []

    async def __call__(self, command: AlarmCommand, source: str) -> CommandOutcome:
        self.asked.append(command)
        return CommandOutcome(accepted=True, events=("edge-1-7",))


def say(port: int, topic: str, payload: bytes | str, *, retain: bool = False) -> None:
    """Publish once, from a client that goes away again."""
    client = paho.Client(CallbackAPIVersion.VERSION2, f"sayer-{time.monotonic_ns()}")
    client.connect("127.0.0.1", port)
    client.loop_start()
    client.publish(topic, payload, qos=1, retain=retain).wait_for_publish(PATIENCE_S)
    client.disconnect()
    client.loop_stop()
