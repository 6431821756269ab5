"""The replay of recordings as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from daqsvc.settings.problems import AssemblyError
from drivers.plugin import DriverPlugin, units_of
from drivers.replay.checks import check_replay_buses, check_replayed
from drivers.replay.settings import ReplayBus, TableLayout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.base import BusPort, Driver
    from drivers.replay.files import ColumnLayout


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

    def stream_layout(self, machine: MachineFile, stream: str) -> ColumnLayout:
        """See `DriverPlugin.stream_layout`."""
        from drivers.replay.files import ColumnLayout  # noqa: PLC0415 - brings what reads recordings

        given = machine.streams[stream].layout
        if not isinstance(given, TableLayout):
            raise AssemblyError(f"{machine.path}: stream {stream!r} does not come from a table")
        return ColumnLayout(
            channels=given.channel_names,
            columns=tuple(column.column for column in given.columns),
            scale=np.array([column.scale for column in given.columns]),
            offset=np.array([column.offset for column in given.columns]),
        ).in_units(units_of(machine, stream))

    def options(self, machine: MachineFile, bus: ReplayBus) -> dict[str, Any]:
        """See `DriverPlugin.options`."""
        return {**bus.model_dump(), "file": machine.resolve(bus.file)}

    def build(self, bus: ReplayBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.replay.driver import ReplayDriver  # noqa: PLC0415 - brings python-can

        del bus
        return ReplayDriver(port)
