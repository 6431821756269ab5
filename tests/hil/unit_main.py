"""``daqsvc`` as the unit under test runs it: with a probe of its sandbox, and hanging when it is asked to.

``/etc/daqsvc/hang`` has a process id and what is to hang in it. What the probe has found is ``probe.json`` in
the state directory.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc import kernel_cache
from daqsvc.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable

HANG = Path("/etc/daqsvc/hang")


def is_to_hang(part: str) -> bool:
    try:
        return HANG.read_text() == f"{os.getpid()} {part}"
    except OSError:
        return False


def arrange_to_hang() -> None:
    kernel_cache.prepare()
    from daqsvc.detectors.levels.detector import LevelDetector
    from daqsvc.service import LoopLag

    process, watch = LevelDetector.process, LoopLag.watch

    def process_or_hang(self: LevelDetector, window: Any) -> Any:
        while is_to_hang("detector"):
            time.sleep(0.1)
        return process(self, window)

    async def watch_or_hang(self: LoopLag) -> None:
        loop = asyncio.get_running_loop()

        def look() -> None:
            while is_to_hang("loop"):
                time.sleep(0.1)
            loop.call_later(0.2, look)

        look()
        await watch(self)

    LevelDetector.process, LoopLag.watch = process_or_hang, watch_or_hang  # type: ignore[method-assign]


def outcome(do: Callable[[], object]) -> str:
    try:
        do()
    except OSError as error:
        return type(error).__name__ if error.errno is None else os.strerror(error.errno)
    return "done"


def probe() -> None:
    status = dict(
        line.split(":\t") for line in Path("/proc/self/status").read_text().splitlines() if ":\t" in line
    )
    found: dict[str, Any] = {
        "uid": os.getuid(),
        "groups": os.getgroups(),
        "capabilities": int(status["CapEff"], 16) | int(status["CapBnd"], 16),
        "no_new_privileges": status["NoNewPrivs"],
        "seccomp": status["Seccomp"],
        "write /etc": outcome(lambda: Path("/etc/daqsvc/mine").write_text("")),
        "write /usr": outcome(lambda: Path("/usr/mine").write_text("")),
        "read /root": outcome(lambda: list(Path("/root").iterdir())),
        "packet socket": outcome(lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW).close()),
        "CAN socket": outcome(lambda: socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()),
        "set the clock": outcome(lambda: time.clock_settime(time.CLOCK_REALTIME, time.time())),
        "change the owner": outcome(lambda: os.chown(os.environ["STATE_DIRECTORY"], 0, 0)),
        "write a sysctl": outcome(lambda: Path("/proc/sys/kernel/domainname").write_text("x")),
        "write the state": outcome(lambda: Path(os.environ["STATE_DIRECTORY"], "mine").write_text("")),
        "secret": outcome(lambda: Path(os.environ["CREDENTIALS_DIRECTORY"], "mqtt-password").read_text()),
        "no secret": outcome(lambda: Path(os.environ["CREDENTIALS_DIRECTORY"], "mqtt-key").read_text()),
        "variables": sorted(name for name in os.environ if name.endswith("_DIRECTORY")),
    }
    Path(os.environ["STATE_DIRECTORY"], "probe.json").write_text(json.dumps(found))


if __name__ == "__main__":
    if sys.argv[1:] == ["run", "/etc/daqsvc/pump.toml"] and "STATE_DIRECTORY" in os.environ:
        probe()
        arrange_to_hang()
    sys.exit(main())
