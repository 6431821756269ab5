"""The edge node at work: connects, waits for its host, tells births, alarms and figures, and leaves in order.

Sparkplug's data have QoS 0, which nobody acknowledges. So after alarms the node asks the broker something
harmless and waits for the answer: brokers work off a connection in order, so then they have the alarms too.
Only what a broker has so taken is not told again, as history, after the next connection.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace
from typing import TYPE_CHECKING

import daqsvc
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.publish.connection import Connection, Will
from daqsvc.publish.credentials import read_credentials
from daqsvc.publish.delivery import IN_FLIGHT
from daqsvc.publish.errors import MqttError
from daqsvc.publish.faults import Faults
from daqsvc.publish.outage import Outage
from daqsvc.publish.sparkplug.alarm_commands import AlarmCommands
from daqsvc.publish.sparkplug.host import HostReports
from daqsvc.publish.sparkplug.memory import Memory
from daqsvc.publish.sparkplug.metrics import (
    NS_PER_MS,
    Board,
    declared,
    diagnosis_metrics,
    node_properties,
    quiet_alarm,
)
from daqsvc.publish.sparkplug.node import EdgeNode
from daqsvc.publish.sparkplug.session import EdgeSession, HostAwayError, SparkplugCounters
from daqsvc.publish.spoken import Spoken
from daqsvc.publish.stopping import unless

if TYPE_CHECKING:
    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import CommandHandler
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.settings import MqttSettings
    from daqsvc.publish.sparkplug.settings import Server, SparkplugSettings
    from daqsvc.publish.topics import Topics

__all__ = ["SparkplugEdge"]

log = logging.getLogger(__name__)

FIRST_RETRY_NS = 800_000_000
GOODBYE_S = 0.3


class SparkplugEdge:
    """The box as a Sparkplug B 3.0 edge node, its machine as a device.

    Args:
        settings: what it is, and where.
        mqtt: credentials and protocol, shared with the box's own topics.
        outbox: where the alarms are; open while `run` runs.
        topics: the box's own topics, by which the alarms are known in the outbox.
        clock: for time stamps.
        commands: carries out what hosts write to alarms, where the machine file allows it; None: nothing.

    Raises:
        ValueError: an id that a Sparkplug topic cannot hold.
    """

    def __init__(
        self,
        settings: SparkplugSettings,
        mqtt: MqttSettings,
        outbox: Outbox,
        topics: Topics,
        clock: Clock,
        commands: CommandHandler | None = None,
    ) -> None:
        self.counters = SparkplugCounters()
        self.node = EdgeNode(settings.group, settings.edge_node)
        self._settings = settings
        self._mqtt = mqtt
        self._outbox = outbox
        self._topics = topics
        self._clock = clock
        self._memory = Memory(settings.memory)
        self._board = Board()
        self._board.put(None, node_properties(daqsvc.__version__, topics.site, topics.box))
        self._commands: AlarmCommands | None = None
        if mqtt.commands is not None and commands is not None:
            self._commands = AlarmCommands(
                mqtt.commands, settings.machine, topics, commands, clock, outbox.command_ids
            )
        for alarm in settings.alarms:
            self._board.put(None, quiet_alarm(settings.machine, alarm))
            if self._commands is not None:
                self._board.put(None, self._commands.of_node(alarm))
        self._board.put(settings.device, declared(settings.readings))
        if self._commands is not None:
            self._board.put(settings.device, self._commands.of_device(settings.alarms))
        self._watched = {reading.detector for reading in settings.readings}
        self._there = True
        self._server = 0
        self._backoff = Backoff(FIRST_RETRY_NS)
        self._spoken = {
            server: Spoken(outbox.directory, server.host, server.port, mqtt.protocol, clock.wall_ns)
            for server in settings.servers
        }
        self._outage = Outage(log)
        self._host_reports = HostReports()
        self._faults = Faults()
        self._stopping = asyncio.Event()
        self._running: asyncio.Future[None] | None = None

    def observe(self, diagnosis: Diagnosis) -> None:
        """Take in a statement of a detector; its figures are told within a second. Never waits."""
        if diagnosis.detector in self._watched:
            wall_ns = self._clock.wall_ns() - self._clock.monotonic_ns() + diagnosis.t_ns
            metrics = diagnosis_metrics(diagnosis, self._settings.readings, wall_ns)
            self._board.put(self._settings.device, metrics)

    def reach(self, *, there: bool) -> None:
        """Say whether the machine can be reached, that is, whether any of its buses is up."""
        self._there = there

    async def run(self) -> None:
        """Be an edge node until `stop`."""
        self._running = asyncio.get_running_loop().create_future()
        try:
            await asyncio.to_thread(self._memory.load)
            while not self._stopping.is_set():
                try:
                    await self._one_session(self._settings.servers[self._server])
                except Exception as error:  # noqa: BLE001  any, for watching the machine must go on
                    self._faults.note(
                        "Sparkplug was interrupted and begins anew with a new connection", error
                    )
                    await self._wait()
        finally:
            self._running.set_result(None)

    async def stop(self, deadline_s: float = 1.0) -> None:
        """Tell what alarms are left, publish the death, and end `run`; takes ``deadline_s`` at most."""
        self._stopping.set()
        if self._running is not None:
            await asyncio.wait({self._running}, timeout=deadline_s)

    async def _one_session(self, server: Server) -> None:
        """Connect to one broker and stay until that ends, for whatever reason."""
        try:
            made = await unless(self._stopping, self._connect(server))
        except (MqttError, OSError, ValueError) as error:
            if self._spoken[server].falls_back(error):
                return
            self._report_outage(server, error)
            self._walk()
            await self._wait()
            return
        if made is None:
            return
        connection, session = made
        try:
            await session.run(self._stopping, lambda: self._there)
            await session.leave(GOODBYE_S)
        except HostAwayError as away:
            self._host_reports.missing(f"Sparkplug at {server.host}:{server.port}: {away}")
            await session.leave(GOODBYE_S)
            self._walk()
            await self._wait()
        except (MqttError, OSError) as error:
            self._report_outage(server, error)
            if session.was_born:
                self._backoff.reset()
            self._walk()
            await self._wait()
        finally:
            self.counters.connected = False
            self.node.die()
            connection.abandon()

    async def _connect(self, server: Server) -> tuple[Connection, EdgeSession]:
        """A connection whose last will is the node's death."""
        spoken = self._spoken[server]
        await asyncio.to_thread(spoken.recall)
        mqtt = replace(self._mqtt, host=server.host, port=server.port, tls=server.tls)
        credentials = await asyncio.to_thread(read_credentials, mqtt)
        death = self.node.will(self._memory.bd_seq, self._clock.wall_ns() // NS_PER_MS)
        connection = Connection(
            server.host,
            server.port,
            in_flight=IN_FLIGHT,
            mqtt5=spoken.mqtt5,
            identifier=self._settings.client_id,
            username=mqtt.username,
            password=credentials.password,
            tls_context=credentials.context,
            keepalive=mqtt.keepalive_s,
            will=Will(death.topic, death.payload, qos=death.qos, retain=False),
        )
        try:
            await connection.open(spoken.consent_s)
            await asyncio.to_thread(spoken.agreed)
            bd_seq = self._memory.bd_seq
            newest = max((message.sequence for message in await self._outbox.latest()), default=0)
            # Only now: a connection that failed has used no number up.
            await asyncio.to_thread(self._memory.begin_session, newest)
        except BaseException:
            connection.abandon()
            raise
        self.counters.connections += 1
        self.counters.connected = True
        if self._outage.is_told:
            log.warning("Sparkplug is connected to broker %s:%d", server.host, server.port)
        self._outage.end()
        session = EdgeSession(
            connection,
            bd_seq,
            node=self.node,
            board=self._board,
            settings=self._settings,
            memory=self._memory,
            outbox=self._outbox,
            topics=self._topics,
            clock=self._clock,
            counters=self.counters,
            reports=self._host_reports,
            commands=self._commands,
        )
        return connection, session

    def _walk(self) -> None:
        """The next broker's turn."""
        self._server = (self._server + 1) % len(self._settings.servers)

    async def _wait(self) -> None:
        await unless(self._stopping, asyncio.sleep(self._backoff.next_ns() / NS_PER_S))

    def _report_outage(self, server: Server, error: Exception) -> None:
        broker = f"Sparkplug broker {server.host}:{server.port}"
        self._outage.tell(broker, error, "trying again until one is there")
