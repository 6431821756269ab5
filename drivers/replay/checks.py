"""Whether recordings and what is to be read from them fit each other."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from drivers.can.settings import DbcLayout, PlainLayout
from drivers.replay.settings import TABLES, ReplayBus, TableLayout

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import KeyPath


_DATA_BASES = frozenset({".db", ".sqlite", ".sqlite3"})


def check_replay_buses(draft: MachineFile) -> Iterator[Finding]:
    """The file can be played, while it is being written too, and has the channel that is asked for."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if not isinstance(bus, ReplayBus):
                continue
            yield from _check_format(bus, ("buses", name))
            if bus.at_end == "wait" and bus.file.suffix.lower() != ".log":
                yield Finding(
                    ("buses", name, "at_end"),
                    f"{bus.file.name} cannot be read while it is written: only a candump log (.log) can",
                    'write at_end = "stop" or "loop", or have a candump log written',
                )


def _check_format(bus: ReplayBus, at: KeyPath) -> Iterator[Finding]:
    if bus.file.suffix.lower() in _DATA_BASES:
        yield Finding(
            (*at, "file"),
            "is a data base, which cannot be played",
            f"make a BLF of it: can_logconvert {bus.file.name} {bus.file.stem}.blf",
        )
    if bus.is_table and bus.channel is not None:
        yield Finding(
            (*at, "channel"),
            f"means nothing to a table of samples, which {bus.file.name} is",
            "remove it; the columns are named in the layouts of the streams",
        )


def check_replayed(draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
    """A table takes columns, a CAN log takes frames."""
    bus, layout = draft.buses.get(stream.bus), stream.layout
    table = isinstance(bus, ReplayBus) and bus.is_table
    if isinstance(layout, TableLayout):
        if bus is not None and not table:
            yield Finding(
                (*at, "layout", "columns"),
                f'bus "{stream.bus}" has no columns: only the replay of a table has ({TABLES})',
                "describe the frames of the bus, or correct the bus of the stream",
            )
        for index, column in enumerate(layout.columns):
            if column.scale == 0:
                yield Finding(
                    (*at, "layout", "columns", index, "scale"),
                    "would make every sample the same",
                    "write what the value 1 is worth, e.g. 0.001",
                )
    elif table or (isinstance(bus, ReplayBus) and not isinstance(layout, PlainLayout | DbcLayout)):
        wanted = "columns of a table" if table else "CAN frames"
        yield Finding(
            (*at, "layout"),
            f'bus "{stream.bus}" replays {wanted}, and this describes something else',
            "write columns = [{ name = ..., column = ... }]" if table else "describe the frames of the log",
        )
