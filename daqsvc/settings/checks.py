"""Whether the parts of a machine file fit each other: everything that one value alone cannot show.

Each check is a generator over a few values. On a faulty file it runs on what is valid, and ends quietly
where it asks for a value that is not (`UnusableValueError`): one mistake never hides another.
"""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from daqsvc.errors.machine_file import (
    COARSE_ALIGNMENT,
    NAMED_TWICE,
    NO_EFFECT,
    NO_SUCH_DRIVER,
    NO_SUCH_NAME,
    PLUGIN_FAILED,
    SNAPSHOTS_OVERLAP,
    SPEED_UNKNOWN,
    THOUSANDS,
    TOO_MUCH_MEMORY,
    UNUSED_BUS,
)
from daqsvc.rounding import rounded_down
from daqsvc.settings.alarm_checks import alarm_checks
from daqsvc.settings.error_messages import dotted
from daqsvc.settings.failures import BrokenContractError
from daqsvc.settings.hooks import PluginFailedError
from daqsvc.settings.plugins import (
    bus_tables,
    configured,
    configured_outputs,
    detector_tables,
    driver_of_layout,
)
from daqsvc.settings.problems import Finding, choice, unique
from daqsvc.settings.registry import broken_drivers
from daqsvc.settings.rotor_physics import physics_checks
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensor_checks import (
    check_alarm_reach,
    check_probe_angles,
    check_reach,
    check_room_above,
    check_sensitivity,
    check_unit,
    check_value_names,
    check_voltages,
)
from daqsvc.settings.speed_signals import speed_signals
from daqsvc.settings.written_numbers import thousands_meant

if TYPE_CHECKING:
    from collections.abc import Collection, Hashable, Iterator, Mapping

    from daqsvc.settings.buses import Layout
    from daqsvc.settings.models import MachineFile, Sensor, Stream
    from daqsvc.settings.plugins import BusTable
    from daqsvc.settings.problems import KeyPath


_MOST_FINDINGS = 200
"""Once these are corrected, the check can be run again."""


def check(draft: MachineFile, facts: Mapping[str, Any]) -> list[Finding]:
    """Run every check on a machine file.

    Args:
        draft: the machine file, or what is valid of it.
        facts: by stream, what was read from the files that its layout names.
    """
    findings: list[Finding] = []
    for one in _checks(draft, MappingProxyType(facts)):
        with suppress(UnusableValueError):
            for finding in one:
                findings.append(finding)
                if len(findings) >= _MOST_FINDINGS:
                    return findings
    with suppress(UnusableValueError):
        findings += _strangers(draft, {finding.path[:2] for finding in findings if finding.fatal})
    return findings


def _strangers(draft: MachineFile, wrong: Collection[KeyPath]) -> Iterator[Finding]:
    """Sensors that a detector takes together and that there are none of, where its table is not to blame."""
    sensors = [sensor.name for sensor in draft.sensors]
    for key, plugin, settings in configured(draft.pipeline, valid_only=True):
        with suppress(UnusableValueError):
            strange = [name for name in plugin.sampled_together(settings) if name not in sensors]
            if strange and ("pipeline", key) not in wrong:
                words = f"it names {strange[0]!r:.60}, which is no sensor; name some of {', '.join(sensors)}"
                hook = type(plugin).sampled_together
                error = BrokenContractError(hook, words)
                yield failure(draft, PluginFailedError(plugin, "sampled_together", error))


def failure(draft: MachineFile, failed: PluginFailedError) -> Finding:
    """A hook that fails, at the table that it was asked about; a warning where the file has no such table."""
    at = next(_places(draft, failed), ())
    table = at[:2] if at[:1] in {("buses",), ("streams",)} else at
    remedy = failed.failure.or_remove(dotted(table))
    return Finding(at, failed.failure.message, remedy, fatal=bool(at), code=PLUGIN_FAILED)


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
            yield _check_stream_bus(draft, stream, at)
            yield from _stream_checks(draft, facts, name)
            with suppress(UnusableValueError):
                yield _check_channels(stream.layout, (*at, "layout"))
    yield _check_unused(draft)
    yield _check_drivers(draft)
    yield from _bus_checks(draft, facts)
    yield from _sensor_checks(draft, facts)
    yield _check_memory(draft)
    yield _names(draft)
    yield _check_speed(draft)
    yield _check_speed_steps(draft)
    yield _check_schedule(draft)
    yield from physics_checks(draft)
    with suppress(UnusableValueError):
        for _, detector, settings in configured(draft.pipeline, valid_only=True):
            with suppress(UnusableValueError):
                yield from detector.checks(draft, settings)
    yield from _alignment_checks(draft)
    yield from alarm_checks(draft)
    for _, output, settings in configured_outputs(draft, valid_only=True):
        with suppress(UnusableValueError):
            yield from output.checks(draft, settings)


def _stream_checks(draft: MachineFile, facts: Mapping[str, Any], name: str) -> Iterator[Iterator[Finding]]:
    """Every check of a stream by those whose bus or layout it has."""
    for plugin in _drivers_of(draft, draft.streams[name]):
        with suppress(UnusableValueError):
            yield from plugin.stream_checks(draft, draft.streams[name], facts.get(name), ("streams", name))


def _bus_checks(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
    """Every check of what buses, and the streams on each of them, are to each other."""
    yield _check_devices(draft)
    for plugin in _drivers(draft):
        with suppress(UnusableValueError):
            yield from plugin.checks(draft, facts)


def bus_checks(draft: MachineFile, facts: Mapping[str, Any]) -> list[Finding]:
    """What is wrong with buses, and with the streams on each of them, beside each other; see `check`."""
    of_streams = (one for name in draft.streams for one in _stream_checks(draft, facts, name))
    return [finding for one in (*of_streams, *_bus_checks(draft, facts)) for finding in one]


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
            yield _check_sensor_channel(draft, sensor, at)
            yield check_voltages(draft, sensor, at)
            yield check_sensitivity(sensor, at)
            yield check_unit(sensor, at)
            yield check_reach(draft, sensor, facts, at)
            yield check_value_names(draft, sensor, facts)
    yield _check_channel_use(draft)
    yield check_probe_angles(draft)
    yield check_alarm_reach(draft, facts)
    yield check_room_above(draft, facts)


def _names(draft: MachineFile) -> Iterator[Finding]:
    with suppress(UnusableValueError):
        yield from unique([sensor.name for sensor in draft.sensors], ("sensors",), "sensor")
    yield from unique([alarm.name for alarm in draft.alarms], ("alarms",), "alarm")


def _check_drivers(draft: MachineFile) -> Iterator[Finding]:
    """The drivers of the buses are installed, and can be loaded."""
    installed, broken = bus_tables(), broken_drivers()
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            at = ("buses", name, "driver")
            if bus.driver in broken:
                why = broken[bus.driver]
                yield Finding(at, why.message, why.or_remove(f"buses.{name}"), code=PLUGIN_FAILED)
            elif bus.driver not in installed:
                remedy = f"{choice(bus.driver, installed)}; or install the package that brings it"
                yield Finding(at, "no such driver is installed", remedy, code=NO_SUCH_DRIVER)


def _check_devices(draft: MachineFile) -> Iterator[Finding]:
    """No device belongs to two buses."""
    owners: dict[Hashable, str] = {}
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            device = bus.device
            owner = name if device is None else owners.setdefault(device.identity, name)
            if device is not None and owner != name:
                yield Finding(
                    ("buses", name, device.key),
                    f'belongs to bus "{owner}" already',
                    device.remedy,
                    code=NAMED_TWICE,
                )


def _check_unused(draft: MachineFile) -> Iterator[Finding]:
    """Streams come over every bus."""
    used = {stream.bus for stream in draft.streams.values()}
    for name in draft.buses:
        if name not in used:
            yield Finding(
                ("buses", name),
                "no stream comes over this bus",
                "remove it, or add its streams",
                fatal=False,
                code=UNUSED_BUS,
            )


def _check_channels(layout: Layout, at: KeyPath) -> Iterator[Finding]:
    """Channel names are unique."""
    yield from unique(list(layout.channel_names), (*at, layout.channels_key), "channel")


def _check_stream_bus(draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
    """The stream's bus exists."""
    if stream.bus not in draft.buses:
        yield Finding(
            (*at, "bus"), "there is no such bus", choice(stream.bus, draft.buses), code=NO_SUCH_NAME
        )


def _check_sensor_channel(draft: MachineFile, sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """The sensor's stream and channel exist."""
    if sensor.stream not in draft.streams:
        yield Finding(
            (*at, "stream"),
            "there is no such stream",
            choice(sensor.stream, draft.streams),
            code=NO_SUCH_NAME,
        )
        return
    channels = draft.streams[sensor.stream].layout.channel_names
    if sensor.channel not in channels:
        yield Finding(
            (*at, "channel"),
            f'stream "{sensor.stream}" has no such channel',
            choice(sensor.channel, channels),
            code=NO_SUCH_NAME,
        )


def _check_channel_use(draft: MachineFile) -> Iterator[Finding]:
    """No channel is claimed by two sensors."""
    owners: dict[tuple[str, str], int] = {}
    for index, sensor in enumerate(draft.sensors):
        with suppress(UnusableValueError):
            owner = owners.setdefault((sensor.stream, sensor.channel), index)
            if owner != index:
                yield Finding(
                    ("sensors", index, "channel"),
                    f'channel "{sensor.channel}" of stream "{sensor.stream}" belongs to '
                    f'sensor "{draft.sensors[owner].name}" already',
                    "give each sensor its own channel",
                    code=NAMED_TWICE,
                )


_ALIGNMENT: KeyPath = ("pipeline", "alignment")
_COARSE_DEG = 10.0
"""An error of the phase that a detector of the rotor takes for a change of the machine."""


def _alignment_checks(draft: MachineFile) -> Iterator[Iterator[Finding]]:
    """Every check of the alignment.

    Args:
        draft: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        if draft.pipeline.alignment is not None:
            yield _used(draft)
            yield _fine_enough(draft, draft.pipeline.alignment.max_error_us)


def _used(draft: MachineFile) -> Iterator[Finding]:
    """Some detector has its sensors in several streams."""
    named = {sensor.name: sensor.stream for sensor in draft.sensors}
    if any(len({named.get(name) for name in together}) > 1 for together in draft.sampled_together):
        return
    yield Finding(
        _ALIGNMENT,
        "has no effect: no detector of the rotor has its sensors in several streams",
        "remove it",
        fatal=False,
        code=NO_EFFECT,
    )


def _fine_enough(draft: MachineFile, max_error_us: float) -> Iterator[Finding]:
    """The error is a small part of a revolution."""
    speed_rpm = abs(draft.machine.speed_rpm)
    error_deg = 360.0 * speed_rpm / 60.0 * max_error_us / 1e6
    if error_deg > _COARSE_DEG:
        yield Finding(
            (*_ALIGNMENT, "max_error_us"),
            f"{max_error_us:g} us are {error_deg:.3g} deg of a revolution at {speed_rpm:g} rpm: as much as a "
            "fault moves the phase",
            f"write max_error_us = {rounded_down(_COARSE_DEG / 6.0 / speed_rpm * 1e6)} or less, or bring the "
            "sensors together in one stream",
            fatal=False,
            code=COARSE_ALIGNMENT,
        )


SAMPLE_BYTES = 4
_HISTORY_SPARE_S = 8.0
"""What the recorder remembers beyond the begin of a snapshot."""
_CONTINUOUS_SPARE_S = 16.0
"""The same where it records continuously: what waits for the next file."""
_MOST_SHARE = 0.5
"""Of the memory: the rest is for detectors, outbox, operating system and whoever else there is."""
_CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def memory_bytes() -> int:
    """The memory that this process may have: that of the computer, or less if its control group has less."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for file in _CGROUP_LIMITS:
        with suppress(OSError, ValueError):
            there = min(there, int(file.read_text(encoding="ascii")))
    return there


def memory_share() -> float:
    """What rings may take of the memory at most: the rest is for detectors, outbox and all others."""
    return _MOST_SHARE


def needed_bytes(draft: MachineFile) -> dict[str, float]:
    """What each stream takes: its ring and those of grids that it is in, late frames, blocks on their way."""
    pipeline = draft.pipeline
    needed: dict[str, float] = {}
    rings = dict.fromkeys(draft.streams, 1)
    for together in draft.sampled_together:
        joined = {sensor.stream for sensor in draft.sensors if sensor.name in together}
        for name in joined & rings.keys() if len(joined) > 1 else ():
            rings[name] += 1
    for name, stream in draft.streams.items():
        with suppress(UnusableValueError):
            row_bytes = SAMPLE_BYTES * len(stream.layout.channel_names)
            kept_s = pipeline.ring_s * rings[name] + stream.reorder_window_ms / 1e3
            if (recorder := draft.recorder) is not None:
                spare_s = _CONTINUOUS_SPARE_S if recorder.continuous else _HISTORY_SPARE_S
                kept_s += (recorder.before_s + spare_s) * rings[name]
            needed[name] = stream.rate_hz * kept_s * row_bytes
            if (block := stream.layout.block) is not None:
                needed[name] += block.buffer_bytes
    return needed


def _check_speed(draft: MachineFile) -> Iterator[Finding]:
    """The point of the speed is no point between thousands, as in 1.485 for 1485."""
    speed_rpm = draft.machine.speed_rpm
    meant = thousands_meant(speed_rpm)
    # Of a file nobody is asked: only a third decimal that is not 0 is known to have been written.
    if meant is not None and round(speed_rpm, 2) != speed_rpm:
        yield Finding(
            ("machine", "speed_rpm"),
            "is slow for a shaft, and the point is a decimal point",
            f"write speed_rpm = {meant}.0 if that is meant; or leave it",
            fatal=False,
            code=THOUSANDS,
        )


def _check_speed_steps(draft: MachineFile) -> Iterator[Finding]:
    """Where snapshots are to be made by the speed, that is known."""
    recorder = draft.recorder
    if recorder is None or recorder.every_rpm is None or speed_signals(draft):
        return
    tables = [f"[pipeline.{key}]" for key, plugin in detector_tables().items() if plugin.states_speed]
    yield Finding(
        ("recorder", "every_rpm"),
        "asks for snapshots by the speed, and no detector of this machine states one",
        f'write a table {" or ".join(tables)}, a sensor of type "trend" in rpm, or remove every_rpm',
        code=SPEED_UNKNOWN,
    )


def _check_schedule(draft: MachineFile) -> Iterator[Finding]:
    """Snapshots by the clock do not come before the one that came before is over."""
    recorder = draft.recorder
    if recorder is None or recorder.every_s is None:
        return
    lasts_s = recorder.before_s + recorder.after_s
    if recorder.every_s < lasts_s:
        yield Finding(
            ("recorder", "every_s"),
            f"asks for a snapshot every {recorder.every_s:g} s, and each holds {lasts_s:g} s "
            "(before_s and after_s): they would overlap",
            f"write every_s = {math.ceil(lasts_s)} or more, or have all recorded with continuous = true",
            fatal=False,
            code=SNAPSHOTS_OVERLAP,
        )


def _check_memory(draft: MachineFile) -> Iterator[Finding]:
    """The rings of all streams fit the memory together."""
    needed = needed_bytes(draft)
    together, there = sum(needed.values()), memory_bytes()
    if together <= _MOST_SHARE * there:
        return
    most = max(needed, key=lambda name: needed[name])
    fitting_s = draft.pipeline.ring_s * _MOST_SHARE * there / together
    yield Finding(
        ("pipeline", "ring_s"),
        f"the rings of {draft.pipeline.ring_s:g} s would take {together / 1e9:.3g} GB, most of it for stream "
        f'"{most}" at {draft.streams[most].rate_hz:g} Hz, and this computer has {there / 1e9:.3g} GB',
        f"write ring_s = {rounded_down(fitting_s, 2)} or less in [pipeline], or correct rate_hz of the "
        "stream",
        code=TOO_MUCH_MEMORY,
    )
