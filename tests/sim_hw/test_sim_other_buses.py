"""``daqsvc sim`` on serial lines and Modbus, and what the service makes of what it plays."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from support.live_service import running
from support.ports import free_port
from support.sim_processes import PER_FRAME, VIRTUAL_RIG, process, summary_of

from daqsvc.settings import load_machine_file

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
SERIAL = """
[buses.probes]
driver = "serial"
port = "{port}"
baud = 921600
framing = "cobs"
[streams.shaft]
bus = "probes"
rate_hz = 640.0
[streams.shaft.layout]
payload_length = 64
counter = {{ byte = 0, bits = 32, counts = "samples" }}
first_byte = 4
samples_per_frame = 10
channels = [
  {{ name = "x", type = "int16", scale = 0.001 }},
  {{ name = "y", type = "int16", scale = 0.001 }},
  {{ name = "kph", type = "int16", scale = 0.001 }},
]
"""


def machine_text(buses: str) -> str:
    """The virtual rig on other buses."""
    text = VIRTUAL_RIG.read_text()
    before, rest = text.split("[buses.can0]", 1)
    _, after = rest.split("[[sensors]]", 1)
    return re.sub(r"\[mqtt\].*", "", before + buses + "[[sensors]]" + after, flags=re.DOTALL)


@pytest.fixture
def serial_file(tmp_path: Path) -> Path:
    file = tmp_path / "serial.toml"
    file.write_text(machine_text(SERIAL.format(port=tmp_path / "ttyProbes")))
    return file


@pytest.mark.long
async def test_a_serial_device_behind_a_pseudo_terminal(
    tmp_path: Path, bad_link: Path, serial_file: Path
) -> None:
    file, machine = serial_file, load_machine_file(serial_file)
    async with running(machine, tmp_path / "store") as service:
        with process("sim", file, "--scenario", bad_link) as sim:
            summary = await summary_of(sim)
        sent = summary["streams"]["shaft"]
        counted = service.figures()["streams"]["shaft"]
    assert summary["buses"] == {"probes": str(tmp_path / "ttyProbes")}
    assert sent["injected"]["silenced"] > 10
    assert sent["frames_unsent"] == 0
    assert counted["samples_received"] + counted["samples_lost"] == sent["samples_sent"] == 4480
    injected = sent["injected"]
    lost = injected["dropped"] + injected["silenced"] + injected["corrupted"]
    assert counted["samples_lost"] == PER_FRAME * lost
    assert counted["frames_duplicate"] == injected["duplicated"]
    assert not (tmp_path / "ttyProbes").is_symlink()


MODBUS = """
[buses.line]
driver = "modbus"
transport = "{transport}"
{place}
timeout_ms = 300.0
[streams.shaft]
bus = "line"
rate_hz = 640.0
[streams.shaft.layout]
way = "ring"
unit = 1
count = {{ address = 0, bits = 32 }}
address = 16
depth = 16384
poll_ms = 20.0
channels = [
  {{ name = "x", place = 0, type = "int16", scale = 0.001 }},
  {{ name = "y", place = 1, type = "int16", scale = 0.001 }},
  {{ name = "kph", place = 2, type = "int16", scale = 0.001 }},
]
"""
BAD_REPLIES = """
title = "A healthy rotor behind a bad line"
revolutions = 70.0
[plant]
kind = "rotor"
[[fault]]
kind = "link"
from_s = 1.0
to_s = 6.0
drop = 0.03
corrupt = 0.03
[[fault]]
kind = "delay"
from_s = 2.0
to_s = 4.0
delay_ms = 5.0
"""


@pytest.fixture(params=["tcp", "rtu"])
def modbus_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    (tmp_path / "replies.toml").write_text(BAD_REPLIES)
    place = {
        "tcp": f'host = "127.0.0.1"\ntcp_port = {free_port()}',
        "rtu": f'serial_port = "{tmp_path / "ttyLine"}"\nbaud = 115200\nparity = "none"',
    }[request.param]
    file = tmp_path / "modbus.toml"
    file.write_text(machine_text(MODBUS.format(transport=request.param, place=place)))
    return file


@pytest.mark.long
async def test_a_modbus_unit_hands_out_every_sample_however_bad_its_replies(
    tmp_path: Path, modbus_file: Path
) -> None:
    machine = load_machine_file(modbus_file)
    async with running(machine, tmp_path / "store") as service:
        with process("sim", modbus_file, "--scenario", tmp_path / "replies.toml") as sim:
            summary = await summary_of(sim)
        sent = summary["streams"]["shaft"]
        counted = service.figures()["streams"]["shaft"]
    injected = sent["injected"]
    assert injected.keys() >= {"dropped", "corrupted", "delayed"}
    # The ring holds 25 s: what is not read by one request is read by the next.
    assert counted["samples_lost"] == 0
    assert counted["samples_received"] == sent["samples_sent"] == 4480
