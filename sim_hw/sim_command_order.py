"""What ``daqsvc sim`` asks of a node on a bus, whatever its kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daqsvc.settings import MachineFile
    from daqsvc.settings.buses import Bus
    from sim_hw.node_faults import NodeFaults
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_command_signals import StreamSamples


class NodeError(Exception):
    """A node cannot be put on its bus; says why and what to do."""


@dataclass(frozen=True, slots=True)
class NodeOrder:
    """What a node is asked to be.

    Attributes:
        machine: the machine file.
        bus: name of the bus in it.
        streams: what to send, stream by stream.
        faults: what goes wrong with the node and its link.
        unixbus: path of the virtual bus to use instead of the machine file's CAN interface.
        link: where to put the link to a pseudo-terminal, instead of where the machine file looks for it.
        port: TCP port to serve, instead of the machine file's.
    """

    machine: MachineFile
    bus: str
    streams: Sequence[StreamSamples]
    faults: NodeFaults | None = None
    unixbus: Path | None = None
    link: Path | None = None
    port: int | None = None

    @property
    def settings(self) -> Bus:
        """The bus's table in the machine file."""
        return self.machine.buses[self.bus]


class SimNode(Protocol):
    """A device on a bus, ready to play."""

    address: str
    """Where a client finds it, in words: an interface, a port, the path of a terminal."""

    async def ready(self) -> None:
        """Wait until a client is there, where that can be told."""
        ...

    async def play(self, pacer: Pacer) -> None:
        """Play everything, as the pacer lets time pass."""
        ...

    def figures(self) -> dict[str, dict[str, Any]]:
        """What has been done so far, by stream: at least ``samples_sent``."""
        ...

    async def close(self) -> None:
        """Leave the bus."""
        ...
