"""The CAN and CAN FD driver, on any interface that python-can knows.

python-can's own asyncio reader hangs when the interface goes down and takes one frame per turn of the
event loop (python-can#1865, #1912), so the bus is read by a thread of ours. It drains the bus in
batches, decodes each batch as arrays, and hands it to the event loop. When the event loop cannot keep
up the thread waits: frames then pile up in the interface, and what overflows there shows as a gap in
the devices' counters.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import can
import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.supervisor import Backoff, Link
from drivers.base import BusCounters, BusPort, DeviceAbsentError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import StreamSpec
    from drivers.frames import Decoded, FrameLayout

logger = logging.getLogger(__name__)

POLL_S = 0.05
BATCH_S = 0.002
BATCH_FRAMES = 2048
BATCHES_UNDER_WAY = 32
REMEMBERED_IDS = 64
SHUTDOWN_S = 0.5
ERROR_CLASS_BUS_OFF = 0x40
"""Bit of an error frame's id (linux/can/error.h, CAN_ERR_BUSOFF)."""


class _BusOffError(Exception):
    """The controller has taken itself off the bus; only opening it again helps."""


@dataclass(frozen=True, slots=True)
class _Batch:
    """Decoded frames of one stream, in their order of arrival."""

    stream: str
    decoded: Decoded
    arrival_ns: NDArray[np.int64]


class CanDriver:
    """Reads one CAN bus.

    Options of the bus: ``interface`` and ``channel`` as python-can names them, ``fd``, and optionally
    ``bitrate``, ``data_bitrate`` and ``options`` (a table handed to python-can as it is).

    Args:
        port: settings, streams, clock and where to deliver.
    """

    def __init__(self, port: BusPort) -> None:
        self.name = port.name
        self.link = Link(f"CAN bus {port.name!r} ({port.options['interface']} {port.options.get('channel')})")
        self.counters = BusCounters()
        self._port = port
        self._specs: dict[tuple[int, bool], StreamSpec[FrameLayout]] = {
            (s.layout.frame_id, s.layout.extended): s for s in port.streams
        }
        self._assemblers = {s.name: _assembler(s, port) for s in port.streams}
        self._backoff = Backoff()
        self._said: set[str] = set()

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return {name: (a.counters, a.time_base) for name, a in self._assemblers.items()}

    async def run(self) -> None:
        """See `drivers.base.Driver.run`."""
        first_try = True
        try:
            while True:
                bus = await self._open()
                if bus is not None:
                    self.link.up()
                    before = self._frames
                    reason = await self._receive(bus)
                    self.link.down(reason)
                    if self._frames > before:  # a bus that opens and fails at once is not back
                        self._backoff.reset()
                elif first_try and self._port.start == "error":
                    raise DeviceAbsentError(f"{self.link.name} cannot be opened: {self.link.reason}")
                elif first_try and self._port.start == "ignore":
                    return
                first_try = False
                await self._port.clock.sleep_ns(self._backoff.next_ns())
        finally:
            for assembler in self._assemblers.values():
                assembler.flush()

    @property
    def _frames(self) -> int:
        return sum(a.counters.frames_received for a in self._assemblers.values())

    async def _open(self) -> can.BusABC | None:
        opening = asyncio.ensure_future(asyncio.to_thread(_open_bus, self._port.options))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            # A bus that opens all the same must be closed again, or its next owner finds it taken.
            await asyncio.wait({opening}, timeout=SHUTDOWN_S)
            if opening.done() and opening.exception() is None:
                await asyncio.to_thread(_shut_down, opening.result())
            raise
        except Exception as error:  # noqa: BLE001 - adapters raise what they like; the driver must live on
            self.counters.open_failures += 1
            self.link.down(f"it cannot be opened: {_words(error)}")
            return None

    async def _receive(self, bus: can.BusABC) -> str:
        """Read until the link fails; returns why."""
        reader = _Reader(self, bus, asyncio.get_running_loop())
        reader.start()
        try:
            return await reader.ended
        finally:
            closing = asyncio.ensure_future(asyncio.to_thread(reader.close))
            try:
                await asyncio.shield(closing)
            except asyncio.CancelledError:
                # Cancelled while the bus is being closed: that takes its half second all the same.
                await asyncio.wait({closing}, timeout=2 * SHUTDOWN_S)
                raise

    def take(self, found: _Sorted) -> None:
        """Take in what the reader thread has sorted and decoded; runs on the event loop."""
        for name, count in found.notes.items():
            setattr(self.counters, name, getattr(self.counters, name) + count)
        for name, count in found.unknown.items():
            self._take_unknown(name, count)
        for stream, (count, length) in found.wrong_length.items():
            self._take_wrong_length(stream, count, length)
        for batch in found.batches:
            decoded = batch.decoded
            assembler = self._assemblers[batch.stream]
            assembler.accept(decoded.counter, decoded.samples, decoded.intact, batch.arrival_ns)
        if found.drained_ns is not None:
            for assembler in self._assemblers.values():
                assembler.tick(found.drained_ns)

    def _take_unknown(self, name: str, count: int) -> None:
        ids = self.counters.unknown_ids
        if name in ids or len(ids) < REMEMBERED_IDS:
            ids[name] = ids.get(name, 0) + count
        self._say_once(
            "unknown id",
            "%s carries frames that no stream of the machine file has, id %s the first of them; "
            "they are counted by id",
            self.link.name,
            name,
        )

    def _take_wrong_length(self, stream: str, count: int, length: int) -> None:
        assembler = self._assemblers[stream]
        assembler.counters.frames_wrong_length += count
        spec = next(s for s in self._port.streams if s.name == stream)
        self._say_once(
            f"length of {stream}",
            "%s: a frame %#x of stream %r has %d bytes, its layout %d; such frames are counted and left out",
            self.link.name,
            spec.layout.frame_id,
            stream,
            length,
            spec.layout.length,
        )

    def _say_once(self, key: str, message: str, *arguments: object) -> None:
        if key not in self._said:
            self._said.add(key)
            logger.warning(message, *arguments)

    def sort(self, messages: list[can.Message], arrival_ns: list[int]) -> _Sorted:
        """Sort and decode a batch of messages; runs on the reader thread."""
        found = _Sorted()
        chosen: dict[str, list[int]] = {}
        for k, message in enumerate(messages):
            if message.is_error_frame:
                found.note("frames_error")
                if message.arbitration_id & ERROR_CLASS_BUS_OFF:
                    found.bus_off = True
                continue
            if message.is_remote_frame:
                found.note("frames_remote")
                continue
            spec = self._specs.get((message.arbitration_id, message.is_extended_id))
            if spec is None:
                found.note("frames_unknown")
                name = f"{message.arbitration_id:#x} ({29 if message.is_extended_id else 11} bit)"
                found.unknown[name] = found.unknown.get(name, 0) + 1
            elif len(message.data) != spec.layout.length:
                count, _ = found.wrong_length.get(spec.name, (0, 0))
                found.wrong_length[spec.name] = (count + 1, len(message.data))
            else:
                chosen.setdefault(spec.name, []).append(k)
        for spec in self._specs.values():
            rows = chosen.get(spec.name)
            if rows:
                raw = b"".join(messages[k].data for k in rows)
                payloads = np.frombuffer(raw, np.uint8).reshape(len(rows), spec.layout.length)
                arrival = np.array([arrival_ns[k] for k in rows], np.int64)
                found.batches.append(_Batch(spec.name, spec.layout.decode(payloads), arrival))
        return found


@dataclass(slots=True)
class _Sorted:
    """What a batch of messages held.

    Attributes:
        batches: decoded frames by stream.
        notes: what to add to which of the bus's counters.
        unknown: frames by unknown id, in words.
        wrong_length: frames by stream, and the length of the last of them.
        bus_off: whether an error frame says that the controller went bus-off.
        drained_ns: when the bus was last known to hold no frame that was sent before; None if the
            batch ended for another reason.
    """

    batches: list[_Batch] = field(default_factory=list)
    notes: dict[str, int] = field(default_factory=dict)
    unknown: dict[str, int] = field(default_factory=dict)
    wrong_length: dict[str, tuple[int, int]] = field(default_factory=dict)
    bus_off: bool = False
    drained_ns: int | None = None

    def note(self, counter: str) -> None:
        self.notes[counter] = self.notes.get(counter, 0) + 1


class _Reader(threading.Thread):
    """Drains one open bus until told to stop or the bus fails; `ended` then holds the reason."""

    def __init__(self, driver: CanDriver, bus: can.BusABC, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__(name=f"can-reader-{driver.name}", daemon=True)
        self.ended: asyncio.Future[str] = loop.create_future()
        self._driver = driver
        self._clock = driver._port.clock  # noqa: SLF001 - the reader is a part of the driver
        self._bus = bus
        self._loop = loop
        self._stopping = threading.Event()
        self._under_way = threading.BoundedSemaphore(BATCHES_UNDER_WAY)

    def run(self) -> None:
        try:
            while not self._stopping.is_set():
                self._drain()
            reason = "it was closed"
        except _BusOffError:
            reason = "the controller went bus-off (wiring, termination or bit rate)"
        except (can.CanError, OSError, ValueError) as error:
            reason = _words(error)
        except Exception as error:
            logger.exception("the reader of %s failed", self._driver.link.name)
            self._post(self._driver.take, _Sorted(notes={"reader_failures": 1}))
            reason = f"its reader failed: {_words(error)}"
        self._post(self._end, reason)

    def close(self) -> None:
        """Stop reading and close the bus; takes at most about half a second."""
        self._stopping.set()
        self.join(SHUTDOWN_S)
        if self.is_alive():
            logger.warning("%s: its reader hangs in the adapter and is left behind", self._driver.link.name)
        _shut_down(self._bus)

    def _drain(self) -> None:
        """Take what is there, up to a batch, and hand it over; then raise what the bus has raised.

        Raises:
            _BusOffError: the controller went bus-off.
            Exception: whatever the adapter raises when it is lost.
        """
        messages: list[can.Message] = []
        arrival_ns: list[int] = []
        failure: Exception | None = None
        drained_ns: int | None = None
        asked_ns = self._clock.monotonic_ns()
        while len(messages) < BATCH_FRAMES:
            try:
                message = self._bus.recv(0 if messages else POLL_S)
            except Exception as error:  # noqa: BLE001 - raised again below, after what came before it
                failure = error
                break
            if message is None:
                # Asked before the bus was: whatever was sent until then has been seen by now.
                drained_ns = asked_ns
                break
            asked_ns = self._clock.monotonic_ns()
            messages.append(message)
            arrival_ns.append(asked_ns)
        found = self._driver.sort(messages, arrival_ns)
        found.drained_ns = drained_ns
        if failure is None and (found.bus_off or self._bus.state == can.BusState.ERROR):
            found.note("bus_off")
            failure = _BusOffError()
        self._hand_over(found)
        if failure is not None:
            raise failure
        if messages:
            # Let a few frames gather: one turn of the event loop then serves them all.
            time.sleep(BATCH_S)

    def _hand_over(self, found: _Sorted) -> None:
        while not self._under_way.acquire(timeout=POLL_S):
            if self._stopping.is_set():
                return
        self._post(self._take, found)

    def _take(self, found: _Sorted) -> None:
        self._under_way.release()
        self._driver.take(found)

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)

    def _post(self, call: Any, *arguments: object) -> None:
        try:
            self._loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:  # the event loop is closed: there is nobody left to tell
            self._stopping.set()


def _assembler(spec: StreamSpec[FrameLayout], port: BusPort) -> StreamAssembler:
    return StreamAssembler(
        spec.name,
        spec.rate_hz,
        counter_bits=spec.layout.counter_bits,
        samples_per_frame=spec.layout.samples_per_frame,
        counts_per_frame=spec.layout.counts_per_frame,
        deliver=port.deliver,
        reorder_window_ns=spec.reorder_window_ns,
    )


def _open_bus(options: Mapping[str, Any]) -> can.BusABC:
    chosen: dict[str, Any] = dict(options.get("options") or {})
    for key in ("bitrate", "data_bitrate"):
        if options.get(key) is not None:
            chosen[key] = options[key]
    if options["interface"] == "virtual":
        chosen["protocol"] = can.CanProtocol.CAN_FD if options.get("fd") else can.CanProtocol.CAN_20
    else:
        chosen["fd"] = bool(options.get("fd"))
    return can.Bus(channel=options.get("channel"), interface=options["interface"], **chosen)


def _shut_down(bus: can.BusABC) -> None:
    try:
        bus.shutdown()
    except Exception as error:  # noqa: BLE001 - a lost adapter may fail to close in its own way
        logger.info("closing a CAN bus that is gone: %s", _words(error))


def _words(error: BaseException) -> str:
    return f"{error}" or type(error).__name__
