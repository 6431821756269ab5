"""From the outbox to the broker over one connection: alarms in their order, and telemetry beside them."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from typing import TYPE_CHECKING, Any, Literal

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import MESSAGE_DROPPED, TOPIC_REFUSED
from daqsvc.outbox.messages import OutboxError
from daqsvc.publish.mqtt.errors import PublishRefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.messages import OutboxMessage, TelemetryMessage
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.mqtt.connection import Connection

log = logging.getLogger(__name__)

IN_FLIGHT = 20
"""QoS 1 messages that may wait for their PUBACK at a time."""

READ_AHEAD = 200
"""Messages that are read from the outbox at a time."""

TRY_AGAIN_S = 300.0
"""How often what the broker has refused is tried again; a new connection tries at once."""

TELEMETRY_IN_FLIGHT = 5
"""Telemetry messages that may wait for their PUBACK at a time; the rest of the window is for alarms."""

TELEMETRY_READ_AHEAD = 50
"""Messages that are read from the outbox at a time."""


class Delivery:
    """Delivers the outbox over one connection, from the oldest message that is not acknowledged.

    A message is marked as sent only when all before it are, so whatever goes wrong, consumers see new
    messages in the order of the outbox. First come the retained states that the broker has acknowledged
    before: it may have forgotten them, and a repeat has the same id.

    What the broker refuses goes to the dead letters, and so does what follows on the same topic: nothing else
    waits for it.

    Args:
        outbox: where the messages are.
        connection: where they go.
        base: what the topics of this box begin with; retained states of others are left alone.
        stopping: ends the delivery as soon as nothing is left.
        on_sent: called for each message handed to the broker.
        on_acknowledged: called with each message for which a PUBACK came.
        on_refused: called with the topic and the reason of each message that the broker will not take.
    """

    def __init__(
        self,
        outbox: Outbox,
        connection: Connection,
        base: str,
        stopping: asyncio.Event,
        on_sent: Callable[[], None],
        on_acknowledged: Callable[[OutboxMessage], None],
        on_refused: Callable[[str, str], None],
    ) -> None:
        self._outbox = outbox
        self._letters = outbox.dead_letters
        self._connection = connection
        self._base = base
        self._stopping = stopping
        self._on_sent = on_sent
        self._on_acknowledged = on_acknowledged
        self._on_refused = on_refused
        self._ready: deque[OutboxMessage] = deque()
        self._under_way: deque[tuple[OutboxMessage, asyncio.Task[Literal["taken", "kept", "left"]]]] = deque()
        self._arriving: asyncio.Task[list[OutboxMessage]] | None = None
        self._read_to = 0
        self._left_from: int | None = None
        self._left: set[str] = set()

    async def run(self) -> None:
        """Deliver until `stopping` is set and nothing is left.

        Raises:
            MqttError: the connection is lost; what was under way will be sent again.
        """
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            retained = await self._outbox.retained()
            self._ready.extend(m for m in retained if m.topic.startswith(f"{self._base}/"))
            while True:
                self._send()
                await self._wait(stopping)
                self._settle()
                if stopping.done() and self._is_idle() and not await self._outbox.pending(self._read_to, 1):
                    return
        finally:
            tasks: list[asyncio.Task[Any]] = [stopping, *(task for _, task in self._under_way)]
            if self._arriving is not None:
                tasks.append(self._arriving)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def try_again(self) -> None:
        """Now and then, try what the broker has refused; each topic from its oldest on. Until cancelled.

        Raises:
            MqttError: the connection is lost.
        """
        while True:
            for topic in sorted(self._letters.reasons):
                try:
                    await self._try_topic(topic)
                except OutboxError as error:
                    log.error("%s; tried again in %g s", error, TRY_AGAIN_S, extra=coded(TOPIC_REFUSED))  # noqa: TRY400 - one line
            self._read_again()
            await asyncio.sleep(TRY_AGAIN_S)

    def _read_again(self) -> None:
        """Go back to what is still in the journal because the disk would not take it as refused."""
        if self._left_from is None or not self._is_idle():
            return
        self._read_to = min(self._read_to, self._left_from - 1)
        self._left_from = None
        self._left.clear()
        if self._arriving is not None:
            self._arriving.cancel()

    async def _try_topic(self, topic: str) -> None:
        while (message := await self._letters.oldest(topic)) is not None:
            try:
                await self._connection.deliver(topic, message.payload, retain=message.retain)
            except PublishRefusedError as error:
                await self._letters.put(message, str(error))
                return
            await self._letters.remove(message)
            self._on_acknowledged(message)

    def _is_idle(self) -> bool:
        return not (self._ready or self._under_way)

    def _send(self) -> None:
        while self._ready and len(self._under_way) < IN_FLIGHT:
            message = self._ready.popleft()
            self._under_way.append((message, asyncio.create_task(self._deliver(message))))

    async def _deliver(self, message: OutboxMessage) -> Literal["taken", "kept", "left"]:
        """Have the broker take a message, or keep it among those that it will not take."""
        try:
            if message.topic in self._left:
                return self._leave(message)
            if await self._letters.hold(message):
                return "kept"
            self._on_sent()
            try:
                await self._connection.deliver(message.topic, message.payload, retain=message.retain)
            except PublishRefusedError as error:
                await self._letters.put(message, str(error))
                self._on_refused(message.topic, str(error))
                return "kept"
            await self._letters.overtake(message)
        except OutboxError as error:
            log.error(  # noqa: TRY400 - the message is enough
                "%s; the message on %s waits in the journal", error, message.topic, extra=coded(TOPIC_REFUSED)
            )
            return self._leave(message)
        return "taken"

    def _leave(self, message: OutboxMessage) -> Literal["left"]:
        """Leave a message, and what follows on its topic, where it is, for later."""
        self._left.add(message.topic)
        self._left_from = min(self._left_from or message.sequence, message.sequence)
        return "left"

    async def _wait(self, stopping: asyncio.Task[Any]) -> None:
        """Until the oldest is acknowledged, more arrives, or there is nothing left to wait for."""
        if not self._ready and self._arriving is None:
            self._arriving = asyncio.create_task(self._outbox.next_pending(self._read_to, READ_AHEAD))
        ends: set[asyncio.Task[Any]] = {task for _, task in list(self._under_way)[:1]}
        if self._arriving is not None:
            ends.add(self._arriving)
        if self._is_idle():
            ends.add(stopping)
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)

    def _settle(self) -> None:
        if self._arriving is not None and self._arriving.done():
            if not self._arriving.cancelled():
                self._ready.extend(self._arriving.result())
                self._read_to = self._ready[-1].sequence
            self._arriving = None
        settled: list[int] = []
        try:
            while self._under_way and self._under_way[0][1].done():
                message, task = self._under_way[0]
                outcome = task.result()
                self._under_way.popleft()
                if outcome != "left":
                    settled.append(message.sequence)
                if outcome == "taken":
                    self._on_acknowledged(message)
        finally:
            if settled:
                self._outbox.mark_sent(*settled)


class TelemetryDelivery:
    """Delivers telemetry over one connection, each message with what is left of its time (MQTT 5).

    What the broker refuses is dropped: unlike an alarm it would be out of date when it is taken at last.

    Args:
        outbox: where the messages are.
        connection: where they go.
        clock: the outbox's clock.
        stopping: ends the delivery as soon as nothing is left.
        on_sent: called for each PUBACK.
        on_refused: called for each message that the broker will not take.
    """

    def __init__(
        self,
        outbox: Outbox,
        connection: Connection,
        clock: Clock,
        stopping: asyncio.Event,
        on_sent: Callable[[], None],
        on_refused: Callable[[], None],
    ) -> None:
        self._outbox = outbox
        self._connection = connection
        self._clock = clock
        self._stopping = stopping
        self._on_sent = on_sent
        self._on_refused = on_refused
        self._has_logged_refusal = False

    async def run(self) -> None:
        """Deliver until `stopping` is set and nothing is left.

        Raises:
            MqttError: the connection is lost; what was under way will be sent again.
        """
        read_to = 0
        while messages := await self._next(read_to):
            read_to = messages[-1].number
            left = iter(messages)
            workers = [asyncio.create_task(self._work(left)) for _ in range(TELEMETRY_IN_FLIGHT)]
            try:
                await asyncio.gather(*workers)
            finally:
                for worker in workers:
                    worker.cancel()
                await asyncio.gather(*workers, return_exceptions=True)

    async def _next(self, read_to: int) -> list[TelemetryMessage]:
        """The next messages; none if there are none left and the publisher stops."""
        arriving = asyncio.create_task(self._outbox.next_telemetry(read_to, TELEMETRY_READ_AHEAD))
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            await asyncio.wait({arriving, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if arriving.done():
                return arriving.result()
        finally:
            for task in (arriving, stopping):
                task.cancel()
            await asyncio.gather(arriving, stopping, return_exceptions=True)
        return await self._outbox.pending_telemetry(read_to, TELEMETRY_READ_AHEAD)

    async def _work(self, messages: Iterator[TelemetryMessage]) -> None:
        for message in messages:
            left_s = (message.expires_ns - self._clock.monotonic_ns()) / NS_PER_S
            try:
                await self._connection.deliver(message.topic, message.payload, retain=False, expiry_s=left_s)
            except PublishRefusedError as error:
                self._on_refused()
                if not self._has_logged_refusal:
                    self._has_logged_refusal = True
                    log.warning(
                        "telemetry on %s is dropped and counted: %s",
                        message.topic,
                        error,
                        extra=coded(MESSAGE_DROPPED),
                    )
            else:
                self._on_sent()
            self._outbox.mark_telemetry_sent(message.number)
