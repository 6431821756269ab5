"""Everything that goes on over one connection to the broker, until it ends."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import CREDENTIAL_FILE, TOPIC_REFUSED
from daqsvc.outbox.messages import OutboxError
from daqsvc.publish.mqtt.credentials import read_credentials, stamp_of
from daqsvc.publish.mqtt.delivery import Delivery, TelemetryDelivery
from daqsvc.publish.mqtt.errors import MqttError, PublishRefusedError, unless

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.mqtt.commands import CommandIntake
    from daqsvc.publish.mqtt.connection import Connection, Incoming
    from daqsvc.publish.mqtt.credentials import Credentials
    from daqsvc.publish.mqtt.errors import Faults
    from daqsvc.publish.mqtt.link import MqttLink
    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.publish.output import EarlierState
    from daqsvc.publish.topics import Topics

log = logging.getLogger(__name__)

LOOK_S = 10.0
"""How often to look whether a certificate, key or password was replaced."""

LOOK_AGAIN_S = 86_400.0
"""Time after which a connection is made again to see the broker's certificate, if the one it showed ends
soon."""

EARLIER_S = 3.0
"""How long delivery waits for the broker to send what it has kept of an earlier run."""

MOST_LASTING = 64
"""Commands of which the answer takes a while, at a time."""
ANSWER_EXPIRY_S = 60.0
"""How long the answer to a command is of use."""


@dataclass(slots=True)
class PublishCounters:
    """What the publisher has done.

    Attributes:
        connected: whether there is a connection now.
        connections: how many there have been.
        published: alarm messages handed to the broker, repeats included.
        acknowledged: alarm messages for which a PUBACK came.
        telemetry_sent: telemetry messages for which a PUBACK came.
        telemetry_refused: telemetry messages that the broker would not take.
        refused: alarm messages that the broker would not take, repeats included; they are kept.
        overlooked: messages from the broker dropped because too many came at a time.
        ignored: messages from the broker that the box has not subscribed to, or that came before its consent.
        faults: mistakes of this program, each of which the log names once.
    """

    connected: bool = False
    connections: int = 0
    published: int = 0
    acknowledged: int = 0
    telemetry_sent: int = 0
    telemetry_refused: int = 0
    refused: int = 0
    overlooked: int = 0
    ignored: int = 0
    faults: int = 0

    def count_published(self) -> None:
        """One more was handed to the broker."""
        self.published += 1

    def count_telemetry_sent(self) -> None:
        """One more telemetry message was acknowledged."""
        self.telemetry_sent += 1

    def count_telemetry_refused(self) -> None:
        """One more telemetry message was refused."""
        self.telemetry_refused += 1

    def count_overlooked(self) -> None:
        """One more message from the broker was dropped."""
        self.overlooked += 1

    def count_ignored(self) -> None:
        """One more message from the broker was none of the box's."""
        self.ignored += 1


class CredentialsReplacedError(Exception):
    """Certificate, key or password were replaced, or the broker's may be: time for a new connection."""


class Session:
    """One connection's worth of publishing and listening.

    Args:
        connection: open, and known as online.
        credentials: what it was made with.
        settings: how it was made.
        topics: the box.
        outbox: what must reach the broker.
        clock: the service's clock.
        counters: what is counted here.
        faults: takes mistakes of this program.
        intake: takes commands; None if there are none over MQTT.
        links: who else speaks over the connection.
        ends_soon: whether the certificate that the broker has shown, or the one behind it, ends soon.
        stopping: ends the deliveries as soon as nothing is left.
        earlier: what to ask the broker for before anything is delivered; None for nothing.
    """

    def __init__(
        self,
        connection: Connection,
        credentials: Credentials,
        *,
        settings: Mqtt,
        topics: Topics,
        outbox: Outbox,
        clock: Clock,
        counters: PublishCounters,
        faults: Faults,
        intake: CommandIntake | None,
        links: Sequence[MqttLink],
        ends_soon: Callable[[], bool],
        stopping: asyncio.Event,
        earlier: EarlierState | None = None,
    ) -> None:
        self._connection = connection
        self._credentials = credentials
        self._settings = settings
        self._topics = topics
        self._outbox = outbox
        self._clock = clock
        self._counters = counters
        self._faults = faults
        self._intake = intake
        self._links = links
        self._ends_soon = ends_soon
        self._stopping = stopping
        self._earlier = earlier
        self._refusals_logged: set[str] = set()
        self._lasting: set[asyncio.Task[None]] = set()
        """Answers to commands that take a while."""

    async def run(self, left_s: Callable[[], float]) -> None:
        """Publish and listen until `stopping` is set and everything is handed over, or time is up.

        Args:
            left_s: once `stopping` is set, how long the deliveries may take to hand over what is left, in s.

        Raises:
            MqttError: the connection is lost.
            CredentialsReplacedError: make a new connection.
        """
        await unless(self._stopping, self._ask_for_earlier())
        alarms = Delivery(
            self._outbox,
            self._connection,
            self._topics.base,
            self._stopping,
            on_sent=self._counters.count_published,
            on_acknowledged=self._acknowledged,
            on_refused=self._refused,
        )
        deliveries = {
            asyncio.create_task(alarms.run(), name="mqtt-alarms"),
            asyncio.create_task(self._telemetry(), name="mqtt-telemetry"),
        }
        others = {
            asyncio.create_task(alarms.try_again(), name="mqtt-refused"),
            asyncio.create_task(self._connection.lost(), name="mqtt-lost"),
            asyncio.create_task(self._listen(), name="mqtt-listen"),
            asyncio.create_task(self._look_after_credentials(), name="mqtt-credentials"),
            asyncio.create_task(self._stopping.wait(), name="mqtt-stopping"),
            *(asyncio.create_task(self._run_link(link), name=f"mqtt-{link.name}") for link in self._links),
        }
        try:
            await self._until_stopped(deliveries, others)
            await self._hand_over(deliveries, others, left_s)
        finally:
            ending = deliveries | others | self._lasting
            for task in ending:
                task.cancel()
            await asyncio.gather(*ending, return_exceptions=True)

    async def _ask_for_earlier(self) -> None:
        """Have the broker send what it has kept of an earlier run, before this one takes its place.

        Once for each run of the service: a broker that answers by silence or by ending the connection must
        not hold up the alarms for ever.
        """
        if self._earlier is None or self._earlier.is_asked:
            return
        self._earlier.is_asked = True
        try:
            async with asyncio.timeout(EARLIER_S):
                refused = await self._connection.watch(self._earlier.topic)
        except TimeoutError:
            refused = [self._earlier.topic]
        if refused:
            log.info(
                "MQTT broker %s:%d does not report what it keeps on %s: if an earlier run could not write "
                "its disk, the broker may go on showing its states",
                self._settings.host,
                self._settings.port,
                self._earlier.topic,
            )

    async def _until_stopped(
        self, deliveries: set[asyncio.Task[None]], others: set[asyncio.Task[Any]]
    ) -> None:
        tasks: set[asyncio.Task[Any]] = deliveries | others
        while not self._stopping.is_set():
            done, tasks = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
                if task in deliveries and not self._stopping.is_set():
                    # With the connection up and nothing going out, it would not be noticed.
                    raise RuntimeError(f"{task.get_name()} has ended by itself")

    async def _hand_over(
        self,
        left: set[asyncio.Task[None]],
        others: set[asyncio.Task[Any]],
        left_s: Callable[[], float],
    ) -> None:
        """Let the deliveries finish what is left, for as long as the connection lives and the time allows."""
        while left and (patience_s := left_s()) > 0:
            watched = {task for task in others if not task.done()}
            done, _ = await asyncio.wait(
                left | watched, timeout=patience_s, return_when=asyncio.FIRST_COMPLETED
            )
            for task in done:
                task.result()
            left = left - done

    def _acknowledged(self, message: OutboxMessage) -> None:
        self._counters.acknowledged += 1
        for link in self._links:
            link.note(message)

    def _refused(self, topic: str, reason: str) -> None:
        self._counters.refused += 1
        if topic not in self._refusals_logged:
            self._refusals_logged.add(topic)
            log.error(
                "MQTT broker %s:%d refuses an alarm message on %s: %s; it is kept on disk and tried again "
                "now and then, and all others go on",
                self._settings.host,
                self._settings.port,
                topic,
                reason,
                extra=coded(TOPIC_REFUSED),
            )

    async def _run_link(self, link: MqttLink) -> None:
        try:
            await link.run(self._connection)
        except (MqttError, OutboxError):
            raise
        except Exception as error:  # noqa: BLE001  alarms matter more than what others show
            self._faults.note(f"{link.name} receives nothing more until the next connection", error)

    async def _telemetry(self) -> None:
        delivery = TelemetryDelivery(
            self._outbox,
            self._connection,
            self._clock,
            self._stopping,
            on_sent=self._counters.count_telemetry_sent,
            on_refused=self._counters.count_telemetry_refused,
        )
        await delivery.run()

    async def _listen(self) -> None:
        """Take what the broker sends: commands, and what others send to the links."""
        if self._intake is not None and await self._connection.watch(self._topics.commands, fresh_only=True):
            log.warning(
                "MQTT broker %s:%d does not let this client listen to %s: no commands come over it",
                self._settings.host,
                self._settings.port,
                self._topics.commands,
                extra=coded(TOPIC_REFUSED),
            )
        if self._intake is not None:
            # A broker that does not grant this only leaves mistakes unanswered.
            await self._connection.watch(self._topics.below_commands, fresh_only=True)
        async for message in self._connection.incoming():
            try:
                await self._take(message)
            except MqttError:
                raise
            except Exception as error:  # noqa: BLE001  no message of anybody's ends the connection
                self._faults.note("a message from the broker could not be dealt with", error)

    async def _take(self, message: Incoming) -> None:
        if any(link.take(message) for link in self._links):
            return
        if self._earlier is not None and message.topic == self._earlier.topic:
            if message.retain and not self._earlier.is_answered:
                self._earlier.is_answered = True
                self._earlier.take(message.payload)
            return
        if self._topics.command_of(message.topic) is None or self._intake is None:
            # Brokers send what was never subscribed to: from a session of long ago, or out of malice.
            self._counters.count_ignored()
            return
        if not self._intake.lasts(message):
            await self._answer(self._intake, message)
        elif len(self._lasting) < MOST_LASTING:
            # Whoever acknowledges an alarm does not wait for somebody's snapshot.
            lasting = asyncio.create_task(self._answer(self._intake, message), name="mqtt-snapshot")
            self._lasting.add(lasting)
            lasting.add_done_callback(self._lasted)
        else:
            self._counters.count_overlooked()

    def _lasted(self, lasting: asyncio.Task[None]) -> None:
        self._lasting.discard(lasting)
        error = None if lasting.cancelled() else lasting.exception()
        if isinstance(error, MqttError) and self._intake is not None:
            # The connection is lost, or the broker silent: whoever delivers alarms states it.
            self._intake.counters.unanswered += 1
        elif isinstance(error, Exception):
            self._faults.note("an answer did not reach the broker", error)

    async def _answer(self, intake: CommandIntake, message: Incoming) -> None:
        answer = await intake.take(message)
        if answer is None:
            return
        try:
            await self._connection.deliver(
                answer.topic,
                answer.payload,
                retain=False,
                expiry_s=ANSWER_EXPIRY_S,
                correlation=answer.correlation,
            )
        except PublishRefusedError as error:
            intake.counters.unanswered += 1
            log.warning(
                "an answer on %.200r is not taken: %s", answer.topic, error, extra=coded(TOPIC_REFUSED)
            )

    async def _look_after_credentials(self) -> None:
        """Ask for a new connection when files were replaced by others that can be used.

        Also when the broker's certificate ends soon: it may long be renewed there, which only a new
        connection shows.

        Raises:
            CredentialsReplacedError: they were, or may be.
        """
        known = self._credentials.stamp
        loop = asyncio.get_running_loop()
        since_s = loop.time()
        while True:
            await asyncio.sleep(LOOK_S)
            if loop.time() - since_s > LOOK_AGAIN_S and self._ends_soon():
                raise CredentialsReplacedError
            stamp = await asyncio.to_thread(stamp_of, self._settings)
            if stamp == known:
                continue
            known = stamp
            try:
                await asyncio.to_thread(read_credentials, self._settings)
            except OSError as error:
                log.warning(
                    "%s; the connection is up, but would not come back after a loss",
                    error,
                    extra=coded(CREDENTIAL_FILE),
                )
                continue
            raise CredentialsReplacedError
