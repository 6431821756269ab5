"""Lines of pages that need CAN of the kernel, word for word, on an interface called like that of the page."""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT
from support.shown_lines import Shown, shown_lines
from support.shown_output import differs
from support.snippets import documented, simple
from support.vcan_links import VcanLink
from support.waiting import PATIENCE_S, eventually_blocking
from tutorials.reader import NOT_HERE

if TYPE_CHECKING:
    from collections.abc import Iterator

DBC = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"
LINES = [one for one in shown_lines() if one.words[:2] == ["sniff", "can"]]

TIOCSETD, N_SLCAN = 0x5423, 17
BIT_RATES = {500_000: b"S6"}
"""How a serial CAN adapter (SLCAN) is sent its bit rate."""


def log(name: str) -> Iterator[str]:
    """Of an accelerometer, 1000 frames/s, and a device that the DBC file does not know, 10 frames/s."""
    chance = random.Random(1)
    for number in range(25_600):
        axes = (round(chance.gauss(mean, 80)) for mean in (0, 0, 2000))
        payload = bytes([number % 256]) + b"".join(axis.to_bytes(2, "little", signed=True) for axis in axes)
        yield f"({number / 1000:.6f}) {name} 201#{payload.hex()}00\n"
        if number % 100 == 0:
            yield f"({number / 1000:.6f}) {name} 18FF0102#{number // 100:02x}10270000ffffff\n"


@pytest.fixture
def can0(tmp_path: Path) -> Iterator[None]:
    """The interface of the page, and devices that send there for as long as the test lasts."""
    link = VcanLink("can0")
    file = tmp_path / "can0.log"
    file.write_text("".join(log(link.name)))
    player = subprocess.Popen(["canplayer", "-l", "i", "-I", f"{file}"])
    try:
        yield
    finally:
        player.kill()
        player.wait()
        link.close()


@pytest.mark.usefixtures("can0")
@pytest.mark.parametrize("one", LINES, ids=lambda one: one.line)
def test_what_docs_sniff_shows_of_can_runs(one: Shown, tmp_path: Path) -> None:
    for name in ("sensor.dbc", DBC.name):
        shutil.copy(DBC, tmp_path / name)
    done = subprocess.run(
        [sys.executable, "-m", "daqsvc", *one.words],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": f"{ROOT}"}, text=True, check=False, timeout=PATIENCE_S,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    # What comes in some seconds is counted, and the clock of the guest is a slow one.
    assert differs(one.output or "", done.stdout, figures=False) == ""


@pytest.fixture
def adapter() -> Iterator[list[bytes]]:
    """A serial CAN adapter as can0, which is down; what the kernel sends it."""
    subprocess.run(["modprobe", "slcan"], check=True)
    before = {one.name for one in Path("/sys/class/net").iterdir()}
    reads, port = os.openpty()
    fcntl.ioctl(port, TIOCSETD, struct.pack("i", N_SLCAN))
    [made] = {one.name for one in Path("/sys/class/net").iterdir()} - before
    if made != "can0":
        subprocess.run(["ip", "link", "set", made, "name", "can0"], check=True)
    came: list[bytes] = []

    def read() -> None:
        with contextlib.suppress(OSError):  # the other end is closed
            while True:
                came.append(os.read(reads, 4096))

    # Beside the command: the kernel waits until the adapter has taken what it sends.
    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield came
    finally:
        os.close(port)
        reader.join(PATIENCE_S)
        os.close(reads)


def test_the_bit_rate_of_the_tutorial_is_set(adapter: list[bytes]) -> None:
    """Any controller that takes a bit rate from the kernel: this one is at the other end of a terminal."""
    [line] = [begin for page, begin in NOT_HERE if page == "05-can.md"]
    subprocess.run(line.split(), check=True)
    eventually_blocking(lambda: b"O\r" in b"".join(adapter), "the adapter is switched on")
    assert BIT_RATES[int(line.split()[-1])] in b"".join(adapter).split(b"\r")
    shown = subprocess.check_output(["ip", "-details", "link", "show", "can0"], text=True)
    assert ",UP" in shown
    assert "bitrate 500000" in shown


def test_what_docs_can_shows_of_candump_runs() -> None:
    [line] = [
        words
        for block in documented()
        if block.page.name == "can.md"
        for command in block.commands
        for words in simple(command)
        if words[0] == "candump"
    ]
    link = VcanLink("can0")
    try:
        with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as running:
            assert running.stdout is not None
            until = time.monotonic() + PATIENCE_S
            while not select.select([running.stdout], [], [], 0.2)[0]:
                assert time.monotonic() < until
                subprocess.run(["cansend", "can0", "201#0102"], check=True)
            assert running.stdout.readline().split() == ["can0", "201", "[2]", "01", "02"]
            running.terminate()
    finally:
        link.close()
