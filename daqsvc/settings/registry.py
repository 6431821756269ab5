"""The plugins that tables of a machine file belong to, found by their entry points, once a process.

No driver, detector or output is named in `daqsvc.settings`: they define what a machine file states of them.
The plugins are looked for when a file is read, not when the models are imported: they import these.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping  # noqa: TC003 - attributes of contracts are looked at by it
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from pydantic import Field, create_model

from daqsvc.errors.code import coded
from daqsvc.errors.machine_file import PLUGIN_FAILED
from daqsvc.settings.buses import Bus, Layout, UnknownBus, UnknownLayout
from daqsvc.settings.failures import import_failure, packages
from daqsvc.settings.hooks import Hooks, PluginFailedError, brought_by, contract, see_declared
from daqsvc.settings.pipeline import Pipeline
from daqsvc.settings.schema import forget_homes
from daqsvc.settings.section import Kinds, Section, UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from importlib.metadata import EntryPoint
    from pathlib import Path

    from daqsvc.settings.failures import Failure
    from daqsvc.settings.problems import Finding, KeyPath

DRIVERS = "daqsvc.drivers"
"""The group of entry points that drivers are registered in, by the name that ``driver = "..."`` gives."""
DETECTORS = "daqsvc.detectors"
"""The group of entry points that detectors are registered in, by the key of their table in ``[pipeline]``."""
OUTPUTS = "daqsvc.outputs"
"""The group of entry points that outputs are registered in, by the path of their table."""

log = logging.getLogger(__name__)

_with_outputs: dict[type[Section], type[Any]] = {}
"""Each table with those of the outputs below it, once they are known."""

SettingsT = TypeVar("SettingsT", bound=Section)


@contract
class DetectorKind(Hooks, Generic[SettingsT]):
    """What a detector states of its table in ``[pipeline]`` to have it read; `PipelineTable` adds to it.

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
    place: ClassVar[float] = 100

    def sampled_together(self, settings: SettingsT) -> tuple[str, ...]:
        """Sensors whose samples it takes together, wherever they come from; the reference's first.

        Where these lie in several streams, they are put on one grid: ``[pipeline.alignment]``.
        """
        del settings
        return ()


@contract
class OutputKind(Hooks, Generic[SettingsT]):
    """What an output states of its table in the machine file to have it read; `OutputTable` adds to it.

    Attributes:
        settings: the table.
        about: what it is for, in a few words.
        place: where it stands among other outputs; the smallest first.
    """

    settings: type[SettingsT]
    about: ClassVar[str] = "an output"
    place: ClassVar[float] = 100


@contract
class DriverKind(Hooks):
    """What a driver states of its buses and layouts to have them read; `BusTable` adds to it.

    Attributes:
        buses: the kinds of its table in ``[buses]``.
        layouts: the kinds of layouts of the streams on it.
        self_checks: what the service can watch of such a bus, of ``"overrun"``, ``"controller"`` and
            ``"recording"``: each is an alarm of the service.
        place: where it stands among other drivers; the smallest first. The first one reads a bus that does
            not state its driver, and its first layout is that of a table which no other layout's mark is in.
    """

    buses: ClassVar[tuple[type[Bus], ...]]
    layouts: ClassVar[tuple[type[Layout], ...]] = ()
    self_checks: ClassVar[tuple[str, ...]] = ()
    place: ClassVar[float] = 100

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


@dataclass(frozen=True, slots=True)
class _Installed:
    """What the entry points lead to.

    Attributes:
        tables: the plugins, by the key of their table, in the order of their place.
        broken: why one cannot be loaded, by key.
    """

    tables: Mapping[str, Any]
    broken: Mapping[str, Failure]


@cache
def _installed(group: str, what: str, contract: type[Any]) -> _Installed:
    plugins: dict[str, Any] = {}
    broken: dict[str, Failure] = {}
    for point in entry_points(group=group):
        try:
            plugins[point.name] = _made(point, what, contract)
        except (Exception, SystemExit) as error:  # noqa: BLE001  whatever a plugin does when it is imported
            why = import_failure(error, point.module)
            message = f"the {what} cannot be loaded from {point.value}: {why.message}"
            broken[point.name] = why._replace(message=message)
    ordered = sorted(plugins.items(), key=lambda item: (item[1].place, item[0]))
    return _Installed(MappingProxyType(dict(ordered)), MappingProxyType(broken))


def _made(point: EntryPoint, what: str, contract: type[Any]) -> Any:
    home = "the package that brings it"
    package = home if point.dist is None else f"{point.dist.name} {point.dist.version}"
    packages.setdefault(point.module.partition(".")[0], package)
    plugin = point.load()
    if not (isinstance(plugin, type) and issubclass(plugin, contract)):
        raise TypeError(f"it is not derived from {what.title()}Plugin of daqsvc.api")
    for name in ("buses", "layouts", "self_checks"):  # whoever writes a list is understood
        if isinstance(listed := getattr(plugin, name, None), list):
            setattr(plugin, name, tuple(listed))
    needed = "buses" if contract is DriverKind else "settings"
    if getattr(plugin, needed, ()) in (None, ()):
        raise TypeError(f"{plugin.__qualname__} does not state its {needed}")
    see_declared(plugin)
    for table in (*getattr(plugin, "buses", ()), *getattr(plugin, "layouts", ())):
        see_declared(table)
    made = plugin()
    table = {DetectorKind: f"pipeline.{point.name}", OutputKind: point.name}.get(contract, "")
    brought_by(made, package, table)
    return made


def forget() -> None:
    """Look for plugins again: for whoever installs one in a running process."""
    _installed.cache_clear()
    pipeline_model.cache_clear()
    _with_outputs.clear()
    forget_homes()


def detector_tables() -> Mapping[str, DetectorKind[Any]]:
    """The detectors that are installed, by the key of their table, in the order of their place."""
    return _installed(DETECTORS, "detector", DetectorKind).tables


def first_detector() -> str | None:
    """The first of the detectors that are installed and that an alarm can follow; None if there is none."""
    return next((plugin.detector for plugin in detector_tables().values() if plugin.detector), None)


def broken_detectors() -> Mapping[str, Failure]:
    """Why a detector that is installed cannot be loaded, by the key of its table."""
    return _installed(DETECTORS, "detector", DetectorKind).broken


def bus_tables() -> Mapping[str, DriverKind]:
    """The drivers that are installed, by name, in the order of their place."""
    return _installed(DRIVERS, "driver", DriverKind).tables


def broken_drivers() -> Mapping[str, Failure]:
    """Why a driver that is installed cannot be loaded, by name."""
    return _installed(DRIVERS, "driver", DriverKind).broken


def output_tables() -> Mapping[str, OutputKind[Any]]:
    """The outputs that are installed, by the path of their table, in the order of their place."""
    return _installed(OUTPUTS, "output", OutputKind).tables


def broken_outputs() -> Mapping[str, Failure]:
    """Why an output that is installed cannot be loaded, by the path of its table."""
    return _installed(OUTPUTS, "output", OutputKind).broken


def driver_of_layout(layout: Layout) -> DriverKind | None:
    """The first driver that brings this kind of layout."""
    return next((plugin for plugin in bus_tables().values() if type(layout) in plugin.layouts), None)


def _bus_kind(table: Mapping[str, Any]) -> type[Bus]:
    drivers = bus_tables()
    settings = table.get("driver")
    name = settings if isinstance(settings, str) else next(iter(drivers), "")
    with suppress(PluginFailedError):  # it is a finding, and it is not known what the table may hold
        if name in drivers:
            return drivers[name].bus_of(table)
    return UnknownBus


def _bus_kinds() -> tuple[type[Bus], ...]:
    return tuple(bus for plugin in bus_tables().values() for bus in plugin.buses)


def _layout_kind(table: Mapping[str, Any]) -> type[Layout]:
    # The first driver comes last: it takes what no mark is in.
    for plugin in reversed(tuple(bus_tables().values())):
        with suppress(PluginFailedError):  # it is a finding, and others are asked
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


def with_outputs(base: type[SettingsT], path: str = "") -> type[SettingsT]:
    """A table with those of the outputs below it, at any depth.

    Args:
        base: the table as it is without any.
        path: where it stands; empty for the whole file.
    """
    if base not in _with_outputs:
        _with_outputs[base] = _made_with_outputs(base, path)
    made: type[SettingsT] = _with_outputs[base]
    return made


def _made_with_outputs(base: type[SettingsT], path: str) -> type[SettingsT]:
    fields: dict[str, Any] = {}
    for key, plugin in output_tables().items():
        above, _, name = key.rpartition(".")
        if above != path:
            continue
        if name in base.model_fields:
            log.warning(
                "output %s is left out: [%s] is a table of daqsvc itself; rename it",
                key,
                key,
                extra=coded(PLUGIN_FAILED),
            )
            continue
        table: Any = with_outputs(plugin.settings, key)
        fields[name] = (table | None, Field(default=None, description=plugin.about))
    return create_model(base.__name__, __base__=base, __doc__=base.__doc__, **fields) if fields else base


INSTALLED: Final = Kinds(lambda _table: pipeline_model(), lambda: (pipeline_model(),))
"""Annotation of the table ``[pipeline]``."""


def configured(
    pipeline: Pipeline, *, valid_only: bool = False
) -> Iterator[tuple[str, DetectorKind[Any], Any]]:
    """The detectors that a file has a table for: key, plugin and table, in order.

    Args:
        pipeline: the table ``[pipeline]``, or what is valid of it.
        valid_only: leave out a table that is no table at all.

    Raises:
        UnusableValueError: there is such a one.
    """
    for key, plugin in detector_tables().items():
        with suppress(*((UnusableValueError,) if valid_only else ())):
            settings = getattr(pipeline, key)
            if settings is not None:
                yield key, plugin, settings


def table_at(root: Section, path: str) -> Section | None:
    """The table of an output in a machine file; None if the file has none.

    Args:
        root: the machine file, or what is valid of it.
        path: keys with a dot between them.

    Raises:
        UnusableValueError: there is one that is no table at all.
    """
    table: Section | None = root
    for key in path.split("."):
        table = getattr(table, key, None)
    return table


def configured_outputs(
    root: Section, *, valid_only: bool = False
) -> Iterator[tuple[str, OutputKind[Any], Any]]:
    """The outputs that a machine file has a table for: path, plugin and table, in order.

    Args:
        root: the machine file, or what is valid of it.
        valid_only: leave out a table that is no table at all.

    Raises:
        UnusableValueError: there is such a one.
    """
    for path, plugin in output_tables().items():
        with suppress(*((UnusableValueError,) if valid_only else ())):
            settings = table_at(root, path)
            if settings is not None:
                yield path, plugin, settings
