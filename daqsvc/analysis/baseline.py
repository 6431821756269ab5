"""The healthy machine out of a calibration file, as far as the file knows it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from daqsvc.rotor.calibration.file import CalibrationFileError, load_record

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration


def load_baseline(
    path: Path | str, speed_rpm: float | None, clearance_um: float | None = None
) -> tuple[LavalRotor, Calibration | None]:
    """What a calibration file says about the machine at a speed.

    Args:
        path: the file.
        speed_rpm: shaft speed; None where only a keyphasor tells it.
        clearance_um: radial clearance, in place of the file's.

    Returns:
        The rotor, and the baseline; None if the file holds a run-up only, so that the first revolutions of a
        recording have to be the baseline.

    Raises:
        CalibrationFileError: the file cannot be read or used, or has baselines, but none of that speed.
    """
    record = load_record(path)
    try:
        calibration = record.at(speed_rpm) if record.steady else None
    except ValueError as error:
        raise CalibrationFileError(f"{path}: {error}") from None
    rotor = record.rotor if calibration is None else calibration.rotor
    if clearance_um is not None:
        rotor = replace(rotor, clearance_um=clearance_um)
        calibration = None if calibration is None else replace(calibration, rotor=rotor)
    return rotor, calibration
