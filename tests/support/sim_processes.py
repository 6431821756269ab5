"""``daqsvc sim`` as a separate process, for the tests of what it plays."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any

from support.paths import ROOT
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator

VIRTUAL_RIG = ROOT / "config" / "machines" / "virtual-rig.toml"
DOCUMENTATION = ROOT / "docs" / "virtual-bus.md"
SCENARIOS = ROOT / "config" / "scenarios"
PER_FRAME = 10
"""Samples in a frame of the virtual rig."""

BAD_LINK = """
title = "A healthy rotor on a bad bus"
revolutions = 70.0
samples_per_rev = 64
[plant]
kind = "rotor"
[[fault]]
kind = "drift"
ppm = 60.0
[[fault]]
kind = "link"
from_s = 1.0
to_s = 5.0
drop = 0.08
duplicate = 0.08
corrupt = 0.08
[[fault]]
kind = "delay"
from_s = 2.0
to_s = 4.0
delay_ms = 2.0
jitter_ms = 3.0
[[fault]]
kind = "silence"
from_s = 5.2
to_s = 5.6
[[fault]]
kind = "babble"
from_s = 3.0
to_s = 4.0
rate_hz = 400.0
"""


@contextlib.contextmanager
def process(verb: str, *arguments: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A ``daqsvc`` that is ended with the test, however that ends; ``options`` are those of `Popen`."""
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, "-m", "daqsvc", verb, *map(str, arguments)]
    running: subprocess.Popen[str] = subprocess.Popen(command, **(piped | options))
    try:
        yield running
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate()


async def summary_of(sim: subprocess.Popen[str]) -> dict[str, Any]:
    """What a simulator prints at its end."""
    output, errors = await asyncio.to_thread(sim.communicate, timeout=PATIENCE_S)
    assert sim.returncode == 0, errors
    told: dict[str, Any] = json.loads(output)
    return told
