"""Simulated devices on a CAN interface of the kernel that is taken away under them."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from support.vcan_links import VcanLink

MOTOR = Path(__file__).parents[2] / "config" / "machines" / "motor-accelerometer.toml"
RATE_HZ, FRAME_HZ = 12_000, 400
PLAYED_S, OUTAGE_S = 8.0, 3.0
PATIENCE_S = 90.0


def await_frame(vcan: VcanLink) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as reader:
        reader.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        reader.bind((vcan.name,))
        reader.settimeout(PATIENCE_S)
        reader.recv(128)


@pytest.mark.timeout(250)
@pytest.mark.parametrize("how", ["removed", "down"])
def test_what_is_due_while_the_interface_is_away_is_not_sent_late(
    vcan: VcanLink, tmp_path: Path, how: str
) -> None:
    np.savez(tmp_path / "motor.npz", de=np.zeros(RATE_HZ))
    machine = tmp_path / "machine.toml"
    machine.write_text(MOTOR.read_text().replace('channel = "can0"', f'channel = "{vcan.name}"'))
    recording = ("--recording", tmp_path / "motor.npz", "--map", "accel-de=de", "--fs", RATE_HZ)
    command = [sys.executable, "-m", "daqsvc", "sim", machine, *recording, "--duration", PLAYED_S]
    with subprocess.Popen(
        [str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as sim:
        try:
            await_frame(vcan)
            time.sleep(1.0)
            (vcan.remove if how == "removed" else vcan.down)()
            since_s = time.monotonic()
            time.sleep(OUTAGE_S)
            away_s = time.monotonic() - since_s
            (vcan.add if how == "removed" else vcan.up)()
            await_frame(vcan)
            output, errors = sim.communicate(timeout=PATIENCE_S)
        finally:
            sim.kill()
    assert sim.returncode == 0, errors
    sent = json.loads(output)["streams"]["drive-end"]
    assert sent["samples_sent"] == PLAYED_S * RATE_HZ
    assert sent["frames_sent"] + sent["frames_unsent"] == PLAYED_S * FRAME_HZ
    # All of the outage, but for what a busy machine is behind with when it begins.
    assert sent["frames_unsent"] > 0.8 * away_s * FRAME_HZ
    # It is said once, and not at each attempt to open the interface.
    said = errors.splitlines()
    assert len(said) == 2, errors
    assert said[0].startswith("daqsvc sim: playing drive-end")
    assert "is lost to the node of frame 0x110" in said[1]
