"""Whether the alarms of a machine file can be judged, raised and returned as they stand."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.alarms import DiagnosisAlarm, SetpointAlarm, VotingAlarm
from daqsvc.settings.plugins import configured, detector_tables
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.setpoint_checks import setpoint_checks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.alarms import StartUp
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import KeyPath

_TAKEN = ("alarm-flood", "trip-multiply")
"""Alarms that the service raises itself."""
_START_UP: KeyPath = ("alarm_handling", "start_up")


def alarm_checks(draft: MachineFile) -> Iterator[Iterator[Finding]]:
    """Every check of the alarms.

    Args:
        draft: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        for index, alarm in enumerate(draft.alarms):
            at: KeyPath = ("alarms", index)
            yield _name(alarm.name, at)
            if isinstance(alarm, SetpointAlarm):
                yield from setpoint_checks(draft, alarm, at)
            if isinstance(alarm, VotingAlarm):
                yield _vote(draft, alarm, at)
            if isinstance(alarm, DiagnosisAlarm):
                yield _detector(draft, alarm, at)
    with suppress(UnusableValueError):
        if draft.alarm_handling.start_up is not None:
            yield _start_up(draft, draft.alarm_handling.start_up)


def _name(name: str, at: KeyPath) -> Iterator[Finding]:
    if name in _TAKEN:
        yield Finding(
            (*at, "name"), "is an alarm that the service raises itself", "give this one another name"
        )


def _vote(draft: MachineFile, alarm: VotingAlarm, at: KeyPath) -> Iterator[Finding]:
    count = len(alarm.sensors)
    if alarm.vote > count:
        yield Finding(
            (*at, "vote"),
            f"cannot be reached by {count} sensors",
            f"write vote = {count} or less, or add sensors",
        )
    for position, name in enumerate(alarm.sensors):
        if name in alarm.sensors[:position]:
            yield Finding((*at, "sensors", position), "votes twice", "name each sensor once")
    if alarm.measure in {"velocity_rms", "crest_factor", "gap_voltage"}:
        return
    units = {s.unit for s in draft.sensors if s.name in alarm.sensors and s.type != "keyphasor"}
    if len(units) > 1:
        yield Finding(
            (*at, "sensors"),
            f"one setpoint for sensors in {' and '.join(sorted(units))}",
            "let only sensors of one unit vote together",
        )


def _detector(draft: MachineFile, alarm: DiagnosisAlarm, at: KeyPath) -> Iterator[Finding]:
    """The detector that an alarm follows is there and can raise it."""
    keys = {plugin.detector: key for key, plugin in detector_tables().items() if plugin.detector is not None}
    if alarm.detector not in keys:
        yield Finding((*at, "detector"), "there is no such detector", choice(alarm.detector, keys))
        return
    key = keys[alarm.detector]
    given = getattr(draft.pipeline, key)
    if given is None:
        yield Finding(
            (*at, "detector"),
            "this detector is not configured",
            f"write a table [pipeline.{key}], or remove the alarm",
        )
        return
    yield from detector_tables()[key].alarm_checks(given, at)


def _start_up(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    if start_up.between is None and start_up.change_per_s is None:
        yield Finding(_START_UP, "has neither between nor change_per_s", "add one of the two, or both")
    if start_up.between is not None and not start_up.between[0] < start_up.between[1]:
        yield Finding((*_START_UP, "between"), "is no range", "write the lower end first")
    yield from _never_up(draft, start_up)
    yield from _start_up_signal(draft, start_up)
    if not any(isinstance(alarm, SetpointAlarm) and alarm.trip_multiply > 1 for alarm in draft.alarms):
        yield Finding(
            _START_UP,
            "has no effect: no alarm has a trip_multiply",
            "write e.g. trip_multiply = 2.0 in an alarm on a level, or remove it",
            fatal=False,
        )


def _never_up(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    """A machine at its nominal speed has started up."""
    speed_rpm = abs(draft.machine.speed_rpm)
    if start_up.between is None or start_up.measure != "speed":
        return
    low, high = start_up.between
    if low <= speed_rpm <= high:
        yield Finding(
            (*_START_UP, "between"),
            f"holds machine.speed_rpm, {speed_rpm:g} rpm: the machine would always be starting up",
            f"end it below {speed_rpm:g}, e.g. between = [{0.1 * speed_rpm:g}, {0.9 * speed_rpm:g}]",
        )


def _start_up_signal(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    signals: dict[str, tuple[str, ...]] = {}
    for _, plugin, given in configured(draft.pipeline):
        signals |= plugin.start_up_signals(draft, given)
    if not signals:
        tables = [f"[pipeline.{key}]" for key, plugin in detector_tables().items() if plugin.states_speed]
        yield Finding(
            (*_START_UP, "detector"),
            "no detector of this machine states a speed",
            f"write a table {' or '.join(tables)}, take a trend value that is the speed, or remove "
            "[alarm_handling.start_up] and every trip_multiply",
        )
    elif start_up.detector not in signals:
        there = (
            start_up.detector in draft.detectors or start_up.detector.partition("/")[0] in detector_tables()
        )
        yield Finding(
            (*_START_UP, "detector"),
            "states no speed while the machine starts up"
            if there
            else "there is no such detector in [pipeline]",
            choice(start_up.detector, list(signals)),
        )
    elif start_up.measure not in signals[start_up.detector]:
        yield Finding(
            (*_START_UP, "measure"),
            f"is nothing that {start_up.detector} states while the machine starts up",
            choice(start_up.measure, signals[start_up.detector]),
        )
