"""From a machine file to what is known of its streams: how often something comes, and how much at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.diagnosis.silence import Patience
from daqsvc.settings.modbus import WaveformLayout

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def patience(machine: MachineFile, stream: str, rate_hz: float) -> Patience:
    """How long a stream, or a grid of several, may be silent.

    Args:
        machine: the machine file.
        stream: its name, or that of the grid.
        rate_hz: its sampling rate.
    """
    given = _snapshots(machine, stream)
    if given is None:
        return Patience(NS_PER_S / rate_hz)
    every_ns = None if given.trigger is None else round(given.trigger.every_s * NS_PER_S)
    return Patience(snapshots=True, every_ns=every_ns)


def at_once(machine: MachineFile, stream: str) -> int:
    """Samples that come in one piece of a stream, or a grid, and are judged as one; 0 if none need to be."""
    given = _snapshots(machine, stream)
    return 0 if given is None else given.samples


def _snapshots(machine: MachineFile, stream: str) -> WaveformLayout | None:
    given = machine.streams[stream].layout if stream in machine.streams else None
    return given if isinstance(given, WaveformLayout) else None
