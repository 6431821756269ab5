"""The replay of recordings as a plugin, and whether recordings and what is read of them fit together."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.errors.buses import NOT_PLAYABLE, WRONG_LAYOUT
from daqsvc.errors.machine_file import NO_EFFECT, WRONG_SCALE
from daqsvc.recording.formats import CAN_LOGS, named_as_can_log
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from drivers.can.settings import DbcLayout, PlainLayout
from drivers.plugin import DriverPlugin, in_units
from drivers.replay.settings import TABLES, ReplayBus, TableLayout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import KeyPath
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


_DATA_BASES = frozenset({".db", ".sqlite", ".sqlite3"})


def check_replay_buses(draft: MachineFile) -> Iterator[Finding]:
    """The file can be played, while it is being written too, and has the channel that is asked for."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if not isinstance(bus, ReplayBus):
                continue
            file = draft.resolve(bus.file)
            if file.exists() and not file.is_file():
                what = "a folder" if file.is_dir() else "a pipe or a device"
                yield Finding(
                    ("buses", name, "file"), f"is no file but {what}", "name a file", code=NOT_PLAYABLE
                )
            else:
                yield from _check_format(bus, ("buses", name))
            if bus.at_end == "wait" and bus.file.suffix.lower() != ".log":
                yield Finding(
                    ("buses", name, "at_end"),
                    f"{bus.file.name} cannot be read while it is written: only a candump log (.log) can",
                    'write at_end = "stop" or "loop", or have a candump log written',
                    code=NOT_PLAYABLE,
                )


def _check_format(bus: ReplayBus, at: KeyPath) -> Iterator[Finding]:
    if bus.file.suffix.lower() in _DATA_BASES:
        yield Finding(
            (*at, "file"),
            "is a data base, which cannot be played",
            f"make a BLF of it: can_logconvert {bus.file.name} {bus.file.stem}.blf",
            code=NOT_PLAYABLE,
        )
    elif not (bus.is_table or named_as_can_log(bus.file)) and (remedy := _unknown_format(bus.file)):
        yield Finding(
            (*at, "file"),
            "has an ending that no reader is known for, so that it cannot be played",
            remedy,
            code=NOT_PLAYABLE,
        )
    if bus.is_table and bus.channel is not None:
        yield Finding(
            (*at, "channel"),
            f"means nothing to a table of samples, which {bus.file.name} is",
            "remove it; the columns are named in the layouts of the streams",
            code=NO_EFFECT,
        )


def _unknown_format(file: Path) -> str:
    """What to do about a file that is neither a table nor a CAN log; empty if python-can reads it."""
    from can.io import MESSAGE_READERS  # noqa: PLC0415 - only for files of odd names

    name = file.with_suffix("") if file.suffix.lower() == ".gz" else file
    suffix = name.suffix.lower()
    if suffix in MESSAGE_READERS and suffix not in _DATA_BASES:
        return ""
    return f"give a CAN log ({', '.join(CAN_LOGS)}; .gz behind it if zipped) or a table ({TABLES})"


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
                code=WRONG_LAYOUT,
            )
        for index, column in enumerate(layout.columns):
            if column.scale == 0:
                yield Finding(
                    (*at, "layout", "columns", index, "scale"),
                    "would make every sample the same",
                    "write what the value 1 is worth, e.g. 0.001",
                    code=WRONG_SCALE,
                )
    elif table or (isinstance(bus, ReplayBus) and not isinstance(layout, PlainLayout | DbcLayout)):
        wanted = "columns of a table" if table else "CAN frames"
        yield Finding(
            (*at, "layout"),
            f'bus "{stream.bus}" replays {wanted}, and this describes something else',
            "write columns = [{ name = ..., column = ... }]" if table else "describe the frames of the log",
            code=WRONG_LAYOUT,
        )
