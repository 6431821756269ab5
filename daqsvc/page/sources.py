"""What the page asks of its source of machines: a service, or snapshots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterable
    from contextlib import AbstractAsyncContextManager, AbstractContextManager

    from daqsvc.alarms.commands import AlarmCommand, CommandOutcome
    from daqsvc.page.box_snapshots import KeptSnapshot
    from daqsvc.page.machine_live import MachineLive


class NotToldError(OSError):
    """What is asked for is not to be had here; the text, for a person, states why."""


class Heard(Protocol):
    """One machine that is listened to."""

    @property
    def live(self) -> MachineLive | None:
        """What was received; None before the first message."""
        ...

    @property
    def why_not(self) -> str:
        """Why nothing is received at present; empty if something is."""
        ...

    @property
    def heard_s(self) -> float:
        """When something was heard last, by `time.monotonic`."""
        ...

    async def first(self, timeout_s: float) -> MachineLive | None:
        """The machine, as soon as something was received about it; None if nothing is in time."""
        ...

    def wanting(self, streams: Iterable[str]) -> AbstractContextManager[None]:
        """Have the samples of streams come meanwhile."""
        ...


class MachineSource(Protocol):
    """Machines that can be shown."""

    async def statuses(self) -> list[dict[str, Any]]:
        """The state of each machine: the names and alarms of `daqsvc.publish.service_status`.

        Raises:
            OSError, ValueError: there is no answer.
        """
        ...

    def looking(self, machine: str) -> AbstractAsyncContextManager[Heard]:
        """Listen to a machine meanwhile, together with all others who look at it.

        Raises:
            KeyError: there is none of that name, where that is known.
        """
        ...

    async def journal(self, machine: str, alarm: str, most: int) -> list[dict[str, Any]]:
        """What has happened to the alarms of a machine, or to one of them: alarm events, newest first.

        Args:
            machine: its name.
            alarm: its name; empty for all.
            most: no more than so many.

        Raises:
            OSError: that cannot be read here.
        """
        ...

    async def snapshots(self, machine: str) -> list[KeptSnapshot]:
        """The recorder's snapshots of a machine that can be shown, by their names, the newest first.

        Raises:
            OSError: they cannot be read here.
        """
        ...

    async def handle(self, machine: str, command: AlarmCommand, denied: str, via: str) -> CommandOutcome:
        """Have a person's command carried out, and written down in the audit log of who does that.

        Args:
            machine: its name.
            command: what is asked.
            denied: why the page has found that the person may not: it is logged, and refused.
            via: over what the person has asked, for the audit log.
        """
        ...

    async def close(self) -> None:
        """Listen to none any more."""
        ...
