"""The edge node at work: connects, waits for its host, tells births, alarms and figures, and leaves in order.

Sparkplug's data have QoS 0, which is not acknowledged. So after alarms the node asks the broker something
harmless and waits for the answer: brokers work off a connection in order, so then they have the alarms too.
Only what a broker has acknowledged is not sent again, as history, after the next connection.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import daqsvc
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.notice import notice
from daqsvc.publish.mqtt.connection import Connection, Will
from daqsvc.publish.mqtt.credentials import read_credentials
from daqsvc.publish.mqtt.delivery import IN_FLIGHT
from daqsvc.publish.mqtt.errors import Faults, MqttError, Outage, unless
from daqsvc.publish.mqtt.spoken import Spoken
from daqsvc.publish.output import Output
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

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.publish.output import OutputPort, Watched
    from daqsvc.publish.sparkplug.settings import Sparkplug

log = logging.getLogger(__name__)

FIRST_RETRY_NS = 800_000_000
GOODBYE_S = 0.3

MEMORY = "sparkplug.json"
"""File in the store for what must survive a restart."""


class SparkplugEdge(Output):
    """The box as a Sparkplug B 3.0 edge node, each of its machines as a device.

    Args:
        settings: what it is, and where.
        mqtt: credentials and protocol, shared with the box's own topics.
        port: what there is to tell, and who carries out what hosts write to alarms where `mqtt` allows it.

    Raises:
        ValueError: an id that a Sparkplug topic cannot hold.
    """

    def __init__(self, settings: Sparkplug, mqtt: Mqtt, port: OutputPort) -> None:
        topics = port.topics
        self.counters = SparkplugCounters()
        self.node = EdgeNode(settings.group or topics.site, settings.edge_node or topics.box)
        self._settings = settings
        self._port = port
        # What represents the service itself is the node: its figures are no device's.
        several = len(port.machines) > 1
        self._devices = {
            name: settings.device or name
            for name, watched in port.machines.items()
            if watched.readings or watched.alarms or not several
        }
        self._brokers = [mqtt.model_copy(update={"url": url}) for url in settings.servers or (mqtt.url,)]
        self._client_id = settings.client_id or f"{mqtt.client_id}:sparkplug"
        self._clock = port.clock
        self._memory = Memory(port.store / MEMORY)
        self._board = Board()
        self._board.put(None, node_properties(daqsvc.__version__, topics.site, topics.box))
        self._commands: dict[str, AlarmCommands] = {}
        for name, watched in port.machines.items():
            if mqtt.commands.enabled and port.commands is not None:
                self._commands[name] = AlarmCommands(mqtt.commands, name, port, port.commands)
            self._declare(name, watched)
        self._there = dict.fromkeys(self._devices, True)
        self._turn = 0
        self._backoff = Backoff(FIRST_RETRY_NS)
        self._spoken = [
            Spoken(port.store, broker.host, broker.port, mqtt.protocol, port.clock.wall_ns)
            for broker in self._brokers
        ]
        self._outage = Outage(log)
        self._host_reports = HostReports()
        self._faults = Faults()
        self._stopping = asyncio.Event()
        self._running: asyncio.Future[None] | None = None

    def _declare(self, machine: str, watched: Watched) -> None:
        """Name all that will be reported about a machine."""
        alarms, commands = (*watched.alarms, *watched.services), self._commands.get(machine)
        for alarm in alarms:
            self._board.put(None, quiet_alarm(machine, alarm))
            if commands is not None:
                self._board.put(None, commands.of_node(alarm))
        device = self._devices.get(machine)
        if device is not None:
            self._board.put(device, declared(watched.readings))
            if commands is not None:
                self._board.put(device, commands.of_device(alarms))

    def report(self, diagnosis: Diagnosis) -> None:
        """Take in a statement of a detector; its figures are sent within a second."""
        readings = self._port.machines[diagnosis.machine].readings
        if any(reading.detector == diagnosis.detector for reading in readings):
            wall_ns = self._clock.wall_ns() - self._clock.monotonic_ns() + diagnosis.t_ns
            metrics = diagnosis_metrics(diagnosis, readings, wall_ns)
            self._board.put(self._devices[diagnosis.machine], metrics)

    def status(self, figures: Mapping[str, Any]) -> None:
        """Take in whether each machine can be reached, that is, whether any of its buses is up."""
        for machine in self._devices:
            buses = self._port.machines[machine].buses
            self._there[machine] = any(figures["buses"][bus]["up"] for bus in buses)

    def figures(self) -> dict[str, Any]:
        """See `Output.figures`."""
        return asdict(self.counters)

    async def run(self) -> None:
        """Be an edge node until `stop`."""
        self._running = asyncio.get_running_loop().create_future()
        try:
            await asyncio.to_thread(self._memory.load)
            while not self._stopping.is_set():
                try:
                    await self._one_session(self._brokers[self._turn], self._spoken[self._turn])
                except Exception as error:  # noqa: BLE001  any, for watching the machine must go on
                    self._faults.note(
                        "Sparkplug was interrupted and begins again with a new connection", error
                    )
                    await self._wait()
        finally:
            self._running.set_result(None)

    async def stop(self, deadline_s: float = 1.0) -> None:
        """Tell what alarms are left, publish the death, and end `run`; takes ``deadline_s`` at most."""
        self._stopping.set()
        if self._running is not None:
            await asyncio.wait({self._running}, timeout=deadline_s)

    async def _one_session(self, server: Mqtt, spoken: Spoken) -> None:
        """Connect to one broker and stay until that ends, for whatever reason."""
        try:
            made = await unless(self._stopping, self._connect(server, spoken))
        except (MqttError, OSError, ValueError) as error:
            if spoken.falls_back(error):
                return
            self._report_outage(server, error)
            self._walk()
            await self._wait()
            return
        if made is None:
            return
        connection, session = made
        try:
            await session.run(self._stopping, self._there)
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

    async def _connect(self, server: Mqtt, spoken: Spoken) -> tuple[Connection, EdgeSession]:
        """A connection whose last will is the node's death."""
        await asyncio.to_thread(spoken.recall)
        credentials = await asyncio.to_thread(read_credentials, server)
        death = self.node.will(self._memory.bd_seq, self._clock.wall_ns() // NS_PER_MS)
        connection = Connection(
            server.host,
            server.port,
            in_flight=IN_FLIGHT,
            mqtt5=spoken.mqtt5,
            identifier=self._client_id,
            username=server.username,
            password=credentials.password,
            tls_context=credentials.context,
            keepalive=server.keepalive_s,
            will=Will(death.topic, death.payload, qos=death.qos, retain=False),
        )
        try:
            await connection.open(spoken.consent_s)
            await asyncio.to_thread(spoken.agreed)
            bd_seq = self._memory.bd_seq
            newest = max((message.sequence for message in await self._port.outbox.latest()), default=0)
            # Only now: a connection that failed has used no number up.
            await asyncio.to_thread(self._memory.begin_session, newest)
        except BaseException:
            connection.abandon()
            raise
        self.counters.connections += 1
        self.counters.connected = True
        if self._outage.is_reported:
            notice(log, "Sparkplug is connected to broker %s:%d", server.host, server.port)
        self._outage.end()
        session = EdgeSession(
            connection,
            bd_seq,
            node=self.node,
            board=self._board,
            devices=self._devices,
            primary_host=self._settings.primary_host,
            alone=len(self._brokers) == 1,
            port=self._port,
            memory=self._memory,
            counters=self.counters,
            reports=self._host_reports,
            commands=self._commands,
        )
        return connection, session

    def _walk(self) -> None:
        """The next broker's turn."""
        self._turn = (self._turn + 1) % len(self._brokers)

    async def _wait(self) -> None:
        await unless(self._stopping, asyncio.sleep(self._backoff.next_ns() / NS_PER_S))

    def _report_outage(self, server: Mqtt, error: Exception) -> None:
        broker = f"Sparkplug broker {server.host}:{server.port}"
        self._outage.tell(broker, error, "trying again until one is there")
