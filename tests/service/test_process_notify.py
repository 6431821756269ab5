"""The process of ``daqsvc run`` under a service manager: ready, alive, stalled, stopping."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
import tty
from typing import TYPE_CHECKING, Self

import pytest
from support.machine_files import LAVAL
from support.notify_sockets import NotifySocket
from support.ports import free_port
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.integration
WATCHDOG_S = 4.0

MAIN = """
import os, sys, threading, time
from daqsvc.cli import main
{fault}
sys.exit(main(sys.argv[1:]))
"""

CASING = """
[buses.casing]
driver = "serial"
port = "{port}"
baud = 115_200
framing = "lines"
start = "error"

[streams.casing]
bus = "casing"
rate_hz = 100.0

[streams.casing.layout]
line = ["seq", "v"]
counter = {{ column = "seq", bits = 16 }}
channels = [{{ name = "v" }}]

[[sensors]]
name = "casing-v"
type = "accelerometer"
stream = "casing"
channel = "v"
unit = "g"

[[alarms]]
name = "casing"
sensor = "casing-v"
measure = "rms"
alert = 5.0

"""

HANGS = {
    "detector levels/casing": (
        "from daqsvc.detectors.levels.detector import LevelDetector\n"
        "process = LevelDetector.process\n"
        "def hang(self, window):\n"
        "    while os.path.exists(sys.argv[2] + '.hang') and window.samples.shape[1] == 1: time.sleep(0.1)\n"
        "    return process(self, window)\n"
        "LevelDetector.process = hang\n"
    ),
    "driver casing": (
        "from drivers.serial.reader import SerialReader\n"
        "drain = SerialReader._drain\n"
        "def hang(self):\n"
        "    while os.path.exists(sys.argv[2] + '.hang'): time.sleep(0.1)\n"
        "    drain(self)\n"
        "SerialReader._drain = hang\n"
    ),
    "outbox": (
        "from daqsvc.outbox.writer import JournalWriter\n"
        "perform = JournalWriter._perform\n"
        "def hang(self, *args):\n"
        "    while os.path.exists(sys.argv[2] + '.hang'): time.sleep(0.1)\n"
        "    return perform(self, *args)\n"
        "JournalWriter._perform = hang\n"
    ),
    "the event loop": (
        "from daqsvc.service import LoopLag\n"
        "watch = LoopLag.watch\n"
        "async def hang(self):\n"
        "    import asyncio\n"
        "    def look():\n"
        "        while os.path.exists(sys.argv[2] + '.hang'): time.sleep(0.1)\n"
        "        asyncio.get_running_loop().call_later(0.1, look)\n"
        "    look()\n"
        "    await watch(self)\n"
        "LoopLag.watch = hang\n"
    ),
}


class Casing(threading.Thread):
    """A device on a serial line that sends a hundred lines a second, from when it is told to."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self.sends, self.value, self._over = threading.Event(), 1.0, threading.Event()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Take the device away."""
        if self._over.is_set():
            return
        self._over.set()
        self.sends.set()
        self.join()
        os.close(self._master)
        os.close(self._slave)

    def run(self) -> None:
        self.sends.wait()
        begun_s, sent = time.monotonic(), 0
        while not self._over.wait(0.05):
            due = int((time.monotonic() - begun_s) * 100.0)
            lines = "".join(f"{n % 65536},{self.value * (-1) ** n:.3f}\n" for n in range(sent, due))
            sent = due
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, lines.encode())


def machine_file(tmp_path: Path, port: str) -> Path:
    text = LAVAL.read_text().replace('interface = "socketcan"', 'interface = "virtual"')
    text = re.sub(r"^url = .*$", f'url = "mqtt://127.0.0.1:{free_port()}"', text, flags=re.MULTILINE)
    text = re.sub(r"^(ca_file|username|password_file) = .*$", "", text, flags=re.MULTILINE)
    text = re.sub(
        r"^\[mqtt\]", f"{CASING.format(port=port)}[mqtt]\ninsecure = true", text, flags=re.MULTILINE
    )
    text = text.replace("window_s = 0.5", "window_s = 0.5\nvelocity_band_hz = [10.0, 40.0]")
    file = tmp_path / "rig.toml"
    file.write_text(text)
    return file


@contextlib.contextmanager
def service(
    tmp_path: Path, systemd: NotifySocket, casing: Casing, fault: str = ""
) -> Iterator[subprocess.Popen[str]]:
    """A service that tells how it is; killed at the end if need be. Its log is the file ``log``."""
    arguments = ["run", str(machine_file(tmp_path, casing.port)), "--store", str(tmp_path / "store"), "-v"]
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": f"{round(WATCHDOG_S * 1e6)}"}
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", MAIN.format(fault=fault), *arguments],
            stderr=log,
            text=True,
            env=os.environ | environment,
        )
    systemd.listens_to = process
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def log_of(tmp_path: Path) -> str:
    return (tmp_path / "log").read_text()


@pytest.mark.long
def test_it_is_ready_when_what_it_must_have_delivers_and_tells_how_it_stands(tmp_path: Path) -> None:
    with (
        NotifySocket(None) as systemd,
        Casing() as casing,
        service(tmp_path, systemd, casing) as process,
    ):
        systemd.until("STATUS", "starting: ")
        systemd.until("EXTEND_TIMEOUT_USEC")
        systemd.until("STATUS", "waiting for bus casing: no samples have come yet")
        # A reload is no reason to be ready, nor does it end the waiting.
        file = tmp_path / "rig.toml"
        file.write_text(file.read_text().replace("alert = 5.0", "alert = 4.0"))
        process.send_signal(signal.SIGHUP)
        systemd.until("STATUS", "reloaded")
        assert not systemd.has_told("RELOADING")
        systemd.until("STATUS", "waiting for bus casing: no samples have come yet")
        time.sleep(1.0)
        assert not systemd.has_told("READY")
        assert not systemd.has_told("WATCHDOG")
        casing.sends.set()
        assert systemd.until("READY") == "1"
        said = systemd.told[-1]["STATUS"]
        assert re.fullmatch(
            r"2 of 2 buses up; alarms: [\w ]+; broker not connected( \(.*\))?; \d+ alarm messages? waits? "
            r"for the broker",
            said,
        ), said
        for _ in range(3):
            systemd.until("WATCHDOG")
        casing.close()
        said = systemd.until("STATUS", "1 of 2 buses up (casing: ")
        assert "it has hung up" in said or "it is gone" in said or "cannot be opened" in said, said
        process.send_signal(signal.SIGTERM)
        systemd.until("STOPPING")
        assert process.wait(PATIENCE_S) == 0, log_of(tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(
    "part",
    ["detector levels/casing", *(pytest.param(n, marks=pytest.mark.long) for n in [*HANGS][1:])],
)
def test_a_part_that_hangs_ends_the_signs_of_life_and_is_named(part: str, tmp_path: Path) -> None:
    hang = tmp_path / "rig.toml.hang"
    with NotifySocket(tmp_path) as systemd, Casing() as casing:
        casing.sends.set()
        with service(tmp_path, systemd, casing, HANGS[part]) as process:
            systemd.until("READY")
            systemd.until("WATCHDOG")
            hang.touch()
            silent_s = time.monotonic()
            while systemd.next(0.2) is None or time.monotonic() - silent_s < 4 * WATCHDOG_S:
                if "has stalled" in log_of(tmp_path) or "has been blocked" in log_of(tmp_path):
                    break
                assert time.monotonic() - silent_s < PATIENCE_S, "nothing was said"
            systemd.has_told("WATCHDOG")
            systemd.told.clear()
            time.sleep(1.5 * WATCHDOG_S)
            assert not systemd.has_told("WATCHDOG"), "systemd hears nothing of it any more"
            assert process.poll() is None
            said = log_of(tmp_path)
            assert said.count("has stalled") + said.count("has been blocked") == 1, said
            assert re.search(
                rf"CRITICAL {part} has (stalled, without a step for 4 s|been blocked for 2 s): ", said
            )
            hang.unlink()
            systemd.until("WATCHDOG")
