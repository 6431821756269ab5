"""Whether what a rotor detector is told fits together: its sensors, the rotor, the speed, its alarm."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.bearing import BEARING
from daqsvc.settings.mode_checks import mode_checks
from daqsvc.settings.pipeline import ROTOR_BANK
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.rotor import ROTOR_SYNCHRONOUS
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.alarms import DiagnosisAlarm
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.pipeline import RotorBank
    from daqsvc.settings.problems import KeyPath
    from daqsvc.settings.rotor import RotorSynchronous

_BANK: KeyPath = ("pipeline", "rotor_bank")
_SYNCHRONOUS: KeyPath = ("pipeline", "rotor_synchronous")
_LEAST_PROBE_ANGLE_DEG = {ROTOR_BANK: 30.0, ROTOR_SYNCHRONOUS: 30.0}
_LEAST_FOR_PULSES = 4.0
_LEAST_SAMPLES_PER_REV = 12.0
"""Mean, 1X and 2X both ways are five complex figures; the rest is left for the noise."""


def rotor_checks(draft: MachineFile) -> Iterator[Iterator[Finding]]:
    """Every check of the rotor's detectors.

    Args:
        draft: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        if (bank := draft.pipeline.rotor_bank) is not None:
            yield _rotor(draft, _BANK, "the model bank")
            yield _modelled(draft)
            yield _sensors(draft, _BANK, bank.probes, bank.keyphasor)
            yield _geometry(draft, _BANK, bank.probes, _LEAST_PROBE_ANGLE_DEG[ROTOR_BANK])
            yield _pulses(draft, bank)
            yield from mode_checks(draft, bank)
    with suppress(UnusableValueError):
        if (synchronous := draft.pipeline.rotor_synchronous) is not None:
            at, probes = _SYNCHRONOUS, synchronous.probes
            yield _rotor(draft, at, "the calibrated rotor")
            yield _sensors(draft, at, probes, synchronous.keyphasor)
            yield _geometry(draft, at, probes, _LEAST_PROBE_ANGLE_DEG[ROTOR_SYNCHRONOUS])
            yield _speed_source(synchronous)
            yield _samples_per_rev(draft, synchronous)


def check_alarm_detector(draft: MachineFile, alarm: DiagnosisAlarm, at: KeyPath) -> Iterator[Finding]:
    """The detector that an alarm follows is there and can raise it.

    Args:
        draft: the machine file, or what is valid of it.
        alarm: the alarm.
        at: where it stands in the file.
    """
    tables = {ROTOR_BANK: "rotor_bank", ROTOR_SYNCHRONOUS: "rotor_synchronous", BEARING: "bearing"}
    if alarm.detector not in tables:
        yield Finding((*at, "detector"), "there is no such detector", choice(alarm.detector, tables))
        return
    table = tables[alarm.detector]
    if getattr(draft.pipeline, table) is None:
        yield Finding(
            (*at, "detector"),
            "this detector is not configured",
            f"write a table [pipeline.{table}], or remove the alarm",
        )
        return
    bank = draft.pipeline.rotor_bank
    if alarm.detector == ROTOR_BANK and bank is not None and bank.rule == "paper":
        yield Finding(
            (*at, "detector"),
            'would never raise it: pipeline.rotor_bank.rule = "paper" gives probabilities only',
            'write rule = "cusum", or remove the alarm',
        )


def _rotor(draft: MachineFile, at: KeyPath, who: str) -> Iterator[Finding]:
    if draft.machine.rotor is None:
        yield Finding(
            at,
            f"{who} needs the rotor's data",
            f"write a table [machine.rotor], or remove [{'.'.join(map(str, at))}]",
        )


def _modelled(draft: MachineFile) -> Iterator[Finding]:
    """What only the models of the bank need to know of the rotor."""
    rotor = draft.machine.rotor
    if rotor is None:
        return  # said already
    for key, about, example in (
        ("eccentricity_um", "mass eccentricity", "10.0"),
        ("contact_stiffness", "stiffness of the stator", "30.0"),
    ):
        with suppress(UnusableValueError):
            if getattr(rotor, key) is None:
                yield Finding(
                    ("machine", "rotor", key),
                    f"is missing: {about}; the model bank needs it",
                    f"add e.g. {key} = {example} to [machine.rotor], or remove [pipeline.rotor_bank]",
                )


def _named(draft: MachineFile) -> dict[str, Sensor]:
    return {sensor.name: sensor for sensor in draft.sensors}


def _sensors(
    draft: MachineFile, at: KeyPath, probes: tuple[str, str], keyphasor: str | None
) -> Iterator[Finding]:
    """The probes and the keyphasor exist, are what they should be, and are or can be sampled together."""
    sensors = _named(draft)
    asked: list[tuple[KeyPath, str, str]] = [
        ((*at, "probes", 0), probes[0], "proximity"),
        ((*at, "probes", 1), probes[1], "proximity"),
    ]
    if keyphasor is not None:
        asked.append(((*at, "keyphasor"), keyphasor, "keyphasor"))
    for path, name, wanted in asked:
        if name not in sensors:
            yield Finding(path, "there is no such sensor", choice(name, sensors))
        elif sensors[name].type != wanted:
            suitable = [sensor.name for sensor in draft.sensors if sensor.type == wanted]
            yield Finding(path, f'must be a sensor of type "{wanted}"', choice(name, suitable))
    if draft.pipeline.alignment is not None:
        return
    streams = {
        name: sensors[name].stream
        for _, name, _ in asked
        if name in sensors and sensors[name].stream in draft.streams
    }
    other, its_name = ("keyphasor", keyphasor) if keyphasor is not None else ("probe", probes[0])
    stream = streams.get(its_name)
    for index, probe in enumerate(probes):
        if stream is not None and streams.get(probe, stream) != stream:
            yield Finding(
                (*at, "probes", index),
                f'is in stream "{streams[probe]}", but {other} "{its_name}" is in stream "{stream}"',
                "take sensors of one stream, or write a table [pipeline.alignment]: it puts samples that are "
                "not taken at the same instants on one grid",
            )


def _geometry(
    draft: MachineFile, detector: KeyPath, probes: tuple[str, str], least_angle_deg: float
) -> Iterator[Finding]:
    """The two probes look at the shaft from directions that tell x from y."""
    at: KeyPath = (*detector, "probes")
    if probes[0] == probes[1]:
        yield Finding((*at, 1), "is the same probe twice", "name two different probes")
        return
    sensors = _named(draft)
    angles: list[float] = []
    for index, name in enumerate(probes):
        probe = sensors.get(name)
        if probe is None or probe.type != "proximity":
            return
        if probe.angle_deg is None:
            yield Finding(
                (*at, index),
                f'sensor "{name}" does not say where it points',
                f'add angle_deg to the entry "{name}" of sensors, e.g. {90 * index}.0',
            )
        else:
            angles.append(probe.angle_deg)
    if len(angles) == len(probes):
        apart = abs(math.degrees(math.asin(math.sin(math.radians(angles[1] - angles[0])))))
        if apart < least_angle_deg:
            yield Finding(
                at,
                f"the probes point along one line ({angles[0]:g} and {angles[1]:g} deg): they see one "
                "direction of the motion only",
                "correct angle_deg of the sensors, or take probes that are some 90 deg apart",
            )


def _speed_source(synchronous: RotorSynchronous) -> Iterator[Finding]:
    """What tells the shaft angle is there, and what is there tells it."""
    if synchronous.reference == "keyphasor" and synchronous.keyphasor is None:
        yield Finding(
            (*_SYNCHRONOUS, "speed_source"),
            "needs a keyphasor, and none is named",
            'add keyphasor, or write speed_source = "fixed" or "orbit"',
        )
    elif synchronous.reference != "keyphasor" and synchronous.keyphasor is not None:
        yield Finding(
            (*_SYNCHRONOUS, "keyphasor"),
            f'is not looked at: the shaft angle comes from speed_source = "{synchronous.reference}"',
            'write speed_source = "keyphasor", or remove it',
            fatal=False,
        )


def _pulses(draft: MachineFile, bank: RotorBank) -> Iterator[Finding]:
    """A revolution has enough samples for the keyphasor's pulse."""
    keyphasor = _named(draft).get(bank.keyphasor)
    if keyphasor is None or keyphasor.stream not in draft.streams:
        return
    rate_hz, speed_rpm = draft.streams[keyphasor.stream].rate_hz, abs(draft.machine.speed_rpm)
    samples = 60.0 * rate_hz / speed_rpm
    if samples < _LEAST_FOR_PULSES:
        yield Finding(
            (*_BANK, "keyphasor"),
            f"is sampled {samples:.3g} times a revolution ({rate_hz:g} Hz at {speed_rpm:g} rpm): its pulses "
            f"need {_LEAST_FOR_PULSES:g}",
            f"sample at {_LEAST_FOR_PULSES * speed_rpm / 60.0:.4g} Hz or faster",
        )


def _samples_per_rev(draft: MachineFile, synchronous: RotorSynchronous) -> Iterator[Finding]:
    """A revolution has enough samples for its harmonics."""
    named = _named(draft)
    sensors = [named[name] for name in synchronous.sensors if name in named]
    rates_hz = [draft.streams[s.stream].rate_hz for s in sensors if s.stream in draft.streams]
    if not rates_hz:
        return
    rate_hz, speed_rpm = min(rates_hz), abs(draft.machine.speed_rpm)
    samples = 60.0 * rate_hz / speed_rpm
    if samples < _LEAST_SAMPLES_PER_REV:
        yield Finding(
            (*_SYNCHRONOUS, "probes"),
            f"are sampled {samples:.3g} times a revolution ({rate_hz:g} Hz at {speed_rpm:g} rpm); 1X and 2X "
            f"need {_LEAST_SAMPLES_PER_REV:g}",
            f"sample at {_LEAST_SAMPLES_PER_REV * speed_rpm / 60.0:.4g} Hz or faster, "
            "or remove [pipeline.rotor_synchronous]",
        )
