"""The Modbus driver, TCP and RTU: keeps one line up and polls all streams on it.

It reads. It writes nothing but what a layout needs (acknowledging a FIFO, selecting a page, triggering a
block) and what `ModbusDriver.write` is called with, and of that only registers that the bus allows to write.
"""

from __future__ import annotations

import asyncio
import logging
from collections import ChainMap, defaultdict
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.link import Link
from daqsvc.errors.buses import DRIVER_FAILED
from daqsvc.errors.code import coded
from drivers.modbus.client import ModbusClient
from drivers.modbus.fifo import FifoReader
from drivers.modbus.line import ModbusLine, RetryPolicy, SparingByRequest
from drivers.modbus.registers import shared_runs
from drivers.modbus.replies import LineLostError, ModbusCounters
from drivers.modbus.ring import DeviceRingReader
from drivers.modbus.settings import FifoLayout, ModbusRtuBus, ModbusTcpBus, RegistersLayout, RingLayout
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
    from drivers.modbus.settings import ModbusBus


logger = logging.getLogger(__name__)


def readers_for(bus: ModbusBus, port: BusPort, counters: ModbusCounters) -> list[Reader]:
    """A reader for each stream, by the way its device hands out samples; one for all that share requests."""
    readers: list[Reader] = []
    polled: dict[tuple[int, str, float], list[StreamSpec[Any]]] = {}
    windows: dict[int, asyncio.Lock] = defaultdict(asyncio.Lock)
    checked = isinstance(bus, ModbusRtuBus)  # each frame with its CRC
    for spec in port.streams:
        layout = spec.layout
        if isinstance(layout, RegistersLayout):
            polled.setdefault((layout.unit, layout.table, spec.rate_hz), []).append(spec)
        elif isinstance(layout, FifoLayout):
            readers.append(FifoReader(spec, port, checked=checked))
        elif isinstance(layout, RingLayout):
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

    The layouts of the streams are those of `drivers.modbus.settings`.

    Args:
        bus: its table in the machine file.
        port: streams, clock and where to deliver.
    """

    def __init__(self, bus: ModbusBus, port: BusPort) -> None:
        self.name = port.name
        self.counters = ModbusCounters()
        self._bus = bus
        self._port = port
        self._patience = RetryPolicy.of(bus)
        kind = "Modbus TCP" if isinstance(bus, ModbusTcpBus) else "Modbus RTU"
        self.link = Link(f"{kind} bus {port.name!r} ({bus.where})")
        parity = "none" if isinstance(bus, ModbusTcpBus) else bus.parity
        self._characters = CharacterFormat(self.link.name, Character(8, parity))
        self._readers = readers_for(bus, port, self.counters)
        self.link.faults = ChainMap(*(reader.faults for reader in self._readers))
        self._line: ModbusLine | None = None
        self._sparing: SparingByRequest = {}

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
        bus = self._bus
        if isinstance(bus, ModbusRtuBus):
            bus = bus.model_copy(update={"parity": self._characters.on(bus.serial_port).parity})
        client = ModbusClient(bus, self._port.clock, self.counters)
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
                may_write=bus.may_write,
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
                logger.error(
                    "%s: %s failed",
                    self.link.name,
                    task.get_name(),
                    exc_info=error,
                    extra=coded(DRIVER_FAILED),
                )
                self.counters.reader_failures += 1
                return f"its reader failed: {error}"
        return "its reader has ended"

    def _heard(self) -> None:
        if self.link.state == "down":
            self.link.up()
