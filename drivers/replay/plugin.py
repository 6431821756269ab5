"""The replay of recordings as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from drivers.plugin import DriverPlugin, in_units
from drivers.replay.checks import check_replay_buses, check_replayed
from drivers.replay.settings import ReplayBus, TableLayout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.base import BusPort, Driver


class ReplayPlugin(DriverPlugin[ReplayBus]):
    """Recordings in place of a bus: CAN logs with the layouts of CAN frames, and tables of samples."""

    buses: ClassVar[tuple[type[Bus], ...]] = (ReplayBus,)
    layouts: ClassVar[tuple[type[Layout], ...]] = (TableLayout,)
    place = 4

    def checks(self, draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
        """See `BusTable.checks`."""
        del facts
        yield check_replay_buses(draft)

    def stream_checks(
        self, draft: MachineFile, stream: Stream, facts: Any, at: KeyPath
    ) -> Iterator[Iterator[Finding]]:
        """See `BusTable.stream_checks`."""
        del facts
        yield check_replayed(draft, stream, at)

    def stream_layout(self, machine: MachineFile, stream: str) -> Layout:
        """See `DriverPlugin.stream_layout`."""
        return in_units(machine.streams[stream].layout, machine, stream)

    def absolute(self, machine: MachineFile, bus: ReplayBus) -> ReplayBus:
        """See `DriverPlugin.absolute`."""
        return bus.model_copy(update={"file": machine.resolve(bus.file)})

    def build(self, bus: ReplayBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.replay.driver import ReplayDriver  # noqa: PLC0415 - brings python-can

        return ReplayDriver(bus, port)
