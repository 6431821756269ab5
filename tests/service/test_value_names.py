"""A state whose values have names in a DBC file: who reads its value reads the name, too."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.alarm_rig import AlarmRig
from support.live_service import running

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.alarms.make import alarm_rule
from daqsvc.commands.status_text import status_text
from daqsvc.control import ask_status
from daqsvc.settings import parse_machine_file

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.settings import MachineFile

DBC = """VERSION ""
BU_: A
BO_ 800 Drive: 8 A
 SG_ State : 0|8@1+ (1,0) [0|0] "" A
 SG_ Load : 8|8@1+ (1,0) [0|0] "%" A
VAL_ 800 State 0 "Stop" 1 "Run" 2 "Fault" ;
"""
MACHINE = """schema_version = 1
site = "lab"
box = "edge-1"

[machine]
name = "fan"
speed_rpm = 1480.0

[buses.can0]
driver = "can"
interface = "virtual"
channel = "names"

[streams.Drive]
bus = "can0"
rate_hz = 10.0

[streams.Drive.layout]
dbc = "drive.dbc"
message = "Drive"
no_counter = true
channels = [{ name = "State", signals = ["State"] }, { name = "Load", signals = ["Load"] }]

[[sensors]]
name = "drive-state"
type = "trend"
stream = "Drive"
channel = "State"
unit = "1"

[[sensors]]
name = "load"
type = "trend"
stream = "Drive"
channel = "Load"
unit = "%"

[[alarms]]
name = "drive-state"
sensor = "drive-state"
measure = "value"
alert = 0.5
danger = 1.5
deadband = 0.1

[pipeline.levels]
"""


@pytest.fixture
def machine(tmp_path: Path) -> MachineFile:
    (tmp_path / "drive.dbc").write_text(DBC)
    return parse_machine_file(MACHINE, tmp_path / "machine.toml")


@pytest.mark.parametrize(("state", "shown"), [(2.0, "2 (Fault)"), (1.0, "1 (Run)"), (1.8, "1.8"), (7.0, "7")])
def test_the_message_of_an_alarm_has_the_name_of_the_state(
    machine: MachineFile, state: float, shown: str
) -> None:
    [alarm] = machine.alarms
    rig = AlarmRig(alarm_rule(alarm, machine.value_names))
    rig.take_state("drive-state", state, times=2)
    level = "danger limit 1.5" if state > 1.5 else "alert limit 0.5"
    assert f"value of drive-state is {shown}, {level}" in rig.status("drive-state").summary


@pytest.mark.integration
async def test_the_status_has_the_name_of_the_state(machine: MachineFile, tmp_path: Path) -> None:
    async with running(machine, tmp_path / "store") as service:
        now_ns = service.clock.monotonic_ns()
        samples = np.array([[2.0, 2.0]], np.float32)
        service._deliver(SampleBlock("Drive", 0, samples, now_ns, NS_PER_S / 10.0))
        [status] = await asyncio.to_thread(ask_status, tmp_path / "store")
    assert [(one["value"], one["value_name"]) for one in status["channels"]] == [(2.0, "Fault"), (2.0, None)]
    shown = status_text(status, 200)
    assert " 2 (Fault) " in shown
    assert " 2 % " in shown
