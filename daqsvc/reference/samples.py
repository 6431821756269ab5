"""Services of the examples, never started: what they count and name is what any service can have."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import daqsvc
from daqsvc.box import Box
from daqsvc.service import Service
from daqsvc.settings import MachineFile, parse_machine_file

EXAMPLES = Path(daqsvc.__file__).parent / "examples" / "machines"
FULL = "virtual-rig"
"""The example that gets every output."""
_DRIVERS = ("rotor-two-buses", "modbus-vibration-temperature", "serial-probes", "replay-fan")
"""With `FULL`, a bus of each driver, and sensors on several buses."""
_OUTPUTS = """
[mqtt.commands]
enabled = true
allow = ["acknowledge", "reset"]
[mqtt.home_assistant]
[mqtt.sparkplug]
[mqtt.live]
[metrics]
[history]
[page]
[recorder]
"""


@cache
def machine_files() -> tuple[MachineFile, ...]:
    """The examples, the one with every output first."""
    made = []
    for name in (FULL, *_DRIVERS):
        path = EXAMPLES / f"{name}.toml"
        more = _OUTPUTS if name == FULL else ""
        made.append(parse_machine_file(path.read_text(encoding="utf-8") + more, path))
    return tuple(made)


@cache
def services() -> tuple[Service, ...]:
    """A service of each, in a store that is gone: it is asked for names only."""
    made = []
    for machine in machine_files():
        with tempfile.TemporaryDirectory() as store:
            made.append(Service(Box.single(machine), Path(store)))
    return tuple(made)
