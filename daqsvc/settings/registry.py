"""The plugins that tables of a machine file belong to, found by their entry points, once a process.

No driver and no detector is named in `daqsvc.settings`: what a machine file may say of them, they say.
The plugins are looked for when a file is read, not when the models are imported: they import these.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, NamedTuple, TypeVar

from pydantic import Field, create_model

from daqsvc.settings.buses import Bus, Layout, UnknownBus, UnknownLayout
from daqsvc.settings.packed_checks import counted, packed_room, valid_raw
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.pipeline import Pipeline
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import Kinds, Section, UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from importlib.metadata import EntryPoint
    from pathlib import Path

    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import KeyPath

DRIVERS = "daqsvc.drivers"
"""The group of entry points that drivers are registered in, by the name that ``driver = "..."`` gives."""
DETECTORS = "daqsvc.detectors"
"""The group of entry points that detectors are registered in, by the key of their table in ``[pipeline]``."""

SettingsT = TypeVar("SettingsT", bound=Section)


class PipelineTable(Generic[SettingsT]):
    """What a detector says of its table in ``[pipeline]``; `daqsvc.diagnosis.plugin` adds the detector.

    Attributes:
        settings: the table.
        about: what it is for, in a few words.
        detector: name of the detector that an alarm can follow; None if none can.
        states_speed: whether it always states the speed of the machine, also while that changes.
        measures_levels: whether it measures what alarms with setpoints watch.
        place: where its table stands among those of other detectors; the smallest first.
    """

    settings: type[SettingsT]
    about: ClassVar[str] = "a detector"
    detector: ClassVar[str | None] = None
    states_speed: ClassVar[bool] = False
    measures_levels: ClassVar[bool] = False
    place: ClassVar[int] = 100

    def sampled_together(self, given: SettingsT) -> tuple[str, ...]:
        """Sensors whose samples it takes together, wherever they come from; the reference's first.

        Where these lie in several streams, they are put on one grid: ``[pipeline.alignment]``.
        """
        del given
        return ()

    def checks(self, draft: MachineFile, given: SettingsT) -> Iterator[Iterator[Finding]]:
        """Every check of what the table says, and of what it asks of other tables.

        Args:
            draft: the machine file, or what is valid of it.
            given: the table, or what is valid of it.
        """
        del draft, given
        return iter(())

    def alarm_checks(self, given: SettingsT, at: KeyPath) -> Iterator[Finding]:
        """Whether an alarm that follows the detector can be raised.

        Args:
            given: the table, or what is valid of it.
            at: where the alarm stands in the file.
        """
        del given, at
        return iter(())

    def start_up_signals(self, draft: MachineFile, given: SettingsT) -> Mapping[str, tuple[str, ...]]:
        """By detector, the statistics that it goes on stating while the speed of the machine changes."""
        del draft, given
        return {}

    def describe(self, machine: MachineFile, given: SettingsT) -> str:
        """What was understood of the table, for a person."""
        del machine
        return ", ".join(f"{key} {value}" for key, value in given)


class StreamWords(NamedTuple):
    """What `daqsvc check` shows of a stream beside name, bus and rate; each may be empty.

    Attributes:
        frame_id: what the stream is known by on its bus.
        frames: how many frames come in a second.
        frame: what is in one.
        counter: how loss is told.
        share: of the bus's time that it takes.
    """

    frame_id: str = ""
    frames: str = ""
    frame: str = ""
    counter: str = ""
    share: str = ""


class BusTable:
    """What a driver brings to the machine file; `drivers.plugin` adds the driver.

    Attributes:
        buses: the kinds of its table in ``[buses]``.
        layouts: the kinds of layouts of the streams on it.
        self_checks: what the service can watch of such a bus, of ``"overrun"``, ``"controller"`` and
            ``"recording"``: each is an alarm of the service.
        place: where it stands among other drivers; the smallest first. The first one reads a bus that does
            not say its driver, and its first layout is that of a table which no other layout's mark is in.
    """

    buses: ClassVar[tuple[type[Bus], ...]]
    layouts: ClassVar[tuple[type[Layout], ...]] = ()
    self_checks: ClassVar[tuple[str, ...]] = ()
    place: ClassVar[int] = 100

    def bus_of(self, table: Mapping[str, Any]) -> type[Bus]:
        """The kind of bus that a table means."""
        del table
        return self.buses[0]

    def layout_of(self, table: Mapping[str, Any]) -> type[Layout] | None:
        """The kind of layout that a table means; None if it is none of this driver's."""
        return next((layout for layout in self.layouts if layout.mark in table), None)

    def read_files(self, layout: Layout, folder: Path, at: KeyPath) -> tuple[Any, list[Finding]]:
        """Read the files that a layout names.

        Args:
            layout: one of this driver's kinds.
            folder: where relative paths start.
            at: key path of the layout.

        Returns:
            What is known by them, for the methods below; None if nothing is. And what is wrong.
        """
        del layout, folder, at
        return None, []

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
            at: where the stream stands in the file.
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
        if bus is not None and isinstance(bus, self.buses) != isinstance(layout, self.layouts):
            remedy = "correct bus, or describe what comes over it; docs/drivers.md has the layouts"
            yield Finding((*at, "layout"), f'is {layout.kind}, and bus "{stream.bus}" is {bus.kind}', remedy)

    def describe_bus(self, machine: MachineFile, name: str) -> str:
        """What was understood of a bus, for a person."""
        return machine.buses[name].summary

    def describe_stream(self, machine: MachineFile, name: str) -> StreamWords:
        """What was understood of a stream, for a person."""
        return StreamWords(frame=machine.streams[name].layout.summary)


@dataclass(frozen=True, slots=True)
class _Installed:
    """What the entry points lead to.

    Attributes:
        tables: the plugins, by the key of their table, in the order of their place.
        broken: why one cannot be loaded, by key.
    """

    tables: Mapping[str, Any]
    broken: Mapping[str, str]


@cache
def _installed(group: str, what: str, contract: type[Any]) -> _Installed:
    found: dict[str, Any] = {}
    broken: dict[str, str] = {}
    for point in entry_points(group=group):
        try:
            found[point.name] = _made(point, contract)
        except Exception as error:  # noqa: BLE001  whatever a plugin does when it is imported
            broken[point.name] = f"the {what} cannot be loaded from {point.value}: {error}"
    ordered = sorted(found.items(), key=lambda item: (item[1].place, item[0]))
    return _Installed(MappingProxyType(dict(ordered)), MappingProxyType(broken))


def _made(point: EntryPoint, contract: type[Any]) -> Any:
    plugin = point.load()
    if not (isinstance(plugin, type) and issubclass(plugin, contract)):
        raise TypeError(f"it is no {contract.__name__}")
    return plugin()


def forget() -> None:
    """Look for plugins anew: for whoever installs one in a running process."""
    _installed.cache_clear()
    pipeline_model.cache_clear()


def detector_tables() -> Mapping[str, PipelineTable[Any]]:
    """The detectors that are installed, by the key of their table, in the order of their place."""
    return _installed(DETECTORS, "detector", PipelineTable).tables


def broken_detectors() -> Mapping[str, str]:
    """Why a detector that is installed cannot be loaded, by the key of its table."""
    return _installed(DETECTORS, "detector", PipelineTable).broken


def bus_tables() -> Mapping[str, BusTable]:
    """The drivers that are installed, by name, in the order of their place."""
    return _installed(DRIVERS, "driver", BusTable).tables


def broken_drivers() -> Mapping[str, str]:
    """Why a driver that is installed cannot be loaded, by name."""
    return _installed(DRIVERS, "driver", BusTable).broken


def driver_of_layout(layout: Layout) -> BusTable | None:
    """The first driver that brings this kind of layout."""
    return next((plugin for plugin in bus_tables().values() if type(layout) in plugin.layouts), None)


def _bus_kind(table: Mapping[str, Any]) -> type[Bus]:
    drivers = bus_tables()
    driver = table.get("driver")
    if isinstance(driver, str):
        return drivers[driver].bus_of(table) if driver in drivers else UnknownBus
    return next(iter(drivers.values())).bus_of(table) if drivers else UnknownBus


def _bus_kinds() -> tuple[type[Bus], ...]:
    return tuple(bus for plugin in bus_tables().values() for bus in plugin.buses)


def _layout_kind(table: Mapping[str, Any]) -> type[Layout]:
    # The first driver comes last: it takes what no mark is in.
    for plugin in reversed(tuple(bus_tables().values())):
        layout = plugin.layout_of(table)
        if layout is not None:
            return layout
    kinds = _layout_kinds()
    return kinds[0] if kinds else UnknownLayout


def _layout_kinds() -> tuple[type[Layout], ...]:
    return tuple(dict.fromkeys(kind for plugin in bus_tables().values() for kind in plugin.layouts))


BUSES: Final = Kinds(_bus_kind, _bus_kinds)
"""Annotation of a table in ``[buses]``."""
LAYOUTS: Final = Kinds(_layout_kind, _layout_kinds)
"""Annotation of the layout of a stream."""


@cache
def pipeline_model() -> type[Pipeline]:
    """The table ``[pipeline]`` with one for each detector that is installed."""
    fields: dict[str, Any] = {
        key: (plugin.settings | None, Field(default=None, description=plugin.about))
        for key, plugin in detector_tables().items()
    }
    return create_model("Pipeline", __base__=Pipeline, __doc__=Pipeline.__doc__, **fields)


def no_detectors() -> Pipeline:
    """What a file without the table means."""
    return pipeline_model()()


INSTALLED: Final = Kinds(lambda _table: pipeline_model(), lambda: (pipeline_model(),))
"""Annotation of the table ``[pipeline]``."""


def configured(
    pipeline: Pipeline, *, valid_only: bool = False
) -> Iterator[tuple[str, PipelineTable[Any], Any]]:
    """The detectors that a file has a table for: key, plugin and table, in order.

    Args:
        pipeline: the table ``[pipeline]``, or what is valid of it.
        valid_only: leave out a table that is no table at all.

    Raises:
        UnusableValueError: there is such a one.
    """
    for key, plugin in detector_tables().items():
        with suppress(*((UnusableValueError,) if valid_only else ())):
            given = getattr(pipeline, key)
            if given is not None:
                yield key, plugin, given
