"""What the page asks of whatever tells it of machines: a service, or snapshots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable
    from contextlib import AbstractAsyncContextManager, AbstractContextManager

    from daqsvc.page.machine_live import MachineLive


class Heard(Protocol):
    """One machine that is listened to."""

    @property
    def live(self) -> MachineLive | None:
        """What was told; None before anything was."""
        ...

    @property
    def why_not(self) -> str:
        """Why nothing is told by now; empty if something is."""
        ...

    @property
    def heard_s(self) -> float:
        """When something was heard last, by `time.monotonic`."""
        ...

    async def first(self, timeout_s: float) -> MachineLive | None:
        """The machine, as soon as something was told of it; None if nothing is in time."""
        ...

    def wanting(self, streams: Iterable[str]) -> AbstractContextManager[None]:
        """Have the samples of streams come meanwhile."""
        ...


class MachineSource(Protocol):
    """Machines that can be looked at."""

    async def statuses(self) -> list[dict[str, Any]]:
        """How each machine stands: the names and alarms of `daqsvc.publish.service_status`.

        Raises:
            OSError, ValueError: nobody answers.
        """
        ...

    def looking(self, machine: str) -> AbstractAsyncContextManager[Heard]:
        """Listen to a machine meanwhile, together with all others who look at it.

        Raises:
            KeyError: there is none of that name, where that is known.
        """
        ...

    async def close(self) -> None:
        """Listen to none any more."""
        ...
