"""Messages into a journal without the thread that does so in service."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from daqsvc.outbox.journal import Journal
    from daqsvc.outbox.messages import Draft


def commit(
    journal: Journal, drafts: Iterable[Draft], sent: Iterable[int]
) -> tuple[list[int | Exception], int]:
    """Write drafts and mark others as sent.

    Returns:
        For each draft its number, or what its payload function raised; and how many were newly marked.
    """
    outcomes = journal.number(drafts)
    journal.acknowledge(sent)
    marked = 0
    while journal.has_unwritten:
        marked += journal.write(10_000)[1]
    return [one if isinstance(one, Exception) else one.sequence for one in outcomes], marked
