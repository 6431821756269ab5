"""One Modbus line and its units: one request at a time, quiet after a failure, silent units set aside.

A reply on a serial line carries no number that tells which request it answers. One that comes after its
request was given up would be taken for the reply to the next request, so after every failure the line is
kept quiet, and whatever arrives meanwhile is thrown away and counted.
"""

from __future__ import annotations

import asyncio
import logging
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from daqsvc.acquisition.clock import NS_PER_S
from drivers.modbus_outcomes import LineLostError, NoReplyError, RefusedError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus_client import ModbusClient
    from drivers.modbus_outcomes import ModbusCounters
    from drivers.registers import Run

logger = logging.getLogger(__name__)

GATEWAY_CODES = frozenset({10, 11})
"""Exceptions by which a gateway says that the unit behind it is silent."""

LONGEST_BABBLE = 4
"""Quiet times for which a line that does not fall silent is waited for, before it is used all the same."""

Result = TypeVar("Result")


class UnitSetAsideError(NoReplyError):
    """The unit has been silent, and it is not yet time to ask it again."""


class WriteRefusedError(PermissionError):
    """The machine file does not allow to write these registers."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How long to bear with a line and its units.

    Attributes:
        quiet_ns: silence kept after a failed request on a serial line; at least the response time-out.
        gap_ns: silence between frames on a serial line.
        demote_after: requests without reply, in a row, after which a unit is set aside.
        demotion_ns: how long it is set aside, before one request probes whether it is back.
    """

    quiet_ns: int
    gap_ns: int
    demote_after: int = 3
    demotion_ns: int = 10 * NS_PER_S


@dataclass(frozen=True, slots=True)
class WritableRun:
    """Holding registers of a unit that may be written."""

    unit: int
    run: Run


@dataclass(slots=True)
class _Unit:
    """What is known about a unit: requests without reply in a row, and when to ask again."""

    failures: int = 0
    probe_ns: int | None = None


class ModbusLine:
    """An open line. It is lost when its connection is, or when no unit of it answers any more.

    Args:
        client: the connection; it is open.
        clock: the service's clock.
        counters: of the bus.
        patience: see there.
        units: the units that are asked.
        writable: what may be written; nothing else ever is.
        heard: called when a unit has answered.
    """

    def __init__(
        self,
        client: ModbusClient,
        clock: Clock,
        counters: ModbusCounters,
        patience: Patience,
        *,
        units: Sequence[int],
        writable: Sequence[WritableRun] = (),
        heard: Callable[[], None] = lambda: None,
    ) -> None:
        self.lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._client = client
        self._clock = clock
        self._counters = counters
        self._patience = patience
        self._units = {unit: _Unit() for unit in units}
        self._writable = writable
        self._heard = heard
        self._lock = asyncio.Lock()
        self._quiet_until_ns = 0
        self._failed = False
        self._last_words: dict[int, str] = defaultdict(str)

    async def read(self, unit: int, function: int, run: Run) -> bytes:
        """Read registers; see `ModbusClient.read` for what is returned and raised.

        Raises:
            UnitSetAsideError: the unit is silent, and it is not yet time to ask it again.
        """
        return await self._ask(unit, lambda: self._client.read(unit, function, run.address, run.count))

    async def read_fifo(self, unit: int, address: int) -> bytes:
        """Read a FIFO queue; see `read`."""
        return await self._ask(unit, lambda: self._client.read_fifo(unit, address))

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers that the machine file allows to write; see `read`.

        Raises:
            WriteRefusedError: it does not; nothing has been sent.
        """
        if not may_write(self._writable, unit, address, len(values)):
            raise WriteRefusedError(
                f"registers {address} to {address + len(values) - 1} of unit {unit} must not be written; add "
                f"{{ unit = {unit}, address = {address}, count = {len(values)} }} to writes of the bus if "
                "they may"
            )
        await self._ask(unit, lambda: self._client.write(unit, address, values))

    async def _ask(self, unit: int, request: Callable[[], Awaitable[Result]]) -> Result:
        async with self._lock:
            if self._quiet_left_ns() > 0:
                await self._keep_quiet()
            state = self._units.setdefault(unit, _Unit())
            if state.probe_ns is not None:
                if self._clock.monotonic_ns() < state.probe_ns:
                    raise UnitSetAsideError(f"unit {unit} is set aside: {self._last_words[unit]}")
                self._counters.probes += 1
            self._failed = True  # until a reply is there: also if this task is cancelled meanwhile
            try:
                result = await request()
            except LineLostError as error:
                self._lose(f"{error}")
                raise
            except NoReplyError as error:
                self._miss(unit, state, f"{error}")
                raise
            except RefusedError as error:
                self._failed = False
                if error.code in GATEWAY_CODES:
                    self._miss(unit, state, f"{error}")
                else:
                    self._answered(unit, state)
                raise
            else:
                self._failed = False
                self._answered(unit, state)
                return result
            finally:
                silence_ns = self._patience.quiet_ns if self._failed else self._patience.gap_ns
                self._quiet_until_ns = self._clock.monotonic_ns() + silence_ns

    async def _keep_quiet(self) -> None:
        """Wait out the quiet time; a late reply makes it longer by a frame's gap."""
        longest_ns = self._quiet_until_ns + LONGEST_BABBLE * self._patience.quiet_ns
        while (left_ns := min(self._quiet_left_ns(), longest_ns - self._clock.monotonic_ns())) > 0:
            await self._clock.sleep_ns(left_ns)

    def _quiet_left_ns(self) -> int:
        until_ns = max(self._quiet_until_ns, self._client.last_byte_ns + self._patience.gap_ns)
        return until_ns - self._clock.monotonic_ns()

    def _answered(self, unit: int, state: _Unit) -> None:
        self._heard()
        if state.probe_ns is not None:
            self._counters.units_back += 1
            logger.warning("unit %d is back", unit)
        state.failures, state.probe_ns = 0, None

    def _miss(self, unit: int, state: _Unit, why: str) -> None:
        state.failures += 1
        self._last_words[unit] = why
        if state.failures < self._patience.demote_after and state.probe_ns is None:
            return
        if state.probe_ns is None:
            self._counters.units_demoted += 1
            logger.warning(
                "%s; it is set aside and asked every %g s from now on",
                why,
                self._patience.demotion_ns / NS_PER_S,
            )
        state.probe_ns = self._clock.monotonic_ns() + self._patience.demotion_ns
        if all(other.probe_ns is not None for other in self._units.values()):
            self._lose(f"no unit answers any more; the last: {why}")

    def _lose(self, why: str) -> None:
        if not self.lost.done():
            self.lost.set_result(why)


def may_write(writable: Sequence[WritableRun], unit: int, address: int, count: int) -> bool:
    """Whether one entry of the allow-list holds all these registers."""
    return any(w.unit == unit and w.run.address <= address and address + count <= w.run.end for w in writable)
