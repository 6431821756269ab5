"""Recordings of a machine that has a machine file, as `calibrate_recordings` wants them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.analysis.calibrating import CalibrationSetup
from daqsvc.analysis.machine import MachineAnalyst
from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.recording.channels import LengthUnit
    from daqsvc.recording.recording import Recording
    from daqsvc.settings import MachineFile


class MachineRecordings:
    """Finds the sensors of a machine in its recordings.

    Args:
        machine: a machine file with ``[pipeline.rotor_synchronous]``; its ``calibration`` is not looked at.
        channels: which variable of a recording is which sensor or channel.
        rate_hz: sampling rate; None: what a recording says.
        unit: unit of the proximity probes in the recordings; None: those of the sensors.
    """

    def __init__(
        self,
        machine: MachineFile,
        channels: Mapping[str, str],
        rate_hz: float | None,
        unit: LengthUnit | None,
    ) -> None:
        given = machine.pipeline.table(RotorSynchronous)
        assert given is not None  # noqa: S101 - the command has asked for it
        self._given = given.model_copy(update={"calibration": None})
        pipeline = machine.pipeline.model_copy(update={"rotor_synchronous": self._given})
        self._machine = machine.model_copy(update={"pipeline": pipeline})
        self._analyst = MachineAnalyst(
            machine=str(machine.path), channels=channels, rate_hz=rate_hz, unit=unit
        )

    def setup(self, sweep_rpm: tuple[float, float] | None) -> CalibrationSetup:
        """What the machine file says.

        Args:
            sweep_rpm: see `CalibrationSetup`.

        Raises:
            ValueError: the map names what is no sensor or channel.
        """
        self._analyst.check_map(self._machine)
        taken = self._analyst.setup(self._machine, self._given)
        return CalibrationSetup(taken=taken, sweep_rpm=sweep_rpm)

    def load(self, path: str) -> Recording:
        """The sensors of the calibrated rotor in a recording.

        Raises:
            RecordingError: it cannot be read.
            RefusedError: it lacks one of them.
        """
        return self._analyst.load(self._machine, path, self._given.sensors)
