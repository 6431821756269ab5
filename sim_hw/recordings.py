"""Recordings that are played: files of any kind, and CAN logs by the machine file with their layouts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.errors.recordings import NEEDS_MACHINE_FILE
from daqsvc.recording import RecordingError
from daqsvc.recording.formats import named_as_can_log
from daqsvc.recording.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from daqsvc.recording.recording import Recording
    from daqsvc.settings import MachineFile


def load_played(
    path: Path,
    channels: Mapping[str, str] | None,
    rate_hz: float | None,
    machine: MachineFile | None,
    remedy: str,
) -> Recording:
    """Read what is played.

    Args:
        path: a file, a CAN log, or a folder of CAN logs.
        channels: see `load_recording`; not of a CAN log.
        rate_hz: the same; of a CAN log it must be that of the machine file.
        machine: states how the frames of a CAN log are laid out.
        remedy: how that is given where it is missing.

    Raises:
        RecordingError: it cannot be read.
    """
    if not (path.is_dir() or named_as_can_log(path)):
        return load_recording(path, channels, rate_hz)
    if machine is None:
        raise RecordingError(
            f"{path} is a CAN log, which only the layouts of a machine file make sense of: {remedy}",
            NEEDS_MACHINE_FILE,
        )
    if channels:
        raise RecordingError(
            f"{path} is a CAN log, of which the machine file states channels; leave out --map",
            NEEDS_MACHINE_FILE,
        )
    from daqsvc.offline.can_logs import load_can_log  # noqa: PLC0415 - brings python-can and kernels

    return load_can_log(machine, str(path), rate_hz)
