"""From a machine file to what is known of its streams: how often something comes, and how much at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.dsp.quality.missing import Patience

if TYPE_CHECKING:
    from daqsvc.settings.buses import Block
    from daqsvc.settings.models import MachineFile


def patience(machine: MachineFile, stream: str, rate_hz: float) -> Patience:
    """How long a stream, or a grid of several, may be silent.

    Args:
        machine: the machine file.
        stream: its name, or that of the grid.
        rate_hz: its sampling rate.
    """
    block = _block(machine, stream)
    if block is None:
        return Patience(NS_PER_S / rate_hz)
    every_ns = None if block.every_s is None else round(block.every_s * NS_PER_S)
    return Patience(snapshots=True, every_ns=every_ns)


def at_once(machine: MachineFile, stream: str) -> int:
    """Samples that come in one piece of a stream, or a grid, and are judged as one; 0 if none need to be."""
    block = _block(machine, stream)
    return 0 if block is None else block.samples


def _block(machine: MachineFile, stream: str) -> Block | None:
    return machine.streams[stream].layout.block if stream in machine.streams else None
