"""Why a unit refuses a request: it is asked for parts of it, once.

A unit refuses a request that is longer than it can answer, and one with a register that it does not have. Not
all units tell these two apart by their exception, so what they answer to smaller requests decides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from drivers.modbus.registers import RegisterRun, inseparable
from drivers.modbus.replies import NoReplyError, RequestRefusedError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from drivers.modbus.line import ModbusLine

ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3
REFUSALS_OF_REGISTERS = frozenset({ILLEGAL_ADDRESS, ILLEGAL_VALUE})
"""Exceptions of a unit that does not have these registers, or not that many at once."""


class RefusalSearch(NamedTuple):
    """Asks a unit for parts of a request that it refuses.

    Attributes:
        line: that the unit is on.
        unit: its address.
        function: that reads the registers.
        asked: takes what is asked for, as the line calls it.
    """

    line: ModbusLine
    unit: int
    function: int
    asked: set[str]

    async def refused_alone(self, channels: Mapping[str, RegisterRun]) -> tuple[dict[str, RegisterRun], bool]:
        """Which of the channels the unit refuses one by one, and whether all could be asked for."""
        refused: dict[str, RegisterRun] = {}
        for name, run in channels.items():
            try:
                code = await self._refusal(run)
            except NoReplyError:
                return refused, False
            if code in REFUSALS_OF_REGISTERS:
                refused[name] = run
        return refused, True

    async def longest(self, code: int, wanted: Iterable[RegisterRun]) -> int | None:
        """How many registers the unit answers at once, if it refuses a request for its length.

        It is asked for the first few of what is wanted. It refuses the next one with them, and not by itself.

        Args:
            code: the exception by which it refuses the whole request.
            wanted: what was to be read by that.

        Returns:
            None if its length is not the reason, or the unit has not answered.
        """
        parts = inseparable(wanted)
        ends = [run.end for run in parts]
        begin, answered, refused = parts[0].address, 1, len(parts)
        try:
            if len(parts) < 2 or await self._refusal(parts[0]) == code:
                return None
            if await self._refusal(RegisterRun(begin, ends[-1] - begin)) != code:
                return None  # it was for a moment only
            while refused - answered > 1:
                middle = (answered + refused) // 2
                if await self._refusal(RegisterRun(begin, ends[middle - 1] - begin)) == code:
                    refused = middle
                else:
                    answered = middle
            if await self._refusal(parts[answered]) == code:
                return None
        except NoReplyError:
            return None
        return ends[answered - 1] - begin

    async def _refusal(self, run: RegisterRun) -> int | None:
        """The exception by which the unit refuses these registers; None if it does not.

        Raises:
            NoReplyError: there is no reply.
        """
        self.asked.add(run.in_words)
        try:
            await self.line.poll(self.unit, self.function, run, run.in_words)
        except RequestRefusedError as error:
            return error.code
        return None
