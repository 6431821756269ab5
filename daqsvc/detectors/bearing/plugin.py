"""The bearings' detector as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.detectors.bearing.checks import bearing_checks
from daqsvc.detectors.bearing.kinematics import orders_by
from daqsvc.detectors.bearing.settings import BEARING, Bearing
from daqsvc.diagnosis.plugin import DetectorPlugin
from daqsvc.diagnosis.reading import Reading
from daqsvc.errors.detectors import UNFIT_BEARING
from daqsvc.settings.problems import AssemblyError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.detectors.bearing.recorded import RecordedBearings
    from daqsvc.detectors.bearing.settings import WatchedBearing
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.recorded import RecordingOptions
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import Finding


class BearingPlugin(DetectorPlugin[Bearing]):
    """Bearings judged by the lines of their kinematics, and against the healthy machine."""

    settings = Bearing
    about = "the rolling bearings"
    detector = BEARING
    calibrated = True
    place = 3

    def checks(self, draft: MachineFile, settings: Bearing) -> Iterator[Iterator[Finding]]:
        """See `PipelineTable.checks`."""
        return bearing_checks(draft, settings)

    def describe(self, machine: MachineFile, settings: Bearing) -> str:
        """See `PipelineTable.describe`."""
        del machine
        return _described(settings)

    def build(self, machine: MachineFile, settings: Bearing, store: Path | None) -> tuple[Detector, ...]:
        """See `DetectorPlugin.build`."""
        from daqsvc.detectors.bearing.build import bearing_detector  # noqa: PLC0415 - SciPy's statistics

        try:
            return (bearing_detector(machine, settings, store),)
        except ValueError as error:
            raise AssemblyError(f"{machine.path}: {error}", code=UNFIT_BEARING) from error

    def check_files(self, machine: MachineFile, settings: Bearing) -> None:
        """See `DetectorPlugin.check_files`: its calibration, and that its bearings are known."""
        self.build(machine, settings, None)

    def recorded(
        self, machine: MachineFile, settings: Bearing, options: RecordingOptions
    ) -> RecordedBearings:
        """See `DetectorPlugin.recorded`."""
        from daqsvc.detectors.bearing.recorded import RecordedBearings  # noqa: PLC0415 - brings SciPy

        return RecordedBearings(machine, settings, options)

    def readings(self, machine: MachineFile, settings: Bearing) -> Iterator[Reading]:
        """See `DetectorPlugin.readings`."""
        from daqsvc.detectors.bearing.finding import WORDS  # noqa: PLC0415 - brings SciPy's statistics

        del machine, settings
        for word in WORDS:
            yield Reading(BEARING, "probabilities", word)


def _described(settings: Bearing) -> str:
    healthy = (
        f"the first {settings.calibrate_s:g} s are the healthy state, kept over restarts"
        if settings.calibration is None
        else f"healthy state in {settings.calibration}"
    )
    return "; ".join(
        [
            *(_watched(bearing) for bearing in settings.bearings),
            *(() if settings.keyphasor is None else (f"speed by {settings.keyphasor}",)),
            healthy,
            f'false alarms of "changed" {settings.false_alarm_probability:g} an evaluation',
        ]
    )


def _watched(bearing: WatchedBearing) -> str:
    orders, geometry = bearing.orders, bearing.geometry
    kinematics = f"{bearing.type}"
    if orders is not None:
        kinematics = f"BPFI {orders.bpfi:g}, BPFO {orders.bpfo:g}, BSF {orders.bsf:g}, FTF {orders.ftf:g}"
    elif geometry is not None:
        made = orders_by(geometry)
        kinematics = (
            f"{geometry.balls} of {geometry.ball_diameter_mm:g} mm on {geometry.pitch_diameter_mm:g} mm: "
            f"BPFI {made.inner:.4g}, BPFO {made.outer:.4g}, BSF {made.ball:.4g}, FTF {made.cage:.4g}"
        )
    by = bearing.sensor
    if bearing.rotor_sensor is not None:
        by += f", races also by direction with {bearing.rotor_sensor}"
    return f"{bearing.name} ({kinematics}) by {by}"
