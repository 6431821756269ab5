"""A Modbus driver under test, a line with units on it, and time that passes as soon as it is asked to."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import selectors
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pymodbus.transport import CommParams, CommType, ModbusProtocol
from support.bus_tables import modbus_bus
from support.clocks import LoopClock
from support.waiting import PATIENCE_S

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.modbus.driver import ModbusDriver
from sim_hw.nodes.modbus_node import UnitConnection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.modbus.settings import ModbusLayout
    from sim_hw.nodes.modbus_node import FaultPlan
    from sim_hw.nodes.modbus_unit import ModbusUnit


class Rig:
    """A driver and the blocks that it has delivered."""

    def __init__(
        self,
        options: Mapping[str, Any],
        streams: Mapping[str, tuple[ModbusLayout, float]],
        *,
        start: Literal["error", "retry", "ignore"] = "retry",
        clock: Any = None,
    ) -> None:
        specs = [StreamSpec(name, layout, rate_hz) for name, (layout, rate_hz) in streams.items()]
        self.blocks: dict[str, list[SampleBlock]] = {name: [] for name in streams}
        port = BusPort("mb", specs, clock or SystemClock(), lambda b: self.blocks[b.stream].append(b), start)
        self.driver = ModbusDriver(modbus_bus(**options), port)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[ModbusDriver]:
        task = asyncio.create_task(self.driver.run(), name="driver under test")
        try:
            yield self.driver
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    def counters(self, stream: str) -> Any:
        return self.driver.streams[stream][0]

    def samples(self, stream: str) -> np.ndarray:
        return np.concatenate([block.samples for block in self.blocks[stream]])

    def indices(self, stream: str) -> np.ndarray:
        return np.concatenate([np.arange(b.first_index, b.end_index) for b in self.blocks[stream]])

    def check_books(self, stream: str) -> None:
        """Blocks follow each other by index, but for what they say is missing."""
        blocks = self.blocks[stream]
        for before, block in itertools.pairwise(blocks):
            assert block.first_index == before.end_index + block.gap
        assert sum(len(block.samples) for block in blocks) == self.counters(stream).samples_received
        assert sum(block.lost_before for block in blocks) == self.counters(stream).samples_lost


async def until(true: Callable[[], bool], what: str = "it to be so") -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not true():
            await asyncio.sleep(0.002)
    assert true(), what


class _JumpingSelector(selectors.DefaultSelector):
    """Instead of waiting, lets the time pass."""

    jump: Callable[[float], None]

    def select(self, timeout: float | None = None) -> list[Any]:
        ready = super().select(0)
        if not ready and timeout is None:
            raise RuntimeError(
                "nothing is ready, and nothing is waited for: simulated time would stand still"
            )
        if not ready and timeout:
            self.jump(timeout)
        return ready


class SimulatedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time passes by itself, at once, whenever nothing else is left to do."""

    def __init__(self) -> None:
        self._now_s = 1000.0
        selector = _JumpingSelector()
        selector.jump = self._jump
        super().__init__(selector)
        self._clock_resolution = 1e-9

    def time(self) -> float:
        return self._now_s

    def _jump(self, seconds: float) -> None:
        self._now_s += seconds


def simulate(main: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine in simulated time."""
    with asyncio.Runner(loop_factory=SimulatedLoop) as runner:
        runner.run(main())


class _Cable:
    """A serial cable: units on it do not know who has opened its other end, and send to whoever has."""

    def __init__(self, units: Mapping[int, ModbusUnit], plan: FaultPlan) -> None:
        self.wire = UnitConnection(units, self._send, serial=True, plan=plan, clock=LoopClock())
        self.end: ModbusProtocol | None = None

    def _send(self, data: bytes) -> None:
        if self.end is not None:
            self.end.send(data)


class Responder(ModbusProtocol):
    """Units at the far end of pymodbus' null modem, which passes bytes at once and without a system call."""

    PORT = 5020

    def __init__(
        self, units: Mapping[int, ModbusUnit], plan: FaultPlan, *, cable: _Cable | None = None
    ) -> None:
        params = CommParams(
            comm_name="responder",
            comm_type=CommType.TCP,
            host="__pymodbus_nullmodem",
            source_address=("__pymodbus_nullmodem", self.PORT),
            port=self.PORT,
            reconnect_delay=0,
        )
        super().__init__(params, is_server=True)
        self._given = (units, plan)
        self._cable = cable
        if cable is not None:
            self._wire = cable.wire
        else:
            self._wire = UnitConnection(units, self.send, serial=False, plan=plan, clock=LoopClock())

    def callback_new_connection(self) -> ModbusProtocol:
        connection = Responder(*self._given, cable=self._cable)
        if self._cable is not None:
            self._cable.end = connection
        return connection

    def callback_connected(self) -> None:
        pass

    def callback_disconnected(self, exc: Exception | None) -> None:
        if self._cable is None:
            self._wire.close()
        elif self._cable.end is self:
            self._cable.end = None

    def callback_data(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        self._wire.feed(data)
        return len(data)


def options_of(*, serial: bool, **more: Any) -> dict[str, Any]:
    """Options of a bus at the near end of the null modem of a `Responder`."""
    if serial:
        where: dict[str, Any] = {
            "transport": "rtu",
            "serial_port": f"socket://__pymodbus_nullmodem:{Responder.PORT}",
        }
    else:
        where = {"transport": "tcp", "host": "__pymodbus_nullmodem", "tcp_port": Responder.PORT}
    return where | more


@contextlib.asynccontextmanager
async def responding(
    units: Mapping[int, ModbusUnit], plan: FaultPlan, *, serial: bool
) -> AsyncIterator[Responder]:
    cable = _Cable(units, plan) if serial else None
    responder = Responder(units, plan, cable=cable)
    assert await responder.listen()
    try:
        yield responder
    finally:
        responder.close()
        if cable is not None:
            cable.wire.close()


def ramp(n: int, channels: int = 2, first: int = 0) -> np.ndarray:
    """Whole numbers that tell every sample and channel from every other."""
    index = np.arange(first, first + n)
    return np.stack(
        [index % 30_000 if c == 0 else index // 30_000 + 100 * c for c in range(channels)], axis=1
    )


def field_names(layouts: Sequence[ModbusLayout]) -> list[str]:
    return [channel.name for layout in layouts for channel in layout.channels]
