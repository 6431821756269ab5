"""What docs/modbus.md shows can be used as it is, and the counters that it names are there."""

from __future__ import annotations

import re
from dataclasses import fields

from support.machine_files import MACHINES
from support.paths import ROOT

from daqsvc.settings import parse_machine_file
from drivers.base import BusCounters
from drivers.make import stream_layout
from drivers.modbus.replies import ModbusCounters

TEXT = (ROOT / "docs" / "modbus.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
EXAMPLE = MACHINES / "modbus-gap-voltages.toml"
HEAD = EXAMPLE.read_text(encoding="utf-8").split("[buses.io]")[0]


def test_the_blocks_of_the_page_make_a_machine_file():
    bus, *layouts = BLOCKS
    text = HEAD + bus
    for block in layouts:
        name = re.search(r"\[streams\.(\w+)\.layout\]", block)[1]
        channel = re.search(r'name = "(\w+)"', block)[1]
        text += f'\n[streams.{name}]\nbus = "rs485"\nrate_hz = 10.0\n{block}\n'
        text += f'[[sensors]]\nname = "{name}"\ntype = "velocity"\nunit = "mm/s"\n'
        text += f'stream = "{name}"\nchannel = "{channel}"\n'
    machine = parse_machine_file(text, EXAMPLE)
    assert [stream_layout(machine, name).unit for name in machine.streams] == [1, 1]


def test_every_counter_of_a_fault_is_named():
    of_any_bus = {field.name for field in fields(BusCounters)}
    named = re.search(r"Every fault has a counter.*?\n\n", TEXT, re.DOTALL)[0]
    for field in fields(ModbusCounters):
        if field.name not in of_any_bus | {"requests", "replies"}:
            assert f"`{field.name}`" in named or f"`{field.name.removeprefix('replies')}`" in named, (
                field.name
            )
