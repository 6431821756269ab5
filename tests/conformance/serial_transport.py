"""Serial ports over pseudo-terminals, with a plug that a test can pull: COBS, sync words, and lines."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np
from cobs import cobs
from conformance.faulty_device import FaultyDevice
from conformance.transport import CHANNELS, STREAM, SimulatedTime
from support.bus_tables import line_layout, serial_bus

from daqsvc.acquisition.clock import NS_PER_S
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.serial.binary import CobsFraming
from drivers.serial.driver import SerialDriver, framing_of
from drivers.serial.lines import LineFraming
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy
    from drivers.serial.settings import LineLayout, SerialBus

RATE_HZ = 1000.0
SAMPLE_BYTE = 8
"""A byte that lies in the samples of a binary frame, with and without its sync word."""


def packed(per_frame: int) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=0,
        length=4 + 4 * per_frame,
        channels=[(name, 16, "signed", 1.0, 0.0) for name in CHANNELS],
        samples_per_frame=per_frame,
        counter_byte=0,
        counter_bits=32,
        first_byte=4,
    )


LINES = line_layout(("seq", *CHANNELS), CHANNELS, counter="seq")


class CableDevice(FaultyDevice):
    def __init__(self, cable: PseudoTerminal, bus: SerialBus, spec: StreamSpec[Any]) -> None:
        super().__init__(spec.layout.samples_per_frame)
        self.cable = cable
        self._framing = framing_of(bus, [spec])

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        index = np.array([first_index], np.int64)
        frame = self._framing.encode(STREAM, index, samples[None])[0]
        if corrupt:
            frame = self._spoil(frame)
        taken = self.cable.send(frame)
        if self.cable.pending:  # the rest of a frame follows as soon as there is room
            asyncio.get_running_loop().add_writer(self.cable.fd, self._push)
        return taken

    def _push(self) -> None:
        if self.cable.flush():
            asyncio.get_running_loop().remove_writer(self.cable.fd)

    def _spoil(self, frame: bytes) -> bytes:
        if isinstance(
            self._framing, CobsFraming
        ):  # not through the stuffing: that would make two frames of it
            return cobs.encode(_flipped(cobs.decode(frame[:-1]), SAMPLE_BYTE)) + b"\0"
        if isinstance(self._framing, LineFraming):  # the last digit before the checksum
            return _flipped(frame, frame.rindex(b"*") - 1)
        return _flipped(frame, SAMPLE_BYTE)

    def go_away(self) -> None:
        super().go_away()
        self.unplug()

    def unplug(self) -> None:
        if self.cable.plugged:
            asyncio.get_running_loop().remove_writer(self.cable.fd)
        self.cable.unplug()

    def come_back(self) -> None:
        super().come_back()
        self.cable.plug()

    def close(self) -> None:
        self.unplug()


def _flipped(data: bytes, place: int) -> bytes:
    spoilt = bytearray(data)
    spoilt[place] ^= 1
    return bytes(spoilt)


class SerialTransport:
    """See `conformance.transport.Transport`."""

    rate_hz = RATE_HZ
    counter_modulus = 2**32
    jitter_ns = 1000
    latency_ns = 0
    poll_ns = 0
    overflow_frames = 40_000
    cannot = {}  # noqa: RUF012

    def __init__(self, name: str, layout: FrameLayout | LineLayout, folder: Path, **options: str) -> None:
        self.name = name
        self.samples_per_frame = layout.samples_per_frame
        self.time = SimulatedTime()
        self._path = folder / "port"
        self._bus = serial_bus(port=str(self._path), **options)
        window_ns = 3 * layout.samples_per_frame * round(NS_PER_S / RATE_HZ)
        self._spec: StreamSpec[Any] = StreamSpec(STREAM, layout, RATE_HZ, window_ns)

    async def start(self) -> None:
        self.device = CableDevice(PseudoTerminal(self._path), self._bus, self._spec)

    async def stop(self) -> None:
        self.device.unplug()

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> SerialDriver:
        return SerialDriver(self._bus, BusPort("ser0", [self._spec], self.time.clock, deliver, start))


TRANSPORTS: dict[str, Callable[[Path], SerialTransport]] = {
    "serial COBS": lambda folder: SerialTransport("serial COBS", packed(10), folder, framing="cobs"),
    "serial sync": lambda folder: SerialTransport(
        "serial sync", packed(10), folder, framing="sync", sync_word="a55a"
    ),
    "serial lines": lambda folder: SerialTransport(
        "serial lines", LINES, folder, framing="lines", checksum="crc16"
    ),
}
