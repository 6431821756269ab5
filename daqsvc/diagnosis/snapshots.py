"""From a machine file to its streams: how often something comes, how much at once, and on which grids."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.alignment import AlignedSource, Aligner, Alignment
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.dsp.quality.missing import Patience

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.acquisition.alignment import AlignedBlock
    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.settings.buses import Block
    from daqsvc.settings.models import MachineFile

_NS_PER_MS = 1_000_000


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


def alignment(machine: MachineFile, clock: Clock | None, deliver: Callable[[SampleBlock], None]) -> Alignment:
    """The grids that the detectors of a machine file need; often none.

    Args:
        machine: the machine file.
        clock: of the host; None where blocks come as fast as samples were taken.
        deliver: called with each block of a grid, which is named by `Grid.name`.
    """

    def pass_on(block: AlignedBlock) -> None:
        deliver(block.as_block())

    settings = machine.pipeline.alignment
    if settings is None:
        return Alignment()
    return Alignment(
        Aligner(
            grid.name,
            [
                AlignedSource(
                    name, stream.layout.channel_names, stream.rate_hz, round(stream.latency_ms * _NS_PER_MS)
                )
                for name, stream in grid.streams.items()
            ],
            pass_on,
            max_error_ns=settings.max_error_us * 1e3,
            max_wait_ns=round(settings.max_wait_ms * _NS_PER_MS),
            clock=clock,
        )
        for grid in machine.grids
    )
