"""Devices that sample and count in real time, for ever, and know what they could not send."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from typing import TYPE_CHECKING, Any, Protocol, Self

import can
import numpy as np
from nothing_lost.broker import unused_port
from soak.machines import RING_DEPTH, SPARE

from drivers.base import StreamSpec
from drivers.make import stream_layout
from drivers.serial.driver import framing_of
from drivers.serial.settings import SerialBus
from sim_hw.bus_socket_hub import Hub
from sim_hw.nodes.modbus_node import ModbusRtuServer, ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit, encode, store_for
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.settings import MachineFile

    Send = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.bool_]]

TICK_S = 0.05
STILL_S = 2.0
"""Devices that are so late have stood still: this process was starved, which is no fault of the service."""
AT_ONCE_S = 1.0
"""What a device sends at once at most; older samples are none that it could send."""
MODULUS = 2**24
"""What a device writes beside each sample is its number, modulo this: a float of 32 bits has all of them."""
CALM_G, LOUD_G = 0.1, 8.0


class Device:
    """Samples an accelerometer, and numbers the samples.

    Attributes:
        name: the machine that it is on.
        rate_hz: of its samples.
        rms_g: how much it shakes.
        silent: while true it sends nothing, and goes on sampling.
        count: samples that it has taken.
        keeps: samples that it keeps until it is asked for them; none if it sends them of itself.
        disturbances: how often its wire was pulled, or plugged in, or whoever reads it came or went.
        disturbed_at: samples that it had taken by the last of these.
        steady: whether it has been read without a break since the last of these.

    Args:
        name: of the machine.
        rate_hz: of its samples.
        per_frame: samples in a frame.
        seed: of what it measures.
        keeps: see above.
    """

    def __init__(self, name: str, rate_hz: float, per_frame: int, seed: int, keeps: int = 0) -> None:
        self.name = name
        self.keeps = keeps
        self.rate_hz = rate_hz
        self.rms_g = CALM_G
        self.silent = False
        self.count = 0
        self.disturbances = 0
        self.disturbed_at = 0
        self.steady = False
        self._recovers = False
        self.send: Send = lambda first, _: np.zeros(len(first), np.bool_)
        self._per_frame = per_frame
        self._rng = np.random.default_rng(seed)
        self._begun_s = time.monotonic()
        self._unsent: list[list[int]] = []

    def disturb(self) -> None:
        """Something happens to its wire."""
        self.disturbances += 1
        self.disturbed_at = self.count
        self.steady = self._recovers = False

    def stand_still(self) -> None:
        """It was not played for a while: who reads it may have lost samples, until it is read on steadily."""
        self.disturb()
        self._recovers = True

    def read_to(self, number: int) -> None:
        """The service has samples up to a number."""
        if self._recovers and number > self.disturbed_at:
            self.steady, self._recovers = True, False

    def step(self) -> None:
        """Take the samples that are due, and send them."""
        due = int((time.monotonic() - self._begun_s) * self.rate_hz) // self._per_frame
        frames = due - self.count // self._per_frame
        if frames <= 0:
            return
        first = self.count + self._per_frame * np.arange(frames)
        number = (first[:, None] + np.arange(self._per_frame)) % MODULUS
        x = self._rng.normal(scale=self.rms_g, size=number.shape).clip(-30.0, 30.0)
        self.count = due * self._per_frame
        samples = np.stack([x, number], axis=2)
        sent = np.zeros(frames, np.bool_)
        if not self.silent:
            late = 0 if self.keeps else max(0, frames - math.ceil(AT_ONCE_S * self.rate_hz / self._per_frame))
            sent[late:] = self.send(first[late:], samples[late:])
        for begin in first[~sent].tolist():
            self._miss(begin, begin + self._per_frame)

    def _miss(self, begin: int, end: int) -> None:
        if self._unsent and self._unsent[-1][1] == begin:
            self._unsent[-1][1] = end
        else:
            self._unsent.append([begin, end])

    def number_of(self, shown: float) -> int:
        """The number of a sample, from what was written beside it; the sample must be one of the last."""
        return self.count - (self.count - int(shown)) % MODULUS

    def unsent(self, begin: int, end: int) -> int:
        """How many of the samples of these numbers it could not send."""
        return sum(max(min(end, b) - max(begin, a), 0) for a, b in self._unsent)


class Wire(Protocol):
    """Between a device and the service."""

    async def plug(self) -> None:
        """Put it there; nothing happens if it is."""
        ...

    async def pull(self) -> None:
        """Take it away, with what is under way on it; nothing happens if it is away."""
        ...


class CanWire:
    """A CAN bus between processes, and the device's end of it."""

    def __init__(self, path: Path, frame_id: int, encoded: Callable[..., NDArray[np.uint8]]) -> None:
        self._path, self._id, self._encoded = f"{path}", frame_id, encoded
        self._hub: Hub | None = None
        self._bus: can.BusABC | None = None

    async def plug(self) -> None:
        if self._hub is None:
            self._hub = Hub(self._path)
            self._hub.start()
            self._bus = await asyncio.to_thread(
                lambda: can.Bus(interface="unixbus", channel=self._path, fd=True, receive=False, hub="join")
            )

    async def pull(self) -> None:
        hub, bus, self._hub, self._bus = self._hub, self._bus, None, None
        if hub is not None:
            await asyncio.to_thread(hub.stop)
        if bus is not None:
            bus.shutdown()

    def send(self, first: NDArray[np.int64], samples: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Put frames on the bus; which ones it has taken."""
        return np.array([self._sent(row.tobytes()) for row in self._encoded(first, samples)], np.bool_)

    def _sent(self, data: bytes) -> bool:
        if self._bus is None:
            return False
        message = can.Message(arbitration_id=self._id, is_extended_id=False, is_fd=True, data=data)
        try:
            self._bus.send(message, timeout=0)
        except can.CanOperationError:
            return False
        return True


class SerialWire:
    """A serial cable."""

    def __init__(self, path: Path, encoded: Callable[..., list[bytes]]) -> None:
        self._encoded = encoded
        self._cable = PseudoTerminal(path)

    async def plug(self) -> None:
        self._cable.plug()

    async def pull(self) -> None:
        self._cable.unplug()

    def send(self, first: NDArray[np.int64], samples: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Send frames; which ones had room on the cable."""
        return np.array([self._cable.send(frame) for frame in self._encoded(first, samples)], np.bool_)


class ModbusWire:
    """A Modbus line; the device keeps its samples in a ring until it is asked."""

    def __init__(self, server: ModbusTcpServer | ModbusRtuServer, unit: ModbusUnit, layout: Any) -> None:
        self._server, self._store, self._layout = server, store_for(unit, layout), layout
        self._there = False

    async def plug(self) -> None:
        if not self._there:
            started = self._server.start()
            if started is not None:
                await started
            self._there = True

    async def pull(self) -> None:
        self._server.stop()
        self._there = False

    def keep(self, first: NDArray[np.int64], samples: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Write samples into the ring; whoever asks too late loses them, and can tell by the count."""
        self._store.put(int(first[0]), encode(self._layout, samples[:, 0]))
        return np.ones(len(first), np.bool_)


TREND_UNIT, TREND_ADDRESS = 2, 400


class Plant:
    """All devices and their wires, played in the event loop while this is entered.

    Attributes:
        devices: by the names of their machines.
        wires: likewise.
        answered: requests for the trend value that were answered.
        stood_still_s: how long they were not played, each time.
        tcp_port: of the Modbus server.

    Args:
        folder: where ports and sockets are.
        seed: of what is measured.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.answered = 0
        self.stood_still_s: list[float] = []
        kinds = {
            "pump": (640.0, 10),
            "fan": (100.0, 1),
            "gear": (100.0, 1),
            "mill": (100.0, 4),
            "saw": (50.0, 1),
            SPARE: (50.0, 1),
        }
        rings = {"fan": RING_DEPTH, "gear": RING_DEPTH}
        self.devices = {
            name: Device(name, *kind, seed + k, rings.get(name, 0))
            for k, (name, kind) in enumerate(kinds.items())
        }
        self.wires: dict[str, Wire] = {}
        self._units = {name: ModbusUnit() for name in ("fan", "gear")}
        self._trend = ModbusUnit()
        self._trend.put("holding", TREND_ADDRESS, np.array([40.0, 41.0], ">f4").tobytes())
        self.tcp_port = unused_port()
        self._tcp = ModbusTcpServer(
            {1: self._units["fan"], TREND_UNIT: self._trend},
            lambda unit, _: self._asked("fan", unit),
            self.tcp_port,
        )
        self._rtu = ModbusRtuServer(
            {1: self._units["gear"]}, folder / "rtu", lambda unit, _: self._asked("gear", unit)
        )
        self._playing: asyncio.Task[None] | None = None

    def wire(self, machines: Mapping[str, MachineFile]) -> None:
        """Have the devices send as their machine files say."""
        for name, machine in machines.items():
            layout = stream_layout(machine, "casing")
            if name in self._units:
                server = self._tcp if name == "fan" else self._rtu
                line = ModbusWire(server, self._units[name], layout)
                self.wires[name], self.devices[name].send = line, line.keep
                continue
            bus = machine.buses[machine.streams["casing"].bus]
            if isinstance(bus, SerialBus):
                spec: StreamSpec[Any] = StreamSpec("casing", layout, self.devices[name].rate_hz)
                framing = framing_of(bus, [spec])
                wire: SerialWire | CanWire = SerialWire(
                    self.folder / f"{bus.port}",
                    lambda first, samples, f=framing: f.encode("casing", first, samples, clip=True),
                )
            else:
                wire = CanWire(
                    self.folder / "can0",
                    layout.frame_id,
                    lambda first, samples, k=layout: k.encode(first, samples, clip=True),
                )
            self.wires[name], self.devices[name].send = wire, wire.send

    async def __aenter__(self) -> Self:
        for wire in self.wires.values():
            await wire.plug()
        self._playing = asyncio.create_task(self._play(), name="devices")
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._playing is not None:
            self._playing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._playing
        for wire in self.wires.values():
            await wire.pull()

    async def _play(self) -> None:
        played_s = time.monotonic()
        while True:
            late_s, played_s = time.monotonic() - played_s - TICK_S, time.monotonic()
            if late_s > STILL_S:
                self.stood_still_s.append(late_s)
            for device in self.devices.values():
                device.step()
                if late_s > STILL_S:
                    device.stand_still()
            await asyncio.sleep(TICK_S)

    def _asked(self, name: str, unit: int) -> PlannedReply:
        """A device knows the time when it is asked, however busy this process was."""
        if unit == TREND_UNIT:
            self.answered += 1
        else:
            self.devices[name].step()
        return PlannedReply()
