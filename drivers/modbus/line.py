"""One Modbus line and its units: one request at a time, quiet after a failure, silent units set aside.

A reply on a serial line carries no number that tells which request it answers. One that comes after its
request was given up would be taken for the reply to the next request, so after every failure the line is
kept quiet, and whatever arrives meanwhile is thrown away and counted. The same goes for a line that has just
been opened: whoever had it before may have asked for what is still to come.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from drivers.modbus.outcomes import LineLostError, NoReplyError, RequestRefusedError
from drivers.modbus.replies import GATEWAY_CODES, READ_FIFO, WRITE_REGISTERS
from drivers.modbus.silence import Enquiry, UnitSilence

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.client import ModbusClient
    from drivers.modbus.outcomes import ModbusCounters
    from drivers.modbus.registers import RegisterRun
    from drivers.modbus.silence import RetryPolicy, Silence, SparingByEnquiry

LONGEST_BABBLE = 4
"""Quiet times for which a line that does not fall silent is waited for, before it is used all the same."""

COURTESY_NS = 2_000_000
"""How long a request that may stay without reply stands back: no event loop wakes up to the millisecond."""

MOST_WRITTEN = 123
"""Registers that a request can write (Modbus Application Protocol 1.1b3, 6.12)."""

MOST_VALUE = 0xFFFF

Result = TypeVar("Result")


class WriteRefusedError(PermissionError):
    """The machine file does not allow to write these registers."""


@dataclass(frozen=True, slots=True)
class WritableRun:
    """Holding registers of a unit that may be written."""

    unit: int
    run: RegisterRun


class RegisterValues(NamedTuple):
    """Registers, and when they were read.

    Attributes:
        registers: high byte of each first.
        asked_ns: when the request went out, host monotonic.
        answered_ns: when its reply was there.
    """

    registers: bytes
    asked_ns: int
    answered_ns: int


class ModbusLine:
    """An open line. It is lost when its connection is, or when no unit of it answers any more.

    Args:
        client: the connection; it has just been opened.
        clock: the service's clock.
        counters: of the bus.
        patience: see there.
        units: the units that are asked.
        writable: what may be written; nothing else ever is.
        heard: called when a unit has answered.
        sparing: what has been said of its units, also while it was open before.
    """

    def __init__(
        self,
        client: ModbusClient,
        clock: Clock,
        counters: ModbusCounters,
        patience: RetryPolicy,
        *,
        units: Sequence[int],
        writable: Sequence[WritableRun] = (),
        heard: Callable[[], None] = lambda: None,
        sparing: SparingByEnquiry | None = None,
    ) -> None:
        self.lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._client = client
        self._clock = clock
        self._counters = counters
        self._patience = patience
        self._sparing: SparingByEnquiry = {} if sparing is None else sparing
        self._units = {unit: UnitSilence(unit, patience, counters, self._sparing) for unit in units}
        self._writable = writable
        self._heard = heard
        self._lock = asyncio.Lock()
        self._quiet_until_ns = clock.monotonic_ns() + patience.opening_ns
        self._failed = False
        self._due_ns: dict[object, int] = {}

    def expect(self, who: object, due_ns: int) -> None:
        """Know when somebody will next ask: what may stay without reply is put between such times."""
        self._due_ns[who] = due_ns

    async def poll(self, unit: int, function: int, run: RegisterRun, what: str = "") -> RegisterValues:
        """Read registers, and tell when that was; see `read`."""
        enquiry = Enquiry(function, what)
        return RegisterValues(
            *await self._ask(unit, enquiry, lambda: self._client.read(unit, function, run.address, run.count))
        )

    async def read(self, unit: int, function: int, run: RegisterRun, what: str = "") -> bytes:
        """Read registers; see `ModbusClient.read` for what is returned and raised.

        Args:
            unit: address of the unit.
            function: see `ModbusClient.read`.
            run: the registers.
            what: what is read, in words. Requests of one function for the same are set aside together, if
                they stay without reply while the unit answers others.

        Raises:
            UnitSetAsideError: there was no reply before, and it is not yet time to ask again.
        """
        return (await self.poll(unit, function, run, what)).registers

    async def read_fifo(self, unit: int, address: int, what: str = "") -> bytes:
        """Read a FIFO queue; see `read`."""
        enquiry = Enquiry(READ_FIFO, what)
        registers, _, _ = await self._ask(unit, enquiry, lambda: self._client.read_fifo(unit, address))
        return registers

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers that the machine file allows to write; see `read`.

        Raises:
            ValueError: registers cannot hold these values, or a request so many; nothing has been sent.
            WriteRefusedError: the machine file does not allow it; nothing has been sent.
        """
        _check_values(values)
        if not may_write(self._writable, unit, address, len(values)):
            raise WriteRefusedError(
                f"registers {address} to {address + len(values) - 1} of unit {unit} must not be written; add "
                f"{{ unit = {unit}, address = {address}, count = {len(values)} }} to writes of the bus if "
                "they may"
            )
        await self._ask(unit, Enquiry(WRITE_REGISTERS), lambda: self._client.write(unit, address, values))

    async def _ask(
        self, unit: int, enquiry: Enquiry, request: Callable[[], Awaitable[Result]]
    ) -> tuple[Result, int, int]:
        """Make a request as soon as it may be; returns its result, when it went out and when it ended."""
        asked = self._units.get(unit)
        if asked is None:
            asked = self._units[unit] = UnitSilence(unit, self._patience, self._counters, self._sparing)
        silence = asked.of(enquiry)
        if asked.doubts(silence):
            asked.check(silence, self._clock.monotonic_ns())
            await self._let_others_go_first()
        async with self._lock:
            asked_ns = self._clock.monotonic_ns()
            if self._quiet_until() > asked_ns:
                await self._keep_quiet()
                asked_ns = self._clock.monotonic_ns()
            if asked.doubts(silence):
                asked.check(silence, asked_ns)
                self._counters.probes += asked.probes(silence)
            self._failed = True  # until a reply is there: also if this task is cancelled meanwhile
            ended_ns = 0
            try:
                result = await request()
            except LineLostError as error:
                self._lose(f"{error}")
                raise
            except NoReplyError as error:
                self._miss(asked, silence, f"{error}")
                raise
            except RequestRefusedError as error:
                self._failed = False
                if error.code in GATEWAY_CODES:
                    self._miss(asked, silence, f"{error}")
                else:
                    self._heard()
                    asked.answered(silence, refused=True)
                raise
            else:
                self._failed = False
                self._heard()
                asked.answered(silence)
                ended_ns = self._clock.monotonic_ns()
                return result, asked_ns, ended_ns
            finally:
                silence_ns = self._patience.quiet_ns if self._failed else self._patience.gap_ns
                self._quiet_until_ns = (ended_ns or self._clock.monotonic_ns()) + silence_ns

    async def _let_others_go_first(self) -> None:
        """Line up behind all that is due soon: what stays without reply holds the line for long.

        Neighbours that are polled as rarely as that lose nothing if it begins just after them.
        """
        hold_ns = self._patience.hold_ns
        begun_ns = self._clock.monotonic_ns()
        until_ns = begun_ns
        while until_ns - begun_ns < hold_ns:
            now_ns = self._clock.monotonic_ns()
            soon = [due_ns for due_ns in self._due_ns.values() if until_ns < due_ns < now_ns + hold_ns // 2]
            if not soon:
                break
            until_ns = max(soon)
            await self._clock.sleep_ns(until_ns - now_ns)
        await self._clock.sleep_ns(COURTESY_NS)
        async with self._lock:
            pass

    async def _keep_quiet(self) -> None:
        """Wait out the quiet time; a late reply makes it longer by a frame's gap."""
        longest_ns = self._quiet_until_ns + LONGEST_BABBLE * self._patience.quiet_ns
        while (left_ns := min(self._quiet_until(), longest_ns) - self._clock.monotonic_ns()) > 0:
            await self._clock.sleep_ns(left_ns)

    def _quiet_until(self) -> int:
        return max(self._quiet_until_ns, self._client.last_byte_ns + self._patience.gap_ns)

    def _miss(self, asked: UnitSilence, silence: Silence, why: str) -> None:
        asked.missed(silence, why, self._clock.monotonic_ns())
        if all(unit.dead for unit in self._units.values()):
            self._lose(f"no unit answers any more; the last: {why}")

    def _lose(self, why: str) -> None:
        if not self.lost.done():
            self.lost.set_result(why)


def _check_values(values: Sequence[int]) -> None:
    """Make sure that a request can write these.

    Raises:
        ValueError: it cannot.
    """
    if not 1 <= len(values) <= MOST_WRITTEN:
        raise ValueError(
            f"{len(values)} values to be written; a request writes 1 to {MOST_WRITTEN} registers"
        )
    for value in values:
        if not isinstance(value, Integral) or not 0 <= value <= MOST_VALUE:
            raise ValueError(
                f"value {value!r} to be written; a register holds whole numbers 0 to {MOST_VALUE}"
            )


def may_write(writable: Sequence[WritableRun], unit: int, address: int, count: int) -> bool:
    """Whether one entry of the allow-list holds all these registers."""
    return any(w.unit == unit and w.run.address <= address and address + count <= w.run.end for w in writable)
