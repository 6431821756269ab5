"""Whether probes, keyphasor and rotor are there as detectors of the rotor need them, and fit together."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.errors.detectors import NEEDS_ANGLES, NEEDS_ROTOR
from daqsvc.errors.machine_file import (
    NAMED_TWICE,
    NO_SUCH_NAME,
    PROBES_IN_LINE,
    SAMPLED_APART,
    WRONG_SENSOR_TYPE,
)
from daqsvc.settings.problems import Finding, choice

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.problems import KeyPath

_LEAST_PROBE_ANGLE_DEG = 30.0
LEAST_FOR_PULSES = 4.0
"""Samples of a revolution that its keyphasor's pulse takes."""


def check_rotor(draft: MachineFile, at: KeyPath, who: str) -> Iterator[Finding]:
    """The rotor's data are there."""
    if draft.machine.rotor is None:
        yield Finding(
            at,
            f"{who} needs the rotor's data",
            f"write a table [machine.rotor], or remove [{'.'.join(map(str, at))}]",
            code=NEEDS_ROTOR,
        )


def check_sensors(
    draft: MachineFile, at: KeyPath, probes: tuple[str, str], keyphasor: str | None
) -> Iterator[Finding]:
    """The probes and the keyphasor exist, are what they should be, and are or can be sampled together."""
    sensors = named(draft)
    asked: list[tuple[KeyPath, str, str]] = [
        ((*at, "probes", 0), probes[0], "proximity"),
        ((*at, "probes", 1), probes[1], "proximity"),
    ]
    if keyphasor is not None:
        asked.append(((*at, "keyphasor"), keyphasor, "keyphasor"))
    for path, name, wanted in asked:
        if name not in sensors:
            yield Finding(path, "there is no such sensor", choice(name, sensors), code=NO_SUCH_NAME)
        elif sensors[name].type != wanted:
            suitable = [sensor.name for sensor in draft.sensors if sensor.type == wanted]
            yield Finding(
                path, f'must be a sensor of type "{wanted}"', choice(name, suitable), code=WRONG_SENSOR_TYPE
            )
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
                code=SAMPLED_APART,
            )


def check_geometry(draft: MachineFile, detector: KeyPath, probes: tuple[str, str]) -> Iterator[Finding]:
    """The two probes look at the shaft from directions that tell x from y."""
    at: KeyPath = (*detector, "probes")
    if probes[0] == probes[1]:
        yield Finding((*at, 1), "is the same probe twice", "name two different probes", code=NAMED_TWICE)
        return
    sensors = named(draft)
    angles: list[float] = []
    for index, name in enumerate(probes):
        probe = sensors.get(name)
        if probe is None or probe.type != "proximity":
            return
        if probe.angle_deg is None:
            yield Finding(
                (*at, index),
                f'sensor "{name}" does not state where it points',
                f'add angle_deg to the entry "{name}" of sensors, e.g. {90 * index}.0',
                code=NEEDS_ANGLES,
            )
        else:
            angles.append(probe.angle_deg)
    if len(angles) == len(probes):
        apart = abs(math.degrees(math.asin(math.sin(math.radians(angles[1] - angles[0])))))
        if apart < _LEAST_PROBE_ANGLE_DEG:
            yield Finding(
                at,
                f"the probes point along one line ({angles[0]:g} and {angles[1]:g} deg): they see one "
                "direction of the motion only",
                "correct angle_deg of the sensors, or take probes that are some 90 deg apart",
                code=PROBES_IN_LINE,
            )


def named(draft: MachineFile) -> dict[str, Sensor]:
    """The sensors, by name."""
    return {sensor.name: sensor for sensor in draft.sensors}
