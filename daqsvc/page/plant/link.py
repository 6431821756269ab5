"""The page's connection to the broker of a plant."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import uuid
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import NOT_SHOWN
from daqsvc.notice import notice
from daqsvc.publish.mqtt.connection import Connection
from daqsvc.publish.mqtt.credentials import read_credentials
from daqsvc.publish.mqtt.errors import MqttError, NoConsentError, Outage, in_words
from daqsvc.publish.topics import Topics, box_topic

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.page.plant.known import KnownMachine, KnownPlant
    from daqsvc.publish.mqtt.connection import Incoming
    from daqsvc.publish.mqtt.settings import Mqtt

log = logging.getLogger(__name__)

IN_FLIGHT = 20
MOST_WAITING = 100_000
"""Messages that wait to be examined: at first all that the broker keeps comes at once."""
ANSWER_S = 10.0
"""How long the answer to a command is waited for."""
CLOSE_S = 1.0
MOST_PIECES = 1000
"""Pieces of a live feed that wait; of more the feed is begun again."""


class BrokerAwayError(OSError):
    """There is no connection to the broker; the text states why."""


class BrokerLink:
    """Listens to all boxes of a plant over one connection, which is made again whenever it is lost.

    Args:
        mqtt: the broker.
        known: takes in what comes.
    """

    def __init__(self, mqtt: Mqtt, known: KnownPlant) -> None:
        self.looker = f"page-{uuid.uuid4().hex[:16]}"
        """By which boxes know this page among those that look on."""
        self.connections = 0
        """How many there have been."""
        self.why_not = "the broker has not answered yet"
        """Why nothing comes by now; empty if something does."""
        self._mqtt = mqtt
        self._known = known
        self._mqtt5 = mqtt.protocol != "3.1.1"
        self._connection: Connection | None = None
        self._outage = Outage(log)
        self._feeds: dict[str, asyncio.Queue[bytes]] = {}
        self._answers: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._heard_boxes: set[tuple[str, str]] = set()
        self._new_boxes = asyncio.Event()

    @property
    def name(self) -> str:
        """What the broker is called."""
        return f"{self._mqtt.host}:{self._mqtt.port}"

    def topics_of(self, machine: KnownMachine) -> Topics:
        """The topics of a machine's box."""
        return Topics(self._mqtt.topic_root, machine.site, machine.box)

    async def run(self) -> None:
        """Listen until cancelled."""
        backoff = Backoff()
        while True:
            connection: Connection | None = None
            try:
                credentials = await asyncio.to_thread(read_credentials, self._mqtt)
                connection = self._made(credentials.password, credentials.context)
                await connection.open()
                await self._begin(connection)
                backoff.reset()
                await self._serve(connection)
            except (MqttError, OSError) as error:
                self.why_not = f"the broker {self.name} is away: {in_words(error)}"
                self._outage.tell(f"MQTT broker {self.name}", error, "trying again until it is back")
                if isinstance(error, NoConsentError) and self._mqtt.protocol == "auto":
                    self._mqtt5 = not self._mqtt5
            finally:
                self._connection = None
                if connection is not None:
                    with contextlib.suppress(MqttError):
                        await connection.close(CLOSE_S)
            await asyncio.sleep(backoff.next_ns() / NS_PER_S)

    def _made(self, password: str | None, context: Any) -> Connection:
        mqtt = self._mqtt
        return Connection(
            mqtt.host,
            mqtt.port,
            in_flight=IN_FLIGHT,
            mqtt5=self._mqtt5,
            # No two pages end each other's connections, whatever the file states about a box.
            identifier=f"daqsvc-{self.looker}",
            username=mqtt.username,
            password=password,
            tls_context=context,
            keepalive=mqtt.keepalive_s,
            most_waiting=MOST_WAITING,
        )

    async def _begin(self, connection: Connection) -> None:
        root = self._mqtt.topic_root
        refused = await connection.watch(
            f"{root}/+/+/availability",
            f"{root}/+/+/+/live/{self.looker}/feed",
            f"{root}/+/+/+/commands/+/response",
        )
        for topic in refused:
            log.warning(
                "MQTT broker %s does not let the page listen to %s", self.name, topic, extra=coded(NOT_SHOWN)
            )
        self._connection = connection
        self.connections += 1
        self._heard_boxes.clear()
        self._new_boxes.set()
        self.why_not = ""
        if self._outage.is_reported:
            self._outage.end()
            notice(log, "MQTT broker %s is back", self.name)

    async def _serve(self, connection: Connection) -> None:
        hearing = asyncio.create_task(self._hear_boxes(connection), name="listen to boxes")
        taking = asyncio.create_task(self._take_all(connection), name="read what boxes send")
        try:
            done, _ = await asyncio.wait({hearing, taking}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in (hearing, taking):
                task.cancel()
            await asyncio.wait({hearing, taking})

    async def _hear_boxes(self, connection: Connection) -> None:
        """Listen to each box as it comes to be known: one after the other, so that no queue runs over."""
        while True:
            await self._new_boxes.wait()
            self._new_boxes.clear()
            for site, box in [*self._known.boxes]:
                if (site, box) in self._heard_boxes:
                    continue
                self._heard_boxes.add((site, box))
                base = Topics(self._mqtt.topic_root, site, box).base
                await connection.watch(f"{base}/status", f"{base}/+/alarms/#")

    async def _take_all(self, connection: Connection) -> None:
        async for message in connection.incoming():
            topic = box_topic(self._mqtt.topic_root, message.topic)
            if topic is None:
                continue
            if len(topic.rest) == 3 and topic.rest[1] == "live":
                self._take_piece(message)
            elif len(topic.rest) == 3 and topic.rest[1] == "commands":
                self._take_answer(message)
            else:
                self._known.take(message)
                if (topic.site, topic.box) not in self._heard_boxes:
                    self._new_boxes.set()

    def _take_piece(self, message: Incoming) -> None:
        pieces = self._feeds.get(message.topic)
        if pieces is not None and not pieces.full():
            pieces.put_nowait(message.payload)  # one that is left out is missed, and asked for again

    def _take_answer(self, message: Incoming) -> None:
        try:
            answer = json.loads(message.payload)
            waiting = self._answers.get(answer["id"])
        except (ValueError, LookupError, TypeError, RecursionError):
            return
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)

    async def hear_diagnoses(self, machine: KnownMachine) -> None:
        """Have the diagnoses of a machine come: they are many, and of few machines somebody looks at them."""
        if self._connection is not None:
            base = self.topics_of(machine).base
            with contextlib.suppress(MqttError):
                await self._connection.watch(f"{base}/{machine.machine}/diagnosis/#")

    async def leave_diagnoses(self, machine: KnownMachine) -> None:
        """Have them come no more."""
        if self._connection is not None:
            base = self.topics_of(machine).base
            with contextlib.suppress(MqttError):
                await self._connection.unsubscribe(f"{base}/{machine.machine}/diagnosis/#")

    @contextlib.contextmanager
    def feed(self, topic: str) -> Iterator[asyncio.Queue[bytes]]:
        """What comes on the topic of a live feed meanwhile."""
        pieces = self._feeds[topic] = asyncio.Queue(MOST_PIECES)
        try:
            yield pieces
        finally:
            if self._feeds.get(topic) is pieces:
                del self._feeds[topic]

    async def say(self, topic: str, payload: bytes) -> None:
        """Publish, and wait for the PUBACK.

        Raises:
            BrokerAwayError: it does not reach the broker, or that refuses it.
        """
        connection = self._connection
        if connection is None:
            raise BrokerAwayError(self.why_not or "the connection to the broker is lost")
        try:
            await connection.deliver(topic, payload, retain=False)
        except MqttError as error:
            raise BrokerAwayError(f"the broker {self.name} does not take it: {in_words(error)}") from None

    def tell(self, topic: str, payload: bytes) -> None:
        """Publish, if there is a connection; whether it arrives is not reported."""
        if self._connection is not None:
            with contextlib.suppress(MqttError):
                self._connection.tell(topic, payload)

    async def command(self, topic: str, asked: dict[str, Any]) -> dict[str, Any] | None:
        """Send a command, and wait for its answer; None if there is none in time.

        Args:
            topic: of the command.
            asked: its payload but for id and time.

        Raises:
            BrokerAwayError: it does not reach the broker.
        """
        secret = str(uuid.uuid4())
        now = datetime.now(UTC).isoformat()
        payload = {"schema": "daqsvc.command/1", "id": secret, "issued_at": now, **asked}
        answer = self._answers[secret] = asyncio.get_running_loop().create_future()
        try:
            await self.say(topic, json.dumps(payload).encode())
            async with asyncio.timeout(ANSWER_S):
                reply: dict[str, Any] = await answer
                return reply
        except TimeoutError:
            return None
        finally:
            del self._answers[secret]
