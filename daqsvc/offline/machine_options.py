"""Options of the command line as a machine file in memory, for recordings of a machine without one.

Its tables are those of the detectors; only figures that a recording has to show are left open, as NaN. Its
stream is the columns of a file. Nothing is checked here that an option has been checked for.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from daqsvc.bearing.geometry import BearingOrders, bearing_orders
from daqsvc.detectors.bearing.settings import Bearing, FaultOrders, WatchedBearing
from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
from daqsvc.diagnosis.recorded import RecordingOptions
from daqsvc.errors.command_line import WRONG_VALUE
from daqsvc.settings.models import (
    Accelerometer,
    Keyphasor,
    Machine,
    MachineFile,
    ProximityProbe,
    Rotor,
    Stream,
)
from daqsvc.settings.registry import pipeline_model
from drivers.replay.settings import ReplayBus, TableColumn, TableLayout

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping, Sequence

    from daqsvc.settings.models import Pipeline, Sensor

_RECORDING = "recording"
"""Name of the machine, its bus and its stream."""
_INSTEAD_OF_BEARING = (
    "Give --balls (or rollers, in a row), --ball-diameter-mm, --pitch-diameter-mm and --contact-deg, "
    "or --orders BPFI=..,BPFO=..,BSF=..,FTF=.."
)
_ANY_ROTOR = (1.0, 0.1)
"""Natural frequency and damping ratio of a rotor that a run-up has to show."""


class WrongValueError(ValueError):
    """The value of one option cannot be used."""

    code = WRONG_VALUE


def recording_options(arguments: argparse.Namespace, **others: Any) -> RecordingOptions:
    """What the options state of the recordings.

    Args:
        arguments: the options of `analyze` or `calibrate`.
        others: what else is known of them, by its name in `RecordingOptions`.
    """
    return RecordingOptions(channels=arguments.map, rate_hz=arguments.fs, unit=arguments.unit, **others)


def rotor_machine(arguments: argparse.Namespace) -> MachineFile:
    """The calibrated rotor that options describe.

    Args:
        arguments: of `daqsvc.commands.recording_options.add_rotor`. What `calibrate` asks is not known yet:
            natural frequency and damping may be missing, and ``sweep_rpm`` may state the speed.

    Raises:
        ValueError: the options contradict each other.
    """
    options = vars(arguments)
    probes, keyphasor, speed = arguments.probes, arguments.keyphasor, arguments.speed_rpm
    speed_rpm = math.nan if speed is None or speed.rpm is None else speed.rpm
    if math.isnan(speed_rpm) and options.get("sweep_rpm") is not None:
        speed_rpm = arguments.sweep_rpm[1]
    orbit = options.get("follow_orbit", False) or (speed is not None and speed.orbit)
    if keyphasor is not None and orbit:
        raise ValueError(
            "speed and angle come either from the keyphasor or from the orbit: leave out --keyphasor, or "
            "do not follow the orbit"
        )
    names = [*probes, *([] if keyphasor is None else [keyphasor])]
    if len({arguments.map.get(name, name) for name in names}) < len(names):
        raise ValueError(
            f"probes {probes[0]!r} and {probes[1]!r} and the keyphasor must be different channels of the "
            "recording; correct --probes, --keyphasor or --map"
        )
    sensors: list[Sensor] = [
        _sensor(ProximityProbe, name, arguments.map, "um", ac_coupled=arguments.ac_coupled) for name in probes
    ]
    if keyphasor is not None:
        threshold = math.nan if arguments.keyphasor_threshold is None else arguments.keyphasor_threshold
        hidden = {"threshold_v": threshold, "hysteresis_v": math.nan}
        sensors.append(_sensor(Keyphasor, keyphasor, arguments.map, "V", **hidden))
    frequency_hz, damping = arguments.natural_frequency_hz, arguments.damping_ratio
    asked = {
        key: options[option]
        for key, option in (
            ("calibrate_revolutions", "calibrate_revs"),
            ("false_alarms_per_1000_rev", "false_alarms_per_1000_rev"),
        )
        if option in options
    }
    rotor = RotorSynchronous.model_construct(
        probes=probes,
        keyphasor=keyphasor,
        speed_source="orbit" if orbit else None,
        natural_frequency_tolerance_percent=arguments.natural_frequency_tolerance,
        damping_tolerance_percent=arguments.damping_tolerance,
        **asked,
    )
    return _machine(
        sensors,
        _pipeline(rotor_synchronous=rotor),
        speed_rpm=speed_rpm,
        rotor=Rotor.model_construct(
            natural_frequency_hz=_ANY_ROTOR[0] if frequency_hz is None else frequency_hz,
            damping_ratio=_ANY_ROTOR[1] if damping is None else damping,
            clearance_um=arguments.clearance_um,
            static_sag_um=arguments.static_sag_um,
        ),
    )


def bearing_machine(arguments: argparse.Namespace) -> MachineFile:
    """The bearings that options name, one for each channel.

    Args:
        arguments: with ``channels``, ``speed_rpm``, ``map``, and ``bearing`` or ``orders``.

    Raises:
        ValueError: the orders contradict each other, or the catalogue does not know the bearing.
    """
    fault_orders = _orders(arguments)
    orders = FaultOrders.model_construct(
        bpfi=fault_orders.inner, bpfo=fault_orders.outer, bsf=fault_orders.ball, ftf=fault_orders.cage
    )
    bearings = tuple(
        WatchedBearing.model_construct(name=name, sensor=name, type=arguments.bearing, orders=orders)
        for name in arguments.channels
    )
    asked = {"false_alarm_probability": vars(arguments).get("false_alarm_probability")}
    table = Bearing.model_construct(
        bearings=bearings, **{key: value for key, value in asked.items() if value is not None}
    )
    return _machine(
        _accelerometers(arguments),
        _pipeline(bearing=table),
        speed_rpm=abs(arguments.speed_rpm.rpm),
    )


def accelerometer_machine(arguments: argparse.Namespace) -> MachineFile:
    """A machine of which options state accelerometers and speed only: no detector of the service watches it.

    Args:
        arguments: with ``channels``, ``speed_rpm`` and ``map``.
    """
    return _machine(_accelerometers(arguments), _pipeline(), speed_rpm=arguments.speed_rpm.rpm)


def _accelerometers(arguments: argparse.Namespace) -> list[Sensor]:
    unit = arguments.unit or "g"
    return [_sensor(Accelerometer, name, arguments.map, unit) for name in arguments.channels]


def _sensor(kind: type[Any], name: str, channels: Mapping[str, str], unit: str, **others: Any) -> Any:
    return kind.model_construct(
        name=name, stream=_RECORDING, channel=channels.get(name, name), unit=unit, **others
    )


def _pipeline(**tables: Any) -> Pipeline:
    model: type[Any] = pipeline_model()
    return cast("Pipeline", model.model_construct(**tables))


def _machine(
    sensors: Sequence[Sensor], pipeline: Pipeline, *, speed_rpm: float, rotor: Rotor | None = None
) -> MachineFile:
    columns = tuple(
        TableColumn.model_construct(name=sensor.channel, column=sensor.channel) for sensor in sensors
    )
    stream = Stream.model_construct(
        bus=_RECORDING, rate_hz=math.nan, layout=TableLayout.model_construct(columns=columns)
    )
    return MachineFile.model_construct(
        schema_version=1,
        site=_RECORDING,
        box=_RECORDING,
        machine=Machine.model_construct(name=_RECORDING, speed_rpm=speed_rpm, rotor=rotor),
        buses={_RECORDING: ReplayBus.model_construct(driver="replay", file=Path(_RECORDING))},
        streams={_RECORDING: stream},
        sensors=tuple(sensors),
        pipeline=pipeline,
    )


def _orders(arguments: argparse.Namespace) -> BearingOrders:
    """Fault orders as given, or out of the catalogue.

    Raises:
        WrongValueError: they contradict each other, or the catalogue does not know the bearing.
    """
    if arguments.bearing is not None:
        try:
            return bearing_orders(arguments.bearing)
        except KeyError as error:
            what = str(error.args[0]).partition(". ")[0]
            raise WrongValueError(f"--bearing: {what}. {_INSTEAD_OF_BEARING}") from None
    orders = arguments.orders
    try:
        return BearingOrders(
            inner=orders["BPFI"], outer=orders["BPFO"], ball=orders["BSF"], cage=orders["FTF"]
        )
    except ValueError as error:
        raise WrongValueError(f"--orders: {error}") from None
