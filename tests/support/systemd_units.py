"""Units under a systemd of their own, in a guest: what tests ask of them, and the shaft that they watch."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from daqsvc.outbox.reading import JOURNAL_NAME, read_journal
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import to_frames

if TYPE_CHECKING:
    from support.vcan_links import VcanLink

UNIT = "daqsvc@pump"
STORE = Path("/var/lib/daqsvc/pump")
PATIENCE_S = 60.0
RATE_HZ = 640
OF_A_LOGIN = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LANG": "C.UTF-8"}
"""What root has on a box, and nothing of the tests."""
IN_A_GUEST = pytest.mark.skipif(
    os.environ.get("DAQSVC_HIL_SYSTEMD") != "1", reason="needs a separate systemd: make hil"
)


def sh(*command: object, cwd: Path | None = None) -> str:
    """What a program of the box prints."""
    done = subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, env=OF_A_LOGIN, cwd=cwd
    )
    assert done.returncode == 0, f"{command}: {done.returncode}: {done.stdout}{done.stderr}"
    return done.stdout


def let_go_of_files() -> None:
    """Have the guest's kernel forget files that nobody has open: each that it remembers is open on the host.

    Packages and searches look at more than the 20,000 that a process there may have.
    """
    Path("/proc/sys/vm/drop_caches").write_text("2\n")


def shown(unit: str = UNIT) -> dict[str, str]:
    """The state of a unit for systemd."""
    keys = "ActiveState,SubState,MainPID,NRestarts,Result,StatusText,ExecMainStatus"
    return dict(line.split("=", 1) for line in sh("systemctl", "show", unit, "-p", keys).splitlines())


def journal(unit: str = UNIT, least: str = "debug") -> str:
    """What the journal has of a unit, from a level on."""
    return sh("journalctl", "-u", unit, "--no-pager", "-o", "cat", "-p", least)


def until(true: Any, what: str) -> Any:
    """What ``true`` returns, once it is true."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        if result := true():
            return result
        time.sleep(0.1)
    pytest.fail(f"not within {PATIENCE_S:g} s: {what}; {shown()}\n{journal()[-3000:]}")


def say(figure: str) -> None:
    """Into the log of `make hil`, whatever pytest captures."""
    with contextlib.suppress(OSError), Path(os.environ["HIL_OUT"], "console").open("a") as console:
        console.write(f"\n{figure}\n")


def messages(store: Path = STORE, history: int = 0) -> list[dict[str, Any]]:
    """The newest event of each alarm by the journal, which its own account may read, or so many of all."""
    if not (store / JOURNAL_NAME).exists():
        return []
    os.seteuid(store.stat().st_uid)
    try:
        view = read_journal(store, history=history)
    finally:
        os.seteuid(0)
    return [json.loads(message.payload) for message in (view.history if history else view.latest)]


def alarm(name: str, store: Path = STORE) -> dict[str, Any] | None:
    """The state of an alarm."""
    stands = next((one for one in messages(store) if one.get("alarm") == name), None)
    return stands and {key: stands[key] for key in ("state", "level", "occurrence", "time")}


class Shaft(threading.Thread):
    """The probes of the rig at 600 rpm, its critical speed, on a CAN interface, until the end.

    The rotor is the healthy one of the machine file: an orbit of 10 um / (2 * 0.18), a quarter of a turn
    behind the heavy spot, about a shaft that sags by 10 um.
    """

    def __init__(self, machine: Path, link: VcanLink) -> None:
        super().__init__(daemon=True)
        self._layout = frame_layout(load_machine_file(machine), "shaft")
        self._link = link
        self._over = threading.Event()

    def run(self) -> None:
        turns = np.arange(RATE_HZ) / 64.0
        rng = np.random.default_rng(3)
        waves = {
            "x": 10.0 / 0.36 * np.sin(2 * np.pi * turns),
            "y": -10.0 / 0.36 * np.cos(2 * np.pi * turns) - 10.0,
            "kph": np.where(turns % 1.0 < 0.1, -2.0, -10.0),
        }
        samples = np.stack([waves[n] + rng.normal(0.0, 0.02, RATE_HZ) for n in self._layout.channels], axis=1)
        begun_s, second = time.monotonic(), 0
        with self._link.sender() as sender:
            while not self._over.is_set():
                frames = to_frames(samples, self._layout, RATE_HZ, first_index=second * RATE_HZ).payloads
                for n, payload in enumerate(frames):
                    due_s = begun_s + second + (n + 1) / len(frames)
                    time.sleep(max(0.0, due_s - time.monotonic()))
                    head = (0x101).to_bytes(4, sys.byteorder) + bytes([len(payload), 0, 0, 0])
                    sender.send(head + payload.tobytes())
                second += 1

    def stop(self) -> None:
        self._over.set()
        self.join()
