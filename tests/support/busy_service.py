"""A service with everything on, over four buses, and devices that nothing in its event loop can stop."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import threading
import time
import tty
from typing import TYPE_CHECKING, Any, Self

import can
import numpy as np
from support.machine_files import MACHINES
from support.ports import free_port
from support.waiting import PATIENCE_S

from daqsvc.acquisition.clock import SystemClock
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.modbus_node import ModbusTcpServer
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.settings import MachineFile

LONGEST_S = 900.0
SPEED_HZ = 25.0
LINES_HZ = 100.0

MORE = """
[buses.casing]
driver = "serial"
port = "{port}"
baud = 115_200
framing = "lines"

[streams.casing]
bus = "casing"
rate_hz = 100.0

[streams.casing.layout]
line = ["seq", "v"]
counter = {{ column = "seq", bits = 16 }}
channels = [{{ name = "v" }}]

[buses.io]
driver = "modbus"
transport = "tcp"
host = "127.0.0.1"
tcp_port = {tcp_port}
timeout_ms = 200.0

[streams.gap]
bus = "io"
rate_hz = 20.0

[streams.gap.layout]
way = "registers"
unit = 1
channels = [{{ name = "g", address = 0, type = "uint16", scale = 0.001, offset = -20.0 }}]

[buses.can0.record]
folder = "{recording}"

[[sensors]]
name = "casing-v"
type = "accelerometer"
stream = "casing"
channel = "v"
unit = "g"

[[sensors]]
name = "gap-g"
type = "trend"
stream = "gap"
channel = "g"
unit = "V"

[[alarms]]
name = "never"
sensor = "casing-v"
measure = "rms"
alert = 1000.0

[mqtt]
url = "mqtt://127.0.0.1:{broker}"
insecure = true

[mqtt.commands]
enabled = true
allow = ["acknowledge", "shelve", "unshelve"]

[mqtt.home_assistant]

[mqtt.sparkplug]

[metrics]
listen = "127.0.0.1:{metrics}"
"""


def busy_machine(folder: Path, devices: Devices, broker: int) -> MachineFile:
    """The rotor of two buses, with a serial port and a Modbus line; recorded, and told to everybody."""
    path = MACHINES / "rotor-two-buses.toml"
    text = path.read_text(encoding="utf-8").replace('"socketcan"', '"virtual"')
    for channel in ("can0", "can1"):
        text = text.replace(f'channel = "{channel}"', f'channel = "{devices.channel(channel)}"')
    text = text.replace("window_s = 0.5", "window_s = 0.5\nvelocity_band_hz = [10.0, 40.0]")
    # How well streams are aligned is tested elsewhere, and on a machine that is less busy.
    text = text.replace("max_error_us = 200.0", "max_error_us = 20_000.0")
    more = MORE.format(
        port=devices.port,
        tcp_port=devices.tcp_port,
        broker=broker,
        metrics=free_port(),
        recording=folder / "recording",
    )
    (folder / "recording").mkdir()
    return parse_machine_file(text[: text.index("[mqtt]")] + more, path)


class Devices(threading.Thread):
    """Two CAN devices, one that sends lines, and a Modbus server, in a thread with a separate event loop.

    Use it as a context manager; `play` begins, once the machine file is known.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name="devices", daemon=True)
        self._name = name
        self._machine: MachineFile | None = None
        self._listening, self._playing, self._over = (threading.Event() for _ in range(3))
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self._slave = slave
        self.port = os.ttyname(slave)
        self.tcp_port = 0

    def channel(self, bus: str) -> str:
        return f"{self._name}-{bus}"

    def __enter__(self) -> Self:
        self.start()
        assert self._listening.wait(PATIENCE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._playing.set()
        self.join(PATIENCE_S)
        os.close(self._master)
        os.close(self._slave)

    def play(self, machine: MachineFile) -> None:
        self._machine = machine
        self._playing.set()

    def run(self) -> None:
        asyncio.run(self._run())

    async def _run(self) -> None:
        unit = ModbusUnit()
        unit.map("holding", 0, 16)
        server = ModbusTcpServer({1: unit})
        await server.start()
        self.tcp_port = server.port
        self._listening.set()
        await asyncio.to_thread(self._playing.wait)
        playing = [] if self._machine is None else self._tasks(self._machine)
        await asyncio.to_thread(self._over.wait)
        for task in playing:
            task.cancel()
        await asyncio.gather(*playing, return_exceptions=True)
        server.stop()

    def _tasks(self, machine: MachineFile) -> list[asyncio.Task[Any]]:
        shafts = [
            self._shaft(machine, stream, bus) for stream, bus in (("shaft-y", "can0"), ("shaft-x", "can1"))
        ]
        return [asyncio.create_task(work) for work in (*shafts, self._lines())]

    async def _shaft(self, machine: MachineFile, stream: str, bus_name: str) -> None:
        layout = frame_layout(machine, stream)
        rate_hz = machine.streams[stream].rate_hz
        turns = SPEED_HZ * np.arange(round(60.0 * rate_hz)) / rate_hz
        rng = np.random.default_rng(5)
        waves = {
            "x": 20.0 * np.cos(2 * np.pi * turns),
            "y": 20.0 * np.sin(2 * np.pi * turns),
            "kph": np.where(turns % 1.0 < 0.1, -2.0, -10.0),
        }
        samples = np.stack(
            [waves[name] + rng.normal(0.0, 0.02, len(turns)) for name in layout.channels], axis=1
        )
        with can.Bus(
            interface="virtual", channel=self.channel(bus_name), protocol=can.CanProtocol.CAN_FD
        ) as bus:
            first = 0
            whole = len(samples) - len(samples) % (layout.samples_per_frame * 8)
            while True:
                node = CanNode(bus, layout, samples[:whole], rate_hz, first_index=first)
                await node.play(RealTimePacer(SystemClock()))
                first += whole

    async def _lines(self) -> None:
        begun_s, sent = time.monotonic(), 0
        while True:
            await asyncio.sleep(0.02)
            due = int((time.monotonic() - begun_s) * LINES_HZ)
            lines = "".join(f"{n % 65536},{n % 7 / 7.0:.4f}\n" for n in range(sent, due))
            sent = due
            with contextlib.suppress(BlockingIOError):  # nobody reads: what is sent is gone
                os.write(self._master, lines.encode())
