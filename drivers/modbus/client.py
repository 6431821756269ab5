"""The Modbus client: requests as pymodbus encodes them, one at a time, and what came of each.

Only this module and `drivers.modbus.wire` import pymodbus. Reconnecting, quiet times and retries are not
their business: see `drivers.modbus.line`.
"""

from __future__ import annotations

import asyncio
import contextlib
from functools import lru_cache
from typing import TYPE_CHECKING

from pymodbus.pdu.file_message import ReadFifoQueueRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
)

from drivers.modbus.outcomes import LineLostError, RequestRefusedError
from drivers.modbus.replies import READ_HOLDING, READ_INPUT, register_bytes
from drivers.modbus.wire import ModbusRequest, ModbusWire

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pymodbus.pdu import ModbusPDU

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.outcomes import ModbusCounters
    from drivers.modbus.wire import LineOptions

_READS = {READ_HOLDING: ReadHoldingRegistersRequest, READ_INPUT: ReadInputRegistersRequest}


def _encoded(request: ModbusPDU, data_bytes: int | None = None) -> ModbusRequest:
    return ModbusRequest(request.dev_id, bytes([request.function_code]) + request.encode(), data_bytes)


@lru_cache(maxsize=1024)
def _read_request(unit: int, function: int, address: int, count: int) -> ModbusRequest:
    """A read; what is polled is asked for in the same bytes every time."""
    return _encoded(_READS[function](address=address, count=count, dev_id=unit), 2 * count)


class ModbusClient:
    """One connection, one request at a time. Connect again with a new client.

    Args:
        options: what to open.
        clock: stamps when bytes last arrived.
        counters: where faults are counted.
    """

    def __init__(self, options: LineOptions, clock: Clock, counters: ModbusCounters) -> None:
        self._wire = ModbusWire(options, clock, counters)
        self._counters = counters

    @property
    def last_byte_ns(self) -> int:
        """When bytes last arrived, monotonic; 0 if never."""
        return self._wire.last_byte_ns

    @property
    def connected(self) -> bool:
        """Whether the connection stands."""
        return self._wire.is_active()

    async def connect(self) -> None:
        """Open the connection.

        Raises:
            LineLostError: it cannot be opened.
        """
        await self._wire.open()

    async def close(self) -> None:
        """Close the connection; harmless if it is closed."""
        serial = getattr(self._wire.transport, "sync_serial", None)
        if serial is not None:
            # Closing a tty waits until everything is sent, which a dead adapter never does.
            with contextlib.suppress(OSError, ValueError):
                serial.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._wire.close()
        await asyncio.sleep(0)  # a TCP transport closes its socket in the next turn

    async def read(self, unit: int, function: int, address: int, count: int) -> bytes:
        """Read registers.

        Args:
            unit: address of the unit.
            function: `READ_HOLDING` or `READ_INPUT`.
            address: first register, from 0.
            count: how many, 1 to 125.

        Returns:
            ``2 * count`` bytes, high byte of each register first.

        Raises:
            LineLostError: the connection is gone.
            NoReplyError: no sound reply came in time.
            RequestRefusedError: the unit answers with an exception.
        """
        return await self._ask(_read_request(unit, function, address, count))

    async def read_fifo(self, unit: int, address: int) -> bytes:
        """Read a FIFO queue (function 24); see `read` for what is returned and raised."""
        return await self._ask(_encoded(ReadFifoQueueRequest(address=address, dev_id=unit)))

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers (function 16); see `read` for what is raised."""
        request = WriteMultipleRegistersRequest(address=address, registers=list(values), dev_id=unit)
        await self._ask(_encoded(request))

    async def _ask(self, request: ModbusRequest) -> bytes:
        if not self._wire.is_active():
            raise LineLostError(self._wire.why_lost)
        self._counters.requests += 1
        pdu = await self._wire.exchange(request)
        self._counters.replies += 1
        if pdu[0] != request.pdu[0]:
            kind = self._counters.note_exception(pdu[1])
            raise RequestRefusedError(
                f"unit {request.unit} refuses function {request.pdu[0]}: {kind}", pdu[1]
            )
        return register_bytes(pdu)
