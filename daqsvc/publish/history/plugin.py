"""History as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.publish.history.settings import History
from daqsvc.publish.plugin import OutputPlugin

if TYPE_CHECKING:
    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.settings.models import MachineFile


class HistoryPlugin(OutputPlugin[History]):
    """Trends and alarm events of months, on the box."""

    settings = History
    about = "trends and alarm events of months, on the box; none are kept if absent"
    place = 5
    label = "history"
    status_key = "history"

    def describe(self, machine: MachineFile, settings: History) -> str:
        """See `OutputTable.describe`."""
        del machine
        return (
            f"seconds for {settings.seconds_keep_days:g} days, minutes for {settings.minutes_keep_days:g}, "
            f"hours for {settings.hours_keep_days:g}, {settings.max_mb} MB at most"
        )

    def build(self, machine: MachineFile, settings: History, port: OutputPort) -> Output:
        """See `OutputPlugin.build`."""
        from daqsvc.publish.history.output import HistoryOutput  # noqa: PLC0415 - brings SQLite

        reserve_mb = 64 if machine.store is None else machine.store.reserve_mb
        return HistoryOutput(settings, port, reserve_mb=reserve_mb)
