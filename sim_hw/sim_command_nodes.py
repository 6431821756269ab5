"""The nodes that ``daqsvc sim`` knows, by the driver that reads their bus.

Another kind registers by entry point in the group ``daqsvc.sim_nodes``, under the name that the machine file
says in ``driver = "..."``: a callable that takes a `NodeOrder` and returns a `SimNode` that is ready to play.
"""

from __future__ import annotations

import asyncio
import socket
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Protocol

import can
from can.interfaces.socketcan import SocketcanBus

from daqsvc import assembly_drivers
from sim_hw.nodes.can_node import CanNode

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence
    from pathlib import Path

    from daqsvc.settings import MachineFile
    from sim_hw.node_faults import NodeFaults
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_command_signals import StreamSamples

NODES = "daqsvc.sim_nodes"


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
    def options(self) -> dict[str, Any]:
        """The bus's settings."""
        return dict(self.machine.buses[self.bus].model_dump())


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


async def node_for(order: NodeOrder) -> SimNode:
    """Put a node of the right kind on its bus.

    Raises:
        NodeError: there is no such kind, or it cannot be put there.
    """
    driver = str(order.options["driver"])
    known: dict[str, Callable[[NodeOrder], Awaitable[SimNode]]] = {
        "can": CanNodes.open,
        "modbus": _modbus_nodes,
        "serial": _serial_nodes,
    }
    known |= {point.name: point.load() for point in entry_points(group=NODES)}
    if driver not in known:
        raise NodeError(
            f"buses.{order.bus}.driver = {driver!r}: no such node can be simulated; there are "
            f"{', '.join(sorted(known))}. Install the package that brings it, or choose other streams with "
            "--stream"
        )
    try:
        return await known[driver](order)
    except ValueError as error:
        raise NodeError(f"bus {order.bus} cannot be played: {error}") from error


class CanNodes:
    """All streams of a CAN bus, each a node of its own."""

    def __init__(self, address: str, nodes: dict[str, CanNode]) -> None:
        self.address = address
        self._nodes = nodes

    @classmethod
    async def open(cls, order: NodeOrder) -> CanNodes:
        """See `node_for`."""
        options = order.options
        if order.unixbus is not None:
            options |= {"interface": "unixbus", "channel": str(order.unixbus), "options": {}}
        interface, channel = options["interface"], options["channel"]
        if interface == "virtual":
            raise NodeError(
                f'buses.{order.bus}: python-can\'s interface "virtual" lives within one process; use a '
                "virtual bus between processes with --bus PATH"
            )

        chosen = {key: options[key] for key in ("bitrate", "data_bitrate") if options.get(key)}
        chosen |= options["options"] or {}
        # A node reads nothing: what the others send must not pile up for it.
        chosen |= {"receive": False} if interface == "unixbus" else {}

        def bus() -> can.BusABC:
            opened = can.Bus(interface=interface, channel=channel, fd=options["fd"], **chosen)
            if isinstance(opened, SocketcanBus):
                opened.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            return opened

        nodes: dict[str, CanNode] = {}
        opened: list[can.BusABC] = []
        try:
            for played in order.streams:
                opened.append(await asyncio.to_thread(bus))
                layout = assembly_drivers.frame_layout(order.machine, played.stream)
                nodes[played.stream] = CanNode(
                    opened[-1],
                    layout,
                    played.samples,
                    played.rate_hz,
                    # One babbling node is enough for a bus.
                    faults=order.faults if not nodes or order.faults is None else order.faults.without_babble,
                    clip=True,
                    reopen=bus,
                )
        except BaseException as error:
            for each in opened:
                each.shutdown()
            if isinstance(error, can.CanError | OSError):
                raise NodeError(
                    f"CAN bus {order.bus} ({interface} {channel}) cannot be opened: {error}"
                ) from error
            raise
        return cls(f"{interface} {channel}", nodes)

    async def ready(self) -> None:
        """See `SimNode.ready`: nobody can tell who listens to a CAN bus."""

    async def play(self, pacer: Pacer) -> None:
        """See `SimNode.play`."""
        async with asyncio.TaskGroup() as group:
            for node in self._nodes.values():
                group.create_task(node.play(pacer))

    def figures(self) -> dict[str, dict[str, Any]]:
        """See `SimNode.figures`."""
        return {name: node.figures() for name, node in self._nodes.items()}

    async def close(self) -> None:
        """See `SimNode.close`."""
        for node in self._nodes.values():
            node.close()


async def _modbus_nodes(order: NodeOrder) -> SimNode:
    from sim_hw.sim_command_polled import ModbusNodes  # noqa: PLC0415 - brings pymodbus

    return await ModbusNodes.open(order)


async def _serial_nodes(order: NodeOrder) -> SimNode:
    from sim_hw.sim_command_serial import SerialNodes  # noqa: PLC0415 - brings pyserial

    return await SerialNodes.open(order)
