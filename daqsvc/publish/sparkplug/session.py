"""One session of an edge node at one broker, from its subscriptions to its death."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from daqsvc.publish.mqtt.errors import MqttError
from daqsvc.publish.sparkplug.alarm_commands import MOST_AT_A_TIME
from daqsvc.publish.sparkplug.codec import PayloadError
from daqsvc.publish.sparkplug.host import STATES, HostReports, PrimaryHost
from daqsvc.publish.sparkplug.metrics import NS_PER_MS, alarm_metrics

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterable, Mapping

    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.publish.mqtt.connection import Connection, Incoming
    from daqsvc.publish.output import OutputPort
    from daqsvc.publish.sparkplug.alarm_commands import AlarmCommands, HostCommand
    from daqsvc.publish.sparkplug.codec import Metric
    from daqsvc.publish.sparkplug.memory import Memory
    from daqsvc.publish.sparkplug.metrics import Board
    from daqsvc.publish.sparkplug.node import EdgeNode, Publication

log = logging.getLogger(__name__)

READ_AHEAD = 100
"""Alarm events that are sent before the broker is asked whether it has them."""

TELL_S = 1.0
"""How often changed figures are sent."""

HEARD = 16
"""Messages from the broker that may wait here; more wait, and are dropped, in the connection."""

HOST_S = 5.0
"""How long a broker's word about the primary host is waited for where there are other brokers."""


HOST_REPORT_S = 30.0
"""After so long it is logged that the primary host has not come, and which hosts there are."""

LOOK_S = 1.0
"""How long the broker may take to tell which hosts there are."""

HOSTS_NAMED = 5
_SHOWN_ID = 64


class HostAwayError(Exception):
    """The primary host is not at this broker."""


@dataclass(slots=True)
class SparkplugCounters:
    """What the edge node has done; every figure but the first only grows.

    Attributes:
        connected: whether there is a session now.
        connections: how many there have been.
        births: births of the node, by request or new metrics too.
        alarms: alarm events published as they happened.
        historical: alarm events published as history.
        data: messages with figures of the device.
        commands: what hosts have written to alarms and was carried out.
        commands_refused: commands that ask for what cannot be had, or were refused.
        states_refused: STATE messages of the host that cannot be read, or are older than one before.
        unreadable: messages of the outbox that are no alarm of this version.
        waiting_for_host: whether it has waited for the primary host for longer than 30 s.
    """

    connected: bool = False
    connections: int = 0
    births: int = 0
    alarms: int = 0
    historical: int = 0
    data: int = 0
    commands: int = 0
    commands_refused: int = 0
    states_refused: int = 0
    unreadable: int = 0
    waiting_for_host: bool = False


class EdgeSession:
    """What is sent and received over one connection.

    One task does all the talking, so that sequence numbers follow each other on the wire.

    Args:
        connection: open, with the node's death as its last will.
        bd_seq: number of the session, as in the will.
        node: makes the messages.
        board: present values.
        devices: by machine, the id of the device that it is.
        primary_host: host application to wait for; None waits for nobody.
        alone: whether there is no other broker to try.
        port: the alarms, and the machines.
        memory: where to go on in the outbox.
        counters: what is counted here.
        reports: what is logged of the primary host; goes on over sessions.
        commands: by machine, what takes what hosts write to its alarms; empty if they may not.
    """

    def __init__(
        self,
        connection: Connection,
        bd_seq: int,
        *,
        node: EdgeNode,
        board: Board,
        devices: Mapping[str, str],
        primary_host: str | None,
        alone: bool,
        port: OutputPort,
        memory: Memory,
        counters: SparkplugCounters,
        reports: HostReports,
        commands: Mapping[str, AlarmCommands] = MappingProxyType({}),
    ) -> None:
        self._connection = connection
        self._bd_seq = bd_seq
        self._node = node
        self._board = board
        self._devices = devices
        self._machine_of = {device: machine for machine, device in devices.items()}
        self._alone = alone
        self._host = None if primary_host is None else PrimaryHost(primary_host)
        self._memory = memory
        self._outbox = port.outbox
        self._topics = port.topics
        self._clock = port.clock
        self._counters = counters
        self._reports = reports
        self._commands = commands
        self._wishes: asyncio.Queue[tuple[AlarmCommands, HostCommand]] = asyncio.Queue(MOST_AT_A_TIME)
        self._ungranted: list[str] = []
        self._sent: dict[str, dict[str, Any]] = {}
        """By device, what it has sent."""
        self._there: Mapping[str, bool] = dict.fromkeys(devices, True)
        self.was_born = False
        """Whether this session got as far as its births."""

    async def run(self, stopping: asyncio.Event, there: Mapping[str, bool]) -> None:
        """Listen, wait for the host, tell everything; until ``stopping`` is set.

        Args:
            stopping: ends the session when the alarms that are on disk are sent.
            there: by machine, whether it can be reached by now.

        Raises:
            HostAwayError: the primary host has left this broker, or never came.
            MqttError: the connection is lost.
        """
        self._there = there
        heard: asyncio.Queue[Incoming] = asyncio.Queue(HEARD)
        wanted = [self._node.commands, self._node.device_commands]
        self._ungranted = await self._connection.watch(*wanted, *(self._host.topics if self._host else ()))
        obeying = asyncio.create_task(self._execute(), name="sparkplug-commands")
        listening = asyncio.create_task(self._listen(heard), name="sparkplug-listen")
        stopped = asyncio.create_task(stopping.wait(), name="sparkplug-stop")
        try:
            if self._host is not None:
                await self._await_host(heard, listening, stopped)
            if stopped.done():
                return
            present = await self._outbox.latest()
            for message in present:
                self._board.put(None, self._all_metrics_of(message))
            self._be_born()
            if self._host is not None:
                self._reports.there(self._host.host_id)
            await self._tell_history(max((message.sequence for message in present), default=0))
            await self._tell(heard, listening, stopped)
            await self._tell_alarms(await self._outbox.following(self._cursor, READ_AHEAD))
        finally:
            self._counters.waiting_for_host = False
            for task in (listening, stopped, obeying):
                task.cancel()
            await asyncio.gather(listening, stopped, obeying, return_exceptions=True)

    async def leave(self, timeout_s: float) -> None:
        """Publish the node's death, if it was born, and disconnect; takes about ``timeout_s`` at most."""
        try:
            async with asyncio.timeout(timeout_s):
                if self._node.is_born:
                    death = self._node.will(self._bd_seq, self._now_ms)
                    self._node.die()
                    await self._connection.deliver(death.topic, death.payload, retain=False)
        except (TimeoutError, MqttError) as error:
            log.info("the node's death was not published (%s); the last will reports it", error)
            return  # dropped without a word, so that the broker publishes the will
        await self._connection.close(timeout_s)

    @property
    def _now_ms(self) -> int:
        return self._clock.wall_ns() // NS_PER_MS

    @property
    def _cursor(self) -> int:
        return self._memory.cursor or 0

    async def _listen(self, heard: asyncio.Queue[Incoming]) -> None:
        async for message in self._connection.incoming():
            await heard.put(message)

    async def _await_host(
        self,
        heard: asyncio.Queue[Incoming],
        listening: asyncio.Task[None],
        stopped: asyncio.Task[Any],
    ) -> None:
        """Until the primary host states that it is online at this broker, or stopped.

        Raises:
            HostAwayError: it is not, and there are other brokers to try.
            MqttError: the connection is lost.
        """
        assert self._host is not None  # noqa: S101 - asked for only with a host
        loop = asyncio.get_running_loop()
        report_at_s = loop.time() + HOST_REPORT_S
        while not self._host.online and not stopped.done():
            alone_s = None if self._counters.waiting_for_host else max(report_at_s - loop.time(), 0.0)
            patience_s = alone_s if self._alone else HOST_S
            message = await self._first(heard.get(), listening, stopped, patience_s)
            if message is not None:
                self._hear(message)
            elif self._alone and not stopped.done():
                self._counters.waiting_for_host = True
                await self._say_who_is_there(heard, listening, stopped)
            if not self._alone and not self._host.online and not stopped.done():
                raise HostAwayError(
                    f"primary host {self._host.host_id} is not at this broker; trying the next"
                )
        self._counters.waiting_for_host = False

    async def _say_who_is_there(
        self,
        heard: asyncio.Queue[Incoming],
        listening: asyncio.Task[None],
        stopped: asyncio.Task[Any],
    ) -> None:
        """Log that the primary host has not come, its last state, and which hosts there are instead."""
        assert self._host is not None  # noqa: S101 - asked for only with a host
        wanted = self._host.topics
        everybody = [f"{begin}+" for begin in STATES]
        await self._connection.watch(*everybody)
        others: set[str] = set()
        loop = asyncio.get_running_loop()
        until_s = loop.time() + LOOK_S
        while not stopped.done() and (left_s := until_s - loop.time()) > 0:
            message = await self._first(heard.get(), listening, stopped, left_s)
            if message is None:
                break
            if not message.topic.startswith(STATES) or message.topic in wanted:
                self._hear(message)
            elif len(others) < HOSTS_NAMED:
                others.add(message.topic.rpartition("/")[2][:_SHOWN_ID])
        for topic in everybody:
            await self._connection.unsubscribe(topic)
        if self._host.online:
            return
        offline = self._host.online is False
        word = "reports that it is offline" if offline else "has sent no state that can be read"
        closed = [topic for topic in self._ungranted if topic in wanted]
        there = ", ".join(repr(name) for name in sorted(others))
        barred = f" (the broker lets this client not listen to {' and '.join(closed)})" if closed else ""
        hosts = f"hosts at this broker are {there}" if there else "there is no other host at this broker"
        self._reports.missing(
            f"Sparkplug sends nothing yet: primary host {self._host.host_id} {word} on "
            f"{' or '.join(wanted)}{barred}; {hosts}. Correct primary_host in [mqtt.sparkplug], or have "
            "that host connect to this broker"
        )

    async def _execute(self) -> None:
        """Carry out what hosts have written to alarms, one after the other."""
        while self._commands:
            commands, wish = await self._wishes.get()
            if await commands.carry_out(wish):
                self._counters.commands += 1
            else:
                self._counters.commands_refused += 1

    async def _first(
        self,
        wanted: Coroutine[Any, Any, Incoming],
        listening: asyncio.Task[None],
        stopped: asyncio.Task[Any],
        patience_s: float | None,
    ) -> Incoming | None:
        """The next message, or None if it takes too long or the service stops."""
        waiting = asyncio.ensure_future(wanted)
        try:
            await asyncio.wait(
                {waiting, listening, stopped}, timeout=patience_s, return_when=asyncio.FIRST_COMPLETED
            )
            if listening.done():
                listening.result()
            return waiting.result() if waiting.done() else None
        finally:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)

    def _be_born(self) -> None:
        """Publish all births, with present values."""
        node = self._board.of(None, self._now_ms)
        devices = {
            device: self._board.of(device, self._now_ms)
            for machine, device in self._devices.items()
            if self._there[machine]
        }
        self._sent = {device: _values(metrics) for device, metrics in devices.items()}
        for publication in self._node.births(self._bd_seq, self._now_ms, node, devices):
            self._publish(publication)
        self._counters.births += 1
        self.was_born = True

    async def _tell_history(self, newest: int) -> None:
        """Tell, as history, the alarm events up to ``newest`` that no broker has taken yet.

        The births reported the latest of each alarm only.
        """
        while self._cursor < newest:
            messages = await self._outbox.following(self._cursor, READ_AHEAD)
            messages = [message for message in messages if message.sequence <= newest]
            if not messages:
                return
            for message in messages:
                metrics = [replace(metric, historical=True) for metric in self._metrics_of(message)]
                if metrics and self._node.knows(None, metrics):
                    self._publish(self._node.data(None, self._now_ms, metrics))
                    self._counters.historical += 1
            await self._confirm(messages[-1].sequence)

    async def _tell(
        self,
        heard: asyncio.Queue[Incoming],
        listening: asyncio.Task[None],
        stopped: asyncio.Task[Any],
    ) -> None:
        """Tell alarms as they come and figures once a second, and do what hosts ask for."""
        loop = asyncio.get_running_loop()
        due_s = loop.time() + TELL_S
        arriving = asyncio.create_task(self._outbox.next_following(self._cursor, READ_AHEAD))
        asked = asyncio.create_task(heard.get())
        try:
            while not stopped.done():
                await asyncio.wait(
                    {arriving, asked, listening, stopped},
                    timeout=max(due_s - loop.time(), 0.0),
                    return_when=asyncio.FIRST_COMPLETED,
                )
                if listening.done():
                    listening.result()
                if asked.done():
                    if self._hear(asked.result()):
                        self._be_born()
                    asked = asyncio.create_task(heard.get())
                if self._host is not None and not self._host.online:
                    raise HostAwayError(f"primary host {self._host.host_id} has left this broker")
                if arriving.done():
                    await self._tell_alarms(arriving.result())
                    arriving = asyncio.create_task(self._outbox.next_following(self._cursor, READ_AHEAD))
                if loop.time() >= due_s:
                    due_s = loop.time() + TELL_S
                    for machine, device in self._devices.items():
                        self._tell_device(device, there=self._there[machine])
        finally:
            for task in (arriving, asked):
                task.cancel()
            await asyncio.gather(arriving, asked, return_exceptions=True)

    async def _tell_alarms(self, messages: list[OutboxMessage]) -> None:
        """Tell alarm events as they are."""
        for message in messages:
            changed = self._board.put(None, self._all_metrics_of(message))
            if not changed:
                continue
            if self._node.knows(None, changed):
                self._publish(self._node.data(None, self._now_ms, changed))
            else:
                # An alarm that no birth has named: new births tell its present state.
                self._be_born()
            self._counters.alarms += 1
        if messages:
            await self._confirm(messages[-1].sequence)

    def _tell_device(self, device: str, *, there: bool) -> None:
        """Tell what has changed at a machine, and whether it can be reached."""
        if not there:
            if self._node.lives(device):
                self._publish(self._node.device_death(device, self._now_ms))
            return
        present, sent = self._board.of(device, self._now_ms), self._sent.get(device, {})
        changed = [m for m in present if m.name not in sent or sent[m.name] != m.value]
        if not self._node.lives(device) or not self._node.knows(device, changed):
            self._publish(self._node.device_birth(device, self._now_ms, present))
        elif changed:
            self._publish(self._node.data(device, self._now_ms, changed))
            self._counters.data += 1
        self._sent[device] = _values(present)

    def _hear(self, message: Incoming) -> bool:
        """Take in what a host states; whether it asks for new births."""
        topic, payload = message.topic, message.payload
        try:
            if self._host is not None and topic in self._host.topics:
                if not self._host.take(topic, payload):
                    self._counters.states_refused += 1
            elif topic.startswith(STATES):
                pass  # of another host, which was looked for and is no longer
            elif message.retain:
                self._counters.commands_refused += 1
            elif topic == self._node.commands:
                rest = self._take_wishes(topic, None, payload)
                return rest is not None and self._node.is_born and self._node.wants_rebirth(rest)
            elif (device := self._device_of(topic)) is not None:
                if self._take_wishes(topic, device, payload) is not None:
                    raise PayloadError("it asks for nothing that can be written")  # noqa: TRY301
            else:
                self._counters.commands_refused += 1
        except PayloadError as error:
            if self._host is not None and topic in self._host.topics:
                self._counters.states_refused += 1
            else:
                self._counters.commands_refused += 1
            log.info("%s is left alone: %s", topic, error)
        return False

    def _device_of(self, topic: str) -> str | None:
        """The device that commands on a topic are for; None for none of these."""
        topics = {self._node.command_topic(device): device for device in self._machine_of}
        return topics.get(topic)

    def _take_wishes(self, topic: str, device: str | None, payload: bytes) -> list[Metric] | None:
        """Take in what is written to alarms.

        Returns:
            The metrics that are no wish; None if there were wishes and nothing else.

        Raises:
            PayloadError: it cannot be read, or asks for too much at a time.
        """
        commands = self._node.command(device, payload)
        if not self._commands:
            return list(commands.metrics)
        if len(commands.metrics) > MOST_AT_A_TIME:
            raise PayloadError(
                f"it writes {len(commands.metrics)} metrics; {MOST_AT_A_TIME} at a time are taken"
            )
        rest = []
        for metric in commands.metrics:
            wish = self._meant(topic, device, metric, commands.timestamp_ms)
            if wish is None:
                rest.append(metric)
            elif self._wishes.full():
                self._counters.commands_refused += 1
            else:
                self._wishes.put_nowait(wish)
        return rest if rest or not commands.metrics else None

    def _meant(
        self, topic: str, device: str | None, metric: Metric, sent_ms: int | None
    ) -> tuple[AlarmCommands, HostCommand] | None:
        """What a written metric asks for, and who carries it out; None if hosts may not write it."""
        if device is not None:
            asked = [self._commands[self._machine_of[device]]]
        else:
            asked = [*self._commands.values()]
        for commands in asked:
            wish = commands.meant(topic, metric, sent_ms, of_node=device is None)
            if wish is not None:
                return commands, wish
        return None

    def _all_metrics_of(self, message: OutboxMessage) -> list[Metric]:
        """The metrics of an alarm event, and those by which hosts may ask something of the alarm."""
        metrics = self._metrics_of(message)
        for machine, commands in self._commands.items() if metrics else ():
            prefix = self._topics.alarm_prefix(machine)
            if message.topic.startswith(prefix):
                return [*metrics, *commands.of_node(message.topic.removeprefix(prefix))]
        return metrics  # of a machine of before, perhaps

    def _metrics_of(self, message: OutboxMessage) -> list[Metric]:
        """The metrics of an alarm event; none of anything else in the outbox."""
        if not (message.topic.startswith(f"{self._topics.base}/") and "/alarms/" in message.topic):
            return []
        try:
            return alarm_metrics(message.payload)
        except ValueError:
            self._counters.unreadable += 1
            return []

    def _publish(self, publication: Publication) -> None:
        self._connection.tell(publication.topic, publication.payload)

    async def _confirm(self, sequence: int) -> None:
        """Have the broker answer, which shows that it has all that was sent before, and remember that."""
        await self._connection.unsubscribe(f"{self._node.commands}/none")
        await asyncio.to_thread(self._memory.advance, sequence)


def _values(metrics: Iterable[Metric]) -> dict[str, Any]:
    return {metric.name or "": metric.value for metric in metrics}
