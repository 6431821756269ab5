"""The Modbus driver, TCP and RTU: keeps one line up and polls all streams on it.

It reads. It writes nothing but what a layout needs (acknowledging a FIFO, selecting a page, triggering a
block) and what `ModbusDriver.write` is told to, and of that only registers that the bus allows to write.
"""

from __future__ import annotations

import asyncio
import logging
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Link
from drivers.modbus.client import LineOptions, ModbusClient
from drivers.modbus.fifo import FifoReader
from drivers.modbus.layouts import Fifo, Ring, TrendLayout, shared_runs
from drivers.modbus.line import ModbusLine, RetryPolicy, SparingByEnquiry, WritableRun
from drivers.modbus.registers import RegisterRun
from drivers.modbus.replies import LineLostError, ModbusCounters
from drivers.modbus.ring import DeviceRingReader
from drivers.modbus.trend import TrendReader
from drivers.modbus.waveform import WaveformReader
from drivers.reconnect import Attempt, CannotOpenError, run_with_reconnect
from drivers.tty import Character, CharacterFormat

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus.reading import Reader


logger = logging.getLogger(__name__)


def readers_for(port: BusPort, counters: ModbusCounters) -> list[Reader]:
    """A reader for each stream, by the way its device hands out samples; one for all that share requests."""
    readers: list[Reader] = []
    polled: dict[tuple[int, str, float], list[StreamSpec[Any]]] = {}
    windows: dict[int, asyncio.Lock] = defaultdict(asyncio.Lock)
    checked = port.options.get("transport") == "rtu"  # each frame with its CRC
    for spec in port.streams:
        layout = spec.layout
        if isinstance(layout, TrendLayout):
            polled.setdefault((layout.unit, layout.table, spec.rate_hz), []).append(spec)
        elif isinstance(layout, Fifo):
            readers.append(FifoReader(spec, port, checked=checked))
        elif isinstance(layout, Ring):
            readers.append(DeviceRingReader(spec, port, counters, checked=checked))
        else:
            readers.append(WaveformReader(spec, port, counters, windows[layout.unit]))
    for specs in polled.values():
        if (runs := shared_runs([spec.layout for spec in specs])) is not None:
            readers.append(TrendReader(specs, port, runs))
        else:
            readers += [TrendReader([spec], port) for spec in specs]
    return readers


_NS_PER_MS = 1_000_000


class ModbusDriver:
    """Polls the streams of one Modbus line.

    Options of the bus: ``transport`` (``"tcp"`` or ``"rtu"``); ``host`` and ``tcp_port``, or
    ``serial_port``, ``baud``, ``parity`` and ``stop_bits``; optionally ``timeout_ms``, ``quiet_ms``,
    ``demote_after``, ``demotion_s``, and ``writes``: tables of ``unit``, ``address`` and ``count``.

    The layouts of the streams are those of `drivers.modbus.layouts`.

    Args:
        port: settings, streams, clock and where to deliver.
    """

    def __init__(self, port: BusPort) -> None:
        self.name = port.name
        self.counters = ModbusCounters()
        self._port = port
        self._options = _line_options(port.options)
        self._patience = _patience(port.options, self._options)
        self._writable = [
            WritableRun(entry["unit"], RegisterRun(entry["address"], entry.get("count", 1)))
            for entry in port.options.get("writes") or ()
        ]
        kind = "Modbus TCP" if self._options.transport == "tcp" else "Modbus RTU"
        self.link = Link(f"{kind} bus {port.name!r} ({self._options.where})")
        self._characters = CharacterFormat(self.link.name, Character(8, self._options.parity))
        self._readers = readers_for(port, self.counters)
        self._line: ModbusLine | None = None
        self._sparing: SparingByEnquiry = {}

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        states = {name: state for reader in self._readers for name, state in reader.streams.items()}
        return {spec.name: states[spec.name] for spec in self._port.streams}

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers that the machine file allows to write.

        Args:
            unit: address of the unit.
            address: first register, from 0.
            values: what to write, 0 to 65535 each.

        Raises:
            ValueError: registers cannot hold these values, or a request so many; nothing has been sent.
            WriteRefusedError: the machine file does not allow it; nothing has been sent.
            LineLostError: the line is down.
            NoReplyError: the unit does not answer.
            RefusedError: the unit refuses.
        """
        if self._line is None:
            raise LineLostError(f"{self.link.name} is down: {self.link.reason or 'it is not open yet'}")
        await self._line.write(unit, address, values)

    async def run(self) -> None:
        """See `drivers.base.Driver.run`."""
        try:
            await run_with_reconnect(self.link, self._port, self._attempt)
        finally:
            self.link.stop()
            for reader in self._readers:
                reader.flush()

    async def _attempt(self) -> Attempt:
        answered = self.counters.replies
        reason = await self._session()
        heard = self.counters.replies > answered  # a line that opens and stays silent is not there
        return Attempt(present=heard, useful=heard, reason=reason)

    async def _session(self) -> str:
        """Open the line and read until it is lost; returns why."""
        character = self._characters.on(self._options.serial_port)
        options = replace(self._options, parity=character.parity)
        client = ModbusClient(options, self._port.clock, self.counters)
        reading: list[asyncio.Task[None]] = []
        try:
            try:
                await client.connect()
            except LineLostError as error:
                raise CannotOpenError(f"{error}") from error
            line = self._line = ModbusLine(
                client,
                self._port.clock,
                self.counters,
                self._patience,
                units=sorted({spec.layout.unit for spec in self._port.streams}),
                writable=self._writable,
                heard=self._heard,
                sparing=self._sparing,
            )
            reading = [
                asyncio.create_task(
                    reader.run(line), name=f"modbus-reader {self.name} {' '.join(reader.streams)}"
                )
                for reader in self._readers
            ]
            waited_for: set[asyncio.Future[Any]] = {line.lost, *reading}
            ended, _ = await asyncio.wait(waited_for, return_when=asyncio.FIRST_COMPLETED)
            return self._why(line, [task for task in reading if task in ended])
        finally:
            self._line = None
            for task in reading:
                task.cancel()
            await asyncio.gather(*reading, return_exceptions=True)
            await client.close()

    def _why(self, line: ModbusLine, ended: list[asyncio.Task[None]]) -> str:
        if line.lost.done():
            return line.lost.result()
        for task in ended:
            if task.cancelled():
                return f"its {task.get_name()} was cancelled"
            if (error := task.exception()) is not None:
                logger.error("%s: %s failed", self.link.name, task.get_name(), exc_info=error)
                self.counters.reader_failures += 1
                return f"its reader failed: {error}"
        return "its reader has ended"

    def _heard(self) -> None:
        if self.link.state == "down":
            self.link.up()


def _line_options(options: Mapping[str, Any]) -> LineOptions:
    names = ("transport", "host", "tcp_port", "serial_port", "baud", "parity", "stop_bits")
    given = {name: options[name] for name in names if options.get(name) is not None}
    return LineOptions(**given, timeout_ns=round(options.get("timeout_ms", 500.0) * _NS_PER_MS))


def _patience(options: Mapping[str, Any], line: LineOptions) -> RetryPolicy:
    quiet_ms = options.get("quiet_ms")
    quiet_ns = 0 if line.transport == "tcp" else max(line.timeout_ns, line.gap_ns)
    if line.transport == "rtu" and quiet_ms is not None:
        quiet_ns = max(quiet_ns, round(quiet_ms * _NS_PER_MS))
    return RetryPolicy(
        quiet_ns=quiet_ns,
        gap_ns=line.gap_ns,
        demote_after=options.get("demote_after", 3),
        demotion_ns=round(options.get("demotion_s", 10.0) * NS_PER_S),
        timeout_ns=line.timeout_ns,
    )
