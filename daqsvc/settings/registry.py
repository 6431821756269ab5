"""The plugins that tables of a machine file belong to, found by their entry points, once a process.

No driver and no detector is named in `daqsvc.settings`: what a machine file may say of them, they say.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from pydantic import Field, create_model

from daqsvc.settings.pipeline import Pipeline
from daqsvc.settings.section import Kinds, Section, UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import Finding, KeyPath

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


@dataclass(frozen=True, slots=True)
class _Installed:
    """What the entry points lead to.

    Attributes:
        tables: the plugins, by the key of their table, in the order of their place.
        broken: why one cannot be loaded, by key.
    """

    tables: Mapping[str, PipelineTable[Any]]
    broken: Mapping[str, str]


@cache
def _installed() -> _Installed:
    found: dict[str, PipelineTable[Any]] = {}
    broken: dict[str, str] = {}
    for point in entry_points(group=DETECTORS):
        try:
            found[point.name] = point.load()()
        except Exception as error:  # noqa: BLE001  whatever a plugin does when it is imported
            broken[point.name] = f"the detector cannot be loaded from {point.value}: {error}"
    ordered = sorted(found.items(), key=lambda item: (item[1].place, item[0]))
    return _Installed(MappingProxyType(dict(ordered)), MappingProxyType(broken))


def forget() -> None:
    """Look for plugins anew: for whoever installs one in a running process."""
    _installed.cache_clear()
    pipeline_model.cache_clear()


def detector_tables() -> Mapping[str, PipelineTable[Any]]:
    """The detectors that are installed, by the key of their table, in the order of their place."""
    return _installed().tables


def broken_detectors() -> Mapping[str, str]:
    """Why a detector that is installed cannot be loaded, by the key of its table."""
    return _installed().broken


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


# Chosen when a file is read, not when the models are imported: plugins import these themselves.
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
