"""The simulated serial device and its cable, and how a UART's own counts are read."""

from __future__ import annotations

import array
import os
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import line_layout

from daqsvc.acquisition.clock import DrivenClock
from drivers.serial import reader as serial_reader
from drivers.serial.lines import LineFraming
from sim_hw.nodes.pacing import DrivenPacer
from sim_hw.nodes.serial_node import PseudoTerminal, SerialNode

if TYPE_CHECKING:
    from pathlib import Path

LAYOUT = line_layout(("seq", "x"), ("x",), counter="seq")


def node(cable: PseudoTerminal, samples: np.ndarray, **options) -> SerialNode:
    return SerialNode(cable, LineFraming({"a": LAYOUT}, {"a": 100.0}), "a", LAYOUT, samples, 100.0, **options)


def pacer() -> DrivenPacer:
    return DrivenPacer(DrivenClock(), lambda: 0, 1)


async def test_what_is_sent_can_be_read_at_the_path(tmp_path: Path):
    with PseudoTerminal(tmp_path / "port") as cable:
        port = os.open(cable.path, os.O_RDWR | os.O_NOCTTY)
        device = node(cable, np.array([[5.0], [6.0]]), first_index=41)
        await device.play(pacer())
        heard = b""
        while len(heard) < 26:  # the terminal hands on what it has got so far
            heard += os.read(port, 100)
        assert heard == b"41,5.000000\r\n42,6.000000\r\n"
        os.close(port)
    assert (device.samples_sent, device.frames_unsent, device.duration_ns) == (2, 0, 10_000_000)
    assert not cable.path.is_symlink()


async def test_what_nobody_listens_to_is_gone(tmp_path: Path):
    with PseudoTerminal(tmp_path / "port") as cable:
        device = node(cable, np.zeros((3, 1)))
        await device.play(pacer())
        assert device.frames_unsent == 3
        cable.unplug()
        assert not cable.listening
        with pytest.raises(OSError, match="is unplugged; plug it in"):
            cable.fd  # noqa: B018 - asking is what is tested
        cable.plug()
        port = os.open(cable.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        assert cable.listening
        with pytest.raises(BlockingIOError):
            os.read(port, 1)
        os.close(port)


async def test_a_reader_that_has_stopped_is_named(tmp_path: Path):
    with PseudoTerminal(tmp_path / "port") as cable:
        port = os.open(cable.path, os.O_RDWR | os.O_NOCTTY)
        device = node(cable, np.zeros((20_000, 1)), give_up_s=0.05)
        with pytest.raises(TimeoutError, match="whoever has it open has stopped reading"):
            await device.play(pacer())
        assert device.send_retries > 0
        os.close(port)


def test_samples_that_do_not_fit_are_refused(tmp_path: Path):
    with PseudoTerminal(tmp_path / "port") as cable:
        for wrong in (np.zeros((0, 1)), np.zeros((4, 2)), np.zeros(4)):
            with pytest.raises(ValueError, match="a frame of stream 'a' takes 1 of x"):
                node(cable, wrong)


def test_the_counts_of_a_uart_are_told_apart(monkeypatch: pytest.MonkeyPatch):
    # linux/serial.h: cts, dsr, rng, dcd, rx, tx, frame, overrun, parity, brk, buf_overrun, reserved[9]
    def answer(_fd: int, request: int, counts: array.array) -> int:
        assert request == 0x545D
        counts[:11] = array.array("i", range(100, 111))
        return 0

    monkeypatch.setattr(serial_reader.fcntl, "ioctl", answer)
    assert serial_reader.line_errors(0) == (106, 107 + 110, 108, 109)


def test_a_port_without_such_counts_has_none(tmp_path: Path):
    with PseudoTerminal(tmp_path / "port") as cable:
        assert serial_reader.line_errors(cable.fd) is None
