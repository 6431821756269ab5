"""The driver of serial ports: framed binary samples, or lines of text, from a device that sends by itself.

pyserial opens the port and sets it up. The bytes are read from its file descriptor by a thread of ours, cut
into frames and decoded by another, and handed to the event loop in batches. When the event loop cannot keep
up the threads wait: bytes then pile up in the kernel, and what overflows there shows as a gap in the
devices' counters. A port that goes away, because it was unplugged, is opened again by its path.
"""

from __future__ import annotations

import asyncio
import logging
import termios
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import serial

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Link
from daqsvc.errors.buses import NO_FRAME
from daqsvc.errors.code import coded
from drivers.base import BusCounters, BusPort
from drivers.reconnect import Attempt, CannotOpenError, ended, in_thread, run_with_reconnect, sparing_others
from drivers.serial.binary import BodyCodec, CobsFraming, SyncFraming
from drivers.serial.framing import COMPARE
from drivers.serial.lines import TIME_COUNTER_BITS, LineFraming
from drivers.serial.pauses import longest_pause_s
from drivers.serial.reader import SHUTDOWN_S, SerialReader, close_port
from drivers.serial.settings import CobsBus, LineLayout, LinesBus, SyncBus
from drivers.stream_driver import assembler_of
from drivers.tty import Character, CharacterFormat, why_not_open

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from daqsvc.errors.code import Code
    from drivers.base import StreamSpec
    from drivers.frames import DecodedBatch, FrameLayout
    from drivers.serial.framing import Framing
    from drivers.serial.settings import SerialBus

logger = logging.getLogger(__name__)

REMEMBERED_IDS = 64
RECENT_NS = 10 * NS_PER_S
"""Time for which bytes that were no frame count as coming."""
_MOST_LOGGED = 4
"""Kinds of bytes that are no frame which are logged."""

_PARITY = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}


@dataclass(slots=True)
class SerialCounters(BusCounters):
    """See `BusCounters`; besides what only a serial port has.

    Attributes:
        bytes_received: bytes read.
        bytes_garbage: of those, in no frame.
        frames_malformed: pieces of the byte stream that should have been a frame.
        resyncs: how often a frame was found again after something malformed.
        stalls: how often the reader had to wait because the event loop was behind.
        overruns: bytes that the UART or the kernel's buffer lost, as far as the UART's driver reports.
        framing_errors: characters without a stop bit, as far as the UART's driver reports.
        parity_errors: characters of wrong parity, as far as it reports.
        breaks: break conditions, as far as it reports.
    """

    bytes_received: int = 0
    bytes_garbage: int = 0
    frames_malformed: int = 0
    resyncs: int = 0
    stalls: int = 0
    overruns: int = 0
    framing_errors: int = 0
    parity_errors: int = 0
    breaks: int = 0


class SerialDriver:
    """Reads one serial port.

    The layouts of its streams are `FrameLayout`, or `LineLayout` for lines.

    Args:
        bus: its table in the machine file.
        port: streams, clock and where to deliver.

    Raises:
        LayoutError: the streams do not fit the framing.
    """

    def __init__(self, bus: SerialBus, port: BusPort) -> None:
        self.name = port.name
        self.link = Link(f"serial port {port.name!r} ({bus.port})")
        self.counters = SerialCounters()
        self._bus = bus
        self._port = port
        self._framing = framing_of(bus, port.streams)
        self._assemblers = {s.name: _assembler(s, port, self._unread) for s in port.streams}
        self._logged: set[str] = set()
        self._remedies: list[str] = []
        self._faults: dict[str, str] = {}
        self.link.faults = self._faults
        self._no_frame = ""
        self._no_frame_ns = 0
        self._characters = CharacterFormat(self.link.name, Character(bus.data_bits, bus.parity))

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return {name: (a.counters, a.time_base) for name, a in self._assemblers.items()}

    async def run(self) -> None:
        """See `drivers.base.Driver.run`."""
        try:
            # What the device sends meanwhile waits in the port's buffer, or is lost: it is not silent.
            self.link.preparing = True
            await in_thread(_warm, self._bus, self._port.streams, patience_s=SHUTDOWN_S)
            self.link.preparing = False
            await run_with_reconnect(self.link, self._port, self._attempt)
        finally:
            self.link.preparing = False
            self.link.stop()
            for assembler in self._assemblers.values():
                assembler.flush()

    async def _attempt(self) -> Attempt:
        device = await self._open()
        self.link.up()
        before = self._frames
        reason = await self._receive(device)
        return Attempt(present=True, useful=self._frames > before, reason=reason)

    @property
    def _frames(self) -> int:
        return sum(a.counters.frames_received for a in self._assemblers.values())

    async def _open(self) -> serial.Serial:
        try:
            return await in_thread(
                _open_port, self._bus, self._characters, undo=close_port, patience_s=SHUTDOWN_S
            )
        except (OSError, ValueError, termios.error) as error:  # pyserial's own is an OSError
            self.counters.open_failures += 1
            why = why_not_open(error, self._bus.port, "port")
            raise CannotOpenError(f"it cannot be opened: {why}") from error

    async def _receive(self, device: serial.Serial) -> str:
        """Read until the link fails; returns why."""
        self._framing.restart()
        loop = asyncio.get_running_loop()
        reader = SerialReader(
            self.link.name,
            device,
            self._framing,
            self,
            self._port.clock,
            loop,
            longest_pause_s(self._bus.bits_per_character, self._bus.baud, map(_wrap_s, self._port.streams)),
            self.link.turn,
        )
        reader.start()
        try:
            return await ended(reader.ended, reader, reader.cutter)
        finally:
            # Cancelled while the port is being closed: that takes its time all the same.
            try:
                await in_thread(reader.close, patience_s=2 * SHUTDOWN_S)
            finally:
                reader.finish()

    def accept(self, batch: DecodedBatch) -> None:
        """Take in what the reader thread has found; runs on the event loop."""
        for name, count in batch.notes.items():
            self.note(name, count)
        if batch.malformed or "frames_malformed" in batch.notes:
            self._say_what_is_no_frame(batch)
            self._come_in_place(batch)
        for name, count in batch.unknown.items():
            self._count_unknown(name, count)
        for stream, (count, length) in batch.wrong_length.items():
            self._assemblers[stream].counters.frames_wrong_length += count
            self._say_once(
                f"length of {stream}",
                NO_FRAME,
                "%s: a frame of stream %r has %d bytes, id and CRC included, and its layout another length; "
                "such frames are counted and left out",
                self.link.name,
                stream,
                length,
            )
        for stream, frames in batch.frames.items():
            self._faults.pop(stream, None)
            with sparing_others(self.link, stream, self.counters):
                self._assemblers[stream].accept(*frames)

    def tick(self, drained_ns: int) -> None:
        """Nothing more is under way that was sent before ``drained_ns``; runs on the event loop."""
        if self._faults and self._port.clock.monotonic_ns() - self._no_frame_ns > RECENT_NS:
            self._faults.clear()
        for name, assembler in self._assemblers.items():
            with sparing_others(self.link, name, self.counters):
                assembler.tick(drained_ns)

    def _say_what_is_no_frame(self, batch: DecodedBatch) -> None:
        """Log what is wrong with the first piece that is no frame, and what is wrong with all later ones."""
        is_other = bool(batch.malformed) and batch.remedy not in self._remedies
        # Noise is of all sorts: it must not fill the log.
        if self._remedies and (not is_other or len(self._remedies) >= _MOST_LOGGED):
            return
        self._remedies.append(batch.remedy)
        logger.warning(
            "%s carries bytes that are no frame; they are counted and left out%s. If it is all of them, %s",
            self.link.name,
            f"; {batch.malformed}" if batch.malformed else "",
            batch.remedy or COMPARE,
            extra=coded(NO_FRAME),
        )

    def _come_in_place(self, batch: DecodedBatch) -> None:
        """State what comes in place of the frames of streams, until these come."""
        self._no_frame = batch.malformed or self._no_frame
        self._no_frame_ns = self._port.clock.monotonic_ns()
        frame = "line" if isinstance(self._bus, LinesBus) else "frame"
        for stream in self._assemblers.keys() - batch.frames.keys():
            why = f"bytes come on {self.name}, but no {frame} as its layout states"
            self._faults[stream] = f"{why}; {self._no_frame}" if self._no_frame else why

    def _unread(self) -> int:
        """How many frames could not be read; 0 if there are several streams: they may be of any."""
        return self.counters.frames_malformed if len(self._assemblers) == 1 else 0

    def note(self, counter: str, count: int = 1) -> None:
        """Add to one of the bus's counters; runs on the event loop."""
        setattr(self.counters, counter, getattr(self.counters, counter) + count)

    def _count_unknown(self, name: str, count: int) -> None:
        self.counters.frames_unknown += count
        ids = self.counters.unknown_ids
        if name in ids or len(ids) < REMEMBERED_IDS:
            ids[name] = ids.get(name, 0) + count
        self._say_once(
            "unknown id",
            NO_FRAME,
            "%s carries frames that no stream of the machine file has, id %s the first of them; "
            "they are counted by id",
            self.link.name,
            name,
        )

    def _say_once(self, key: str, code: Code, message: str, *arguments: object) -> None:
        if key not in self._logged:
            self._logged.add(key)
            logger.warning(message, *arguments, extra=coded(code))


def framing_of(bus: SerialBus, streams: Sequence[StreamSpec[Any]]) -> Framing:
    """The framing of a port, for its streams.

    Raises:
        LayoutError: the streams do not fit it.
    """
    if isinstance(bus, LinesBus):
        lines: dict[str, LineLayout] = {s.name: s.layout for s in streams}
        rates_hz = {s.name: s.rate_hz for s in streams}
        windows_ns = {s.name: s.reorder_window_ns for s in streams}
        return LineFraming(lines, rates_hz, bus.checksum, bus.delimiter.encode("ascii"), windows_ns)
    assert isinstance(bus, CobsBus | SyncBus)  # noqa: S101 - there are no others
    layouts: dict[str, FrameLayout] = {s.name: s.layout for s in streams}
    codec = BodyCodec(layouts, ids=bus.stream_ids, crc=bus.crc, crc_order=bus.crc_order)
    if isinstance(bus, SyncBus):
        return SyncFraming(codec, bytes.fromhex(bus.sync_word))
    return CobsFraming(codec)


def _warm(bus: SerialBus, streams: Sequence[StreamSpec[Any]]) -> None:
    """Have the loops that the streams need compiled, before their data come in."""
    framing = framing_of(bus, streams)
    for spec in streams:
        shape = (3, spec.layout.samples_per_frame, len(spec.layout.channels))
        frames = framing.encode(spec.name, np.zeros(3, np.int64), np.zeros(shape), clip=True)
        framing.cut(b"".join(frames))


def _assembler(spec: StreamSpec[Any], port: BusPort, unread: Callable[[], int]) -> StreamAssembler:
    layout: FrameLayout | LineLayout = spec.layout
    if not isinstance(layout, LineLayout):
        return assembler_of(spec, port)
    bits = None if layout.no_counter else TIME_COUNTER_BITS
    return StreamAssembler(
        spec.name,
        spec.rate_hz,
        counter_bits=bits if layout.counter is None else layout.counter.bits,
        samples_per_frame=1,
        counts_per_frame=1,
        deliver=port.deliver,
        reorder_window_ns=spec.reorder_window_ns,
        stamped=layout.time is not None,
        tell=port.tell,
        unread=unread,
    )


def _wrap_s(spec: StreamSpec[Any]) -> float:
    """In what time a stream's counter begins again; 0 if it has none, and arrivals give its rate."""
    layout: FrameLayout | LineLayout = spec.layout
    if isinstance(layout, LineLayout):
        return 0.0 if layout.counter is None else 2.0**layout.counter.bits / spec.rate_hz
    if layout.counter_bits is None:
        return 0.0
    frame_rate_hz = spec.rate_hz / layout.samples_per_frame
    return 2.0**layout.counter_bits / (layout.counts_per_frame * frame_rate_hz)


def _open_port(bus: SerialBus, characters: CharacterFormat) -> serial.Serial:
    character = characters.on(bus.port)
    device = serial.Serial(
        bus.port,
        baudrate=bus.baud,
        bytesize=character.data_bits,
        parity=_PARITY[character.parity],
        stopbits=bus.stop_bits,
        rtscts=bus.flow_control == "rts-cts",
        xonxoff=bus.flow_control == "xon-xoff",
        timeout=0,
        write_timeout=0,
        # VMIN = 1: a read that finds nothing then fails with EAGAIN, and nothing at all means hung up.
        inter_byte_timeout=0,
        exclusive=True,
    )
    if bus.low_latency:
        try:
            device.set_low_latency_mode(True)
        except (OSError, ValueError) as error:
            logger.info("%s has no low-latency mode: %s", bus.port, error)
    return device
