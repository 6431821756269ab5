"""Whether what the bearings' detector is told fits together: sensors, rates, windows, orders."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.detectors.bearing.settings import WINDOW_S
from daqsvc.detectors.shaft.checks import named
from daqsvc.settings.layout_checks import unique
from daqsvc.settings.modbus import WaveformLayout
from daqsvc.settings.problems import Finding, choice

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.bearing.settings import Bearing, WatchedBearing
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import KeyPath

_BEARING: KeyPath = ("pipeline", "bearing")
_LEAST_RATE_HZ = 2500.0
"""Whatever tells of a bearing lies from 400 Hz up, and a band of less than 1.6 octaves tells little."""
_DIRECTION_RATE_HZ = 24_000.0
_LEAST_REVOLUTIONS = 25.0
_RING_WINDOWS = 2
_LEAST_BLOCK_S = 0.5 * WINDOW_S
"""A shorter block of samples tells the detector nothing."""


def bearing_checks(draft: MachineFile, given: Bearing) -> Iterator[Iterator[Finding]]:
    """Every check of the bearings' detector.

    Args:
        draft: the machine file, or what is valid of it.
        given: its bearings.
    """
    yield unique([bearing.name for bearing in given.bearings], (*_BEARING, "bearings"), "bearing")
    for index, bearing in enumerate(given.bearings):
        at = (*_BEARING, "bearings", index)
        yield _kinematics(bearing, at)
        yield _sensors(draft, bearing, at)
        yield _direction(draft, bearing, at)
    yield _one_stream(draft, given)
    yield _keyphasor(draft, given)
    yield _speed(draft)
    yield _ring(draft)
    yield _blocks(draft, given)


def _kinematics(bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """The orders come from one place, and are in an order that a bearing can have."""
    if (bearing.type is None) == (bearing.orders is None):
        yield Finding(
            at,
            "has neither type nor orders" if bearing.type is None else "has both type and orders",
            'write type = "6205-2RS", or orders = { bpfi = .., bpfo = .., bsf = .., ftf = .. }',
        )
    orders = bearing.orders
    if orders is not None and not orders.ftf < 0.5 < orders.bpfo < orders.bpfi:
        yield Finding(
            (*at, "orders"),
            "are not those of a bearing whose outer ring stands still: ftf < 0.5 < bpfo < bpfi",
            "give them per revolution of the shaft, not in Hz",
        )


def _sensors(draft: MachineFile, bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """The sensors are accelerometers, sampled fast enough."""
    sensors = named(draft)
    accelerometers = [name for name, sensor in sensors.items() if sensor.type == "accelerometer"]
    for key, name in (("sensor", bearing.sensor), ("rotor_sensor", bearing.rotor_sensor)):
        if name is None:
            continue
        if name not in sensors:
            yield Finding((*at, key), "there is no such sensor", choice(name, accelerometers))
        elif name not in accelerometers:
            yield Finding(
                (*at, key), 'must be a sensor of type "accelerometer"', choice(name, accelerometers)
            )
        elif sensors[name].stream in draft.streams:
            rate_hz = draft.streams[sensors[name].stream].rate_hz
            if rate_hz < _LEAST_RATE_HZ:
                yield Finding(
                    (*at, key),
                    f"is sampled at {rate_hz:g} Hz: a bearing rings above 400 Hz",
                    f"sample at {_LEAST_RATE_HZ:g} Hz or faster",
                )


def _direction(draft: MachineFile, bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """What tells the races by direction is there as a whole, and can."""
    if (bearing.rotor_sensor is None) != (bearing.model is None):
        missing, there = ("model", "rotor_sensor") if bearing.model is None else ("rotor_sensor", "model")
        yield Finding(
            (*at, there),
            f"is of no use without {missing}",
            f"add {missing}, or remove it: the races are then told by their lines alone",
        )
        return
    if bearing.rotor_sensor is None:
        return
    if bearing.rotor_sensor == bearing.sensor:
        yield Finding(
            (*at, "rotor_sensor"), "is the sensor on the housing", "name the one that moves with the rotor"
        )
        return
    sensor = named(draft).get(bearing.sensor)
    if sensor is None or sensor.stream not in draft.streams:
        return
    rate_hz = draft.streams[sensor.stream].rate_hz
    if rate_hz < _DIRECTION_RATE_HZ:
        yield Finding(
            (*at, "rotor_sensor"),
            f"at {rate_hz:g} Hz inner and outer race look alike to any two sensors of most bearings",
            f"sample at {_DIRECTION_RATE_HZ:g} Hz or faster, or remove it",
            fatal=False,
        )


def _one_stream(draft: MachineFile, given: Bearing) -> Iterator[Finding]:
    sensors = named(draft)
    first = sensors.get(given.bearings[0].sensor)
    if first is None:
        return
    for index, bearing in enumerate(given.bearings):
        for key, name in (("sensor", bearing.sensor), ("rotor_sensor", bearing.rotor_sensor)):
            other = None if name is None else sensors.get(name)
            if other is not None and other.stream != first.stream:
                yield Finding(
                    (*_BEARING, "bearings", index, key),
                    f'is in stream "{other.stream}", but "{first.name}" is in stream "{first.stream}"',
                    "take sensors of one stream: bearings of a machine are compared",
                )


def _keyphasor(draft: MachineFile, given: Bearing) -> Iterator[Finding]:
    """What measures the speed is a keyphasor, sampled with the accelerometers."""
    if given.keyphasor is None:
        return
    at = (*_BEARING, "keyphasor")
    sensors = named(draft)
    keyphasors = [name for name, sensor in sensors.items() if sensor.type == "keyphasor"]
    if given.keyphasor not in sensors:
        yield Finding(at, "there is no such sensor", choice(given.keyphasor, keyphasors))
    elif given.keyphasor not in keyphasors:
        yield Finding(at, 'must be a sensor of type "keyphasor"', choice(given.keyphasor, keyphasors))
    else:
        first, own = sensors.get(given.bearings[0].sensor), sensors[given.keyphasor].stream
        if first is not None and own != first.stream:
            yield Finding(
                at,
                f'is in stream "{own}", but "{first.name}" is in stream "{first.stream}"',
                "sample both in one stream, or remove it: the machine is then taken to keep to speed_rpm",
            )


def _speed(draft: MachineFile) -> Iterator[Finding]:
    """A window holds enough revolutions to resolve the lines."""
    speed_rpm = abs(draft.machine.speed_rpm)
    revolutions = WINDOW_S * speed_rpm / 60.0
    if revolutions < _LEAST_REVOLUTIONS:
        yield Finding(
            _BEARING,
            f"a window of {WINDOW_S:g} s has {revolutions:.3g} revolutions at {speed_rpm:g} rpm; the lines "
            f"of a bearing need {_LEAST_REVOLUTIONS:g}",
            "remove it: this machine is too slow for it",
        )


def _ring(draft: MachineFile) -> Iterator[Finding]:
    ring_s = draft.pipeline.ring_s
    if ring_s < _RING_WINDOWS * WINDOW_S:
        yield Finding(
            _BEARING,
            f"a ring of {ring_s:g} s must hold at least {_RING_WINDOWS} windows of {WINDOW_S:g} s",
            f"write ring_s = {_RING_WINDOWS * WINDOW_S:g} or more in [pipeline]",
        )


def _blocks(draft: MachineFile, given: Bearing) -> Iterator[Finding]:
    """Blocks that a device takes by themselves are long enough for a look each."""
    first = named(draft).get(given.bearings[0].sensor)
    stream = None if first is None else draft.streams.get(first.stream)
    if first is None or stream is None or not isinstance(stream.layout, WaveformLayout):
        return
    least = math.ceil(_LEAST_BLOCK_S * stream.rate_hz)
    if stream.layout.samples < least:
        yield Finding(
            ("streams", first.stream, "layout", "samples"),
            f"are {stream.layout.samples / stream.rate_hz:.3g} s at {stream.rate_hz:g} Hz; a bearing is "
            f"judged by {_LEAST_BLOCK_S:g} s or more",
            f"make the device take blocks of {least} samples, or remove [pipeline.bearing]",
        )
