"""Which units and registers answer on a Modbus line: one request at a time, and nothing is written."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
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
    from collections.abc import Callable, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.settings import ModbusBus

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
BLOCK = 100
"""Registers in a request at first."""
ALIKE = 8
"""Addresses that all answer alike, from which on the server is taken to ignore the address."""
QUIET_S = 0.1
"""Silence on a serial line after a request without reply, which may still come."""
ROUNDS, ROUND_S = 5, 0.3
"""Readings of the registers that are there, and the pause before each further one."""
MOST_ROUNDS, STOP_S = 60, 0.2
"""The same where a time is given, and how often it is seen to whether the person has enough."""
READ_ON = 800
"""Registers that are read beyond those asked for, as long as there are any."""
TELL_S = 5.0
"""Time from one line about the progress to the next."""
LAST_REGISTER = 65_535
TABLES = {3: "holding", 4: "input"}


def units_in_words(units: Sequence[int]) -> str:
    """Some units for a person, in order: ``unit 3``, ``units 1 to 5`` or ``units 5, 17``."""
    if len(units) == 1:
        return f"unit {units[0]}"
    in_a_row = units[-1] - units[0] == len(units) - 1
    return f"units {units[0]} to {units[-1]}" if in_a_row else f"units {', '.join(map(str, units))}"


@dataclass(slots=True)
class FoundTable:
    """What one function reads of a unit.

    Attributes:
        unit: its address.
        function: 3 or 4.
        begin: first register that is asked for.
        last: last one that was asked for; None if there was no time for any.
        complete: whether all were asked for.
        first: registers by address, as they were read first.
        again: the same, each time that they were read again.
        refused: exception codes but illegal address, by the first address of a request.
        silent: first addresses of requests that stayed without reply.
        longest: registers of the longest request that was answered.
        too_long: registers of the shortest request that was refused for its length; None if none was.
    """

    unit: int
    function: int
    begin: int = 0
    last: int | None = None
    complete: bool = False
    first: dict[int, int] = field(default_factory=dict)
    again: list[dict[int, int]] = field(default_factory=list)
    refused: dict[int, int] = field(default_factory=dict)
    silent: list[int] = field(default_factory=list)
    longest: int = 0
    too_long: int | None = None
    _refuses_addresses: bool = False

    def answered(self, count: int) -> None:
        """Note that a request of so many registers was answered."""
        self.longest = max(self.longest, count)
        if self.too_long is not None and count >= self.too_long:
            self._not_for_its_length()

    def refused_value(self, count: int) -> None:
        """Note that a request of so many registers was refused as an illegal value."""
        if count == 1 or count <= self.longest:
            self._not_for_its_length()
        elif not self._refuses_addresses:
            self.too_long = min(count, self.too_long or count)

    def _not_for_its_length(self) -> None:
        """This unit refuses registers so that it does not have."""
        self._refuses_addresses, self.too_long = True, None

    @property
    def max_count(self) -> int | None:
        """How many registers the unit answers at once; None if it has refused no request for its length."""
        return self.longest if self.too_long is not None and self.longest else None

    @property
    def name(self) -> str:
        """Of the table, for a person."""
        return f"unit {self.unit}, {TABLES[self.function]} registers (function {self.function})"

    @property
    def rounds(self) -> list[dict[int, int]]:
        """Registers by address, as they were read first, again, and so on."""
        return [self.first, *self.again]

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
        return {
            address
            for again in self.again
            for address, value in again.items()
            if value != self.first.get(address)
        }


@dataclass(slots=True)
class Scan:
    """Asks units for registers.

    Args:
        bus: its table in a machine file.
        clock: of the client.
        stop: set when the person has seen enough.
        pause_s: silence between two requests.
        tell: reports its progress now and then.

    Attributes:
        requests: how many were made.
        first_unit: the first unit that is asked.
        to_ask: all of them.
        asked: the last one that was; None if none was.
        searched: whether all were asked, or the answers show that the others need not be.
        units: those that answered, in order, without those that are left out.
        gateway: addresses of which a gateway reported that no unit is behind them.
        alike: whether every address answered alike, so that only the first is taken for a unit.
        left_out: addresses that answered like most, where every one answered, and few answered differently.
        exception: the one that those gave; None if there are none.
        tables: what was read.
        lost: why the line was lost; empty if it was not.
        counters: of the line.
    """

    bus: ModbusBus
    clock: Clock
    stop: threading.Event
    pause_s: float
    tell: Callable[[str], None]
    requests: int = 0
    first_unit: int = 0
    to_ask: Sequence[int] = ()
    asked: int | None = None
    searched: bool = False
    units: list[int] = field(default_factory=list)
    gateway: list[int] = field(default_factory=list)
    alike: bool = False
    left_out: list[int] = field(default_factory=list)
    exception: int | None = None
    tables: list[FoundTable] = field(default_factory=list)
    lost: str = ""
    counters: ModbusCounters = field(default_factory=ModbusCounters)
    _client: ModbusClient | None = None
    _reported_ns: int = 0
    _begun_ns: int = 0
    """When the first register of a table was asked for."""
    _end: int = 0
    """The last register of it that is asked for."""

    def longest_s(self, units: int) -> float:
        """Time to ask so many units that do not answer."""
        quiet_s = QUIET_S if isinstance(self.bus, ModbusRtuBus) else 0.0
        return units * (self.pause_s + self.bus.timeout_ms / 1000 + quiet_s)

    async def run(
        self,
        units: Sequence[int],
        functions: Sequence[int],
        begin: int,
        end: int,
        *,
        until_found: bool = False,
        read_on: bool = False,
        seconds: float | None = None,
    ) -> None:
        """Find units, read their registers, and read those that are there again and again.

        Args:
            units: addresses to try.
            functions: 3, 4 or both.
            begin: first register.
            end: last one.
            until_found: whether no further function is tried on a unit that has registers that move.
            read_on: whether registers behind the last one are read, too, if that one is there.
            seconds: for which they are read again and again; None for a few times.

        Raises:
            LineLostError: the line cannot be opened.
        """
        self._reported_ns = self.clock.monotonic_ns()
        most = min(end + READ_ON, LAST_REGISTER) if read_on else end
        await self._connect()
        try:
            await self._find(units, functions, begin)
            for unit in self.units:
                for function in functions:
                    table = FoundTable(unit, function, begin)
                    self.tables.append(table)
                    await self._read_table(table, end, most)
                    if until_found and (table.first or self.stop.is_set()):
                        break
            await self._read_again(self.tables, seconds)
            if until_found:
                await self._read_beside_still(functions, end, most, seconds)
            if seconds is None:
                await self._wait_for_moves()
        except LineLostError as error:
            self.lost = f"{error}"
        finally:
            await self._close()

    async def _find(self, units: Sequence[int], functions: Sequence[int], address: int) -> None:
        self.first_unit, self.to_ask = units[0], units
        answers: dict[int, bytes | int] = {}
        for tried, unit in enumerate(units, 1):
            if self.stop.is_set():
                return
            rest_s = math.ceil(self.longest_s(len(units) + 1 - tried))
            answered = ", ".join(map(str, self.units)) or "none"
            self._progress(f"asking unit {unit}, at most {rest_s} s to go; units that answer: {answered}")
            self.asked = unit
            answer = await self._answer(unit, functions[0], address)
            if isinstance(answer, int) and answer in GATEWAY_CODES:
                self.gateway.append(unit)
            elif answer is not None:
                self.units.append(unit)
                answers[unit] = answer
            if (
                tried == ALIKE
                and self._answer_all(tried)
                and await self._is_one(answers, functions[0], address)
            ):
                self.alike, self.units = True, self.units[:1]
                self.searched = True
                return
        self.searched = True
        if len(units) >= ALIKE and self._answer_all(len(units)):
            await self._leave_out(answers, functions, address)

    async def _answer(self, unit: int, function: int, address: int) -> bytes | int | None:
        """What a unit answers for one register: its value, or the code of an exception; None if nothing."""
        try:
            return await self._ask(unit, function, address, 1)
        except NoReplyError:
            return None
        except RequestRefusedError as error:
            return error.code

    def _answer_all(self, asked: int) -> bool:
        """Whether so many addresses all answered, as with a server that answers for any address."""
        return len(self.units) == asked and not isinstance(self.bus, ModbusRtuBus)

    async def _is_one(self, answers: Mapping[int, bytes | int], function: int, address: int) -> bool:
        """Whether values that were read in the name of several units are of one register, which may move."""
        first, *others = answers
        if any(isinstance(answer, int) for answer in answers.values()):
            return False
        for unit in others:
            if answers[unit] != answers[first]:
                before = await self._answer(first, function, address)
                other = await self._answer(unit, function, address)
                after = await self._answer(first, function, address)
                if before == after != other:
                    return False
        return True

    async def _leave_out(
        self, answers: dict[int, bytes | int], functions: Sequence[int], address: int
    ) -> None:
        """Leave out the addresses that give the exception that most give; of all, keep the first.

        A server may answer so for a unit that it does not have.
        """
        for function in functions:
            if function != functions[0]:
                for unit in self.units:
                    if self.stop.is_set():
                        return
                    self._progress(f"asking unit {unit} by function {function}")
                    answers[unit] = await self._answer(unit, function, address) or b""
            common, times = Counter(answers.values()).most_common(1)[0]
            if not isinstance(common, int) or 2 * times <= len(answers):
                return
            if times < len(answers):
                self.exception = common
                self.left_out = [unit for unit in self.units if answers[unit] == common]
                self.units = [unit for unit in self.units if answers[unit] != common]
                return
        self.alike, self.units = True, self.units[:1]

    def _progress(self, words: str) -> None:
        now_ns = self.clock.monotonic_ns()
        if now_ns - self._reported_ns >= TELL_S * NS_PER_S:
            self._reported_ns = now_ns
            self.tell(words)

    async def _read_table(self, table: FoundTable, end: int, most: int) -> None:
        """Registers to the last one, and on to the most as long as the last one is there."""
        at = table.begin
        self._begun_ns = self.clock.monotonic_ns()
        while at <= end:
            self._end = end
            count = min(BLOCK, end + 1 - at)
            await self._read(table, at, count)
            if self.stop.is_set():
                return
            at += count
            if at > end and end in table.first:
                end = min(end + BLOCK, most)
        table.complete = True
        await self._find_longest(table)

    async def _read(self, table: FoundTable, address: int, count: int) -> None:
        """Registers in a row; where one of them is not there, both halves by themselves."""
        if self.stop.is_set() or table.refused.get(address, 0) == ILLEGAL_FUNCTION:
            return
        if ILLEGAL_FUNCTION in table.refused.values():
            return
        if table.too_long is not None and count >= table.too_long:
            await self._read_halves(table, address, count)
            return
        try:
            self._progress(f"reading {table.name} from {address} on{self._rest(table, address)}")
            raw = await self._ask(table.unit, table.function, address, count)
            table.first.update(_registers(raw, address))
            table.answered(count)
        except NoReplyError:
            table.silent.append(address)
        except RequestRefusedError as error:
            if error.code == ILLEGAL_VALUE:
                table.refused_value(count)
            if error.code in {ILLEGAL_ADDRESS, ILLEGAL_VALUE} and count > 1:
                await self._read_halves(table, address, count)
                return
            if error.code != ILLEGAL_ADDRESS:
                table.refused[address] = error.code
        table.last = address + count - 1

    def _rest(self, table: FoundTable, address: int) -> str:
        """How long the rest of a table takes, if it takes as long as what has been read of it."""
        done = address - table.begin
        if not done:
            return ""
        spent_s = (self.clock.monotonic_ns() - self._begun_ns) / NS_PER_S
        return f", about {math.ceil(spent_s * (self._end + 1 - address) / done)} s to go"

    async def _read_halves(self, table: FoundTable, address: int, count: int) -> None:
        await self._read(table, address, count // 2)
        await self._read(table, address + count // 2, count - count // 2)

    async def _find_longest(self, table: FoundTable) -> None:
        """How many registers the unit answers at once, as far as it has so many in a row."""
        first, last = max(table.runs, key=lambda run: run[1] - run[0], default=(0, 0))
        while not self.stop.is_set() and table.too_long is not None and table.longest:
            most = min(table.too_long - 1, last - first + 1)
            if most <= table.longest:
                return
            count = (table.longest + 1 + most) // 2
            try:
                await self._ask(table.unit, table.function, first, count)
                table.answered(count)
            except RequestRefusedError as error:
                if error.code != ILLEGAL_VALUE:
                    return
                table.refused_value(count)
            except NoReplyError:
                return

    async def _read_beside_still(
        self, functions: Sequence[int], end: int, most: int, seconds: float | None
    ) -> None:
        """The next function of each unit whose registers all stand still: they may be only settings."""
        added: list[FoundTable] = []
        for still in [one for one in self.tables if one.complete and one.first and not one.moved]:
            for function in functions[functions.index(still.function) + 1 :]:
                if self.stop.is_set():
                    return
                added.append(FoundTable(still.unit, function, still.begin))
                self.tables.insert(self.tables.index(still) + 1, added[-1])
                await self._read_table(added[-1], end, most)
        await self._read_again(added, seconds)

    async def _wait_for_moves(self) -> None:
        """Read the registers of units that all stand still some more times: a value may change slowly."""
        for _ in range(ROUNDS - 1):
            moving = {table.unit for table in self.tables if table.moved}
            still = [table for table in self.tables if table.first and table.unit not in moving]
            if not still:
                return
            await self._pause(None)
            await self._read_rounds(still)

    async def _read_again(self, tables: Sequence[FoundTable], seconds: float | None) -> None:
        """What is there, so often that what moves is seen to, also if the device measures once a second."""
        if not any(table.first for table in tables):
            return
        rounds, pause_s = ROUNDS - 1, ROUND_S
        if seconds is not None:
            rounds = max(1, min(MOST_ROUNDS, math.ceil(seconds / ROUND_S) if ROUND_S else MOST_ROUNDS))
            pause_s = seconds / rounds
            self.tell(f"reading what is there again and again for {seconds:g} s; Ctrl-C ends it early")
        begin_s = self.clock.monotonic_ns() / NS_PER_S
        for number in range(1, rounds + 1):
            await self._pause(begin_s + number * pause_s if seconds else None)
            if self.stop.is_set():
                return
            await self._read_rounds(tables)
            if seconds and self.clock.monotonic_ns() / NS_PER_S >= begin_s + seconds:
                return

    async def _pause(self, until_s: float | None) -> None:
        """Before a round: as always, or until a time."""
        if until_s is None:
            if not self.stop.is_set():
                await asyncio.sleep(ROUND_S)
            return
        left_s = max(0.0, until_s - self.clock.monotonic_ns() / NS_PER_S)
        parts = max(1, math.ceil(left_s / STOP_S))
        for _ in range(parts):
            if self.stop.is_set():
                return
            await asyncio.sleep(left_s / parts)

    async def _read_rounds(self, tables: Sequence[FoundTable]) -> None:
        """Each of them once."""
        for table in tables:
            if self.stop.is_set():
                return
            table.again.append({})
            await self._read_round(table, table.again[-1])

    async def _read_round(self, table: FoundTable, again: dict[int, int]) -> None:
        most = table.max_count or BLOCK
        for first, last in table.runs:
            for at in range(first, last + 1, most):
                if self.stop.is_set():
                    return
                self._progress(f"reading {table.name} again")
                count = min(most, last + 1 - at)
                try:
                    raw = await self._ask(table.unit, table.function, at, count)
                except (NoReplyError, RequestRefusedError):
                    continue
                again.update(_registers(raw, at))

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
        self._client = ModbusClient(self.bus, self.clock, self.counters)
        await self._client.connect()

    async def _close(self) -> None:
        if self._client is not None:
            await self._client.close()
            self._client = None


def _registers(raw: bytes, address: int) -> dict[int, int]:
    return {address + k: int.from_bytes(raw[2 * k : 2 * k + 2], "big") for k in range(len(raw) // 2)}
