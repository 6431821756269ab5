"""Whether the alarms of a machine file can be judged, raised and returned as they stand."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.alarms import DiagnosisAlarm, SetpointAlarm, VotingAlarm
from daqsvc.settings.pipeline import ROTOR_BANK
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.rotor import ROTOR_SYNCHRONOUS
from daqsvc.settings.rotor_checks import check_alarm_detector
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
_START_UP_SIGNALS = {ROTOR_BANK: ("speed",), ROTOR_SYNCHRONOUS: ("speed", "1x.amplitude")}
"""The detectors that go on stating their signal while the speed changes, and these signals."""


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
                yield check_alarm_detector(draft, alarm, at)
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


def _start_up(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    if start_up.between is None and start_up.change_per_s is None:
        yield Finding(_START_UP, "has neither between nor change_per_s", "add one of the two, or both")
    if start_up.between is not None and not start_up.between[0] < start_up.between[1]:
        yield Finding((*_START_UP, "between"), "is no range", "write the lower end first")
    yield from _start_up_signal(draft, start_up)
    if not any(isinstance(alarm, SetpointAlarm) and alarm.trip_multiply > 1 for alarm in draft.alarms):
        yield Finding(
            _START_UP,
            "has no effect: no alarm has a trip_multiply",
            "write e.g. trip_multiply = 2.0 in an alarm on a level, or remove it",
            fatal=False,
        )


def _start_up_signal(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    signals = {name: _START_UP_SIGNALS[name] for name in draft.detectors if name in _START_UP_SIGNALS}
    if draft.pipeline.levels is not None:
        trends = (sensor.name for sensor in draft.sensors if sensor.type == "trend")
        signals |= {f"levels/{name}": ("value",) for name in trends}
    if not signals:
        yield Finding(
            (*_START_UP, "detector"),
            "no detector of this machine states a speed",
            "write a table [pipeline.rotor_bank] or [pipeline.rotor_synchronous], take a trend value that is "
            "the speed, or remove [alarm_handling.start_up] and every trip_multiply",
        )
    elif start_up.detector not in signals:
        there = start_up.detector in draft.detectors or start_up.detector.startswith("levels/")
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
