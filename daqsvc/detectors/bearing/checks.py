"""Whether the settings of the bearings' detector fit together: sensors, rates, windows, orders."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.detectors.bearing.kinematics import orders_by
from daqsvc.detectors.bearing.settings import WINDOW_S
from daqsvc.detectors.shaft.checks import LEAST_FOR_PULSES, named
from daqsvc.errors.detectors import BEARING_FIGURES, RACES_ALIKE, TOO_SLOW_A_MACHINE, WINDOW_TOO_SHORT
from daqsvc.errors.machine_file import (
    INCOMPLETE,
    NO_SUCH_NAME,
    RING_TOO_SHORT,
    SAMPLED_APART,
    SAMPLED_TOO_SLOWLY,
    WRONG_SENSOR_TYPE,
)
from daqsvc.rounding import rounded_up
from daqsvc.settings.problems import Finding, choice, unique

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.bearing.settings import Bearing, FaultOrders, WatchedBearing
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import KeyPath

_BEARING: KeyPath = ("pipeline", "bearing")
_LEAST_RATE_HZ = 2500.0
"""All signs of a bearing lie above 400 Hz, and a band of less than 1.6 octaves shows little."""
_DIRECTION_RATE_HZ = 24_000.0
_OFF, _OFF_BSF = 0.02, 0.1
"""Share by which stated orders may be rounded; bsf is computed from a difference."""
_LEAST_REVOLUTIONS = 25.0
_RING_WINDOWS = 2
_LEAST_BLOCK_S = 0.5 * WINDOW_S
"""A shorter block of samples is of no use to the detector."""


def bearing_checks(draft: MachineFile, settings: Bearing) -> Iterator[Iterator[Finding]]:
    """Every check of the bearings' detector.

    Args:
        draft: the machine file, or what is valid of it.
        settings: its bearings.
    """
    yield unique([bearing.name for bearing in settings.bearings], (*_BEARING, "bearings"), "bearing")
    for index, bearing in enumerate(settings.bearings):
        at = (*_BEARING, "bearings", index)
        yield _kinematics(bearing, at)
        yield _sensors(draft, bearing, at)
        yield _direction(draft, bearing, at)
        yield _lines(draft, bearing, at)
    yield _one_stream(draft, settings)
    yield _keyphasor(draft, settings)
    yield _pulses(draft, settings)
    yield _speed(draft)
    yield _ring(draft)
    yield _blocks(draft, settings)


def _kinematics(bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """The orders come from one place, and are in an order that a bearing can have."""
    sources = [key for key in ("type", "orders", "geometry") if getattr(bearing, key) is not None]
    if len(sources) != 1:
        yield Finding(
            at,
            f"has both {' and '.join(sources)}" if sources else "has neither type nor orders",
            'write type = "6205-2RS", or orders = { bpfi = .., bpfo = .., bsf = .., ftf = .. }, or '
            "geometry = { balls = .., ball_diameter_mm = .., pitch_diameter_mm = .. }",
            code=BEARING_FIGURES,
        )
    if bearing.geometry is not None:
        try:
            orders_by(bearing.geometry)
        except ValueError as error:
            yield Finding(
                (*at, "geometry"),
                f"is of no bearing: {error}",
                "measure again, or look it up",
                code=BEARING_FIGURES,
            )
    orders = bearing.orders
    if orders is not None and not orders.ftf < 0.5 < orders.bpfo < orders.bpfi:
        yield Finding(
            (*at, "orders"),
            "are not those of a bearing whose outer ring stands still: ftf < 0.5 < bpfo < bpfi",
            "give them per revolution of the shaft, not in Hz",
            code=BEARING_FIGURES,
        )
    elif orders is not None:
        yield from _geometry(orders, (*at, "orders"))


def _geometry(orders: FaultOrders, at: KeyPath) -> Iterator[Finding]:
    """What any bearing with a standing outer ring has, whatever its contact angle.

    Of z balls of diameter d on a circle of diameter D, with g = d / D times the cosine of the contact
    angle. Then bpfo = z (1 - g) / 2 = z ftf, bpfi = z (1 + g) / 2, bsf = D / (2 d) (1 - g^2).
    """
    balls = orders.bpfo + orders.bpfi
    if abs(balls - round(balls)) > _OFF * balls:
        yield Finding(
            at,
            f"make {balls:.4g} balls, the number in bpfo + bpfi: a bearing has a whole number of them",
            "compare bpfo and bpfi with the data sheet of the bearing",
            fatal=False,
            code=BEARING_FIGURES,
        )
    elif abs(orders.bpfo / orders.ftf / balls - 1.0) > _OFF:
        yield Finding(
            (*at, "ftf"),
            f"does not go with bpfo and bpfi: with {balls:.3g} balls the cage turns "
            f"{orders.bpfo / balls:.4g} times a revolution",
            f"write ftf = {orders.bpfo / balls:.4g}, or compare all of them with the data sheet",
            fatal=False,
            code=BEARING_FIGURES,
        )
    ratio = 1.0 - 2.0 * orders.bpfo / balls
    most = (1.0 - ratio**2) / (2.0 * ratio)
    if orders.bsf > (1.0 + _OFF_BSF) * most:
        yield Finding(
            (*at, "bsf"),
            f"is more than {most:.4g}, how often a ball of this bearing can turn about itself",
            "write half of it if the data sheet counts both races that a damaged ball meets in a turn",
            fatal=False,
            code=BEARING_FIGURES,
        )


def _sensors(draft: MachineFile, bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """The sensors are accelerometers, sampled fast enough."""
    sensors = named(draft)
    accelerometers = [name for name, sensor in sensors.items() if sensor.type == "accelerometer"]
    for key, name in (("sensor", bearing.sensor), ("rotor_sensor", bearing.rotor_sensor)):
        if name is None:
            continue
        if name not in sensors:
            yield Finding(
                (*at, key), "there is no such sensor", choice(name, accelerometers), code=NO_SUCH_NAME
            )
        elif name not in accelerometers:
            yield Finding(
                (*at, key),
                'must be a sensor of type "accelerometer"',
                choice(name, accelerometers),
                code=WRONG_SENSOR_TYPE,
            )
        elif sensors[name].stream in draft.streams:
            rate_hz = draft.streams[sensors[name].stream].rate_hz
            if rate_hz < _LEAST_RATE_HZ:
                yield Finding(
                    (*at, key),
                    f"is sampled at {rate_hz:g} Hz: a bearing rings above 400 Hz",
                    f"sample at {_LEAST_RATE_HZ:g} Hz or faster",
                    code=SAMPLED_TOO_SLOWLY,
                )


def _direction(draft: MachineFile, bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """The keys for telling the races apart by direction are complete, and they can do it."""
    if (bearing.rotor_sensor is None) != (bearing.model is None):
        missing, there = ("model", "rotor_sensor") if bearing.model is None else ("rotor_sensor", "model")
        yield Finding(
            (*at, there),
            f"is of no use without {missing}",
            f"add {missing}, or remove it: the races are then told apart by their lines alone",
            code=INCOMPLETE,
        )
        return
    if bearing.rotor_sensor is None:
        return
    if bearing.rotor_sensor == bearing.sensor:
        yield Finding(
            (*at, "rotor_sensor"),
            "is the sensor on the housing",
            "name the one that moves with the rotor",
            code=RACES_ALIKE,
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
            code=RACES_ALIKE,
        )


def _one_stream(draft: MachineFile, settings: Bearing) -> Iterator[Finding]:
    sensors = named(draft)
    first = sensors.get(settings.bearings[0].sensor)
    if first is None:
        return
    for index, bearing in enumerate(settings.bearings):
        for key, name in (("sensor", bearing.sensor), ("rotor_sensor", bearing.rotor_sensor)):
            other = None if name is None else sensors.get(name)
            if other is not None and other.stream != first.stream:
                yield Finding(
                    (*_BEARING, "bearings", index, key),
                    f'is in stream "{other.stream}", but "{first.name}" is in stream "{first.stream}"',
                    "take sensors of one stream: bearings of a machine are compared",
                    code=SAMPLED_APART,
                )


def _keyphasor(draft: MachineFile, settings: Bearing) -> Iterator[Finding]:
    """The speed is measured by a keyphasor, sampled with the accelerometers."""
    if settings.keyphasor is None:
        return
    at = (*_BEARING, "keyphasor")
    sensors = named(draft)
    keyphasors = [name for name, sensor in sensors.items() if sensor.type == "keyphasor"]
    if settings.keyphasor not in sensors:
        yield Finding(
            at, "there is no such sensor", choice(settings.keyphasor, keyphasors), code=NO_SUCH_NAME
        )
    elif settings.keyphasor not in keyphasors:
        yield Finding(
            at,
            'must be a sensor of type "keyphasor"',
            choice(settings.keyphasor, keyphasors),
            code=WRONG_SENSOR_TYPE,
        )
    else:
        first, own = sensors.get(settings.bearings[0].sensor), sensors[settings.keyphasor].stream
        if first is not None and own != first.stream:
            yield Finding(
                at,
                f'is in stream "{own}", but "{first.name}" is in stream "{first.stream}"',
                "sample both in one stream, or remove it: the machine is then taken to keep to speed_rpm",
                code=SAMPLED_APART,
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
            code=TOO_SLOW_A_MACHINE,
        )


def _pulses(draft: MachineFile, settings: Bearing) -> Iterator[Finding]:
    """A revolution has enough samples for the keyphasor's pulse."""
    keyphasor = None if settings.keyphasor is None else named(draft).get(settings.keyphasor)
    if keyphasor is None or keyphasor.stream not in draft.streams:
        return
    rate_hz, speed_rpm = draft.streams[keyphasor.stream].rate_hz, abs(draft.machine.speed_rpm)
    samples = 60.0 * rate_hz / speed_rpm
    if samples < LEAST_FOR_PULSES:
        yield Finding(
            (*_BEARING, "keyphasor"),
            f"is sampled {samples:.3g} times a revolution ({rate_hz:g} Hz at {speed_rpm:g} rpm): its pulses "
            f"need {LEAST_FOR_PULSES:g}",
            f"sample at {rounded_up(LEAST_FOR_PULSES * speed_rpm / 60.0, 4)} Hz or faster",
            code=SAMPLED_TOO_SLOWLY,
        )


def _inner_order(bearing: WatchedBearing) -> float | None:
    """BPFI of a bearing that is not of the catalogue; None if it is not known."""
    if bearing.geometry is None:
        return None if bearing.orders is None else bearing.orders.bpfi
    with suppress(ValueError):
        return orders_by(bearing.geometry).inner
    return None


def _lines(draft: MachineFile, bearing: WatchedBearing, at: KeyPath) -> Iterator[Finding]:
    """The lines of a bearing lie below half the rate, where samples show them."""
    sensor = named(draft).get(bearing.sensor)
    inner = _inner_order(bearing)
    if inner is None or sensor is None or sensor.stream not in draft.streams:
        return
    rate_hz = draft.streams[sensor.stream].rate_hz
    line_hz = inner * abs(draft.machine.speed_rpm) / 60.0
    if line_hz >= rate_hz / 2.0:
        yield Finding(
            (*at, "sensor"),
            f"is sampled at {rate_hz:g} Hz, and the inner race's line lies at {line_hz:.0f} Hz: samples show "
            f"nothing above {rate_hz / 2.0:g} Hz",
            f"sample at {2.5 * line_hz:.0f} Hz or faster, or correct the orders or machine.speed_rpm",
            code=SAMPLED_TOO_SLOWLY,
        )


def _ring(draft: MachineFile) -> Iterator[Finding]:
    ring_s = draft.pipeline.ring_s
    if ring_s < _RING_WINDOWS * WINDOW_S:
        yield Finding(
            _BEARING,
            f"a ring of {ring_s:g} s must hold at least {_RING_WINDOWS} windows of {WINDOW_S:g} s",
            f"write ring_s = {_RING_WINDOWS * WINDOW_S:g} or more in [pipeline]",
            code=RING_TOO_SHORT,
        )


def _blocks(draft: MachineFile, settings: Bearing) -> Iterator[Finding]:
    """Blocks that a device takes by themselves are long enough for an evaluation each."""
    first = named(draft).get(settings.bearings[0].sensor)
    stream = None if first is None else draft.streams.get(first.stream)
    block = None if stream is None else stream.layout.block
    if first is None or stream is None or block is None:
        return
    least = math.ceil(_LEAST_BLOCK_S * stream.rate_hz)
    if block.samples < least:
        yield Finding(
            ("streams", first.stream, "layout", "samples"),
            f"are {block.samples / stream.rate_hz:.3g} s at {stream.rate_hz:g} Hz; a bearing is "
            f"judged by {_LEAST_BLOCK_S:g} s or more",
            f"make the device take blocks of {least} samples, or remove [pipeline.bearing]",
            code=WINDOW_TOO_SHORT,
        )
