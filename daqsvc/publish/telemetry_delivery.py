"""Telemetry from the outbox to the broker over one connection: beside the alarms, never before them."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.publish.errors import PublishRefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.messages import TelemetryMessage
    from daqsvc.outbox.store import Outbox
    from daqsvc.publish.connection import Connection

log = logging.getLogger(__name__)

IN_FLIGHT = 5
"""Telemetry messages that may wait for their PUBACK at a time; the rest of the window is for alarms."""

READ_AHEAD = 50
"""Messages that are read from the outbox at a time."""


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
        self._said_refused = False

    async def run(self) -> None:
        """Deliver until `stopping` is set and nothing is left.

        Raises:
            MqttError: the connection is lost; what was under way will be sent again.
        """
        read_to = 0
        while messages := await self._next(read_to):
            read_to = messages[-1].number
            left = iter(messages)
            workers = [asyncio.create_task(self._work(left)) for _ in range(IN_FLIGHT)]
            try:
                await asyncio.gather(*workers)
            finally:
                for worker in workers:
                    worker.cancel()
                await asyncio.gather(*workers, return_exceptions=True)

    async def _next(self, read_to: int) -> list[TelemetryMessage]:
        """The next messages; none if there are none left and the publisher stops."""
        arriving = asyncio.create_task(self._outbox.next_telemetry(read_to, READ_AHEAD))
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            await asyncio.wait({arriving, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if arriving.done():
                return arriving.result()
        finally:
            for task in (arriving, stopping):
                task.cancel()
            await asyncio.gather(arriving, stopping, return_exceptions=True)
        return await self._outbox.pending_telemetry(read_to, READ_AHEAD)

    async def _work(self, messages: Iterator[TelemetryMessage]) -> None:
        for message in messages:
            left_s = (message.expires_ns - self._clock.monotonic_ns()) / NS_PER_S
            try:
                await self._connection.deliver(message.topic, message.payload, retain=False, expiry_s=left_s)
            except PublishRefusedError as error:
                self._on_refused()
                if not self._said_refused:
                    self._said_refused = True
                    log.warning("telemetry on %s is dropped and counted: %s", message.topic, error)
            else:
                self._on_sent()
            self._outbox.mark_telemetry_sent(message.number)
