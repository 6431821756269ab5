"""Addresses as manuals count them, from 30001 or 40001, in answers of ``daqsvc new``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.modbus.sniff import AUTO, registers_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from drivers.modbus.sniff import RegisterRange
    from drivers.questions import Answers


def manual_note(registers: RegisterRange) -> str:
    """That they are numbers of a manual, with the options that mean the same; empty if they are not."""
    if not registers.reason:
        return ""
    return f"{registers.reason}. Remedy: write --registers {registers.there} --table {registers.table}"


def doubt_of(address: int | None) -> tuple[str, str] | None:
    """See `Question.doubt`: it is counted as in manuals, from 30001 or 40001."""
    if address is None:
        return None
    from drivers.modbus.checks import manuals_first  # noqa: PLC0415 - brings the settings

    first = manuals_first(address)
    if first is None:
        return None
    meant = address - first
    reason = (
        f"{address} looks like a number of the manual, where registers begin at {first}: that is {meant} "
        f"here. Enter takes it; type {address} again if the device has such addresses"
    )
    return reason, f"{meant}"


_MEANT = "meant"
"""Key, beside the answers, of the tables that numbers of a manual mean: by question, register and table."""


def keep_meant(answers: Answers, key: str, there: Any, table: str) -> None:
    """Keep which table a number of the manual means, for when what it is on the line is taken."""
    answers[_MEANT] = {**answers.get(_MEANT, {}), key: (there, table)}


def table_meant(answers: Answers, key: str) -> str | None:
    """The table that an answer means as it was typed, with the number of a manual; None if it was not."""
    there, table = answers.get(_MEANT, {}).get(key, (None, None))
    return table if key in answers and answers[key] == there else None


def doubt_with_table(
    answers: Answers, key: str, address: int | None, *, fixed: bool = False
) -> tuple[str, str] | None:
    """See `doubt_of`; the number also means holding or input registers, and the stream reads one of them.

    Args:
        answers: so far; what is meant is kept there.
        key: of the question.
        address: the answer.
        fixed: whether registers before have the table already.
    """
    doubted = doubt_of(address)
    if doubted is None or address is None:
        return doubted
    reason, there = doubted
    table = _table_of(address)
    if table == answers["table"]:
        return doubted
    if fixed:
        other = f"they are {table} registers, and the channels before {answers['table']} registers"
        return f"{reason}. But {other}: a stream reads one table, make one for each", there
    keep_meant(answers, key, int(there), table)
    return f"{reason}. Enter also takes {table} registers for the table", there


def _table_of(address: int) -> str:
    """The table that a number of the manual is in."""
    return "input" if address < 40_001 else "holding"


def doubt_of_registers(answers: Answers, text: str) -> tuple[str, str] | None:
    """The same of the registers that --listen is to read."""
    registers = AUTO if text == AUTO else registers_of(text)
    if isinstance(registers, str) or not registers.reason:
        return None
    keep_meant(answers, "registers", registers.there, registers.table)
    again = f"Enter takes {registers.there}; type {text} again if the device has such addresses"
    return f"{registers.reason}. {again}", registers.there


def doubt_of_channel(
    doubt: Callable[[int], tuple[str, str] | None],
    taken: Mapping[int, str],
    free: str,
    to_read: range,
    address: int,
) -> tuple[str, str] | None:
    """The same of a channel's register, which may be that of another channel, too.

    Whoever has such registers read, or has given another channel such an address, means them.
    """
    if address not in taken:
        return None if address in to_read or any(map(doubt_of, taken)) else doubt(address)
    reason = (
        f'register {address} holds "{taken[address]}" already. Enter takes {free}; type {address} again '
        "if both are in it"
    )
    return reason, free
