"""The publisher: alarms from the outbox at least once and in order, telemetry as it comes."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import aiomqtt

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.supervisor import Backoff
from daqsvc.publish.connection import Connection, NoConsentError, tls_context
from daqsvc.publish.delivery import IN_FLIGHT, Delivery
from daqsvc.publish.payloads import availability_payload
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    import ssl
    from collections.abc import Coroutine
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.store import Outbox

log = logging.getLogger(__name__)

_T = TypeVar("_T")

STABLE_S = 10.0
"""A connection that lasted this long has earned a quick first retry."""

FIRST_RETRY_NS = 800_000_000
"""Ceiling of the first wait after a loss."""

GOODBYE_S = 0.3
"""What saying goodbye may take of the time to stop."""

_UNSUPPORTED_PROTOCOL_VERSION = 132


@dataclass(frozen=True, slots=True)
class MqttSettings:
    """How to reach the broker.

    Attributes:
        host: host name or address of the broker.
        port: TCP port.
        tls: whether to use TLS; the broker's certificate and host name are always verified.
        ca_file: certificate authorities in PEM; None for those of the system.
        client_id: MQTT client id, unique at the broker.
        username: None for an anonymous connection.
        password_file: file with the password; read again for every connection.
        keepalive_s: MQTT keep-alive.
        topic_root: first part of every topic.
        protocol: MQTT version; ``"auto"`` asks for 5 and takes 3.1.1 if the broker knows no better.
    """

    host: str
    port: int
    client_id: str
    tls: bool = False
    ca_file: Path | None = None
    username: str | None = None
    password_file: Path | None = None
    keepalive_s: int = 30
    topic_root: str = "daqsvc"
    protocol: Literal["auto", "5", "3.1.1"] = "auto"


@dataclass(slots=True)
class PublishCounters:
    """What the publisher has done.

    Attributes:
        connected: whether there is a connection now.
        connections: how many there have been.
        published: QoS 1 messages handed to the broker, repeats included.
        acknowledged: QoS 1 messages for which a PUBACK came.
        telemetry_sent: QoS 0 messages handed to the broker.
        telemetry_dropped: QoS 0 messages dropped: the oldest ones because there was no broker, or what
            was left when the publisher stopped.
    """

    connected: bool = False
    connections: int = 0
    published: int = 0
    acknowledged: int = 0
    telemetry_sent: int = 0
    telemetry_dropped: int = 0

    def count_published(self) -> None:
        """One more was handed to the broker."""
        self.published += 1

    def count_acknowledged(self) -> None:
        """One more PUBACK came."""
        self.acknowledged += 1


class MqttPublisher:
    """Publishes the outbox and telemetry to one broker, through its outages.

    `run` is the one task of it. Connecting, waiting and keep-alive go by real time, whatever clock the
    data has: the broker is real.

    Args:
        settings: how to reach the broker.
        site: name of the site.
        box: name of the box.
        outbox: what must reach the broker; open while `run` runs.
        clock: for the time in the availability payload.
        telemetry_limit: telemetry messages that may wait for a broker; then the oldest is dropped.
    """

    def __init__(
        self,
        settings: MqttSettings,
        site: str,
        box: str,
        outbox: Outbox,
        clock: Clock,
        *,
        telemetry_limit: int = 1000,
    ) -> None:
        self.counters = PublishCounters()
        self.topics = Topics(settings.topic_root, site, box)
        self._settings = settings
        self._outbox = outbox
        self._clock = clock
        self._telemetry: deque[tuple[str, bytes]] = deque()
        self._telemetry_limit = telemetry_limit
        self._telemetry_arrived = asyncio.Event()
        self._backoff = Backoff(FIRST_RETRY_NS)
        self._outage_reported = False
        self._protocol = (
            aiomqtt.ProtocolVersion.V311 if settings.protocol == "3.1.1" else aiomqtt.ProtocolVersion.V5
        )
        self._stopping = asyncio.Event()
        self._stop_at_s = 0.0
        self._running: asyncio.Future[None] | None = None

    def telemetry(self, topic: str, payload: bytes) -> None:
        """Publish with QoS 0 when there is a broker; never waits.

        Args:
            topic: below the box, e.g. ``"status"`` or ``"laval-rig/diagnosis/rotor-bank"``.
            payload: the bytes.
        """
        if self._running is not None and self._running.done():
            self.counters.telemetry_dropped += 1
            return
        if len(self._telemetry) >= self._telemetry_limit:
            self._telemetry.popleft()
            self.counters.telemetry_dropped += 1
        self._telemetry.append((f"{self.topics.base}/{topic}", payload))
        self._telemetry_arrived.set()

    async def run(self) -> None:
        """Publish until `stop`: connect, serve, and connect again after each loss."""
        self._running = asyncio.get_running_loop().create_future()
        try:
            while not self._stopping.is_set():
                connection = await self._unless_stopping(self._connect())
                if connection is None:
                    await self._unless_stopping(asyncio.sleep(self._backoff.next_ns() / NS_PER_S))
                    continue
                try:
                    await self._serve(connection)
                finally:
                    self.counters.connected = False
                    connection.abandon()
        finally:
            self.counters.telemetry_dropped += len(self._telemetry)
            self._telemetry.clear()
            self._running.set_result(None)

    async def stop(self, deadline_s: float = 1.0) -> None:
        """Hand over what is left, say that the box goes offline, and end `run`.

        Without a connection this takes no time; otherwise at most ``deadline_s``. What the broker has
        not acknowledged by then stays in the outbox.
        """
        self._stop_at_s = asyncio.get_running_loop().time() + deadline_s
        self._stopping.set()
        self._telemetry_arrived.set()
        if self._running is not None:
            await asyncio.wait({self._running})

    async def _connect(self) -> Connection | None:
        """A connection at which the box is known as online; None after a failure."""
        try:
            connection = Connection(
                self._settings.host, self._settings.port, in_flight=IN_FLIGHT, **await self._options()
            )
            await connection.open()
            try:
                await connection.deliver(
                    self.topics.availability, self._availability("online", "connected"), retain=True
                )
            except BaseException:
                connection.abandon()
                raise
        except (aiomqtt.MqttError, OSError) as error:
            if not self._falls_back(error):
                self._report_outage(str(error))
            return None
        self.counters.connections += 1
        self.counters.connected = True
        if self._outage_reported:
            self._outage_reported = False
            log.warning("MQTT broker %s is back", self._name)
        else:
            log.info("connected to MQTT broker %s", self._name)
        return connection

    async def _options(self) -> dict[str, Any]:
        """What a connection needs; certificates and password as the files are now."""
        settings = self._settings
        password, context = await asyncio.to_thread(_read_credentials, settings)
        return {
            "identifier": settings.client_id,
            "username": settings.username,
            "password": password,
            "tls_context": context,
            "keepalive": settings.keepalive_s,
            "protocol": self._protocol,
            "will": aiomqtt.Will(
                self.topics.availability, self._availability("offline", "connection lost"), qos=1, retain=True
            ),
        }

    async def _serve(self, connection: Connection) -> None:
        """Publish over one connection until it is lost or the publisher stops."""
        since_s = asyncio.get_running_loop().time()
        delivery = Delivery(
            self._outbox,
            connection,
            self.topics.base,
            self._stopping,
            on_sent=self.counters.count_published,
            on_acknowledged=self.counters.count_acknowledged,
        )
        drain = asyncio.create_task(delivery.run(), name="mqtt-outbox")
        telemetry = asyncio.create_task(self._send_telemetry(connection), name="mqtt-telemetry")
        lost = asyncio.create_task(connection.lost(), name="mqtt-lost")
        tasks = {drain, telemetry, lost}
        try:
            await self._unless_stopping(asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED))
            if self._stopping.is_set() and not lost.done():
                await self._hand_over({drain, telemetry}, lost)
                await self._say_goodbye(connection)
                return
        finally:
            for task in tasks:
                task.cancel()
            outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        reason = "connection lost"
        for outcome in outcomes:
            if isinstance(outcome, (aiomqtt.MqttError, OSError)):
                reason = str(outcome)
            elif isinstance(outcome, Exception):
                raise outcome
        self._report_outage(reason)
        if asyncio.get_running_loop().time() - since_s > STABLE_S:
            self._backoff.reset()
        await self._unless_stopping(asyncio.sleep(self._backoff.next_ns() / NS_PER_S))

    async def _hand_over(self, left: set[asyncio.Task[None]], lost: asyncio.Task[None]) -> None:
        """Let the tasks finish what is left, for as long as the connection lives and the time allows."""
        while left and not lost.done() and (patience_s := self._left_s() - GOODBYE_S) > 0:
            await asyncio.wait({*left, lost}, timeout=patience_s, return_when=asyncio.FIRST_COMPLETED)
            left = {task for task in left if not task.done()}

    async def _send_telemetry(self, connection: Connection) -> None:
        """Send telemetry as it comes, until the publisher stops and nothing is left."""
        while True:
            while not self._telemetry:
                if self._stopping.is_set():
                    return
                self._telemetry_arrived.clear()
                await self._telemetry_arrived.wait()
            topic, payload = self._telemetry.popleft()
            try:
                await connection.publish(topic, payload, qos=0)
            except (aiomqtt.MqttError, asyncio.CancelledError):
                self.counters.telemetry_dropped += 1
                raise
            self.counters.telemetry_sent += 1

    async def _say_goodbye(self, connection: Connection) -> None:
        """Publish that the box goes offline; if that fails, the last will says so."""
        offline = self._availability("offline", "stopped")
        try:
            async with asyncio.timeout(max(self._left_s(), GOODBYE_S / 2)):
                await connection.deliver(self.topics.availability, offline, retain=True)
        except TimeoutError:
            log.warning("MQTT broker %s did not answer to the goodbye; the last will tells", self._name)
        except aiomqtt.MqttError as error:
            log.warning("MQTT broker %s did not take the goodbye: %s; the last will tells", self._name, error)
        else:
            await connection.close(max(self._left_s(), GOODBYE_S / 2))

    async def _unless_stopping(self, work: Coroutine[Any, Any, _T]) -> _T | None:
        """The result of ``work``; None if the publisher is told to stop before."""
        task = asyncio.ensure_future(work)
        stopping = asyncio.ensure_future(self._stopping.wait())
        try:
            await asyncio.wait({task, stopping}, return_when=asyncio.FIRST_COMPLETED)
            return task.result() if task.done() else None
        finally:
            for each in (task, stopping):
                each.cancel()
            await asyncio.gather(task, stopping, return_exceptions=True)

    def _left_s(self) -> float:
        return max(self._stop_at_s - asyncio.get_running_loop().time(), 0.0)

    def _availability(self, state: Literal["online", "offline"], reason: str) -> bytes:
        return availability_payload(self.topics.site, self.topics.box, state, reason, self._clock).to_json()

    def _falls_back(self, error: Exception) -> bool:
        """Choose the other MQTT version if the failure may come of this one; whether that is 3.1.1.

        A broker that does not know MQTT 5 says so, closes the connection or, misled by the longer
        packet, waits for more of it.
        """
        code = getattr(getattr(error, "rc", None), "value", None)
        if self._settings.protocol != "auto" or not (
            isinstance(error, NoConsentError) or code == _UNSUPPORTED_PROTOCOL_VERSION
        ):
            return False
        older = self._protocol is aiomqtt.ProtocolVersion.V5
        self._protocol = aiomqtt.ProtocolVersion.V311 if older else aiomqtt.ProtocolVersion.V5
        return older

    @property
    def _name(self) -> str:
        return f"{self._settings.host}:{self._settings.port}"

    def _report_outage(self, reason: str) -> None:
        if not self._outage_reported:
            self._outage_reported = True
            log.warning("MQTT broker %s is away: %s; trying again until it is back", self._name, reason)


def _read_credentials(settings: MqttSettings) -> tuple[str | None, ssl.SSLContext | None]:
    """The password and a TLS context from the files as they are now; blocks."""
    password = None
    if settings.password_file is not None:
        password = settings.password_file.read_text(encoding="utf-8").rstrip("\r\n")
    context = tls_context(settings.ca_file) if settings.tls else None
    return password, context
