"""What plugins bring to the machine file: checks of their tables, and words for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar, cast

from daqsvc.errors.buses import WRONG_LAYOUT
from daqsvc.settings import registry
from daqsvc.settings.buses import UnknownBus
from daqsvc.settings.hooks import contract
from daqsvc.settings.packing import PackedLayout, counted, packed_room, valid_raw
from daqsvc.settings.problems import Finding
from daqsvc.settings.registry import DetectorKind, DriverKind, OutputKind
from daqsvc.settings.section import Section

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.pipeline import Pipeline
    from daqsvc.settings.problems import KeyPath

SettingsT = TypeVar("SettingsT", bound=Section)


@contract
class PipelineTable(DetectorKind[SettingsT]):
    """What a detector states of its table in ``[pipeline]``; `daqsvc.diagnosis.plugin` adds the detector."""

    def checks(self, draft: MachineFile, settings: SettingsT) -> Iterator[Iterator[Finding]]:
        """Every check of what the table reports, and of what it asks of other tables.

        Args:
            draft: the machine file, or what is valid of it.
            settings: the table, or what is valid of it.
        """
        del draft, settings
        return iter(())

    def alarm_checks(self, settings: SettingsT, at: KeyPath) -> Iterator[Finding]:
        """Whether an alarm that follows the detector can be raised.

        Args:
            settings: the table, or what is valid of it.
            at: where the alarm is in the file.
        """
        del settings, at
        return iter(())

    def start_up_signals(self, draft: MachineFile, settings: SettingsT) -> Mapping[str, tuple[str, ...]]:
        """By detector, the statistics that it goes on stating while the speed of the machine changes."""
        del draft, settings
        return {}

    def describe(self, machine: MachineFile, settings: SettingsT) -> str:
        """What was understood of the table, for a person."""
        del machine
        return ", ".join(f"{key} {value}" for key, value in settings)


@contract
class OutputTable(OutputKind[SettingsT]):
    """What an output states of its table; `daqsvc.publish.plugin` adds the output.

    Attributes:
        label: what `daqsvc check` writes before its words; an output below another adds its words to those.
        absent: these words where the file has no such table; empty for none.
    """

    label: ClassVar[str] = ""
    absent: ClassVar[str] = ""

    def checks(self, draft: MachineFile, settings: SettingsT) -> Iterator[Iterator[Finding]]:
        """Every check of what the table reports, and of what it asks of other tables.

        Args:
            draft: the machine file, or what is valid of it.
            settings: the table, or what is valid of it.
        """
        del draft, settings
        return iter(())

    def several_checks(self, settings: SettingsT) -> Iterator[Finding]:
        """Every check of what the table states where one process watches several machines."""
        del settings
        return iter(())

    def describe(self, machine: MachineFile, settings: SettingsT) -> str:
        """What was understood of the table, for a person; empty for nothing."""
        del machine
        return ", ".join(f"{key} {value}" for key, value in settings)


class StreamWords(NamedTuple):
    """What `daqsvc check` shows of a stream beside name, bus and rate; each may be empty.

    Attributes:
        frame_id: what the stream is known by on its bus.
        frames: how many frames come in a second.
        frame: what is in one.
        counter: how loss is counted.
        share: of the bus's time that it takes.
        channels: rows of a table of its channels, the first of which names the columns.
    """

    frame_id: str = ""
    frames: str = ""
    frame: str = ""
    counter: str = ""
    share: str = ""
    channels: tuple[tuple[str, ...], ...] = ()


@contract
class BusTable(DriverKind):
    """What a driver states of its buses and layouts; `drivers.plugin` adds the driver."""

    def checks(self, draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
        """Every check of the driver's buses and layouts as a whole.

        Args:
            draft: the machine file, or what is valid of it; a value that is not valid cannot be asked for.
            facts: by stream, what was read from the files that its layout names.
        """
        del draft, facts
        return iter(())

    def stream_checks(
        self, draft: MachineFile, stream: Stream, facts: Any, at: KeyPath
    ) -> Iterator[Iterator[Finding]]:
        """Every check of one stream that comes over the driver's bus, or has a layout of its kind.

        Args:
            draft: the machine file, or what is valid of it.
            stream: the stream, or what is valid of it.
            facts: what was read from the files that its layout names; None if nothing is known.
            at: where the stream is in the file.
        """
        del facts
        yield self._fits(draft, stream, at)
        if isinstance(stream.layout, PackedLayout):
            yield packed_room(stream.layout, (*at, "layout"))
            yield valid_raw(stream.layout.channels, (*at, "layout", "channels"))
            yield counted(stream.layout, (*at, "layout"))

    def _fits(self, draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
        """The driver's bus carries its own layouts, and its layouts come over its own bus."""
        bus, layout = draft.buses.get(stream.bus), stream.layout
        if isinstance(bus, UnknownBus):
            return  # its driver is the finding
        if bus is not None and isinstance(bus, self.buses) != isinstance(layout, self.layouts):
            remedy = "correct bus, or describe what comes over it; docs/ has a page for each bus"
            yield Finding(
                (*at, "layout"),
                f'is {layout.kind}, and bus "{stream.bus}" is {bus.kind}',
                remedy,
                code=WRONG_LAYOUT,
            )

    def describe_bus(self, machine: MachineFile, name: str) -> str:
        """What was understood of a bus, for a person."""
        return machine.buses[name].summary

    def describe_stream(self, machine: MachineFile, name: str) -> StreamWords:
        """What was understood of a stream, for a person."""
        return StreamWords(frame=machine.streams[name].layout.summary)


def bus_tables() -> Mapping[str, BusTable]:
    """See `registry.bus_tables`."""
    return cast("Mapping[str, BusTable]", registry.bus_tables())


def driver_of_layout(layout: Layout) -> BusTable | None:
    """See `registry.driver_of_layout`."""
    return cast("BusTable | None", registry.driver_of_layout(layout))


def detector_tables() -> Mapping[str, PipelineTable[Any]]:
    """See `registry.detector_tables`."""
    return cast("Mapping[str, PipelineTable[Any]]", registry.detector_tables())


def configured(
    pipeline: Pipeline, *, valid_only: bool = False
) -> Iterator[tuple[str, PipelineTable[Any], Any]]:
    """See `registry.configured`."""
    tables = registry.configured(pipeline, valid_only=valid_only)
    return cast("Iterator[tuple[str, PipelineTable[Any], Any]]", tables)


def output_tables() -> Mapping[str, OutputTable[Any]]:
    """See `registry.output_tables`."""
    return cast("Mapping[str, OutputTable[Any]]", registry.output_tables())


def configured_outputs(
    root: Section, *, valid_only: bool = False
) -> Iterator[tuple[str, OutputTable[Any], Any]]:
    """See `registry.configured_outputs`."""
    tables = registry.configured_outputs(root, valid_only=valid_only)
    return cast("Iterator[tuple[str, OutputTable[Any], Any]]", tables)
