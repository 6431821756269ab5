"""Every bus of a running service is lost and restored at once, again and again: the books stay exact."""

from __future__ import annotations

import asyncio
import itertools
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conformance.replay_transport import LogDevice
from conformance.rig import numbers_of, samples_of
from conformance.serial_transport import CableDevice
from conformance.transport import STREAM
from conformance.virtual_can_transport import PER_FRAME, CanDevice
from support.clocks import QuickClock
from support.live_service import running, watch_of

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from daqsvc.settings import parse_machine_file
from drivers.base import StreamSpec
from drivers.can.plugin import frame_layout
from drivers.make import stream_layout
from drivers.modbus.registers import RegisterRecord
from drivers.serial.settings import SerialBus
from sim_hw.nodes.modbus_node import ModbusTcpServer
from sim_hw.nodes.modbus_unit import ModbusUnit, RingStore
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.service import Service

RATE_HZ = 1000
OUTAGES = 20
STALL_S = 2.2
"""So long the machine stands still once: longer than a device may without having restarted."""
CHANNELS = '[{ name = "x", type = "int16", scale = 1.0 }, { name = "y", type = "int16", scale = 1.0 }]'
CAN_LAYOUT = f"""
id = 0x101
length = 48
counter = {{ byte = 0, bits = 32, counts = "samples" }}
first_byte = 4
samples_per_frame = 10
crc_byte = 46
channels = {CHANNELS}
"""
_run = itertools.count()

pytestmark = [pytest.mark.integration, pytest.mark.timeout(240)]


def machine_text(channel: str, folder: Path, tcp_port: int) -> str:
    buses = {
        "can-a": f'driver = "can"\ninterface = "plugged"\nchannel = "{channel}-a"\nfd = true',
        "can-b": f'driver = "can"\ninterface = "plugged"\nchannel = "{channel}-b"\nfd = true',
        "serial": f'driver = "serial"\nport = "{folder / "port"}"\nbaud = 115_200\nframing = "cobs"',
        "log": f'driver = "replay"\nfile = "{folder / "can.log"}"\nat_end = "wait"',
        "modbus": f'driver = "modbus"\ntransport = "tcp"\nhost = "127.0.0.1"\ntcp_port = {tcp_port}',
    }
    layouts = dict.fromkeys(("can-a", "can-b", "log"), CAN_LAYOUT) | {
        "serial": f"""
payload_length = 44
counter = {{ byte = 0, bits = 32, counts = "samples" }}
first_byte = 4
samples_per_frame = 10
channels = {CHANNELS}
""",
        "modbus": """
way = "ring"
unit = 1
count = { address = 0, bits = 32 }
address = 16
depth = 256
channels = [{ name = "x", type = "int16", place = 0 }, { name = "y", type = "int16", place = 1 }]
""",
    }
    text = 'schema_version = 1\nsite = "lab"\nbox = "edge-1"\n[machine]\nname = "m"\nspeed_rpm = 600.0\n'
    for name, bus in buses.items():
        text += f"""
[buses.{name}]
{bus}

[streams.{name}]
bus = "{name}"
rate_hz = {RATE_HZ}
[streams.{name}.layout]{layouts[name]}
[[sensors]]
name = "{name}"
type = "accelerometer"
stream = "{name}"
channel = "x"
unit = "g"
"""
    return text + "\n[pipeline]\nring_s = 120.0\n"


class SamplingUnit(ModbusUnit):
    """A unit that has sampled up to the moment at which it is asked, however long the machine stood still."""

    def __init__(self) -> None:
        super().__init__()
        self.catch_up: Callable[[], None] = lambda: None

    def answer(self, pdu: bytes) -> bytes:
        """See `ModbusUnit.answer`."""
        self.catch_up()
        return super().answer(pdu)


class ModbusDevice:
    """A unit that goes on sampling into its ring while its server is away."""

    def __init__(self) -> None:
        self._unit = SamplingUnit()
        self._server = ModbusTcpServer({1: self._unit})
        self.tcp_port = 0

    async def start(self) -> None:
        await self._server.start()
        self.tcp_port = self._server.port

    def sample_when_asked(self, catch_up: Callable[[], None]) -> None:
        """Sample by ``catch_up`` before each reply."""
        self._unit.catch_up = catch_up

    def serve(self, service: Service) -> None:
        """Lay the ring out as the machine file says."""
        self._layout = stream_layout(watch_of(service).machine, "modbus")
        self._store = RingStore(self._unit, self._layout)

    def flood(self, first_index: int, samples: NDArray[np.float32]) -> None:
        self._store.put(first_index, RegisterRecord.of(self._layout).encode(samples))

    def go_away(self) -> None:
        self._server.stop()

    def come_back(self) -> None:
        self._server = ModbusTcpServer({1: self._unit}, port=self.tcp_port)
        self._starting = asyncio.create_task(self._server.start())

    def close(self) -> None:
        self._server.stop()


@pytest.mark.long
async def test_losing_all_buses_at_once_ends_with_exact_books(tmp_path: Path) -> None:
    rng = np.random.default_rng(20)
    channel = f"all-lost-{next(_run)}"
    modbus = ModbusDevice()
    await modbus.start()
    machine = parse_machine_file(machine_text(channel, tmp_path, modbus.tcp_port), tmp_path / "machine.toml")
    layout = frame_layout(machine, "can-a")
    serial_bus = machine.buses["serial"]
    assert isinstance(serial_bus, SerialBus)
    serial_spec = StreamSpec(STREAM, stream_layout(machine, "serial"), RATE_HZ)
    devices = {
        "can-a": CanDevice(f"{channel}-a", layout),
        "can-b": CanDevice(f"{channel}-b", layout),
        "serial": CableDevice(PseudoTerminal(tmp_path / "port"), serial_bus, serial_spec),
        "log": LogDevice(tmp_path / "can.log", SystemClock(), layout),
        "modbus": modbus,
    }
    sent = dict.fromkeys(devices, 0)
    async with running(machine, tmp_path / "store", QuickClock(4)) as service:
        modbus.serve(service)

        async def sample(seconds: float) -> None:
            """Let all devices sample and send for a while, whether anybody listens or not."""
            until_ns = service.clock.monotonic_ns() + round(seconds * NS_PER_S)
            while service.clock.monotonic_ns() < until_ns:
                for name in devices:
                    catch_up(name)
                await asyncio.sleep(0.005)

        def catch_up(name: str) -> None:
            """Let a device sample and send what is due by now."""
            due = (service.clock.monotonic_ns() - begun_ns) * RATE_HZ // NS_PER_S // PER_FRAME * PER_FRAME
            while sent[name] < due:
                # No more at once than a device has in its ring.
                n = min(due - sent[name], 10 * PER_FRAME)
                devices[name].flood(sent[name], samples_of(np.arange(sent[name], sent[name] + n)))
                sent[name] += n

        begun_ns = service.clock.monotonic_ns()
        modbus.sample_when_asked(lambda: catch_up("modbus"))
        async with asyncio.timeout(200):
            while any(watch_of(service).rings[name].end_index == 0 for name in devices):
                await sample(0.05)
            for outage in range(OUTAGES):
                await sample(rng.uniform(0.02, 0.3))
                if outage == OUTAGES // 2:
                    time.sleep(STALL_S)  # noqa: ASYNC251 - as a busy machine does
                    await asyncio.sleep(0.1)  # whoever reads may come before the devices
                for device in devices.values():
                    device.go_away()
                while any(driver.link.losses == outage for driver in service.drivers):
                    await sample(0.02)  # who comes back unseen has not been away
                await sample(rng.uniform(0.0, 0.3))
                for device in devices.values():
                    device.come_back()
                ends = {name: watch_of(service).rings[name].end_index for name in devices}
                while any(watch_of(service).rings[name].end_index == end for name, end in ends.items()):
                    await sample(0.05)
            modbus.sample_when_asked(lambda: None)
            # The last frames of all have arrived when what was sent after the last outage has.
            while any(watch_of(service).rings[name].end_index < sent[name] for name in devices):
                await asyncio.sleep(0.01)
        losses = {driver.name: driver.link.losses for driver in service.drivers}
        counters = {name: c for driver in service.drivers for name, (c, _) in driver.streams.items()}
        for device in (devices["can-a"], devices["can-b"], devices["serial"]):
            device.close()
    modbus.close()
    for name in devices:
        ring = watch_of(service).rings[name]
        stored = ring.read(ring.oldest_index, ring.end_index - ring.oldest_index)
        there = ~np.isnan(stored[:, 0])
        assert ring.end_index == sent[name]
        np.testing.assert_array_equal(
            numbers_of(stored[there]), ring.oldest_index + np.flatnonzero(there), err_msg=name
        )
        assert counters[name].samples_received == there.sum(), name
        assert counters[name].samples_lost == (~there).sum(), name
        assert sent[name] - ring.oldest_index == (
            counters[name].samples_received + counters[name].samples_lost
        ), name
    assert min(losses.values()) >= OUTAGES, losses
    assert sum(c.samples_lost for c in counters.values()) > 0
