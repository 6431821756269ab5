"""A driver for data loggers that send frames of one fixed length over TCP, back to back."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.supervisor import Link
from drivers.base import BusCounters, BusOptionError
from drivers.reconnect import Attempt, run_with_reconnect

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import BusPort

CHUNK_BYTES = 65_536
TICK_NS = 20_000_000


class TcpFramesDriver:
    """Reads one logger.

    Options of the bus: ``host`` and ``tcp_port``. The bus has one stream, whose layout is that of the frame.

    Args:
        port: settings, stream, clock and where to deliver.

    Raises:
        BusOptionError: an option is missing, or there is not exactly one stream.
    """

    def __init__(self, port: BusPort) -> None:
        for key, kind in (("host", str), ("tcp_port", int)):
            if not isinstance(port.options.get(key), kind):
                raise BusOptionError(key, f"is {port.options.get(key)!r}", f"give it as {kind.__name__}")
        if len(port.streams) != 1:
            raise BusOptionError("streams", f"has {len(port.streams)} streams", "give the bus exactly one")
        self.name = port.name
        self._host, self._tcp_port = port.options["host"], port.options["tcp_port"]
        self.link = Link(f"logger {port.name!r} ({self._host}:{self._tcp_port})")
        self.counters = BusCounters()
        self._port = port
        [spec] = port.streams
        self._layout = spec.layout
        self._stream = StreamAssembler(
            spec.name,
            spec.rate_hz,
            counter_bits=spec.layout.counter_bits,
            samples_per_frame=spec.layout.samples_per_frame,
            counts_per_frame=spec.layout.counts_per_frame,
            deliver=port.deliver,
            reorder_window_ns=spec.reorder_window_ns,
        )

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return {self._stream.stream: (self._stream.counters, self._stream.time_base)}

    async def run(self) -> None:
        """See `drivers.base.Driver.run`."""
        try:
            await run_with_reconnect(self.link, self._port, self._attempt)
        finally:
            self.link.stop()
            self._stream.flush()

    async def _attempt(self) -> Attempt:
        try:
            reader, writer = await asyncio.open_connection(self._host, self._tcp_port)
        except OSError as error:
            self.counters.open_failures += 1
            return Attempt(present=False, useful=False, reason=f"it cannot be reached: {error}")
        self.link.up()
        before = self._stream.counters.frames_received
        reason = await self._receive(reader, writer)
        useful = (
            self._stream.counters.frames_received > before
        )  # one that answers and says nothing is not back
        return Attempt(present=True, useful=useful, reason=reason)

    async def _receive(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
        """Read until the connection is lost; returns why."""
        ticking = asyncio.create_task(self._tick(), name=f"tcp-frames-tick-{self.name}")
        length = self._layout.length
        rest = b""
        try:
            while chunk := await reader.read(CHUNK_BYTES):
                now_ns = self._port.clock.monotonic_ns()
                rest += chunk
                n = len(rest) // length
                if n:
                    payloads = np.frombuffer(rest[: n * length], np.uint8).reshape(n, length)
                    rest = rest[n * length :]
                    decoded = self._layout.decode(payloads)
                    arrival_ns = np.full(n, now_ns)
                    self._stream.accept(decoded.counter, decoded.samples, decoded.intact, arrival_ns)
        except OSError as error:
            return f"the connection broke: {error}"
        else:
            return "the logger has closed the connection"
        finally:
            ticking.cancel()
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
            await asyncio.gather(ticking, return_exceptions=True)

    async def _tick(self) -> None:
        """Let the assembler give up on frames that do not come, also while nothing else does."""
        while True:
            await self._port.clock.sleep_ns(TICK_NS)
            self._stream.tick(self._port.clock.monotonic_ns())
