"""Keeps Home Assistant up to date: at every connection, at its birth, and when an alarm has changed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import random
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import OUTPUT_FAILED, TOPIC_REFUSED
from daqsvc.publish.home_assistant.discovery import Discovery
from daqsvc.publish.home_assistant.left_over import LeftOver
from daqsvc.publish.home_assistant.readings import Readings
from daqsvc.publish.home_assistant.summary import Summary
from daqsvc.publish.mqtt.errors import PublishRefusedError
from daqsvc.publish.mqtt.link import MqttLink

if TYPE_CHECKING:
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.publish.home_assistant.settings import HomeAssistant
    from daqsvc.publish.mqtt.connection import Connection, Incoming
    from daqsvc.publish.mqtt.settings import MqttCommands
    from daqsvc.publish.output import OutputPort, Watched

log = logging.getLogger(__name__)

BIRTH_DELAY_S = 5.0
"""After a birth of Home Assistant each box waits up to so long, at random: it has many to listen to."""

EARLIER_S = 1.0
"""How long an earlier discovery message that is retained at the broker may take to arrive."""

LOOK_S = 1.0
"""How often it is looked whether figures have moved."""

PAUSE_S = 0.2
"""What lies between two summaries at least; what comes meanwhile is in the next."""

SUMMARY_BYTES_PER_S = 100_000
"""What summaries may take of the way to the broker: that of 1000 alarms goes out every 2 s."""

_SHOWN = 200


class HomeAssistantLink(MqttLink):
    """Describes each machine to Home Assistant, and removes what it described before.

    Args:
        settings: whether and how often to tell.
        commands: what may be asked over the broker.
        port: what there is to tell.
    """

    name = LeftOver.name

    def __init__(self, settings: HomeAssistant, commands: MqttCommands, port: OutputPort) -> None:
        self.reserved = (settings.prefix,)
        self._devices = {
            name: MachineDevice(settings, commands, watched, port) for name, watched in port.machines.items()
        }
        retained = [topic for device in self._devices.values() for topic in device.retained]
        self._left_over = LeftOver(port.store, retained)

    def note(self, message: OutboxMessage) -> None:
        """Take in an alarm's message that the broker has."""
        for device in self._devices.values():
            device.note(message)

    def report(self, diagnosis: Diagnosis) -> None:
        """Take in what a detector states."""
        if diagnosis.machine in self._devices:
            self._devices[diagnosis.machine].report(diagnosis)

    def take(self, message: Incoming) -> bool:
        """Take in a message from the broker; whether it was meant for this link."""
        taken = [device.take(message) for device in self._devices.values()]  # a birth is for all of them
        return any(taken)

    async def run(self, connection: Connection) -> None:
        """Tell what there is to tell over one connection; ends at once if nothing is left to send.

        Raises:
            MqttError: the connection is lost.
        """
        await self._left_over.take_away(connection)
        parts = [self._left_over.until_remembered(), *(one.run(connection) for one in self._devices.values())]
        tasks = [asyncio.ensure_future(part) for part in parts]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()


class MachineDevice:
    """Publishes the discovery message of one machine and the summary of its alarms.

    Args:
        settings: whether and how often to tell.
        commands: what may be asked over the broker.
        watched: what there is to tell.
        port: what it works with.
    """

    def __init__(
        self, settings: HomeAssistant, commands: MqttCommands, watched: Watched, port: OutputPort
    ) -> None:
        topics, clock = port.topics, port.clock
        self._settings = settings
        self._machine = watched.machine
        self._outbox = port.outbox
        self._topics = topics
        self._clock = clock
        self._discovery = Discovery(settings, commands, watched, topics)
        self._summary = Summary(
            watched.machine, (*watched.alarms, *watched.services), topics, watched.rests_on
        )
        self._readings = Readings(settings, watched, topics, clock)
        self._changed = asyncio.Event()
        self._born = asyncio.Event()
        self._earlier: asyncio.Future[bytes] | None = None
        self._pause_s = PAUSE_S

    @property
    def retained(self) -> tuple[str, ...]:
        """The topics that hold a message of it at the broker."""
        if not self._settings.enabled:
            return ()
        return self._discovery.topic, self._topics.summary(self._machine)

    def note(self, message: OutboxMessage) -> None:
        """Take in an alarm's message that the broker has."""
        try:
            if self._summary.note(message):
                self._changed.set()
        except ValueError as error:
            log.warning(
                "message %d on %s is not in the summary of %s: %s",
                message.sequence,
                message.topic,
                self._machine,
                " ".join(str(error).split())[:_SHOWN],
                extra=coded(OUTPUT_FAILED),  # of pydantic: several lines
            )

    def report(self, diagnosis: Diagnosis) -> None:
        """Take in what a detector states."""
        self._readings.note(diagnosis)

    def take(self, message: Incoming) -> bool:
        """Take in a message from the broker; whether it was meant for this machine."""
        topic = message.topic
        if topic == self._discovery.birth_topic:
            # What is retained is a birth in the past: the connection has just sent everything.
            if message.payload == b"online" and not message.retain:
                self._born.set()
        elif topic == self._discovery.topic:
            if self._earlier is not None and not self._earlier.done():
                self._earlier.set_result(message.payload)
        else:
            return False
        return True

    async def run(self, connection: Connection) -> None:
        """See `MqttLink.run`.

        Raises:
            MqttError: the connection is lost.
        """
        try:
            await self._run(connection)
        except PublishRefusedError as error:
            log.warning(
                "Home Assistant does not get %s: %s; allow this client to write %s and %s at the broker",
                self._machine,
                error,
                self._discovery.topic,
                self._topics.summary(self._machine),
                extra=coded(TOPIC_REFUSED),
            )

    async def _run(self, connection: Connection) -> None:
        if not self._settings.enabled:
            await connection.deliver(self._discovery.topic, b"", retain=True)
            await connection.deliver(self._topics.summary(self._machine), b"", retain=True)
            return
        # What the broker has known for long is not sent again in time: no summary may begin without it.
        for message in await self._outbox.retained():
            self.note(message)
        self._born.clear()
        await connection.watch(self._discovery.birth_topic)
        await self._remove(connection)
        await self._tell(connection)
        born = asyncio.create_task(self._born.wait())
        changed = asyncio.create_task(self._changed.wait())
        try:
            while True:
                await asyncio.wait({born, changed}, timeout=LOOK_S, return_when=asyncio.FIRST_COMPLETED)
                for topic, payload in self._readings.due():
                    await connection.deliver(topic, payload, retain=False)
                if born.done():
                    # Spreads the load on one broker, it keeps no secret.
                    await asyncio.sleep(random.uniform(0, BIRTH_DELAY_S))  # noqa: S311
                    self._born.clear()
                    await self._tell(connection)
                    born = asyncio.create_task(self._born.wait())
                elif changed.done():
                    await self._summarise(connection)
                    # A summary has all alarms. For each event of a flood again, it would be the flood.
                    await asyncio.wait({born}, timeout=self._pause_s)
                if changed.done():
                    changed = asyncio.create_task(self._changed.wait())
        finally:
            born.cancel()
            changed.cancel()

    async def _remove(self, connection: Connection) -> None:
        """Remove what an earlier start has sent and this one has not: a renamed alarm, say."""
        self._earlier = asyncio.get_running_loop().create_future()
        await connection.watch(self._discovery.topic)
        earlier = b""
        with contextlib.suppress(TimeoutError):  # there is none: nothing has been sent before
            earlier = await asyncio.wait_for(self._earlier, EARLIER_S)
        await connection.unsubscribe(self._discovery.topic)
        removals = self._discovery.removals(earlier)
        if removals:
            payload = self._discovery.payload()
            payload["components"] |= removals
            await connection.deliver(self._discovery.topic, _json(payload), retain=True)

    async def _tell(self, connection: Connection) -> None:
        self._readings.forget()
        await connection.deliver(self._discovery.topic, _json(self._discovery.payload()), retain=True)
        await self._summarise(connection)

    async def _summarise(self, connection: Connection) -> None:
        self._changed.clear()
        summary = self._summary.to_json(self._clock)
        self._pause_s = max(PAUSE_S, len(summary) / SUMMARY_BYTES_PER_S)
        await connection.deliver(self._topics.summary(self._machine), summary, retain=True)


def _json(value: object) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode()
