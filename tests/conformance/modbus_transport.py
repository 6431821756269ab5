"""Modbus TCP and RTU, with a queue of samples that the driver empties, and a plug that a test can pull."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from conformance.faulty_device import FaultyDevice
from conformance.transport import CHANNELS, STREAM, SimulatedTime
from support.bus_tables import modbus_bus
from support.modbus_layouts import count_at, fifo_layout, in_sample

from drivers.base import BusPort, StreamSpec
from drivers.modbus.driver import ModbusDriver
from drivers.modbus.registers import RegisterRecord
from sim_hw.nodes.modbus_node import ModbusRtuServer, ModbusTcpServer
from sim_hw.nodes.modbus_unit import FifoStore, ModbusUnit

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy
    from drivers.modbus.settings import FifoLayout

RATE_HZ = 1000.0
POLL_NS = 2_000_000
UNIT, QUEUE, ACKNOWLEDGE = 1, 10, 20
SAMPLE = [in_sample(name, place, "int16") for place, name in enumerate(CHANNELS)]
CANNOT = {
    "duplicate": "a reply answers one request, and a queue has each sample once",
    "reorder": "there is one request at a time, and a queue keeps its order",
    "corrupt": "samples have no checksum of their own; a reply with a wrong one is asked for again, see "
    "test_modbus_line.py",
}


class _Device(FaultyDevice):
    def __init__(self, layout: FifoLayout, unplug: Callable[[], None], plug: Callable[[], None]) -> None:
        super().__init__(samples_per_frame=1)
        self.unit = ModbusUnit()
        self._layout = layout
        self._store = FifoStore(self.unit, layout)
        self._unplug, self._plug = unplug, plug

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        assert not corrupt
        if self._store.full:
            return False
        self._store.put(first_index, RegisterRecord.of(self._layout).encode(samples))
        return True

    def go_away(self) -> None:
        super().go_away()
        self._store.clear()
        self._unplug()

    def come_back(self) -> None:
        super().come_back()
        self._plug()


class _Modbus(ABC):
    """See `conformance.transport.Transport`."""

    rate_hz = RATE_HZ
    samples_per_frame = 1
    counter_modulus = 2**32
    jitter_ns = 10 * POLL_NS
    latency_ns = 5 * POLL_NS
    poll_ns = POLL_NS
    overflow_frames = 2000
    cannot = CANNOT
    acknowledge: int | None
    timeout_ms: float
    """Time is simulated, but replies come when they come."""

    def __init__(self, _folder: Path) -> None:
        self.time = SimulatedTime()
        self._layout = fifo_layout(UNIT, QUEUE, count_at(0, 32), SAMPLE, self.acknowledge, POLL_NS)
        self._spec: StreamSpec[Any] = StreamSpec(STREAM, self._layout, RATE_HZ)
        self.device = _Device(self._layout, self.unplug, self.plug)

    @abstractmethod
    def plug(self) -> None:
        """The server answers."""

    @abstractmethod
    def unplug(self) -> None:
        """The server is gone."""

    @abstractmethod
    def options(self) -> dict[str, Any]:
        """Of the bus."""

    async def stop(self) -> None:
        self.unplug()
        await asyncio.sleep(0)

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> ModbusDriver:
        options = {**self.options(), "timeout_ms": self.timeout_ms, "demote_after": 30}
        port = BusPort("mb", [self._spec], self.time.clock, deliver, start)
        return ModbusDriver(modbus_bus(**options), port)


class ModbusTcp(_Modbus):
    """A device that drops from its queue what it has handed out."""

    name = "Modbus TCP"
    acknowledge = None
    timeout_ms = 20_000.0

    async def start(self) -> None:
        self._server = ModbusTcpServer({UNIT: self.device.unit})
        await self._server.start()

    def plug(self) -> None:
        self._server.start_at_once()

    def unplug(self) -> None:
        self._server.stop()

    def options(self) -> dict[str, Any]:
        return {"transport": "tcp", "host": "127.0.0.1", "tcp_port": self._server.port}


class ModbusRtu(_Modbus):
    """A device that keeps what it has handed out until it is acknowledged."""

    name = "Modbus RTU"
    acknowledge = ACKNOWLEDGE
    timeout_ms = 100.0  # a line that is opened is quiet for twice as long, in simulated time

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._path = folder / "port"
        self._server = ModbusRtuServer({UNIT: self.device.unit}, self._path)

    async def start(self) -> None:
        self.plug()

    def plug(self) -> None:
        self._server.start()

    def unplug(self) -> None:
        self._server.stop()

    def options(self) -> dict[str, Any]:
        writes = [{"unit": UNIT, "address": ACKNOWLEDGE, "count": 2}]
        line = {"serial_port": str(self._path), "baud": 115_200}
        return {"transport": "rtu", "writes": writes, **line}


TRANSPORTS: dict[str, Callable[[Path], _Modbus]] = {ModbusTcp.name: ModbusTcp, ModbusRtu.name: ModbusRtu}
