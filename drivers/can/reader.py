"""The thread that reads a CAN bus.

It takes batches from a source, has them sorted and decoded as arrays, and hands them to the event loop.
When the event loop cannot keep up the thread waits: frames then pile up in the interface, and what
overflows there shows as a gap in the devices' counters.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Any

import can

from drivers.can.batches import BusOffError, DecodedBatch
from drivers.can.errors import BUS_OFF_REASON
from drivers.hand_over import HandOver

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from drivers.can.batches import CanBatch, CanSource, FrameDemultiplexer

logger = logging.getLogger(__name__)

POLL_S = 0.05
BATCHES_UNDER_WAY = 16
SHUTDOWN_S = 0.5


class CanReader(threading.Thread):
    """Drains one open bus until told to stop or the bus fails; `ended` then holds the reason.

    Args:
        link_name: what a person calls the bus.
        source: the open bus.
        sorter: what knows the streams.
        take: called on the event loop with each batch, one in a turn of it.
        loop: the event loop.
        record: called with each batch as it came, on this thread; must not wait.
    """

    def __init__(
        self,
        link_name: str,
        source: CanSource,
        sorter: FrameDemultiplexer,
        take: Callable[[DecodedBatch], None],
        loop: asyncio.AbstractEventLoop,
        record: Callable[[CanBatch], None] | None = None,
    ) -> None:
        super().__init__(name=f"can-reader {link_name}", daemon=True)
        self.ended: asyncio.Future[str] = loop.create_future()
        self._link_name = link_name
        self._source = source
        self._sorter = sorter
        self._take = take
        self._hand = HandOver(loop)
        self._record = record
        self._stopping = threading.Event()
        self._under_way = threading.BoundedSemaphore(BATCHES_UNDER_WAY)

    def run(self) -> None:
        """Read until told to stop or the bus fails; see `threading.Thread.run`."""
        try:
            while not self._stopping.is_set():
                self._drain()
            reason = "it was closed"
        except BusOffError:
            reason = BUS_OFF_REASON
        except (can.CanError, OSError, ValueError) as error:
            reason = words(error)
        except BaseException as error:
            logger.exception("the reader of %s failed", self._link_name)
            self._post(self._take, DecodedBatch(notes={"reader_failures": 1}))
            reason = f"its reader failed: {words(error)}"
        self._post(self._end, reason)

    def close(self) -> None:
        """Stop reading and close the bus; takes at most about half a second."""
        self._stopping.set()
        self.join(SHUTDOWN_S)
        if self.is_alive():
            logger.warning("%s: its reader hangs in the adapter and is left behind", self._link_name)
        close_quietly(self._source)

    def finish(self) -> None:
        """Take in at once what has been handed over; on the event loop, once it is closed."""
        self._hand.finish()

    def _drain(self) -> None:
        """Take what is there, up to a batch, and hand it over.

        Raises:
            BusOffError: the controller went bus-off, and the source does not come back from that by itself.
            Exception: whatever the adapter raises when it is lost.
        """
        try:
            batch = self._source.read(POLL_S)
        except BusOffError:
            self._hand_over(DecodedBatch(notes={"bus_off": 1}))
            raise
        if self._record is not None:
            self._record(batch)
        found = self._sorter.sort(batch, self._source.error_classes)
        self._hand_over(found)
        if found.errors is not None and found.errors.bus_off and not self._source.recovers:
            raise BusOffError
        if len(batch.ids) and batch.drained_ns is not None:
            # Let a few frames gather: one turn of the event loop then serves them all.
            self._stopping.wait(self._source.gather_s)

    def _hand_over(self, found: DecodedBatch) -> None:
        while not self._under_way.acquire(timeout=POLL_S):
            if self._stopping.is_set():
                return
        self._post(self._taken, found)

    def _taken(self, found: DecodedBatch) -> None:
        self._under_way.release()
        self._take(found)

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)

    def _post(self, call: Callable[[Any], None], argument: object) -> None:
        try:
            self._hand.post(call, argument)
        except RuntimeError:  # the event loop is closed: there is nobody left to tell
            self._stopping.set()


def close_quietly(source: CanSource) -> None:
    """Close a bus that may be gone already."""
    try:
        source.close()
    except Exception as error:  # noqa: BLE001 - a lost adapter may fail to close in its own way
        logger.info("closing a CAN bus that is gone: %s", words(error))


def words(error: BaseException) -> str:
    """An error as a person should read it."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"{error}" or type(error).__name__
