"""A CAN gateway that speaks the protocol of socketcand over TCP: frames for a service in another process."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from support.ports import LOOPBACK

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

FRAME_ID = 0x101
SAMPLES_PER_FRAME = 3
RATE_HZ = 600.0
FRAME_S = SAMPLES_PER_FRAME / RATE_HZ
SCALE_G = 0.001

MACHINE = """
schema_version = 1
site = "lab"
box = "edge-1"

[machine]
name = "motor"
speed_rpm = 1800.0

[buses.can0]
driver = "can"
interface = "socketcand"
channel = "can0"
options = {{ host = "127.0.0.1", port = {gateway} }}

[streams.shaking]
bus = "can0"
rate_hz = 600.0

[streams.shaking.layout]
id = 0x101
length = 8
counter = {{ byte = 0, bits = 16, counts = "samples" }}
first_byte = 2
samples_per_frame = 3
channels = [{{ name = "de", type = "int16", scale = 0.001 }}]

[[sensors]]
name = "accel"
type = "accelerometer"
stream = "shaking"
channel = "de"
unit = "g"

[pipeline]
ring_s = 20.0

[pipeline.levels]
window_s = 0.5
velocity_band_hz = [10.0, 250.0]

{alarms}

[mqtt]
url = "mqtt://127.0.0.1:{broker}"
insecure = true
protocol = "3.1.1"
"""
"""A machine file for what the gateway sends; fill in ``gateway``, ``broker`` (ports) and ``alarms``."""


class CanGateway:
    """Sends an accelerometer's samples to whoever connects, in real time, for as long as it is entered.

    Attributes:
        rms_g: how much it shakes.
        lossy: while true nobody is sent anything, and the device goes on counting.
        frames_withheld: frames that nobody was sent for that reason.
    """

    def __init__(self) -> None:
        self.rms_g = 0.1
        self.lossy = False
        self.frames_withheld = 0
        self._counter = 0
        self._random = np.random.default_rng(0)
        self._writers: list[asyncio.StreamWriter] = []
        self._server: Any = None
        self._sending: Any = None

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._greet, LOOPBACK, 0)
        self._sending = asyncio.create_task(self._send(), name="gateway")
        return self

    async def __aexit__(self, *_: object) -> None:
        self._sending.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._sending
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()
        await self._server.wait_closed()

    @property
    def port(self) -> int:
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    @contextlib.asynccontextmanager
    async def losing(self) -> AsyncIterator[None]:
        """What is sent meanwhile is lost."""
        self.lossy = True
        try:
            yield
        finally:
            self.lossy = False

    async def _greet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"< hi >")
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            for _ in ("open", "rawmode"):
                await reader.readuntil(b">")
                writer.write(b"< ok >")
            await asyncio.sleep(0.1)  # the client wants the last "ok" by itself
            self._writers.append(writer)

    async def _send(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            due_s += FRAME_S
            await asyncio.sleep(max(due_s - loop.time(), 0))
            frame = self._next_frame()
            if self.lossy:
                self.frames_withheld += 1
                continue
            self._writers = [writer for writer in self._writers if not writer.transport.is_closing()]
            for writer in self._writers:
                writer.write(frame)

    def _next_frame(self) -> bytes:
        samples = self._random.normal(scale=self.rms_g, size=SAMPLES_PER_FRAME) / SCALE_G
        payload = np.concatenate([[self._counter], samples.clip(-32_000, 32_000)]).astype("<i8")
        self._counter = (self._counter + SAMPLES_PER_FRAME) % 65_536
        return f"< frame {FRAME_ID:03X} 0.000000 {payload.astype('<u2').tobytes().hex()} >".encode()


@contextlib.asynccontextmanager
async def daqsvc_run(file: Path, store: Path, *more: str) -> AsyncIterator[subprocess.Popen[bytes]]:
    """``daqsvc run`` in a separate process; it is stopped at the end. Its log is beside the store.

    Args:
        file: the machine file.
        store: directory of the journal.
        more: options; ``-v`` if left out.
    """
    command = [sys.executable, "-m", "daqsvc", "run", str(file), "--store", str(store), *(more or ["-v"])]
    with (
        (store.parent / "log").open("wb") as log,
        subprocess.Popen(command, stderr=log) as process,  # noqa: ASYNC220 - it takes no time
    ):
        try:
            yield process
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            await asyncio.to_thread(process.wait, 10)
