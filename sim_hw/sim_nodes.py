"""The devices that ``daqsvc sim`` puts on a bus, by the driver that reads it.

Another kind registers by entry point in the group ``daqsvc.sim_nodes``, under the name that the machine file
states in ``driver = "..."``: a callable that takes a `NodeOrder` and returns a `SimNode` ready to play.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import can
import numpy as np
from can.interfaces.socketcan import SocketcanBus

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from daqsvc.errors.command_line import SIMULATION
from drivers.base import StreamSpec
from drivers.can.plugin import frame_layout
from drivers.can.settings import CanBus
from drivers.make import stream_layout
from drivers.modbus.settings import ModbusRtuBus, ModbusTcpBus
from drivers.serial.settings import SerialBus
from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.modbus_node import ModbusNode, ModbusRtuServer, ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.serial_node import PseudoTerminal, SerialNode

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from daqsvc.settings import MachineFile
    from daqsvc.settings.buses import Bus
    from sim_hw.node_faults import FaultWindow
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_signals import StreamSamples


class NodeError(Exception):
    """A node cannot be put on its bus; states why and what to do."""

    code = SIMULATION


@dataclass(frozen=True, slots=True)
class NodeOrder:
    """What a node is made from.

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
        """Wait until a client is there, where that can be known."""
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


NODES = "daqsvc.sim_nodes"


async def node_for(order: NodeOrder) -> SimNode:
    """Put a node of the right kind on its bus.

    Raises:
        NodeError: there is no such kind, or it cannot be put there.
    """
    driver = order.settings.driver
    known: dict[str, Callable[[NodeOrder], Awaitable[SimNode]]] = {
        "can": CanNodes.open,
        "modbus": ModbusNodes.open,
        "serial": SerialNodes.open,
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
    """All streams of a CAN bus, each its own node."""

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
        """See `SimNode.ready`: it is not known who listens to a CAN bus."""

    async def play(self, pacer: Pacer) -> None:
        """See `SimNode.play`."""
        async with asyncio.TaskGroup() as group:
            for node in self._nodes.values():
                group.create_task(node.play(pacer))

    def figures(self) -> dict[str, dict[str, Any]]:
        """See `SimNode.figures`."""
        return {name: {**node.figures()} for name, node in self._nodes.items()}

    async def close(self) -> None:
        """See `SimNode.close`."""
        for node in self._nodes.values():
            node.close()


LOOK_S = 0.01
MODBUS_LINGER_S = 2.0
"""How long the units answer after the last sample, so that it is read."""
SERIAL_LINGER_S = 1.0
"""What has not been read when a pseudo-terminal is closed is gone."""


class ReplyFaults:
    """What a scenario's faults do to replies: silence and dropped replies, late ones, flipped bits.

    Args:
        faults: of the scenario.

    Raises:
        NodeError: the scenario has faults that cannot happen to replies.
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
        if names := [name for name, asked_for in impossible.items() if asked_for]:
            raise NodeError(
                f"the scenario's fault {names[0]!r} cannot be played on Modbus, where units only answer; "
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
        """See `node_for`."""
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
        """See `SimNode.ready`: the first request shows it."""
        while not self._replies.injected["requests"]:  # noqa: ASYNC110 - counted where nothing waits
            await asyncio.sleep(LOOK_S)

    async def play(self, pacer: Pacer) -> None:
        """See `SimNode.play`; a client has time to read the last sample."""
        self._replies.start()
        async with asyncio.TaskGroup() as group:
            for node in self._nodes.values():
                group.create_task(node.play(pacer))
        await asyncio.sleep(MODBUS_LINGER_S)

    def figures(self) -> dict[str, dict[str, Any]]:
        """See `SimNode.figures`; faults are those of the whole line."""
        injected = dict(self._replies.injected)
        return {
            name: {"samples_sent": node.samples_sent, "injected": injected}
            for name, node in self._nodes.items()
        }

    async def close(self) -> None:
        """See `SimNode.close`."""
        self._server.stop()


def _holds(window: FaultWindow, t_s: float) -> bool:
    return window.start_s <= t_s < window.end_s


class SerialNodes:
    """All streams of a serial port, each its own device on the same cable."""

    def __init__(self, cable: PseudoTerminal, nodes: dict[str, SerialNode]) -> None:
        self.address = str(cable.path)
        self._cable = cable
        self._nodes = nodes

    @classmethod
    async def open(cls, order: NodeOrder) -> SerialNodes:
        """See `node_for`."""
        from drivers.serial.driver import framing_of  # noqa: PLC0415 - brings the kernels of a driver

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
        """See `SimNode.ready`: whether the port is open can be known."""
        while not self._cable.listening:  # noqa: ASYNC110 - a pseudo-terminal does not report it
            await asyncio.sleep(LOOK_S)

    async def play(self, pacer: Pacer) -> None:
        """See `SimNode.play`; a client has time to read the last frame."""
        async with asyncio.TaskGroup() as group:
            for node in self._nodes.values():
                group.create_task(node.play(pacer))
        await asyncio.sleep(SERIAL_LINGER_S)

    def figures(self) -> dict[str, dict[str, Any]]:
        """See `SimNode.figures`."""
        return {name: {**node.figures()} for name, node in self._nodes.items()}

    async def close(self) -> None:
        """See `SimNode.close`."""
        self._cable.unplug()
