"""Which units and registers answer on a Modbus line: one request at a time, and nothing is written."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from drivers.modbus.client import ModbusClient
from drivers.modbus.replies import (
    GATEWAY_CODES,
    LineLostError,
    ModbusCounters,
    NoReplyError,
    RequestRefusedError,
)
from drivers.modbus.settings import ModbusRtuBus

if TYPE_CHECKING:
    import threading
    from collections.abc import Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.settings import ModbusBus

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
BLOCK = 100
"""Registers in a request at first."""
ALIKE = 8
"""Addresses in a row that all answer, from which on the server is taken to ignore the address."""
QUIET_S = 0.1
"""Silence on a serial line after a request without reply, which may still come."""


@dataclass(slots=True)
class FoundTable:
    """What one function reads of a unit.

    Attributes:
        unit: its address.
        function: 3 or 4.
        first: registers by address, as they were read first.
        second: as they were read again.
        refused: exception codes but illegal address, by the first address of a request.
        silent: first addresses of requests that stayed without reply.
    """

    unit: int
    function: int
    first: dict[int, int] = field(default_factory=dict)
    second: dict[int, int] = field(default_factory=dict)
    refused: dict[int, int] = field(default_factory=dict)
    silent: list[int] = field(default_factory=list)

    @property
    def runs(self) -> list[tuple[int, int]]:
        """First and last address of registers in a row."""
        runs: list[tuple[int, int]] = []
        for address in sorted(self.first):
            if runs and address == runs[-1][1] + 1:
                runs[-1] = runs[-1][0], address
            else:
                runs.append((address, address))
        return runs

    @property
    def moved(self) -> set[int]:
        """Addresses of registers that had another value when they were read again."""
        return {address for address, value in self.second.items() if value != self.first.get(address)}


@dataclass(slots=True)
class Scan:
    """Asks units for registers.

    Args:
        bus: its table in a machine file.
        clock: of the client.
        stop: set when the person has seen enough.
        pause_s: silence between two requests.

    Attributes:
        requests: how many were made.
        units: those that answered, in order.
        gateway: addresses of which a gateway reported that no unit is behind them.
        alike: whether every address answered, so that only the first is taken for a unit.
        tables: what was read.
        lost: why the line was lost; empty if it was not.
    """

    bus: ModbusBus
    clock: Clock
    stop: threading.Event
    pause_s: float
    requests: int = 0
    units: list[int] = field(default_factory=list)
    gateway: list[int] = field(default_factory=list)
    alike: bool = False
    tables: list[FoundTable] = field(default_factory=list)
    lost: str = ""
    _client: ModbusClient | None = None

    async def run(
        self,
        units: Sequence[int],
        functions: Sequence[int],
        begin: int,
        end: int,
        *,
        until_found: bool = False,
    ) -> None:
        """Find units, read their registers, and read those that are there again.

        Args:
            units: addresses to try.
            functions: 3, 4 or both.
            begin: first register.
            end: last one.
            until_found: whether no further function is tried on a unit that has registers.

        Raises:
            LineLostError: the line cannot be opened.
        """
        await self._connect()
        try:
            await self._find(units, functions[0], begin)
            for unit in self.units:
                for function in functions:
                    table = FoundTable(unit, function)
                    self.tables.append(table)
                    for at in range(begin, end + 1, BLOCK):
                        await self._read(table, at, min(BLOCK, end + 1 - at))
                    if table.first and until_found:
                        break
            for table in self.tables:
                await self._read_again(table)
        except LineLostError as error:
            self.lost = f"{error}"
        finally:
            await self._close()

    async def _find(self, units: Sequence[int], function: int, address: int) -> None:
        for tried, unit in enumerate(units, 1):
            if self.stop.is_set():
                return
            try:
                await self._ask(unit, function, address, 1)
            except NoReplyError:
                continue
            except RequestRefusedError as error:
                if error.code in GATEWAY_CODES:
                    self.gateway.append(unit)
                    continue
            self.units.append(unit)
            if tried == ALIKE == len(self.units) and not isinstance(self.bus, ModbusRtuBus):
                self.alike, self.units = True, self.units[:1]
                return

    async def _read(self, table: FoundTable, address: int, count: int) -> None:
        """Registers in a row; where one of them is not there, both halves by themselves."""
        if self.stop.is_set() or table.refused.get(address, 0) == ILLEGAL_FUNCTION:
            return
        if ILLEGAL_FUNCTION in table.refused.values():
            return
        try:
            raw = await self._ask(table.unit, table.function, address, count)
        except NoReplyError:
            table.silent.append(address)
            return
        except RequestRefusedError as error:
            if error.code in {ILLEGAL_ADDRESS, ILLEGAL_VALUE} and count > 1:
                await self._read(table, address, count // 2)
                await self._read(table, address + count // 2, count - count // 2)
            elif error.code != ILLEGAL_ADDRESS:
                table.refused[address] = error.code
            return
        table.first.update(_registers(raw, address))

    async def _read_again(self, table: FoundTable) -> None:
        for first, last in table.runs:
            for at in range(first, last + 1, BLOCK):
                if self.stop.is_set():
                    return
                count = min(BLOCK, last + 1 - at)
                try:
                    raw = await self._ask(table.unit, table.function, at, count)
                except (NoReplyError, RequestRefusedError):
                    continue
                table.second.update(_registers(raw, at))

    async def _ask(self, unit: int, function: int, address: int, count: int) -> bytes:
        """One request, after a pause.

        Raises:
            LineLostError: the connection is gone, and cannot be opened again.
            NoReplyError: no sound reply came in time, or the connection was closed instead.
            RequestRefusedError: the unit answers with an exception.
        """
        await asyncio.sleep(self.pause_s)
        if self._client is None or not self._client.connected:
            await self._connect()
        assert self._client is not None  # noqa: S101 - for the type checker
        self.requests += 1
        try:
            return await self._client.read(unit, function, address, count)
        except LineLostError as error:
            # Some servers close the connection where others do not answer.
            raise NoReplyError(f"{error}") from error
        except NoReplyError:
            if isinstance(self.bus, ModbusRtuBus):
                await asyncio.sleep(QUIET_S)
            raise

    async def _connect(self) -> None:
        await self._close()
        self._client = ModbusClient(self.bus, self.clock, ModbusCounters())
        await self._client.connect()

    async def _close(self) -> None:
        if self._client is not None:
            await self._client.close()
            self._client = None


def most_requests(units: int, functions: int, registers: int) -> tuple[int, int]:
    """Requests to find units, and the most for the registers of one unit, both readings."""
    blocks = -(-registers // BLOCK)
    return units, functions * (2 * registers - blocks + (registers + 1) // 2)


def _registers(raw: bytes, address: int) -> dict[int, int]:
    return {address + k: int.from_bytes(raw[2 * k : 2 * k + 2], "big") for k in range(len(raw) // 2)}
