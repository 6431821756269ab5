"""Serial devices behind pseudo-terminals, for ``daqsvc sim``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import StreamSpec
from drivers.make import stream_layout
from drivers.serial.driver import framing_of
from drivers.serial.settings import SerialBus
from sim_hw.nodes.pseudo_terminal import PseudoTerminal
from sim_hw.nodes.serial_node import SerialNode
from sim_hw.sim_command_order import NodeError

if TYPE_CHECKING:
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_command_order import NodeOrder

LOOK_S = 0.01
LINGER_S = 1.0
"""What has not been read when a pseudo-terminal is closed is gone."""


class SerialNodes:
    """All streams of a serial port, each a device of its own on the same cable."""

    def __init__(self, cable: PseudoTerminal, nodes: dict[str, SerialNode]) -> None:
        self.address = str(cable.path)
        self._cable = cable
        self._nodes = nodes

    @classmethod
    async def open(cls, order: NodeOrder) -> SerialNodes:
        """See `sim_hw.sim_command_nodes.node_for`."""
        bus = order.settings
        assert isinstance(bus, SerialBus)  # noqa: S101 - the driver of the bus is "serial"
        path = order.link or Path(bus.port)
        specs: list[StreamSpec[Any]] = [
            StreamSpec(s.stream, stream_layout(order.machine, s.stream), s.rate_hz) for s in order.streams
        ]
        if path.exists() and not path.is_symlink():
            raise NodeError(f"{path} is a real port; put the simulated one elsewhere with --link PATH")
        try:
            cable = PseudoTerminal(path)
        except OSError as error:
            raise NodeError(
                f"no link to a pseudo-terminal can be made at {path}: {error.strerror}; name a place that "
                "can be written with --link PATH, and as port in the machine file"
            ) from error
        nodes: dict[str, SerialNode] = {}
        try:
            for spec, played in zip(specs, order.streams, strict=True):
                nodes[spec.name] = SerialNode(
                    cable,
                    framing_of(bus, specs),
                    spec.name,
                    spec.layout,
                    played.samples,
                    played.rate_hz,
                    faults=order.faults,
                    clip=True,
                )
        except BaseException as error:
            cable.unplug()
            if isinstance(error, ValueError):
                raise NodeError(f"no device at {path}: {error}") from error
            raise
        return cls(cable, nodes)

    async def ready(self) -> None:
        """See `sim_hw.sim_command_order.SimNode.ready`: whether the port is open can be told."""
        while not self._cable.listening:  # noqa: ASYNC110 - a pseudo-terminal does not tell
            await asyncio.sleep(LOOK_S)

    async def play(self, pacer: Pacer) -> None:
        """See `sim_hw.sim_command_order.SimNode.play`; a client has time to read the last frame."""
        async with asyncio.TaskGroup() as group:
            for node in self._nodes.values():
                group.create_task(node.play(pacer))
        await asyncio.sleep(LINGER_S)

    def figures(self) -> dict[str, dict[str, Any]]:
        """See `sim_hw.sim_command_order.SimNode.figures`."""
        return {name: node.figures() for name, node in self._nodes.items()}

    async def close(self) -> None:
        """See `sim_hw.sim_command_order.SimNode.close`."""
        self._cable.unplug()
