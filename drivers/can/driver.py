"""The CAN and CAN FD driver: SocketCAN by a reader of ours, anything else through python-can.

python-can's own asyncio reader hangs when the interface goes down and takes one frame per turn of the event
loop (python-can#1865, #1912), so the bus is read by a thread of ours. It takes batches from a source, has
them sorted and decoded as arrays, and passes them to the event loop. There the driver opens the bus, opens
it again, places the decoded frames in time, and counts. When the event loop cannot keep up the thread
waits: frames then pile up in the interface, and what overflows there shows as a gap in the devices'
counters.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter
from typing import TYPE_CHECKING, Any

import can

from daqsvc.acquisition.link import Link
from daqsvc.errors.buses import BUFFER_FULL, BUS_ERRORS, DRIVER_FAILED, NO_FRAME
from daqsvc.errors.code import coded
from daqsvc.errors.service import STOPPED_HARD
from daqsvc.notice import notice
from drivers.can.adapter import open_adapter
from drivers.can.batches import BusOffError, FrameDemultiplexer
from drivers.can.errors import BUS_OFF_REASON, EXPLAINED, CanCounters, ErrorCounts
from drivers.can.record import recorder_of
from drivers.can.socketcan import open_socketcan
from drivers.can.stream_faults import StreamFaults
from drivers.frames import DecodedBatch
from drivers.reconnect import (
    Attempt,
    CannotOpenError,
    HandOver,
    ended,
    in_thread,
    run_with_reconnect,
    sparing_others,
    words,
)
from drivers.stream_driver import assembler_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from daqsvc.errors.code import Code
    from drivers.base import BusPort
    from drivers.can.batches import CanBatch, CanSource
    from drivers.can.record import CanRecorder
    from drivers.can.record_files import Logs
    from drivers.can.settings import CanBus


logger = logging.getLogger(__name__)

POLL_S = 0.05
BATCHES_UNDER_WAY = 16
SHUTDOWN_S = 0.5


class CanReader(threading.Thread):
    """Drains one open bus until stopped or the bus fails; `ended` then holds the reason.

    Args:
        link_name: what a person calls the bus.
        source: the open bus.
        sorter: what knows the streams.
        accept: called on the event loop with each batch, one in a turn of it.
        loop: the event loop.
        record: called with each batch as it came, on this thread; must not wait.
        turn: called on this thread each time it comes round.
    """

    def __init__(
        self,
        link_name: str,
        source: CanSource,
        sorter: FrameDemultiplexer,
        accept: Callable[[DecodedBatch], None],
        loop: asyncio.AbstractEventLoop,
        record: Callable[[CanBatch], None] | None = None,
        turn: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(name=f"can-reader {link_name}", daemon=True)
        self.ended: asyncio.Future[str] = loop.create_future()
        self._link_name = link_name
        self._source = source
        self._sorter = sorter
        self._accept = accept
        self._hand = HandOver(loop)
        self._record = record
        self._turn = turn
        self._stopping = threading.Event()
        self._under_way = threading.BoundedSemaphore(BATCHES_UNDER_WAY)

    def run(self) -> None:
        """Read until stopped or the bus fails; see `threading.Thread.run`."""
        try:
            while not self._stopping.is_set():
                self._turn()
                self._drain()
            reason = "it was closed"
        except BusOffError:
            reason = BUS_OFF_REASON
        except (can.CanError, OSError, ValueError) as error:
            reason = words(error)
        except BaseException as error:
            logger.exception("the reader of %s failed", self._link_name, extra=coded(DRIVER_FAILED))
            self._post(self._accept, DecodedBatch(notes=Counter(reader_failures=1)))
            reason = f"its reader failed: {words(error)}"
        self._post(self._end, reason)

    def close(self) -> None:
        """Stop reading and close the bus; takes at most about half a second."""
        self._stopping.set()
        self.join(SHUTDOWN_S)
        if self.is_alive():
            logger.warning(
                "%s: its reader hangs in the adapter and is left behind",
                self._link_name,
                extra=coded(STOPPED_HARD),
            )
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
            raw = self._source.read(POLL_S)
        except BusOffError:
            self._hand_over(DecodedBatch(notes=Counter(bus_off=1)))
            raise
        if self._record is not None:
            self._record(raw)
        batch = self._sorter.sort(raw, self._source.error_classes)
        self._hand_over(batch)
        if batch.errors is not None and batch.errors.bus_off and not self._source.recovers:
            raise BusOffError
        if len(raw.ids) and raw.drained_ns is not None:
            self._source.gather(self._stopping)

    def _hand_over(self, batch: DecodedBatch) -> None:
        while not self._under_way.acquire(timeout=POLL_S):
            if self._stopping.is_set():
                return
        self._post(self._accepted, batch)

    def _accepted(self, batch: DecodedBatch) -> None:
        self._under_way.release()
        self._accept(batch)

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)

    def _post(self, call: Callable[[Any], None], argument: object) -> None:
        try:
            self._hand.post(call, argument)
        except RuntimeError:  # the event loop is closed: nothing takes the call any more
            self._stopping.set()


def close_quietly(source: CanSource) -> None:
    """Close a bus that may be gone already."""
    try:
        source.close()
    except Exception as error:  # noqa: BLE001 - a lost adapter may fail to close in its own way
        logger.info("closing a CAN bus that is gone: %s", words(error))


REMEMBERED_IDS = 64


class CanDriver:
    """Reads one CAN bus.

    With interface ``socketcan`` python-can is left out; see `drivers.can.socketcan`.

    Args:
        bus: its table in the machine file.
        port: streams, clock and where to deliver.
        open_source: opens the bus; called on a thread.
        logs: where the bus is recorded, if not where its table states.
    """

    def __init__(
        self,
        bus: CanBus,
        port: BusPort,
        open_source: Callable[[BusPort, FrameDemultiplexer], CanSource] | None = None,
        logs: Logs | None = None,
    ) -> None:
        self.name = port.name
        self.link = Link(f"CAN bus {port.name!r} ({bus.interface} {bus.channel})")
        self.counters = CanCounters()
        self._bus = bus
        self._port = port
        self._logs = logs
        self._sorter = FrameDemultiplexer(port.streams)
        self._assemblers = {s.name: assembler_of(s, port) for s in port.streams}
        self._open_source = open_source or self._open_bus
        self._faults = StreamFaults(port.name, port.streams, port.clock)
        self.link.faults = self._faults
        # SocketCAN may leave out frames of other ids, so that they are not known to come.
        if bus.interface != "socketcan" or bus.filter is False:
            self.link.quiet = self._faults.quiet
        self._logged: set[str] = set()
        self._is_fresh = False
        """Whether nothing has come since the bus was opened: its controller's state is then not known."""
        self._recorder: CanRecorder | None = None

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return {name: (a.counters, a.time_base) for name, a in self._assemblers.items()}

    async def run(self) -> None:
        """See `drivers.base.Driver.run`."""
        self._recorder = recorder_of(self._bus, self._port, self.link.name, self.counters, self._logs)
        if self._recorder is not None:
            self._recorder.start()
        try:
            await run_with_reconnect(self.link, self._port, self._attempt)
        finally:
            self.link.stop()
            for assembler in self._assemblers.values():
                assembler.flush()
            if self._recorder is not None:
                await in_thread(self._recorder.close)

    async def _attempt(self) -> Attempt:
        source = await self._open()
        self.link.up()
        self._is_fresh = True
        before = self._frames
        reason = await self._receive(source)
        return Attempt(present=True, useful=self._frames > before, reason=reason)

    @property
    def _frames(self) -> int:
        return sum(a.counters.frames_received for a in self._assemblers.values())

    async def _open(self) -> CanSource:
        try:
            return await in_thread(
                self._open_source, self._port, self._sorter, undo=close_quietly, patience_s=SHUTDOWN_S
            )
        except Exception as error:
            self.counters.open_failures += 1
            raise CannotOpenError(f"it cannot be opened: {words(error)}") from error

    def _open_bus(self, port: BusPort, sorter: FrameDemultiplexer) -> CanSource:
        if self._bus.interface != "socketcan":
            return open_adapter(self._bus, port.clock)
        recorded = self._recorder is not None
        return open_socketcan(self._bus, sorter.matches, port.clock, recorded=recorded)

    async def _receive(self, source: CanSource) -> str:
        """Read until the link fails; returns why."""
        reader = CanReader(
            self.link.name,
            source,
            self._sorter,
            self.accept,
            asyncio.get_running_loop(),
            None if self._recorder is None else self._recorder.record,
            self.link.turn,
        )
        reader.start()
        try:
            return await ended(reader.ended, reader)
        finally:
            # Cancelled while the bus is being closed: that takes its half second all the same.
            try:
                await in_thread(reader.close, patience_s=2 * SHUTDOWN_S)
            finally:
                reader.finish()

    def accept(self, batch: DecodedBatch) -> None:
        """Take in what the reader thread has sorted and decoded; runs on the event loop."""
        for name, count in batch.notes.items():
            setattr(self.counters, name, getattr(self.counters, name) + count)
        if "frames_overrun" in batch.notes:
            self._say_once(
                "overrun",
                BUFFER_FULL,
                "%s: the kernel dropped frames because its receive buffer was full; they are counted from "
                "now on. Raise receive_buffer_bytes of the bus, or relieve the machine",
                self.link.name,
            )
        if batch.errors is not None:
            self._count_errors(batch.errors)
        elif batch.data_frames and (
            self.counters.controller_state == "bus-off"
            or (self._is_fresh and self.counters.controller_state != "error-active")
        ):
            # Whoever receives is on the bus again, even if the frame that reported it was missed.
            self._count_errors(ErrorCounts(state="error-active"))
        self._is_fresh &= not (batch.errors or batch.data_frames)
        for name, count in batch.unknown.items():
            self._count_unknown(name, count, batch.pages_of.get(name, ()))
        for stream, (count, length) in batch.wrong_length.items():
            self._count_wrong_length(stream, count, length)
        for stream, frames in batch.frames.items():
            self._faults.heard(stream)
            with sparing_others(self.link, stream, self.counters):
                self._assemblers[stream].accept(*frames)
        if batch.drained_ns is not None:
            for name, assembler in self._assemblers.items():
                with sparing_others(self.link, name, self.counters):
                    assembler.tick(batch.drained_ns)

    def _count_errors(self, errors: ErrorCounts) -> None:
        """Count what error frames reported; the link goes down with the controller and comes back with it."""
        before = self.counters.controller_state
        self.counters.add(errors)
        state = self.counters.controller_state
        if errors.counts.get("rx_overflows"):
            self._say_once(
                "rx overflow",
                BUFFER_FULL,
                "%s: the controller's receive buffer overflowed: frames are lost, and counted from now on",
                self.link.name,
            )
        if errors.bus_off:
            self.link.down(self._bus_off_reason)
        if state != "bus-off" and (errors.bus_off or before == "bus-off"):
            self.link.up()
        elif state not in {before, "bus-off"}:
            kind = None if state == "error-active" else BUS_ERRORS
            self._say_once(state, kind, "%s is %s: %s", self.link.name, state, EXPLAINED[state])

    @property
    def _bus_off_reason(self) -> str:
        if self._bus.interface != "socketcan":
            return BUS_OFF_REASON
        return (
            f"{BUS_OFF_REASON}; unless {self._bus.channel} has restart-ms set, it comes back by "
            f"`ip link set {self._bus.channel} type can restart`"
        )

    def _count_unknown(self, name: str, count: int, pages_of: Sequence[str]) -> None:
        self._faults.heard_other(name, pages_of)
        ids = self.counters.unknown_ids
        if name in ids or len(ids) < REMEMBERED_IDS:
            ids[name] = ids.get(name, 0) + count
        if pages_of:
            self._say_once(
                "unread page",
                NO_FRAME,
                "%s carries pages of a multiplexed message that no stream reads, such as %s; they are "
                "counted by id and page",
                self.link.name,
                name,
            )
            return
        self._say_once(
            "unknown id",
            NO_FRAME,
            "%s carries frames that no stream of the machine file has, id %s the first of them; "
            "they are counted by id",
            self.link.name,
            name,
        )

    def _count_wrong_length(self, stream: str, count: int, length: int) -> None:
        assembler = self._assemblers[stream]
        assembler.counters.frames_wrong_length += count
        self._faults.has_wrong_length(stream, length)
        spec = next(s for s in self._port.streams if s.name == stream)
        self._say_once(
            f"length of {stream}",
            NO_FRAME,
            "%s: a frame %#x of stream %r has %d bytes, its layout %d; such frames are counted and left out",
            self.link.name,
            spec.layout.frame_id,
            stream,
            length,
            spec.layout.length,
        )

    def _say_once(self, key: str, code: Code | None, message: str, *arguments: object) -> None:
        """Log a fault once, by its code; None is for good news."""
        if key in self._logged:
            return
        self._logged.add(key)
        if code is None:
            notice(logger, message, *arguments)
        else:
            logger.warning(message, *arguments, extra=coded(code))
