"""From the columns in a machine file to what reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.settings.problems import AssemblyError
from drivers.plugin import units_of
from drivers.replay.files import ColumnLayout
from drivers.replay.settings import TableLayout

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def column_layout(machine: MachineFile, stream: str) -> ColumnLayout:
    """The columns of a stream, read straight in the physical units of its sensors.

    Raises:
        AssemblyError: the stream does not come from a table.
    """
    given = machine.streams[stream].layout
    if not isinstance(given, TableLayout):
        raise AssemblyError(f"{machine.path}: stream {stream!r} does not come from a table")
    return ColumnLayout(
        channels=given.channel_names,
        columns=tuple(column.column for column in given.columns),
        scale=np.array([column.scale for column in given.columns]),
        offset=np.array([column.offset for column in given.columns]),
    ).in_units(units_of(machine, stream))
