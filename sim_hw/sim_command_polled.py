"""Modbus units behind a TCP port or a pseudo-terminal, for ``daqsvc sim``."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from drivers.make import stream_layout
from drivers.modbus.settings import ModbusRtuBus, ModbusTcpBus
from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.modbus_node import ModbusNode, ModbusRtuServer, ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.sim_command_order import NodeError

if TYPE_CHECKING:
    from sim_hw.node_faults import FaultWindow
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_command_order import NodeOrder

LOOK_S = 0.01
LINGER_S = 2.0
"""How long the units answer after the last sample, so that it is read."""


class ReplyFaults:
    """What a scenario's faults do to replies: silence and dropped replies, late ones, flipped bits.

    Args:
        faults: of the scenario.

    Raises:
        NodeError: the scenario asks for what cannot happen to replies.
    """

    def __init__(self, faults: NodeFaults) -> None:
        impossible = {
            "drift": faults.drift,
            "brown-out": faults.brown_out,
            "counter-reset": faults.counter_reset_s,
            "babble": faults.babble,
            "duplicate": [link for _, link in faults.link if link.duplicate],
            "reorder": [link for _, link in faults.link if link.reorder],
        }
        if asked := [name for name, asked_for in impossible.items() if asked_for]:
            raise NodeError(
                f"the scenario's fault {asked[0]!r} cannot be played on Modbus, where units only answer; "
                "there are silence, delay, and link with drop and corrupt"
            )
        self.injected: Counter[str] = Counter()
        self._faults = faults
        self._rng = np.random.default_rng([faults.seed, 2])
        self._clock = SystemClock()
        self._start_ns = self._clock.monotonic_ns()

    def start(self) -> None:
        """The playing begins now."""
        self._start_ns = self._clock.monotonic_ns()

    def __call__(self, unit: int, pdu: bytes) -> PlannedReply:
        """What becomes of the reply to this request."""
        del unit, pdu
        t_s = (self._clock.monotonic_ns() - self._start_ns) / NS_PER_S
        self.injected["requests"] += 1
        draw, late = self._rng.random(2)
        if any(_holds(window, t_s) for window in self._faults.silence):
            return self._counted("silenced", PlannedReply("silent"))
        for window, link in self._faults.link:
            if _holds(window, t_s) and draw < link.drop:
                return self._counted("dropped", PlannedReply("silent"))
            if _holds(window, t_s) and draw < link.drop + link.corrupt:
                return self._counted("corrupted", PlannedReply("corrupt"))
        delay_s = sum(d.delay_s + d.jitter_s * late for d in self._faults.delay if _holds(d.window, t_s))
        if delay_s:
            return self._counted("delayed", PlannedReply(delay_ns=round(delay_s * NS_PER_S)))
        return PlannedReply()

    def _counted(self, what: str, answer: PlannedReply) -> PlannedReply:
        self.injected[what] += 1
        return answer


class ModbusNodes:
    """All units of a Modbus line, and the server through which they are asked."""

    def __init__(
        self,
        address: str,
        server: ModbusTcpServer | ModbusRtuServer,
        nodes: dict[str, ModbusNode],
        replies: ReplyFaults,
    ) -> None:
        self.address = address
        self._server = server
        self._nodes = nodes
        self._replies = replies

    @classmethod
    async def open(cls, order: NodeOrder) -> ModbusNodes:
        """See `sim_hw.sim_command_nodes.node_for`."""
        bus = order.settings
        layouts = {s.stream: stream_layout(order.machine, s.stream) for s in order.streams}
        units = {layout.unit: ModbusUnit() for layout in layouts.values()}
        nodes = {
            s.stream: ModbusNode(units[layouts[s.stream].unit], layouts[s.stream], s.samples, s.rate_hz)
            for s in order.streams
        }
        replies = ReplyFaults(order.faults or NodeFaults())
        server: ModbusTcpServer | ModbusRtuServer
        if isinstance(bus, ModbusTcpBus):
            port = bus.tcp_port if order.port is None else order.port
            server = ModbusTcpServer(units, port=port, plan=replies)
            where, remedy = f"TCP port {port} of 127.0.0.1", "--port N, and as tcp_port in the machine file"
        else:
            assert isinstance(bus, ModbusRtuBus)  # noqa: S101 - the driver of the bus is "modbus"
            path = order.link or Path(bus.serial_port)
            if path.exists() and not path.is_symlink():
                raise NodeError(f"{path} is a real port; put the simulated one elsewhere with --link PATH")
            server = ModbusRtuServer(units, path, replies)
            where, remedy = str(path), "--link PATH, and as serial_port in the machine file"
        try:
            if isinstance(server, ModbusTcpServer):
                await server.start()
            else:
                server.start()
        except OSError as error:
            raise NodeError(
                f"no Modbus server can be put at {where}: {error.strerror or error}; name another place with "
                f"{remedy}"
            ) from error
        address = f"127.0.0.1:{server.port}" if isinstance(server, ModbusTcpServer) else where
        return cls(address, server, nodes, replies)

    async def ready(self) -> None:
        """See `sim_hw.sim_command_order.SimNode.ready`: the first request tells."""
        while not self._replies.injected["requests"]:  # noqa: ASYNC110 - counted where nothing waits
            await asyncio.sleep(LOOK_S)

    async def play(self, pacer: Pacer) -> None:
        """See `sim_hw.sim_command_order.SimNode.play`; a client has time to read the last sample."""
        self._replies.start()
        async with asyncio.TaskGroup() as group:
            for node in self._nodes.values():
                group.create_task(node.play(pacer))
        await asyncio.sleep(LINGER_S)

    def figures(self) -> dict[str, dict[str, Any]]:
        """See `sim_hw.sim_command_order.SimNode.figures`; faults are those of the whole line."""
        injected = dict(self._replies.injected)
        return {
            name: {"samples_sent": node.samples_sent, "injected": injected}
            for name, node in self._nodes.items()
        }

    async def close(self) -> None:
        """See `sim_hw.sim_command_order.SimNode.close`."""
        self._server.stop()


def _holds(window: FaultWindow, t_s: float) -> bool:
    return window.start_s <= t_s < window.end_s
