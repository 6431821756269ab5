"""Build the bearings' detector from a machine file."""

from __future__ import annotations

import logging
import os
from functools import partial
from typing import TYPE_CHECKING

from daqsvc.bearing.baseline import BaselineFileError, load_bearing_baseline, save_bearing_baseline
from daqsvc.bearing.identify import ChangeRules
from daqsvc.bearing.isolation import least_rate_hz
from daqsvc.bearing.model import BearingParameters
from daqsvc.bearing.two_sensors import PairModel, TwoSensorMonitor
from daqsvc.detectors.bearing.detector import SAME_SPEED, BearingDetector
from daqsvc.detectors.bearing.direction import TwoSensors
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.detectors.bearing.kinematics import orders_of
from daqsvc.detectors.bearing.settings import BEARING
from daqsvc.dsp.quality.unit import M_S2_PER_UNIT
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.errors.code import coded
from daqsvc.errors.detectors import HEALTHY_STATE
from daqsvc.rounding import rounded_up
from daqsvc.settings.models import Keyphasor

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.detectors.bearing.settings import Bearing, WatchedBearing
    from daqsvc.settings.models import MachineFile

log = logging.getLogger(__name__)

SAME_RATE = 1e-3
"""How far two sampling rates may differ that count as one, as a share."""


def bearing_detector(
    machine: MachineFile,
    settings: Bearing,
    store: Path | None,
    calibration: Path | None = None,
    healthy: BearingBaseline | None = None,
) -> BearingDetector:
    """The detector that ``[pipeline.bearing]`` asks for.

    Args:
        machine: the machine file.
        settings: its bearings.
        store: directory of the state that survives restarts; None to begin without any and leave none.
        calibration: file with the healthy machine, in place of what the machine file names.
        healthy: the healthy machine, in place of any file.

    Raises:
        ValueError: a bearing is not in the catalogue, its orders contradict each other, or a file with the
            healthy machine cannot be used.
    """
    stream = machine.sensor(settings.bearings[0].sensor).stream
    rate_hz = machine.streams[stream].rate_hz
    bearings = [_housed(machine, index, bearing) for index, bearing in enumerate(settings.bearings)]
    speed_rpm = machine.machine.speed_rpm
    keyphasor = None if settings.keyphasor is None else _keyphasor(machine, settings.keyphasor)
    # A measured speed shows when it differs from the healthy machine's.
    same_speed_rpm = speed_rpm if keyphasor is None else None
    baseline = healthy
    kept: Path | None = None
    if baseline is not None:
        pass
    elif calibration is not None:
        baseline = _fitting(calibration, bearings, rate_hz, same_speed_rpm)
    elif settings.calibration is not None:
        try:
            baseline = _fitting(machine.resolve(settings.calibration), bearings, rate_hz, same_speed_rpm)
        except BaselineFileError as error:
            raise BaselineFileError(
                f"pipeline.bearing.calibration = {str(settings.calibration)!r}: {error}"
            ) from None
    elif store is not None:
        kept = store / f"{BEARING}.toml"
        baseline = _kept(kept, bearings, rate_hz, same_speed_rpm)
    return BearingDetector(
        machine=machine.machine.name,
        stream=stream,
        rate_hz=rate_hz,
        speed_rpm=speed_rpm,
        bearings=bearings,
        keyphasor=keyphasor,
        rules=ChangeRules(
            false_alarm_probability=settings.false_alarm_probability,
            repeatability_db=settings.repeatability_db,
        ),
        baseline=baseline,
        calibrate_s=settings.calibrate_s,
        name=BEARING,
        keep=None if kept is None else partial(_keep, kept),
    )


def healthy_machine(machine: MachineFile, settings: Bearing, calibration: Path) -> BearingBaseline:
    """The healthy machine of a file, if it is that of these bearings at their rate and speed.

    Raises:
        ValueError: it is not, the file cannot be used, or a bearing is not known.
    """
    bearings = [_housed(machine, index, bearing) for index, bearing in enumerate(settings.bearings)]
    rate_hz = machine.streams[machine.sensor(settings.bearings[0].sensor).stream].rate_hz
    return _fitting(calibration, bearings, rate_hz, machine.machine.speed_rpm)


def pair_models(machine: MachineFile, settings: Bearing) -> dict[tuple[str, ...], PairModel]:
    """Bearings with an accelerometer on rotor and housing, by the names of these in that order.

    Args:
        machine: the machine file.
        settings: its bearings, or those that a recording has.

    Raises:
        ValueError: masses and springs cannot be those of a bearing, or the rate is too low for them.
    """
    pairs = (
        (bearing.sensors, _two_sensors(machine, bearing, i)) for i, bearing in enumerate(settings.bearings)
    )
    return {tuple(sensors): two.model for sensors, two in pairs if two is not None}


def _keyphasor(machine: MachineFile, name: str) -> KeyphasorProbe:
    sensor = machine.sensor(name)
    assert isinstance(sensor, Keyphasor)  # noqa: S101 - detectors/bearing/checks.py
    column = machine.streams[sensor.stream].layout.channel_names.index(sensor.channel)
    return KeyphasorProbe(name, column, sensor.threshold_v, sensor.hysteresis_v, sensor.edge)


def _housed(machine: MachineFile, index: int, settings: WatchedBearing) -> HousedBearing:
    sensor = machine.sensor(settings.sensor)
    column = machine.streams[sensor.stream].layout.channel_names.index(sensor.channel)
    two = _two_sensors(machine, settings, index)
    units = {name: machine.sensor(name).unit for name in settings.sensors}
    return HousedBearing(settings.name, settings.sensor, column, orders_of(settings, index), two, units)


def _two_sensors(machine: MachineFile, settings: WatchedBearing, index: int) -> TwoSensors | None:
    """The accelerometer on the rotor and the masses of a bearing of a machine file; None if it has none.

    Args:
        machine: the machine file.
        settings: the bearing.
        index: its place in ``pipeline.bearing.bearings``.

    Raises:
        ValueError: its masses and springs cannot be those of a bearing, or the rate is too low for them.
    """
    if settings.rotor_sensor is None or settings.model is None:
        return None
    model = settings.model
    (m_r, m_b, m_h), (k_s, k_c, k_h), (c_s, c_c, c_h) = (
        model.masses_kg,
        model.stiffness_n_per_m,
        model.damping_n_s_per_m,
    )
    rotor, housing = machine.sensor(settings.rotor_sensor), machine.sensor(settings.sensor)
    column = machine.streams[rotor.stream].layout.channel_names.index(rotor.channel)
    m_s2_per_unit = (M_S2_PER_UNIT[rotor.unit], M_S2_PER_UNIT[housing.unit])
    try:
        parameters = BearingParameters(
            m_r=m_r, m_b=m_b, m_h=m_h, k_s=k_s, k_c=k_c, k_h=k_h, c_s=c_s, c_c=c_c, c_h=c_h
        )
    except ValueError as error:
        raise ValueError(f"pipeline.bearing.bearings[{index}].model: {error}") from None
    rate_hz, least_hz = machine.streams[housing.stream].rate_hz, least_rate_hz(parameters)
    if rate_hz < least_hz:
        raise ValueError(
            f"pipeline.bearing.bearings[{index}].model: at {rate_hz:g} samples a second the races of this "
            f"bearing look alike; sample at {rounded_up(least_hz, 4)} Hz or faster, or remove model and "
            "rotor_sensor"
        )
    return TwoSensors(rotor.name, column, PairModel(parameters, m_s2_per_unit, model.mismatch))


def _fitting(
    path: Path, bearings: list[HousedBearing], rate_hz: float, speed_rpm: float | None
) -> BearingBaseline:
    """The healthy machine of a file, if it is that of these bearings at this rate and speed.

    Args:
        path: the file.
        bearings: the bearings.
        rate_hz: sampling rate.
        speed_rpm: speed of the shaft; None: any.

    Raises:
        BaselineFileError: it is not, or the file cannot be used.
    """
    baseline = load_bearing_baseline(path)
    lacking = [
        name
        for b in bearings
        for name in b.sensors
        if b.sensors not in baseline.residuals or b.sensor not in baseline.races
    ]
    if lacking:
        known = ", ".join(baseline.races) or "none"
        raise BaselineFileError(
            f"{path}: holds nothing of {', '.join(lacking)}, but of {known}; calibrate with all of them"
        )
    for what, unit, value, wanted, tolerance in (
        ("the samples to be judged come at", "Hz", baseline.rate_hz, rate_hz, SAME_RATE),
        ("the machine turns at", "rpm", baseline.speed_rpm, abs(speed_rpm or baseline.speed_rpm), SAME_SPEED),
    ):
        if abs(value / wanted - 1.0) > tolerance:
            raise BaselineFileError(
                f"{path}: was learnt at {value:g} {unit}, and {what} {wanted:g} {unit}; "
                f"calibrate at {wanted:g} {unit}"
            )
    for bearing in bearings:
        _refuse_other_bearing(path, baseline, bearing)
    _refuse_other_units(path, baseline, bearings)
    return baseline


def _refuse_other_units(path: Path, baseline: BearingBaseline, bearings: list[HousedBearing]) -> None:
    """Refuse the healthy machine of a file whose levels are in other units than the samples.

    Raises:
        BaselineFileError: an accelerometer's unit is different.
    """
    units = {name: unit for bearing in bearings for name, unit in bearing.units.items()}
    unknown = [name for name in units if name not in baseline.units]
    if unknown:
        log.warning(
            "%s: does not state in which unit it was learnt at %s; calibrate again, and that is checked",
            path,
            ", ".join(unknown),
            extra=coded(HEALTHY_STATE),
        )
    for name, unit in units.items():
        learnt = baseline.units.get(name, unit)
        if learnt != unit:
            raise BaselineFileError(
                f"{path}: was learnt at {name} in {learnt}, and the samples to be judged are in {unit}; "
                f"calibrate in {unit}, or correct the unit"
            )


def _refuse_other_bearing(path: Path, baseline: BearingBaseline, bearing: HousedBearing) -> None:
    """Refuse the healthy machine of a file whose bearing at this place is different.

    Raises:
        BaselineFileError: it has other orders, masses, springs or dampers.
    """
    learnt = baseline.races[bearing.sensor].orders
    if learnt is None:
        log.warning(
            "%s: does not state of which bearing it was learnt at %s; calibrate again, and that is checked",
            path,
            bearing.sensor,
            extra=coded(HEALTHY_STATE),
        )
    elif not learnt.same_as(bearing.orders):
        raise BaselineFileError(
            f"{path}: was learnt at {bearing.sensor} of another bearing ({learnt}) than is watched there "
            f"({bearing.orders}); calibrate with this bearing, or restore the other"
        )
    if bearing.two is None:
        return
    pair = baseline.pairs.get(bearing.sensors)
    names = " and ".join(bearing.sensors)
    if pair is None:
        raise BaselineFileError(f"{path}: holds nothing of {names} together; calibrate with both")
    if pair.parameters != bearing.two.model.parameters:
        raise BaselineFileError(
            f"{path}: was learnt with other masses, springs or dampers of {bearing.name} than "
            "pipeline.bearing.bearings has now; calibrate again, or restore them"
        )
    try:
        TwoSensorMonitor(pair)
    except ValueError as error:
        raise BaselineFileError(f"{path}: pair of {names}: {error}; calibrate again") from None


def _kept(
    path: Path, bearings: list[HousedBearing], rate_hz: float, speed_rpm: float | None
) -> BearingBaseline | None:
    """The healthy machine that was learnt before a restart."""
    if not os.path.lexists(path):  # also if it cannot be read: the outbox reports that
        return None
    try:
        return _fitting(path, bearings, rate_hz, speed_rpm)
    except BaselineFileError as error:
        log.warning(
            "the healthy state of the bearings is learnt again: %s", error, extra=coded(HEALTHY_STATE)
        )
        return None


def _keep(path: Path, baseline: BearingBaseline) -> None:
    """Keep the healthy state, so that a restart does not take a faulty machine for a healthy one."""
    try:
        save_bearing_baseline(baseline, path)
    except BaselineFileError as error:
        log.error(  # noqa: TRY400 - the message is enough
            "the healthy state of the bearings will be lost at the next restart: %s",
            error,
            extra=coded(HEALTHY_STATE),
        )
