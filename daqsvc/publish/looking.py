"""Looking on: what passes of a machine, told to one who looks for as long as they do."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection


class Looking(NamedTuple):
    """One who looks on.

    Attributes:
        lines: waits for what comes next, lines of JSON; nothing at the end.
        leave: ends it.
    """

    lines: Callable[[], Awaitable[bytes]]
    leave: Callable[[], None]


class Look(Protocol):
    """See `daqsvc.service.Service.look`."""

    def __call__(
        self, machine: str | None, streams: Collection[str], *, before_bytes: int | None = None
    ) -> Looking | tuple[str, ...]:
        """Begin to look on; the names of all machines if there is no such one.

        Args:
            machine: its name; None for the only one.
            streams: streams and grids whose samples are wanted.
            before_bytes: samples of before that are told at first, at most; None for what a process of this
                box takes.
        """
        ...
