"""What was understood of a machine file, as text for a person at a terminal."""

from __future__ import annotations

import re
import textwrap
from functools import partial
from itertools import zip_longest
from typing import TYPE_CHECKING

from daqsvc.rounding import unit_behind
from daqsvc.settings.alarms import LevelAlarm, SetpointAlarm
from daqsvc.settings.failures import one_line
from daqsvc.settings.hooks import PluginFailedError
from daqsvc.settings.measures import UNITS
from daqsvc.settings.plugins import (
    StreamWords,
    bus_tables,
    configured,
    configured_outputs,
    driver_of_layout,
    output_tables,
)
from daqsvc.settings.sensors import Accelerometer, Keyphasor, ProximityProbe, TrendValue

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from daqsvc.settings.models import MachineFile, Sensor, Stream

COLUMNS = 100
_INDENT = "  "
_GAP = "  "
_NO_BREAK = "\N{NO-BREAK SPACE}"
_HOUR_S = 3600.0


def describe(
    machine: MachineFile, doubts: Iterable[str] = (), own: MachineFile | None = None, store: str = ""
) -> str:
    """Summary of a machine file: plain text for a terminal of 100 columns, without secrets, warnings last.

    Args:
        machine: the machine file.
        doubts: what is to be warned of beside its own warnings.
        own: the box with its outputs and its store (`daqsvc.box.Box.own`), if others share these.
        store: where the store is, in words; left out, as [store] states.
    """
    blocks = [
        _facts(_identity(machine)),
        ["Buses", *_table([], [(name, _bus(machine, name)) for name in machine.buses])],
        ["Streams", *_streams(machine)],
        *_channels(machine),
        ["Sensors", *_table(_SENSOR_HEADER, [_sensor(sensor) for sensor in machine.sensors])],
        ["Detectors", *_table([], list(_detectors(machine)))],
        ["Alarms", *_table(_ALARM_HEADER, list(_alarms(machine)))],
        _facts([*_outlets(own or machine, store), *_recorder(machine)]),
    ]
    warnings = [
        textwrap.fill(
            str(warning),
            COLUMNS,
            initial_indent=_INDENT,
            subsequent_indent=2 * _INDENT,
            break_long_words=False,
            break_on_hyphens=False,
        )
        for warning in (*machine.warnings, *doubts)
    ]
    if warnings:
        blocks.append([f"Warnings: {len(warnings)}", *warnings])
    return "\n\n".join("\n".join(block) for block in blocks)


def _identity(machine: MachineFile) -> Iterator[tuple[str, str]]:
    yield "File", str(machine.path)
    about = f" - {machine.machine.description}" if machine.machine.description else ""
    yield "Machine", f"{machine.machine.name}{about}"
    speed_rpm = machine.machine.speed_rpm
    way = ", clockwise" if speed_rpm < 0.0 else ""
    yield "Speed", f"{abs(speed_rpm):g} rpm ({abs(speed_rpm) / 60:.4g} Hz){way}"
    yield "Box", f"{machine.box} at site {machine.site}"
    rotor = machine.machine.rotor
    if rotor is not None:
        parts = [
            f"natural frequency {rotor.natural_frequency_hz:g} Hz",
            f"damping ratio {rotor.damping_ratio:g}",
        ]
        if rotor.eccentricity_um is not None:
            parts.append(f"eccentricity {rotor.eccentricity_um:g} um at {rotor.heavy_spot_deg:g} deg")
        parts += [f"clearance {rotor.clearance_um:g} um", f"sag {rotor.static_sag_um:g} um"]
        if rotor.contact_stiffness is not None:
            parts.append(f"contact stiffness K* {rotor.contact_stiffness:g}")
        yield "Rotor", ", ".join(parts)


def _bus(machine: MachineFile, name: str) -> str:
    bus = machine.buses[name]
    plugin = bus_tables()[bus.driver]
    words = _words(partial(plugin.describe_bus, machine, name))
    return f"{words}; if absent at start: {bus.start}"


def _words(say: Callable[[], str]) -> str:
    """What a plugin states of its table; if that fails, why."""
    try:
        return one_line(str(say()))
    except PluginFailedError as failed:
        return failed.failure.message


_STREAM_HEADER = ("name", "bus", "id", "rate", "frames", "frame", "counter", "bus (est.)")


def _streams(machine: MachineFile) -> list[str]:
    rows = [_stream(machine, *item) for item in machine.streams.items()]
    # Of few buses it is known what share of their time a stream takes.
    shown = slice(None) if any(row[-1] for row in rows) else slice(-1)
    return _table(_STREAM_HEADER[shown], [row[shown] for row in rows])


def _stream(machine: MachineFile, name: str, stream: Stream) -> Sequence[str]:
    frame_id, frames, frame, counter, share = map(one_line, _stream_words(machine, name)[:5])
    return name, stream.bus, frame_id, f"{stream.rate_hz:g} Hz", frames, frame, counter, share


def _stream_words(machine: MachineFile, name: str) -> StreamWords:
    plugin = driver_of_layout(machine.streams[name].layout)
    try:
        return StreamWords() if plugin is None else plugin.describe_stream(machine, name)
    except PluginFailedError as failed:
        return StreamWords(frame=failed.failure.message)


_MOST_CHANNELS = 64
"""Lines on the channels of one stream."""


def _channels(machine: MachineFile) -> Iterator[list[str]]:
    """A table of the channels of each stream whose driver has one, without the columns that are empty."""
    for name in machine.streams:
        rows = [[one_line(str(cell)) for cell in row] for row in _stream_words(machine, name).channels]
        columns = [column for column in zip_longest(*rows, fillvalue="") if any(column[1:])]
        if not columns:
            continue
        header, *shown = zip(*columns, strict=True)
        more = len(shown) - _MOST_CHANNELS
        last = [f"{_INDENT}... and {more} more"] if more > 0 else []
        yield [f"Channels of {name}", *_table(header, shown[:_MOST_CHANNELS]), *last]


_SENSOR_HEADER = ("name", "type", "channel", "unit", "sensitivity", "details")


def _sensor(sensor: Sensor) -> Sequence[str]:
    if sensor.sensitivity_mv_per_unit is None:
        sensitivity = "a plain number" if sensor.unit == "1" else f"in {sensor.unit} already"
    else:
        sensitivity = f"{sensor.sensitivity_mv_per_unit:g} mV/{sensor.unit}"
        if sensor.zero_v != 0:
            sensitivity += f", 0 at {sensor.zero_v:g} V"
    return (
        sensor.name,
        sensor.type,
        f"{sensor.stream}.{sensor.channel}",
        sensor.unit,
        sensitivity,
        "; ".join(_sensor_details(sensor)),
    )


def _sensor_details(sensor: Sensor) -> Iterator[str]:
    if isinstance(sensor, ProximityProbe) and sensor.gap_ok_v is not None:
        yield f"gap OK {sensor.gap_ok_v[0]:g} to {sensor.gap_ok_v[1]:g} V"
    if isinstance(sensor, ProximityProbe) and sensor.ac_coupled:
        yield "AC-coupled"
    if isinstance(sensor, ProximityProbe | Accelerometer) and sensor.angle_deg is not None:
        yield f"at {sensor.angle_deg:g} deg"
    if isinstance(sensor, Keyphasor):
        yield f"{sensor.edge} at {sensor.threshold_v:g} V, hysteresis {sensor.hysteresis_v:g} V"
    if isinstance(sensor, TrendValue) and sensor.ok_between is not None:
        yield f"OK {sensor.ok_between[0]:g} to {sensor.ok_between[1]:g}{unit_behind(sensor.unit)}"


def _detectors(machine: MachineFile) -> Iterator[tuple[str, str]]:
    pipeline = machine.pipeline
    yield "ring", f"{pipeline.ring_s:g} s of every stream"
    for grid in machine.grids:
        reference, *others = grid.streams
        assert pipeline.alignment is not None  # noqa: S101 - detectors/shaft/checks.py
        error_us, wait_ms = pipeline.alignment.max_error_us, pipeline.alignment.max_wait_ms
        text = f"{', '.join(others)} on the samples of {reference}; left out where they may be more than "
        yield "grid", f"{text}{error_us:g} us off, missing when more than {wait_ms:g} ms late"
    for key, plugin, settings in configured(pipeline):
        yield plugin.detector or key, _words(partial(plugin.describe, machine, settings))


_ALARM_HEADER = ("name", "watches", "alert", "danger", "deadband and delays")


def _alarms(machine: MachineFile) -> Iterator[Sequence[str]]:
    for alarm in machine.alarms:
        latching = "; latching" if alarm.latching else ""
        if not isinstance(alarm, SetpointAlarm):
            evidence = f"{alarm.evidence_nats:g} nats at least" if alarm.evidence_nats else "none"
            yield alarm.name, alarm.detector, "by mode", "by mode", f"{evidence}{latching}"
            continue
        unit = unit_behind(UNITS.get(alarm.measure, machine.sensor(alarm.watched[0]).unit))
        if isinstance(alarm, LevelAlarm):
            watched = f"{alarm.measure} of {alarm.sensor}"
        else:
            watched = f"{alarm.measure}, {alarm.vote} of {', '.join(alarm.sensors)}"
        deadband = f"{alarm.deadband:g}{unit}"
        delays = f"on {alarm.on_delay_s:g} s, off {alarm.off_delay_s:g} s"
        multiplied = f", start-up x{alarm.trip_multiply:g}" if alarm.trip_multiply > 1 else ""
        yield (
            alarm.name,
            watched,
            _limits(alarm.alert_low, alarm.alert, unit),
            _limits(alarm.danger_low, alarm.danger, unit),
            f"{deadband}, {delays}{multiplied}{_more_of(alarm)}{latching}",
        )


def _more_of(alarm: SetpointAlarm) -> str:
    """What else than its own setpoints an alarm is judged by."""
    more = ""
    if alarm.reference_deg is not None:
        more += f"; off {alarm.reference_deg:g} deg"
    if alarm.boundaries is not None:
        more += "; zones of ISO 20816-3"
    if isinstance(alarm, LevelAlarm) and (phase := alarm.phase) is not None:
        limits = (("alert", phase.alert), ("danger", phase.danger))
        known = " and ".join(f"{name} {limit:g}" for name, limit in limits if limit is not None)
        more += f"; phase off {phase.reference_deg:g} deg: {known} deg"
    return more


def _limits(low: float | None, high: float | None, unit: str) -> str:
    """Where a level begins: at and above ``high``, at and below ``low``, or at both ends of a window."""
    if low is None:
        return "-" if high is None else f"{high:g}{unit}"
    return f"<= {low:g}{unit}" if high is None else f"{low:g}..{high:g}{unit}"


def _outlets(machine: MachineFile, store: str) -> Iterator[tuple[str, str]]:
    lines = [
        (path, _words(partial(plugin.describe, machine, settings)))
        for path, plugin, settings in configured_outputs(machine)
    ]
    for path, plugin in output_tables().items():
        below = [words for at, words in lines if f"{at}.".startswith(f"{path}.") and words]
        if "." not in path and (below or plugin.absent):
            yield one_line(plugin.label) or path, "; ".join(below) or one_line(plugin.absent)
    named = "where daqsvc run keeps it, as [store] names no directory"
    if machine.store is not None:
        named = f"{machine.resolve(machine.store.directory)}"
    yield "Store", store or named


def _recorder(machine: MachineFile) -> Iterator[tuple[str, str]]:
    """What is recorded of this machine, also where others share its outputs and its store."""
    if (recorder := machine.recorder) is None:
        return
    parts = [f"{recorder.before_s:g} s before and {recorder.after_s:g} s after each alarm"]
    if recorder.every_s is not None:
        parts.append("each hour" if recorder.every_s == _HOUR_S else f"every {recorder.every_s:g} s")
    if recorder.every_rpm is not None:
        parts.append(f"each {recorder.every_rpm:g} rpm of speed")
    if recorder.continuous:
        parts.append(f"everything, in files of {recorder.continuous_s:g} s")
    kept = f"{recorder.max_mb} MB, {recorder.keep_days:g} days"
    yield "recorder", "; ".join([*parts, kept, f"{recorder.reserve_mb} MB left free"])


def _facts(facts: Iterable[tuple[str, str]]) -> list[str]:
    """Labels in a column, their texts wrapped beside them."""
    return [line for label, text in facts for line in _wrapped(f"{label:<8} ", text)]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows in aligned columns under a header (none if empty); the last column is wrapped."""
    if not rows:
        return [f"{_INDENT}none"]
    shown = [header, *rows] if header else list(rows)
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)][:-1]
    lines: list[str] = []
    for row in shown:
        cells = [f"{cell:<{width}}{_GAP}" for cell, width in zip(row, widths, strict=False)]
        lines += _wrapped(f"{_INDENT}{''.join(cells)}", row[-1])
    return lines


def _wrapped(label: str, text: str) -> list[str]:
    together = re.sub(r"(?<=\d) (?=[A-Za-z%])", _NO_BREAK, text)  # a number stays with its unit
    wrapped = textwrap.wrap(
        together, max(COLUMNS - len(label), 20), break_long_words=False, break_on_hyphens=False
    )
    first, *rest = [line.replace(_NO_BREAK, " ") for line in wrapped] or [""]
    return [f"{label}{first}".rstrip(), *(" " * len(label) + line for line in rest)]
