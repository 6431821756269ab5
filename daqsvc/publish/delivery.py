"""From the outbox to the broker over one connection: in order, several under way at a time."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.connection import Connection

IN_FLIGHT = 20
"""QoS 1 messages that may wait for their PUBACK at a time."""

READ_AHEAD = 200
"""Messages that are read from the outbox at a time."""


class Delivery:
    """Delivers the outbox over one connection, from the oldest message that is not acknowledged.

    A message is marked as sent only when all before it are, so whatever goes wrong, consumers see new
    messages in the order of the outbox. First come the retained states that the broker has acknowledged
    before: it may have forgotten them, and a repeat has the same id.

    Args:
        outbox: where the messages are.
        connection: where they go.
        base: what the topics of this box begin with; retained states of others are left alone.
        stopping: ends the delivery as soon as nothing is left.
        on_sent: called for each message handed to the broker.
        on_acknowledged: called with each message for which a PUBACK came.
    """

    def __init__(
        self,
        outbox: Outbox,
        connection: Connection,
        base: str,
        stopping: asyncio.Event,
        on_sent: Callable[[], None],
        on_acknowledged: Callable[[OutboxMessage], None],
    ) -> None:
        self._outbox = outbox
        self._connection = connection
        self._base = base
        self._stopping = stopping
        self._on_sent = on_sent
        self._on_acknowledged = on_acknowledged
        self._ready: deque[OutboxMessage] = deque()
        self._under_way: deque[tuple[OutboxMessage, asyncio.Task[None]]] = deque()
        self._arriving: asyncio.Task[list[OutboxMessage]] | None = None
        self._read_to = 0

    async def run(self) -> None:
        """Deliver until `stopping` is set and nothing is left.

        Raises:
            aiomqtt.MqttError: the connection is lost or the broker refuses; what was under way will be
                sent again.
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

    def _is_idle(self) -> bool:
        return not (self._ready or self._under_way)

    def _send(self) -> None:
        while self._ready and len(self._under_way) < IN_FLIGHT:
            message = self._ready.popleft()
            delivery = self._connection.deliver(message.topic, message.payload, retain=message.retain)
            self._under_way.append((message, asyncio.create_task(delivery)))
            self._on_sent()

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
            self._ready.extend(self._arriving.result())
            self._read_to = self._ready[-1].sequence
            self._arriving = None
        while self._under_way and self._under_way[0][1].done():
            message, task = self._under_way[0]
            task.result()
            self._under_way.popleft()
            self._outbox.mark_sent(message.sequence)
            self._on_acknowledged(message)
