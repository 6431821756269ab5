"""The lines of docs/sniff.md about CAN, word for word, on an interface called like that of the page."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT
from support.shown_lines import Shown, shown_lines
from support.shown_output import differs
from support.vcan_links import VcanLink
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

DBC = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"
LINES = [one for one in shown_lines() if one.words[:2] == ["sniff", "can"]]


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
    assert differs(one.output or "", done.stdout) == ""
