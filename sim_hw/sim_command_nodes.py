"""The nodes that ``daqsvc sim`` knows, by the driver that reads their bus.

Another kind registers by entry point in the group ``daqsvc.sim_nodes``, under the name that the machine file
says in ``driver = "..."``: a callable that takes a `NodeOrder` and returns a `SimNode` that is ready to play.
"""

from __future__ import annotations

import asyncio
import socket
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import can
from can.interfaces.socketcan import SocketcanBus

from drivers.can.plugin import frame_layout
from drivers.can.settings import CanBus
from sim_hw.nodes.can_node import CanNode
from sim_hw.sim_command_order import NodeError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_command_order import NodeOrder, SimNode

NODES = "daqsvc.sim_nodes"


async def node_for(order: NodeOrder) -> SimNode:
    """Put a node of the right kind on its bus.

    Raises:
        NodeError: there is no such kind, or it cannot be put there.
    """
    driver = order.settings.driver
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
        settings = order.settings
        assert isinstance(settings, CanBus)  # noqa: S101 - the driver of the bus is "can"
        if order.unixbus is not None:
            virtual = {"interface": "unixbus", "channel": str(order.unixbus), "options": {}}
            settings = settings.model_copy(update=virtual)
        interface, channel, fd = settings.interface, settings.channel, settings.fd
        if interface == "virtual":
            raise NodeError(
                f'buses.{order.bus}: python-can\'s interface "virtual" lives within one process; use a '
                "virtual bus between processes with --bus PATH"
            )

        rates = {"bitrate": settings.bitrate, "data_bitrate": settings.data_bitrate}
        chosen: dict[str, Any] = {key: rate for key, rate in rates.items() if rate}
        chosen |= settings.options
        # A node reads nothing: what the others send must not pile up for it.
        chosen |= {"receive": False} if interface == "unixbus" else {}

        def bus() -> can.BusABC:
            opened = can.Bus(interface=interface, channel=channel, fd=fd, **chosen)
            if isinstance(opened, SocketcanBus):
                opened.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            return opened

        nodes: dict[str, CanNode] = {}
        opened: list[can.BusABC] = []
        try:
            for played in order.streams:
                opened.append(await asyncio.to_thread(bus))
                layout = frame_layout(order.machine, played.stream)
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
