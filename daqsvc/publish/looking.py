"""What the service gives to a viewer of live data."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection


class Looking(NamedTuple):
    """One viewer.

    Attributes:
        lines: waits for the next lines of JSON; empty at the end.
        leave: ends the feed.
    """

    lines: Callable[[], Awaitable[bytes]]
    leave: Callable[[], None]


class Look(Protocol):
    """See `daqsvc.service.Service.look`."""

    def __call__(
        self, machine: str | None, streams: Collection[str], *, before_bytes: int | None = None
    ) -> Looking | tuple[str, ...]:
        """Begin a feed; the names of all machines if there is no such machine.

        Args:
            machine: its name; None for the only one.
            streams: streams and grids whose samples are wanted.
            before_bytes: the most that is sent at first of earlier samples, to a viewer elsewhere; None for a
                process on this box.
        """
        ...
