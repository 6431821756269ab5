"""Whether the parts of a machine file fit each other: everything that one value alone cannot show.

Each check is a generator over a few values. On a faulty file it runs on what is valid, and ends quietly
where it asks for a value that is not (`UnusableValueError`): one mistake never hides another.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from daqsvc.settings.alarm_checks import alarm_checks
from daqsvc.settings.alignment_checks import alignment_checks
from daqsvc.settings.bus_checks import check_devices, check_drivers, check_unused
from daqsvc.settings.error_messages import dotted
from daqsvc.settings.failures import mend_or_remove
from daqsvc.settings.layout_checks import (
    check_channel_use,
    check_channels,
    check_sensor_channel,
    check_stream_bus,
    unique,
)
from daqsvc.settings.memory_checks import check_memory
from daqsvc.settings.plugins import bus_tables, configured, configured_outputs, driver_of_layout
from daqsvc.settings.problems import Finding
from daqsvc.settings.rotor_physics import physics_checks
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensor_checks import (
    check_alarm_reach,
    check_probe_angles,
    check_reach,
    check_sensitivity,
    check_voltages,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.hooks import PluginFailedError
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.plugins import BusTable
    from daqsvc.settings.problems import KeyPath

_MOST_FINDINGS = 200
"""Whoever has mended these may ask again."""


def check(draft: MachineFile, facts: Mapping[str, Any]) -> list[Finding]:
    """Run every check on a machine file.

    Args:
        draft: the machine file, or what is valid of it.
        facts: by stream, what was read from the files that its layout names.
    """
    findings: list[Finding] = []
    for found in _checks(draft, facts):
        with suppress(UnusableValueError):
            for finding in found:
                findings.append(finding)
                if len(findings) >= _MOST_FINDINGS:
                    return findings
    return findings


def failure(draft: MachineFile, failed: PluginFailedError) -> Finding:
    """A hook that fails, at the table that it was asked about; a warning where the file has no such table."""
    at = next(_places(draft, failed), ())
    table = at[:2] if at[:1] in {("buses",), ("streams",)} else at
    remedy = mend_or_remove(type(failed.by), dotted(table))
    return Finding(at, failed.said, remedy, fatal=bool(at))


def _places(draft: MachineFile, failed: PluginFailedError) -> Iterator[KeyPath]:
    """Where a plugin stands, or one of its tables."""
    by = failed.by
    if by.__table__:
        yield tuple(by.__table__.split("."))
    if failed.at is not None:
        yield failed.at
    with suppress(UnusableValueError):
        for name, bus in draft.buses.items():
            with suppress(UnusableValueError):
                if bus is by or bus_tables().get(bus.driver) is by:
                    yield "buses", name
    with suppress(UnusableValueError):
        for name, stream in draft.streams.items():
            with suppress(UnusableValueError):
                if stream.layout is by or driver_of_layout(stream.layout) is by:
                    yield "streams", name, "layout"


def _checks(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
    """Every check with what it is about."""
    with suppress(UnusableValueError):
        for name, stream in draft.streams.items():
            at: KeyPath = ("streams", name)
            yield check_stream_bus(draft, stream, at)
            for plugin in _drivers_of(draft, stream):
                with suppress(UnusableValueError):
                    yield from plugin.stream_checks(draft, stream, facts.get(name), at)
            with suppress(UnusableValueError):
                yield check_channels(stream.layout, (*at, "layout"))
    yield check_unused(draft)
    yield check_drivers(draft)
    yield check_devices(draft)
    for plugin in _drivers(draft):
        with suppress(UnusableValueError):
            yield from plugin.checks(draft, facts)
    yield from _sensor_checks(draft, facts)
    yield check_memory(draft)
    yield _names(draft)
    yield from physics_checks(draft)
    with suppress(UnusableValueError):
        for _, detector, given in configured(draft.pipeline, valid_only=True):
            with suppress(UnusableValueError):
                yield from detector.checks(draft, given)
    yield from alignment_checks(draft)
    yield from alarm_checks(draft)
    for _, output, given in configured_outputs(draft, valid_only=True):
        with suppress(UnusableValueError):
            yield from output.checks(draft, given)


def _drivers_of(draft: MachineFile, stream: Stream) -> list[BusTable]:
    """The driver of a stream's bus, and that of its layout if it is another; in the order of their place."""
    used: set[BusTable | None] = set()
    with suppress(UnusableValueError):
        bus = draft.buses.get(stream.bus)
        used.add(None if bus is None else bus_tables().get(bus.driver))
    with suppress(UnusableValueError):
        if not any(plugin is not None and type(stream.layout) in plugin.layouts for plugin in used):
            used.add(driver_of_layout(stream.layout))
    return [plugin for plugin in bus_tables().values() if plugin in used]


def _drivers(draft: MachineFile) -> list[BusTable]:
    """The drivers that a machine file has a bus or a layout of, in the order of their place."""
    used: set[BusTable] = set()
    with suppress(UnusableValueError):
        for bus in draft.buses.values():
            with suppress(UnusableValueError):
                used.update(plugin for key, plugin in bus_tables().items() if key == bus.driver)
    with suppress(UnusableValueError):
        for stream in draft.streams.values():
            used.update(_drivers_of(draft, stream))
    return [plugin for plugin in bus_tables().values() if plugin in used]


def _sensor_checks(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
    """Every check of the sensors, and of what their channels can carry."""
    with suppress(UnusableValueError):
        for index, sensor in enumerate(draft.sensors):
            at: KeyPath = ("sensors", index)
            yield check_sensor_channel(draft, sensor, at)
            yield check_voltages(draft, sensor, at)
            yield check_sensitivity(sensor, at)
            yield check_reach(draft, sensor, facts, at)
    yield check_channel_use(draft)
    yield check_probe_angles(draft)
    yield check_alarm_reach(draft, facts)


def _names(draft: MachineFile) -> Iterator[Finding]:
    with suppress(UnusableValueError):
        yield from unique([sensor.name for sensor in draft.sensors], ("sensors",), "sensor")
    yield from unique([alarm.name for alarm in draft.alarms], ("alarms",), "alarm")
