"""From a machine file to the grids that put the samples of several streams together."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.alignment import AlignedSource, Aligner, Alignment

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.acquisition.alignment import AlignedBlock
    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.settings.models import MachineFile

_NS_PER_MS = 1_000_000


def alignment(machine: MachineFile, clock: Clock | None, deliver: Callable[[SampleBlock], None]) -> Alignment:
    """The grids that the detectors of a machine file need; often none.

    Args:
        machine: the machine file.
        clock: of the host; None where blocks come as fast as samples were taken.
        deliver: called with each block of a grid, which is named by `Grid.name`.
    """

    def pass_on(block: AlignedBlock) -> None:
        deliver(block.as_block())

    given = machine.pipeline.alignment
    if given is None:
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
            max_error_ns=given.max_error_us * 1e3,
            max_wait_ns=round(given.max_wait_ms * _NS_PER_MS),
            clock=clock,
        )
        for grid in machine.grids
    )
