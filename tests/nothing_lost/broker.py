"""A broker in a process of its own that is stopped, killed and started on the same port."""

from __future__ import annotations

import asyncio
import itertools
import os
import shutil
import signal
import socket
import sys
import time
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pathlib import Path

LOOPBACK = "127.0.0.1"
PATIENCE_S = 60.0
BrokerName = Literal["mosquitto", "amqtt"]

# Below the ports that the system gives to connections: while a broker is down, none takes its port.
_PORTS = itertools.cycle(range(12_000 + 37 * (os.getpid() % 400), 30_000))

MOSQUITTO = """
listener {port} 127.0.0.1
allow_anonymous true
persistence false
{user}
"""


def mosquitto_program() -> str | None:
    """The Mosquitto of this machine, if there is one."""
    return shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")


def signal_child(process: asyncio.subprocess.Process, number: signal.Signals) -> bool:
    """Send a signal to a child, if it still runs; whether it does.

    Its own ``send_signal`` would look whether it has ended, and so take the exit status from asyncio.
    """
    if process.returncode is not None:
        return False
    try:
        os.kill(process.pid, number)
    except ProcessLookupError:
        return False
    return True


def unused_port() -> int:
    """A port that nobody has, and that stays free while whoever listens there is away."""
    for port in _PORTS:
        with socket.socket() as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue
            return port
    raise AssertionError


class Broker:
    """One broker without persistence: whatever way it ends, it forgets everything."""

    def __init__(
        self, name: BrokerName, directory: Path, environment: dict[str, str], *, verbose: bool = True
    ) -> None:
        self.port = unused_port()
        self._environment = environment
        self._log = directory / f"{name}.log"
        self._process: asyncio.subprocess.Process | None = None
        if name == "amqtt":
            self._command = [sys.executable, "-m", "nothing_lost.amqtt_broker", str(self.port)]
        else:
            program = mosquitto_program()
            assert program is not None, "mosquitto is missing (apt-get install mosquitto)"
            config = directory / "mosquitto.conf"
            user = "user root" if os.geteuid() == 0 else ""
            config.write_text(MOSQUITTO.format(port=self.port, user=user))
            self._command = [program, "-c", str(config), *(["-v"] if verbose else [])]

    async def start(self) -> None:
        """Start it and wait until it listens."""
        with self._log.open("ab") as log:
            self._process = await asyncio.create_subprocess_exec(
                *self._command, stdout=log, stderr=log, env=self._environment
            )
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until and self._process.returncode is None:
            try:
                _, writer = await asyncio.open_connection(LOOPBACK, self.port)
            except OSError:
                await asyncio.sleep(0.02)
            else:
                writer.close()
                return
        raise RuntimeError(f"{self._command[0]} did not start; see {self._log}")

    async def kill(self) -> None:
        """End it at once."""
        if self._process is not None:
            self._signal(signal.SIGKILL)
            await self._process.wait()
            self._process = None

    def freeze(self) -> None:
        """Stop it without closing anything: it accepts connections and answers nobody."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None:
            signal_child(self._process, number)
